"""nerfstudio's transforms.json: https://docs.nerf.studio/quickstart/data_conventions.html."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.imports.options import ImportOptions
from mvdyn_gtsam.reconstruction.imports.poses import (
    Array,
    ImportedPoses,
    PoseTable,
    frame_of,
    input_intrinsics,
    median_intrinsics,
    to_wTc,
)

logger = logging.getLogger(__name__)

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: Path, capture: Capture, options: ImportOptions) -> ImportedPoses:
    """``frames`` of ``transform_matrix`` (camera-to-world, OpenGL axes) and ``file_path``.

    ``fl_x fl_y cx cy w h``, of a frame or of the whole file, are the method's own intrinsics, centres at
    +0.5. Raises ResultError for a file that is none and for matrices that are no pose.
    """
    try:
        content = json.loads(path.read_text())
        frames = list(content["frames"])
        entries = [(str(frame["file_path"]), _matrix(frame["transform_matrix"]), frame) for frame in frames]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultError(
            f"{path}: no transforms.json with frames of file_path and 4x4 transform_matrix"
            f" ({type(error).__name__}: {error})"
        ) from error
    table = PoseTable(path, capture)
    intrinsics: dict[str, list[Array]] = {camera.name: [] for camera in capture.cameras}
    for name, matrix, frame in entries:
        camera, time = frame_of(name, capture, options, path)
        table.put(camera, time, to_wTc(matrix[None], options, f"{path}: {name}", "opengl")[0], name)
        own = _intrinsics({**content, **frame}, path, name, capture, camera)
        if own is not None:
            intrinsics[camera].append(own)
    if any({**content, **frame}.get(key) for *_, frame in entries for key in _DISTORTION):
        logger.warning("%s: its lens distortion is ignored; frames are compared undistorted", path)
    return ImportedPoses(table.wTc, median_intrinsics(intrinsics))


def _matrix(values: Any) -> Array:
    matrix = np.asarray(values, dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"a transform_matrix has shape {matrix.shape}")
    return matrix


def _intrinsics(
    values: Mapping[str, Any], path: Path, name: str, capture: Capture, camera: str
) -> Array | None:
    if "fl_x" not in values or "cx" not in values or "cy" not in values:
        return None
    owner = next(item for item in capture.cameras if item.name == camera)
    try:
        fx, cx, cy = (float(values[key]) for key in ("fl_x", "cx", "cy"))
        fy = float(values.get("fl_y", fx))
        size = float(values.get("w", owner.width)), float(values.get("h", owner.height))
    except (TypeError, ValueError) as error:
        raise ResultError(f"{path}: {name}: intrinsics that are no numbers ({error})") from error
    if not np.isfinite([fx, fy, cx, cy, *size]).all() or min(fx, fy, *size) <= 0.0:
        raise ResultError(f"{path}: {name}: fl_x, fl_y, w and h must be positive numbers")
    return input_intrinsics(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), size, owner)
