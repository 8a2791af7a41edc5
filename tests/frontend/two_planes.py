"""Two planes seen by two different cameras, whose true flow is known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.frontend.dense_flow import pixel_raster
from mvdyn_gtsam.geometry import backproject, invert_pose, project, transform_points
from tests.frontend.textures import to_image, values

NEAR, FAR = 2.0, 4.0


@dataclass(frozen=True)
class View:
    intrinsics: np.ndarray
    shape: tuple[int, int]
    wTc: np.ndarray
    image: np.ndarray
    depth: np.ndarray


def view(focal: float, shape: tuple[int, int], wTc: np.ndarray, gain: float = 1.0) -> View:
    """A far wall and a near board (world x -0.5 to 0.1, y -0.4 to 0.3) as this camera sees it."""
    height, width = shape
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    pixels = pixel_raster(shape).reshape(-1, 2).astype(float)
    rays = backproject(pixels, np.ones(len(pixels)), intrinsics) @ wTc[:3, :3].T
    points, depths = [], []
    for z in (NEAR, FAR):
        length = (z - wTc[2, 3]) / rays[:, 2]
        points.append(wTc[:3, 3] + rays * length[:, None])
        depths.append(length)
    x, y = points[0][:, 0], points[0][:, 1]
    board = (x > -0.5) & (x < 0.1) & (y > -0.4) & (y < 0.3)
    near = values(130.0 * x, 130.0 * y, seed=5)
    far = values(70.0 * points[1][:, 0], 70.0 * points[1][:, 1], seed=6)
    grey = to_image(gain * np.where(board, near, far).reshape(shape))
    return View(intrinsics, shape, wTc, grey, np.where(board, *depths).reshape(shape).astype(np.float32))


def pose(rotation_deg: tuple[float, float, float], centre: tuple[float, float, float]) -> np.ndarray:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    wTc[:3, 3] = centre
    return wTc


def two_views() -> tuple[View, View]:
    """A baseline of a quarter of the near depth; sizes, focal lengths and exposures differ."""
    return (
        view(220.0, (160, 208), pose((1.0, -2.0, 0.5), (-0.2, 0.0, 0.0))),
        view(250.0, (176, 224), pose((-1.0, 5.0, -2.0), (0.3, -0.05, 0.1)), gain=0.85),
    )


def true_flow(i: View, j: View) -> tuple[np.ndarray, np.ndarray]:
    """True flow ``(H, W, 2)`` and which points camera j sees, not hidden by the board."""
    pixels = pixel_raster(i.shape).reshape(-1, 2).astype(float)
    world = transform_points(i.wTc, backproject(pixels, i.depth.reshape(-1).astype(float), i.intrinsics))
    target, depth = project(transform_points(invert_pose(j.wTc), world), j.intrinsics)
    near = np.rint(target).astype(int)
    height, width = j.shape
    inside = (near >= 1).all(axis=1) & (near[:, 0] < width - 1) & (near[:, 1] < height - 1)
    there = np.full(len(pixels), np.nan)
    there[inside] = j.depth[near[inside, 1], near[inside, 0]]
    seen = np.abs(depth / there - 1.0) < 0.05
    return (target - pixels).reshape(*i.shape, 2), seen.reshape(i.shape)
