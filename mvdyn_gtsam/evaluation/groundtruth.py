"""Ground truth of a capture: trajectories, and depth and motion masks where they exist."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import EvaluationError

Array = npt.NDArray[np.float64]

DEFAULT_DEPTH_SCALE = 0.001
"""Metres per unit of the 16-bit depth images where ``capture.json`` does not say."""

MASK_FOLDERS = ("dynamic", "masks")
"""``dynamic`` is the contract's name; some published sets ship the same images as ``masks``."""


@dataclass(frozen=True)
class GroundTruth:
    """A ``groundtruth`` folder; images are read when asked for."""

    folder: Path
    trajectories: Mapping[str, tuple[Array, Array]]
    """Camera name -> (timestamps ``(T,)`` seconds, ``wTc`` ``(T, 4, 4)`` metres)."""
    depth_scale: float = DEFAULT_DEPTH_SCALE
    intrinsics: Mapping[str, Array] = field(default_factory=dict)
    """``(3, 3)`` px, of the cameras for which ``capture.json`` beside the folder states them."""

    @property
    def cameras(self) -> list[str]:
        return list(self.trajectories)

    def depth_frames(self, camera: str) -> list[int]:
        """Frame numbers with a depth image, ascending."""
        folder = self.folder / "depth" / camera
        return sorted(int(path.stem) for path in folder.glob("*.png") if path.stem.isdigit())

    def depth(self, camera: str, time: int) -> npt.NDArray[np.float32]:
        """z-depth ``(H, W) float32`` in metres, NaN where there is none.

        Raises EvaluationError when the image is missing or is not 16-bit.
        """
        path = self.folder / "depth" / camera / f"{time:06d}.png"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint16 or image.ndim != 2:
            raise EvaluationError(f"{path}: not a readable 16-bit single-channel depth image")
        depth = image.astype(np.float32) * np.float32(self.depth_scale)
        depth[image == 0] = np.nan
        return depth

    def moving(self, camera: str, time: int) -> npt.NDArray[np.bool_] | None:
        """``(H, W) bool``, True where something moves; None without a mask of that frame.

        Raises EvaluationError when the mask cannot be decoded.
        """
        for name in MASK_FOLDERS:
            path = self.folder / name / camera / f"{time:06d}.png"
            if path.is_file():
                image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
                if image is None:
                    raise EvaluationError(f"{path}: not a readable mask image")
                return image > 127
        return None


def load_groundtruth(folder: str | Path, depth_scale: float | None = None) -> GroundTruth:
    """Read ``<camera>.txt`` TUM files of a ``groundtruth`` folder; images stay on disk.

    ``depth_scale`` (metres per unit) is that of ``capture.json`` next to the folder unless given; intrinsics
    are its, too. Raises EvaluationError when there is no trajectory or one cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise EvaluationError(f"{folder}: no such ground-truth folder; give CAPTURE/groundtruth")
    paths = sorted(folder.glob("*.txt"))
    if not paths:
        raise EvaluationError(f"{folder}: holds no <camera>.txt trajectory")
    trajectories = {path.stem: read_tum(path) for path in paths}
    capture = _read_capture(folder.parent / "capture.json")
    if depth_scale is None:
        depth_scale = _depth_scale_of(capture, folder.parent / "capture.json")
    return GroundTruth(folder, trajectories, depth_scale, _intrinsics_of(capture))


def read_tum(path: Path) -> tuple[Array, Array]:
    """Timestamps ``(T,)`` and ``wTc`` ``(T, 4, 4)`` of a TUM file, in time order.

    Lines are ``timestamp tx ty tz qx qy qz qw`` (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats);
    a line holding NaN is a frame without a pose. Raises EvaluationError on anything else.
    """
    rows = []
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read as a trajectory ({error})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(field) for field in line.replace(",", " ").split()]
        except ValueError as error:
            raise EvaluationError(f"{path}:{number}: not a line of 8 numbers") from error
        if len(row) != 8:
            raise EvaluationError(f"{path}:{number}: {len(row)} numbers, a TUM line has 8")
        rows.append(row)
    if not rows:
        raise EvaluationError(f"{path}: holds no pose")
    values = np.array(rows)
    values = values[np.argsort(values[:, 0], kind="stable")]
    wTc = np.full((len(values), 4, 4), np.nan)
    valid = np.isfinite(values).all(axis=1)
    norms = np.linalg.norm(values[valid, 4:], axis=1)
    if np.any(np.abs(norms - 1.0) > 1e-2):
        raise EvaluationError(f"{path}: a quaternion is not of unit length; expected tx ty tz qx qy qz qw")
    wTc[valid] = np.eye(4)
    if valid.any():
        wTc[valid, :3, :3] = Rotation.from_quat(values[valid, 4:]).as_matrix()
        wTc[valid, :3, 3] = values[valid, 1:4]
    return values[:, 0], wTc


def _read_capture(capture_json: Path) -> Mapping[str, Any]:
    """What ``capture.json`` holds; nothing where there is none."""
    if not capture_json.is_file():
        return {}
    try:
        content = json.loads(capture_json.read_text())
    except (OSError, ValueError) as error:
        raise EvaluationError(
            f"{capture_json}: depth_scale and intrinsics cannot be read ({error})"
        ) from error
    if not isinstance(content, dict):
        raise EvaluationError(f"{capture_json}: depth_scale and intrinsics cannot be read (no object)")
    return content


def _depth_scale_of(capture: Mapping[str, Any], capture_json: Path) -> float:
    try:
        scale = float(capture.get("depth_scale", DEFAULT_DEPTH_SCALE))
    except (ValueError, TypeError) as error:
        raise EvaluationError(f"{capture_json}: depth_scale cannot be read ({error})") from error
    if not (np.isfinite(scale) and scale > 0):
        raise EvaluationError(
            f"{capture_json}: depth_scale is {scale}; it must be a positive number of metres"
        )
    return scale


def _intrinsics_of(capture: Mapping[str, Any]) -> dict[str, Array]:
    """Of the cameras that state them; first guesses are none."""
    found = {}
    for camera in capture.get("cameras", ()):
        numbers = [camera.get(key) for key in ("fx", "fy", "cx", "cy")]
        if not camera.get("estimate_focal") and all(isinstance(number, int | float) for number in numbers):
            fx, fy, cx, cy = (float(number) for number in numbers)
            found[str(camera.get("name"))] = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return found
