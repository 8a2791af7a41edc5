"""A depth prior straight from the ONNX file of a network."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_adapter import fixed_size
from mvdyn_gtsam.frontend.depth_priors.depth_files import DepthFiles
from mvdyn_gtsam.frontend.depth_priors.depth_models import choose_adapter, sidecar_of
from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior, Float32
from mvdyn_gtsam.frontend.depth_priors.network_depth import network_depth, unit_rays
from mvdyn_gtsam.frontend.depth_priors.network_image import Placement, network_image, place
from mvdyn_gtsam.frontend.onnx_model import NUMPY_TYPES, OnnxModel, fingerprint
from mvdyn_gtsam.frontend.threads import flow_threads

logger = logging.getLogger(__name__)

SUFFIX = ".onnx"


def is_model(path: Path) -> bool:
    """Whether ``path`` names an ONNX file, there or not."""
    return path.suffix.lower() == SUFFIX and not path.is_dir()


def open_depth_prior(path: Path, cameras: Sequence[Camera], network: str | None = None) -> DepthPrior:
    """The depth prior at ``path``: an ONNX file, which holds ``network``, or a folder of depth files.

    Raises DepthPriorError, naming it, where it cannot be used.
    """
    if is_model(path):
        return OnnxDepth(path, network)
    if network is not None:
        raise DepthPriorError(
            f"{path}: --depth-model {network} is for an {SUFFIX} file; leave it out for a folder of depths"
        )
    if path.is_file():
        raise DepthPriorError(f"{path}: is neither an {SUFFIX} file nor a folder of depths")
    return DepthFiles(path, cameras)


class OnnxDepth:
    """Runs the network of an ONNX file on every frame it is asked for, in one session.

    What the network calls unknown, and what is not finite or not positive, is unknown.
    """

    def __init__(self, path: Path | str, network: str | None = None) -> None:
        """``network``: its name as in ``depth_models.KNOWN``; None: its sidecar or its signature tells.

        Raises DepthPriorError, in one line, where the file cannot be read, is of another signature, or holds
        a network that cannot be a depth prior.
        """
        self._path = Path(path)
        self._model = OnnxModel(self._path, flow_threads(), DepthPriorError)
        self._adapter = choose_adapter(self._path, self._model.signature, network)
        self._inputs = {tensor.name: tensor for tensor in self._model.signature.inputs}
        self._fixed = fixed_size(self._inputs[self._adapter.image.name])
        sidecar = sidecar_of(self._path)
        described = network is None and sidecar.is_file()
        if sidecar.is_file() and not described:
            logger.warning("%s: is not read, since --depth-model names %s", sidecar, network)
        digest = fingerprint(self._path, *([sidecar.read_bytes()] if described else []))
        self._name = f"{self._path.name} as {self._adapter.name} ({digest})"
        logger.info("depth prior: %s, %s", self._path, self._adapter.name)

    @property
    def name(self) -> str:
        """File, network and a digest of their content, so that no run is resumed with another's."""
        return self._name

    def predict(
        self,
        image: npt.NDArray[np.uint8],
        intrinsics: npt.NDArray[np.float64],
        camera: str,
        time: int,
    ) -> tuple[Float32, Float32 | None] | None:
        """Depth and confidence of the frame, at its size; None, with a warning, where nothing is told.

        Raises DepthPriorError, naming file, camera and frame, where the network fails or gives what its
        adapter does not say, or no number at all.
        """
        frame, adapter = f"{camera} frame {time}", self._adapter
        placement = place((image.shape[1], image.shape[0]), adapter.image.size, self._fixed)
        seen_by = placement.intrinsics(intrinsics)
        given = self._model.run(self._feeds(image, placement, seen_by), adapter.outputs, frame)
        try:
            outputs = dict(zip(adapter.outputs, given, strict=True))
            depth, confidence = network_depth(outputs, adapter, placement, seen_by)
        except ValueError as error:
            raise DepthPriorError(f"{self._path}: {frame}: {adapter.name} {error}") from error
        depth = placement.depth(depth)
        known = np.isfinite(depth)
        # a black image, nothing but sky; or a broken model, which the start then finds to know too little
        if not known.any() or _is_constant(depth[known]):
            what = "one depth for all pixels" if known.any() else "no depth"
            logger.warning(
                "%s: %s: %s gives %s; the frame is taken for unknown", self._path, frame, adapter.name, what
            )
            return None
        return depth, None if confidence is None else placement.nearest(confidence)

    def _feeds(
        self, image: npt.NDArray[np.uint8], placement: Placement, intrinsics: npt.NDArray[np.float64]
    ) -> dict[str, npt.NDArray[Any]]:
        """The inputs by name, in the types of the model."""
        adapter = self._adapter
        feeds: dict[str, npt.NDArray[Any]] = {
            adapter.image.name: network_image(image, adapter.image, placement)
        }
        if adapter.rays is not None:
            feeds[adapter.rays] = unit_rays(placement.canvas, intrinsics).transpose(2, 0, 1)[None]
        if adapter.num_tokens is not None:
            ones = (1,) * len(self._inputs[adapter.num_tokens].shape)
            feeds[adapter.num_tokens] = np.full(ones, adapter.tokens)
        return {
            name: np.ascontiguousarray(value).astype(NUMPY_TYPES[self._inputs[name].type])
            for name, value in feeds.items()
        }


def _is_constant(depths: Float32) -> bool:
    # resizing rounds in the last digit
    return len(depths) > 1 and bool(np.ptp(depths) <= 1e-5 * depths.max())
