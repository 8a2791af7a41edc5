"""Reconstructions and ground truth made of arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import Similarity

Array = npt.NDArray[np.float64]
INTRINSICS = np.array([[40.0, 0.0, 15.5], [0.0, 40.0, 11.5], [0.0, 0.0, 1.0]])


class FakeReconstruction:
    """Trajectories, and depth images where given, at ``fps`` frames per second."""

    def __init__(
        self,
        trajectories: Mapping[str, Array],
        depths: Mapping[tuple[str, int], npt.NDArray[np.float32]] | None = None,
        groups: Sequence[Sequence[str]] = (),
        fps: float = 10.0,
    ) -> None:
        self._trajectories = trajectories
        self._depths = depths or {}
        self.groups = groups
        self.fps = fps

    @property
    def cameras(self) -> list[str]:
        return list(self._trajectories)

    def trajectory(self, camera: str) -> tuple[Array, Array]:
        wTc = self._trajectories[camera]
        return np.arange(len(wTc)) / self.fps, wTc

    def has_depth(self, camera: str, time: int) -> bool:
        return (camera, time) in self._depths

    def depth(self, camera: str, time: int) -> npt.NDArray[np.float32]:
        return self._depths[camera, time]

    def intrinsics(self, camera: str) -> Array:
        return INTRINSICS


def random_poses(rng: np.random.Generator, count: int, step: float = 0.1) -> Array:
    """``(count, 4, 4)`` of a random walk with turns of some degrees."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.normal(0.0, step, (count, 3)), axis=0)
    poses[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.05, (count, 3)), axis=0)).as_matrix()
    return poses


def perturbed(rng: np.random.Generator, poses: Array, metres: float, radians: float) -> Array:
    result = poses.copy()
    result[:, :3, 3] += rng.normal(0.0, metres, (len(poses), 3))
    turn = Rotation.from_rotvec(rng.normal(0.0, radians, (len(poses), 3))).as_matrix()
    result[:, :3, :3] = poses[:, :3, :3] @ turn
    return result


def random_similarity(rng: np.random.Generator, scale: float | None = None) -> Similarity:
    rotation = Rotation.random(random_state=rng).as_matrix()
    factor = float(np.exp(rng.uniform(-2.0, 2.0))) if scale is None else scale
    return Similarity(factor, rotation, rng.normal(0.0, 5.0, 3))


def write_tum(path: Path, timestamps: Array, poses: Array) -> None:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(timestamps, poses, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(" ".join(f"{value:.12f}" for value in (time, *pose[:3, 3], *quaternion)))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def write_groundtruth(
    capture: Path,
    trajectories: Mapping[str, Array],
    depths: Mapping[tuple[str, int], npt.NDArray[np.float32]] | None = None,
    masks: Mapping[tuple[str, int], npt.NDArray[np.bool_]] | None = None,
    depth_scale: float | None = None,
    mask_folder: str = "dynamic",
) -> Path:
    """Write ``capture/groundtruth`` and, with a depth scale, ``capture/capture.json``; returns the former."""
    folder = capture / "groundtruth"
    for camera, poses in trajectories.items():
        write_tum(folder / f"{camera}.txt", np.arange(len(poses)) / 10.0, poses)
    for (camera, time), depth in (depths or {}).items():
        path = folder / "depth" / camera / f"{time:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        units = np.rint(np.nan_to_num(depth) / (depth_scale or 0.001)).astype(np.uint16)
        assert cv2.imwrite(str(path), units)
    for (camera, time), mask in (masks or {}).items():
        path = folder / mask_folder / camera / f"{time:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), np.where(mask, 255, 0).astype(np.uint8))
    if depth_scale is not None:
        (capture / "capture.json").write_text(f'{{"depth_scale": {depth_scale}}}')
    return folder
