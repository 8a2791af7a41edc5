"""Poses of another method, checked and put into this project's convention."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.reconstruction.imports.options import OPTIONS_NAME, ImportOptions

Array = npt.NDArray[np.float64]

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes x right, y down, z forward, from x right, y up, z backward; its own inverse."""
PIXEL_CENTRE = 0.5
"""COLMAP and nerfstudio put the centre of the first pixel at (0.5, 0.5), this project at (0, 0)."""
RIGID_TOLERANCE = 1e-3
"""Largest entry of ``R^T R - 1``: beyond what single precision and printed digits leave."""


@dataclass(frozen=True)
class ImportedPoses:
    """What a reader of one layout returns."""

    wTc: Mapping[str, Array]
    """Camera -> ``(T, 4, 4)``, OpenCV axes, NaN for frames without a pose."""
    intrinsics: Mapping[str, Array] = field(default_factory=dict)
    """Camera -> ``(3, 3)`` at the input resolution, where the layout states the method's own."""


class PoseTable:
    """Collects poses frame by frame; a frame given twice is an error."""

    def __init__(self, source: Path, capture: Capture) -> None:
        self._source = source
        self.wTc = {camera.name: np.full((capture.frame_count, 4, 4), np.nan) for camera in capture.cameras}
        self._seen: set[tuple[str, int]] = set()

    def put(self, camera: str, time: int, wTc: Array, what: str) -> None:
        """Raises ResultError for a frame that has been put before; ``what`` names the entry."""
        if (camera, time) in self._seen:
            raise ResultError(f"{self._source}: {what}: frame {time} of {camera} occurs twice; keep one")
        self._seen.add((camera, time))
        self.wTc[camera][time] = wTc


def to_wTc(matrices: Array, options: ImportOptions, what: str, axes: str = "opencv") -> Array:
    """``(N, 4, 4)`` in this project's convention from ``(N, 4, 4)`` or ``(N, 3, 4)`` in that of ``options``.

    A matrix of NaN alone is a frame without a pose. ``axes`` is what the layout has where the options do not
    say. Raises ResultError, with ``what`` and the index in front, for one that is partly NaN, infinite or not
    rigid.
    """
    result = np.tile(np.eye(4), (len(matrices), 1, 1))
    result[:, : matrices.shape[1]] = matrices
    missing = np.isnan(result[:, :3]).all(axis=(1, 2))
    for index in np.flatnonzero(~missing):
        problem = _problem(result[index])
        if problem:
            raise ResultError(f"{what}, pose {index}: {problem}")
    present = ~missing
    result[missing] = np.nan
    if not present.any():
        return result
    result[present, :3, :3] = Rotation.from_matrix(result[present, :3, :3]).as_matrix()
    if (options.convention or "wTc") == "cTw":
        result[present] = invert_pose(result[present])
    if (options.axes or axes) == "opengl":
        result[present] = result[present] @ OPENCV_FROM_OPENGL
    return result


def _problem(matrix: Array) -> str | None:
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity; a frame without a pose is NaN in every entry, or left out"
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        return f"last row is {matrix[3].tolist()}, not 0 0 0 1; is it transposed?"
    gram = matrix[:3, :3].T @ matrix[:3, :3]
    if np.abs(gram - np.eye(3)).max() > RIGID_TOLERANCE:
        scale = float(np.sqrt(np.trace(gram) / 3.0))
        if np.abs(gram - scale**2 * np.eye(3)).max() <= RIGID_TOLERANCE * scale**2:
            return f"not rigid: the rotation is scaled by {scale:.4g}; divide the 3x3 part by it"
        return "not rigid: the 3x3 part is no rotation"
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        return "not rigid: a reflection; are two camera axes flipped, or one?"
    return None


def frame_of(name: str, capture: Capture, options: ImportOptions, source: Path) -> tuple[str, int]:
    """Camera and time of an image name.

    The camera is a folder of the name (``images/cam0/frame_000012.png``) or, without one, its beginning
    (``cam0_000012.png``); a capture of one camera needs neither. The frame is the number at the end of the
    stem, less ``first_frame``. Raises ResultError for anything else.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    cameras = [camera.name for camera in capture.cameras]
    inside = [part for part in path.parts[:-1] if part in cameras]
    stem, camera = path.stem, inside[-1] if inside else None
    if camera is None:
        starts = [known for known in cameras if re.match(re.escape(known) + r"[^0-9A-Za-z]", stem)]
        camera = max(starts, key=len, default=cameras[0] if len(cameras) == 1 else None)
    number = re.search(r"(\d+)$", stem)
    if camera is None or number is None:
        raise ResultError(
            f"{source}: image {name!r} does not tell camera and frame; name it <camera>/<frame>.png with a"
            f" camera of {', '.join(cameras)}"
        )
    return camera, checked_time(int(number[1]) - options.first_frame, capture, f"{source}: image {name!r}")


def checked_time(time: int, capture: Capture, what: str) -> int:
    """``time``, where the capture has it. Raises ResultError that begins with ``what``."""
    if not 0 <= time < capture.frame_count:
        raise ResultError(
            f"{what}: frame {time} is outside 0..{capture.frame_count - 1} of capture {capture.name!r}; if"
            f' frames are counted from 1, write {{"first_frame": 1}} to {OPTIONS_NAME} beside the poses'
        )
    return time


def input_intrinsics(colmap_matrix: Array, size: tuple[float, float], camera: Camera) -> Array:
    """``(3, 3)`` at the input resolution and with centres at integers, from COLMAP's at ``size`` (w, h)."""
    scale = np.array([camera.width / size[0], camera.height / size[1], 1.0])
    result = colmap_matrix * scale[:, None]
    result[:2, 2] -= PIXEL_CENTRE
    return np.asarray(result)


def median_intrinsics(found: Mapping[str, list[Array]]) -> dict[str, Array]:
    """One matrix per camera, where methods that solve every image apart have many."""
    return {camera: np.median(np.stack(matrices), axis=0) for camera, matrices in found.items() if matrices}
