"""What a depth prior says of each frame: asked for once, checked, and kept on disk until tracking is done."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import DepthPriorError, ResultError
from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior, Float32


@dataclass(frozen=True)
class Prediction:
    """A prior's word on one frame, in the prior's own scale."""

    depth: Float32
    """``(H, W)``, positive; NaN where unknown."""
    confidence: Float32 | None
    """``(H, W)`` in (0, 1], None for 1 everywhere."""


class Predictions:
    """Predictions of a prior, each made at most once; a context manager, at whose end they are gone.

    They lie in ``folder``, so that memory does not grow with the video. What an earlier run left there goes:
    it may be of another prior.
    """

    def __init__(self, prior: DepthPrior, cameras: Sequence[Camera], folder: Path) -> None:
        self.name, self.cameras = prior.name, tuple(cameras)
        self._prior, self._folder = prior, folder
        self._nothing: set[tuple[int, int]] = set()
        """Frames that the prior knows nothing of."""

    def __enter__(self) -> Predictions:
        shutil.rmtree(self._folder, ignore_errors=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)

    def get(self, camera: int, time: int, image: npt.NDArray[np.uint8]) -> Prediction | None:
        """The prediction for frame ``time`` of camera number ``camera``, ``image (H, W, 3) uint8``.

        None where the prior knows nothing of it. Raises DepthPriorError for a prediction that is none, and
        ResultError when it cannot be kept.
        """
        if (camera, time) in self._nothing:
            return None
        path = self._folder / f"{camera}_{time:06d}.npy"
        if path.is_file():
            return _unpacked(np.load(path, allow_pickle=False))
        view = self.cameras[camera]
        answer = self._prior.predict(image, view.intrinsics, view.name, time)
        prediction = (
            None if answer is None else _checked(answer, view, f"{view.name} frame {time}", self.name)
        )
        if prediction is None:
            self._nothing.add((camera, time))
            return None
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            np.save(path, _packed(prediction))
        except OSError as error:
            raise ResultError(
                f"{path}: the depth prior's prediction cannot be kept ({error.strerror or error});"
                " continue with --resume when that is mended"
            ) from error
        return prediction


def _checked(answer: Any, camera: Camera, frame: str, name: str) -> Prediction | None:
    """The prediction with everything unusable unknown; None where nothing else is left."""
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise DepthPriorError(
            f"{frame}: the depth prior {name} handed out {type(answer).__name__}; it must be a pair, depth"
            " and confidence (or None)"
        )
    depth, confidence = answer
    _check_array(depth, "a depth", camera, frame, name)
    with np.errstate(over="ignore"):  # what float32 cannot hold is unknown, too
        depth = depth.astype(np.float32)
    known = np.isfinite(depth) & (depth > 0.0)
    if confidence is not None:
        _check_array(confidence, "a confidence", camera, frame, name)
        confidence = np.clip(np.nan_to_num(confidence, posinf=1.0), 0.0, 1.0).astype(np.float32)
        known &= confidence > 0.0
    if not known.any():
        return None
    return Prediction(np.where(known, depth, np.float32(np.nan)), confidence)


def _check_array(array: Any, what: str, camera: Camera, frame: str, name: str) -> None:
    shape = (camera.height, camera.width)
    fits = isinstance(array, np.ndarray) and array.shape == shape and np.issubdtype(array.dtype, np.floating)
    if fits:
        return
    given = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
    raise DepthPriorError(
        f"{frame}: the depth prior {name} handed out {what} that is {given}; it must be an array of floats of"
        f" shape {shape}"
    )


def _packed(prediction: Prediction) -> Float32:
    """One array ``(1 or 2, H, W)``."""
    both = [prediction.depth] if prediction.confidence is None else [prediction.depth, prediction.confidence]
    return np.stack(both)


def _unpacked(array: Float32) -> Prediction:
    return Prediction(array[0], array[1] if len(array) > 1 else None)
