"""A depth prior out of files: whatever network, sensor or other program made them."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_prior import Float32

SUFFIXES = (".npy", ".npz")
LAYOUT = "<camera>/<frame, six digits>.npy or .npz, such as cam0/000012.npy"


class DepthFiles:
    """Reads ``<folder>/<camera>/000012.npy`` or ``.npz``: z-depth ``(H, W)`` in any unit, 0 or NaN unknown.

    An ``.npz`` holds it as ``depth``, and optionally ``confidence (H, W)`` in [0, 1]. Another size of the
    frame's aspect ratio is resized by nearest pixels, which mixes no depths across an edge. A frame without
    a file is one that the prior knows nothing of: depth of every fifth frame is a prior, too. A camera
    without any is a mistake.
    """

    def __init__(self, folder: Path | str, cameras: Sequence[Camera]) -> None:
        """Raises DepthPriorError, naming it, where the folder or that of a camera is missing or empty."""
        self._folder = Path(folder)
        self._sizes = {camera.name: (camera.height, camera.width) for camera in cameras}
        if not self._folder.is_dir():
            raise DepthPriorError(f"{self._folder}: no such folder; a depth prior is {LAYOUT}")
        for camera in cameras:
            own = self._folder / camera.name
            if not own.is_dir():
                raise DepthPriorError(
                    f"{own}: is missing; the depth prior needs one folder per camera: {LAYOUT}"
                )
            if not any(_is_frame(path) for path in own.iterdir()):
                raise DepthPriorError(f"{own}: holds no depth; a depth prior is {LAYOUT}")

    @property
    def name(self) -> str:
        """With the folder, so that no run is resumed with another's files."""
        return depth_files_name(self._folder)

    def predict(
        self,
        image: npt.NDArray[np.uint8],
        intrinsics: npt.NDArray[np.float64],
        camera: str,
        time: int,
    ) -> tuple[Float32, Float32 | None] | None:
        """Depth and confidence of the frame's file, at the frame's size; None where there is no file.

        Raises DepthPriorError, naming the file, when it cannot be used.
        """
        paths = [self._folder / camera / f"{time:06d}{suffix}" for suffix in SUFFIXES]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            return None
        depth, confidence = _read(path)
        height, width = self._sizes[camera]
        if confidence is not None and confidence.shape != depth.shape:
            raise DepthPriorError(
                f"{path}: confidence of shape {confidence.shape} for a depth of {depth.shape}"
            )
        _check_size(path, depth.shape, (height, width))
        return (
            _resized(depth, (width, height)),
            None if confidence is None else _resized(confidence, (width, height)),
        )


def depth_files_name(folder: Path) -> str:
    """What a result made with the files of ``folder`` says of its depth prior."""
    return f"{DepthFiles.__name__} {folder.resolve()}"


def _is_frame(path: Path) -> bool:
    return path.suffix in SUFFIXES and len(path.stem) == 6 and path.stem.isdecimal()


def _read(path: Path) -> tuple[Float32, Float32 | None]:
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            arrays: dict[str, npt.NDArray[Any]] = {"depth": content}
        else:
            with content:
                arrays = {name: content[name] for name in ("depth", "confidence") if name in content}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DepthPriorError(f"{path}: cannot be read ({error}); write it anew with numpy.save") from error
    if "depth" not in arrays:
        raise DepthPriorError(f'{path}: has no array "depth"; write it with numpy.savez(path, depth=...)')
    for name, array in arrays.items():
        if array.ndim != 2 or not array.size or array.dtype.kind not in "fiu":
            raise DepthPriorError(
                f"{path}: {name} is {array.dtype} of shape {array.shape}; it must be numbers of shape (H, W)"
            )
    floats = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    return floats["depth"], floats.get("confidence")


def _check_size(path: Path, given: tuple[int, ...], wanted: tuple[int, int]) -> None:
    """One size is the other scaled, each side rounded to whole pixels."""
    scale = max(given[0] / wanted[0], given[1] / wanted[1])
    if any(abs(scale * whole - part) > 1.0 for whole, part in zip(wanted, given, strict=True)):
        raise DepthPriorError(
            f"{path}: is {given[1]}x{given[0]}, and its frame {wanted[1]}x{wanted[0]}; it must have the"
            " frame's aspect ratio, without borders or a crop"
        )


def _resized(array: Float32, size: tuple[int, int]) -> Float32:
    if array.shape == size[::-1]:
        return array
    return np.asarray(cv2.resize(array, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
