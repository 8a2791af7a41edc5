"""Depth images of another method: ``depth/<camera>/<frame>.{npy,npz,png,tif,tiff}``."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.imports.options import OPTIONS_NAME, ImportOptions
from mvdyn_gtsam.reconstruction.imports.poses import checked_time

SUFFIXES = (".npy", ".npz", ".png", ".tif", ".tiff")
ASPECT_TOLERANCE = 0.03
"""Networks round sides to multiples of 14 or 16: 3 % of the shorter side at 294 pixels. A crop is more."""


def find_depth(
    folders: Sequence[Path], capture: Capture, options: ImportOptions
) -> dict[tuple[str, int], Path]:
    """Files by camera and time, below ``depth/`` of the first of ``folders`` that has one; none is read.

    Raises ResultError for a folder that is no camera of the capture, a frame outside it or given twice, and
    PNG without a scale.
    """
    folder = next((root / "depth" for root in folders if (root / "depth").is_dir()), None)
    if folder is None:
        return {}
    names = [camera.name for camera in capture.cameras]
    files: dict[tuple[str, int], Path] = {}
    for below in sorted(path for path in folder.iterdir() if path.is_dir()):
        if below.name not in names:
            raise ResultError(f"{below}: no camera of the capture; it has {', '.join(names)}")
        for path in sorted(below.iterdir()):
            if path.suffix.lower() == ".exr":
                raise ResultError(f"{path}: EXR is not read; write npy or a float TIFF instead")
            number = re.search(r"(\d+)$", path.stem)
            if path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
                continue
            if number is None:
                raise ResultError(f"{path}: does not tell its frame; name it <camera>/000012{path.suffix}")
            time = checked_time(int(number[1]) - options.first_frame, capture, str(path))
            if (below.name, time) in files:
                raise ResultError(f"{path}: {files[below.name, time].name} is of the same frame; keep one")
            if path.suffix.lower() == ".png" and options.depth_scale is None:
                raise ResultError(
                    f'{path}: a PNG needs its scale: write {{"depth_scale": 0.001}} (depth per unit, in the'
                    f" unit of the poses) to {OPTIONS_NAME} beside the poses"
                )
            files[below.name, time] = path
    return files


def read_depth(
    path: Path, width: int, height: int, depth_scale: float | None = None
) -> npt.NDArray[np.float32]:
    """z-depth ``(height, width) float32``; 0, negative, infinite and NaN become NaN.

    Another resolution is resized to the nearest sample, so that no depth is made up across an edge. Raises
    ResultError for an image that cannot be read, or whose aspect ratio is not that of the frames.
    """
    depth = np.asarray(_decode(path, depth_scale), dtype=np.float32)
    depth = depth.reshape([side for side in depth.shape if side != 1]) if depth.ndim > 2 else depth
    if depth.ndim != 2:
        raise ResultError(f"{path}: depth of shape {depth.shape}; it must be one image (H, W)")
    with np.errstate(invalid="ignore"):
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(np.nan))
    return resize_nearest(path, depth, width, height)


def resize_nearest(
    path: Path, depth: npt.NDArray[np.float32], width: int, height: int
) -> npt.NDArray[np.float32]:
    """``(height, width)``: of each pixel the nearest sample, both images covering the same view.

    Pixels map as ``x' = (x + 0.5) s - 0.5``. Raises ResultError naming ``path`` where the aspect differs.
    """
    rows, columns = depth.shape
    if (rows, columns) == (height, width):
        return depth
    if rows == 0 or columns == 0 or abs(columns * height / (rows * width) - 1.0) > ASPECT_TOLERANCE:
        raise ResultError(
            f"{path}: depth is {columns}x{rows}, frames are {width}x{height}: another aspect ratio; give the"
            " depth of the whole frame, neither cropped nor padded"
        )
    row = ((np.arange(height) + 0.5) * rows / height).astype(int)
    column = ((np.arange(width) + 0.5) * columns / width).astype(int)
    return depth[np.ix_(row, column)]


def _decode(path: Path, depth_scale: float | None) -> npt.NDArray[Any]:
    suffix = path.suffix.lower()
    try:
        if suffix in (".npy", ".npz"):
            return _checked(path, _from_numpy(path))
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, cv2.error) as error:
        raise ResultError(f"{path}: cannot be read as a depth image ({error})") from error
    if suffix == ".png":
        if image is None or image.dtype != np.uint16 or image.ndim != 2 or depth_scale is None:
            raise ResultError(f"{path}: no readable 16-bit single-channel PNG")
        return image.astype(np.float64) * depth_scale
    if image is None or image.dtype not in (np.float32, np.float64) or image.ndim != 2:
        kind = "damaged" if image is None else f"{image.dtype}, {image.ndim} axes"
        raise ResultError(f"{path}: {kind}; a TIFF of depth must be float32 with one channel")
    return np.asarray(image)


def _from_numpy(path: Path) -> npt.NDArray[Any]:
    stored = np.load(path, allow_pickle=False)
    if isinstance(stored, np.ndarray):
        return stored
    with stored:
        names = ["depth"] if "depth" in stored.files else stored.files
        if len(names) != 1:
            raise ResultError(f"{path}: holds {', '.join(names) or 'nothing'}; save one array called depth")
        return np.asarray(stored[names[0]])


def _checked(path: Path, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if values.dtype.kind != "f":
        raise ResultError(f"{path}: depth is {values.dtype}; it must be floating point")
    return values
