"""Maps of a cloud of points with known descriptors, as error-free structure from motion would give them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.geometry import Similarity, invert_pose, project, transform_points

Array = npt.NDArray[np.float64]
WIDTH, HEIGHT = 512, 384
CAMERA = Camera("cam", WIDTH, HEIGHT, 430.0, 430.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


@dataclass(frozen=True)
class Cloud:
    points: Array
    """``(P, 3)`` in the world."""
    descriptors: npt.NDArray[np.float32]
    """``(P, 128)``, unit length, no two alike."""


def cloud(count: int, seed: int = 0) -> Cloud:
    """Points one median depth in front of cameras near the origin."""
    random = np.random.default_rng(seed)
    points = random.uniform([-0.5, -0.4, 0.7], [0.9, 0.4, 1.4], (count, 3))
    return Cloud(points, unit_descriptors(random, count))


def unit_descriptors(random: np.random.Generator, count: int) -> npt.NDArray[np.float32]:
    """``(N, 128)`` random, non-negative as SIFT's are, with cosines between two of them well below 0.8."""
    sparse = np.abs(random.normal(size=(count, 128))) ** 3
    return (sparse / np.linalg.norm(sparse, axis=1, keepdims=True)).astype(np.float32)


def poses(first: tuple[float, float, float], count: int, turn_deg: float = 0.0) -> Array:
    """``wTc (K, 4, 4)`` of a camera that drifts to the right and forwards from ``first``."""
    wTc = np.tile(np.eye(4), (count, 1, 1))
    for frame in range(count):
        angles = [0.01 * frame, np.radians(turn_deg) - 0.01 * frame, 0.005 * frame]
        wTc[frame, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
        wTc[frame, :3, 3] = np.array(first) + [0.04 * frame, 0.01 * np.sin(frame), 0.01 * frame]
    return wTc


def similarity(scale: float, rotation: tuple[float, ...], translation: tuple[float, ...]) -> Similarity:
    return Similarity(scale, Rotation.from_rotvec(rotation).as_matrix(), np.array(translation))


def camera_map(camera: int, scene: Cloud, wTc: Array, mSw: Similarity, noise_px: float = 0.0) -> CameraMap:
    """Every point that falls inside a frame is a keypoint there; rows of the map are those of ``scene``."""
    random = np.random.default_rng(camera)
    features, rows = [], []
    for pose in wTc:
        pixels, depth = project(transform_points(invert_pose(pose), scene.points), CAMERA.intrinsics)
        inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < [WIDTH, HEIGHT]).all(1)
        seen = np.flatnonzero(inside)
        noisy = pixels[seen] + noise_px * random.normal(size=(len(seen), 2))
        features.append(Features(noisy, scene.descriptors[seen]))
        rows.append(seen)
    return CameraMap(
        camera=camera,
        times=3 * np.arange(len(wTc)),
        mTc=mSw.transform_poses(wTc),
        features=tuple(features),
        point_of_keypoint=tuple(rows),
        points=mSw.transform_points(scene.points),
    )
