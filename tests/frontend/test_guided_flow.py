"""Guided flow on two planes seen by two different cameras, whose true flow is known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig, pixel_raster
from mvdyn_gtsam.frontend.guided_flow import guided_flow, local_correlation, predicted_flow
from mvdyn_gtsam.geometry import backproject, invert_pose, project, transform_points
from tests.frontend.textures import texture, to_image, values

NEAR, FAR = 2.0, 4.0


@dataclass(frozen=True)
class View:
    intrinsics: np.ndarray
    shape: tuple[int, int]
    wTc: np.ndarray
    image: np.ndarray
    depth: np.ndarray


def _view(focal: float, shape: tuple[int, int], wTc: np.ndarray, gain: float = 1.0) -> View:
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


def _pose(rotation_deg: tuple[float, float, float], centre: tuple[float, float, float]) -> np.ndarray:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    wTc[:3, 3] = centre
    return wTc


@pytest.fixture(scope="module")
def views() -> tuple[View, View]:
    """A baseline of a quarter of the near depth; sizes, focal lengths and exposures differ."""
    return (
        _view(220.0, (160, 208), _pose((1.0, -2.0, 0.5), (-0.2, 0.0, 0.0))),
        _view(250.0, (176, 224), _pose((-1.0, 5.0, -2.0), (0.3, -0.05, 0.1)), gain=0.85),
    )


def _truth(i: View, j: View) -> tuple[np.ndarray, np.ndarray]:
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


def test_the_prediction_is_the_geometry(views: tuple[View, View]) -> None:
    i, j = views
    depth = i.depth.copy()
    depth[5, 7] = np.nan
    depth[6, 7] = -1.0
    flow = predicted_flow(depth, i.intrinsics, j.intrinsics, invert_pose(j.wTc) @ i.wTc, j.shape)
    truth, _ = _truth(i, j)
    target = truth + pixel_raster(i.shape)
    inside = np.asarray((target >= 0).all(axis=2) & (target <= np.array(j.shape[::-1]) - 1).all(axis=2))
    inside[5:7, 7] = False
    assert flow.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(flow).all(axis=2), inside)
    np.testing.assert_allclose(flow[inside], truth[inside], atol=2e-3)


@given(st.floats(-0.1, 0.1), st.floats(0.5, 20.0))
def test_points_behind_the_other_camera_are_not_predicted(shift: float, depth: float) -> None:
    intrinsics = np.array([[100.0, 0, 15.5], [0, 100.0, 11.5], [0, 0, 1]])
    flow = predicted_flow(
        np.full((24, 32), depth), intrinsics, intrinsics, _pose((0, 180, 0), (shift, 0, 0)), (24, 32)
    )
    assert np.isnan(flow).all()


@pytest.mark.parametrize("swap", [False, True])
def test_true_flow_is_found_from_a_wrong_depth_and_pose(views: tuple[View, View], swap: bool) -> None:
    i, j = views[::-1] if swap else views
    wrong_jTi = _pose((0.3, -0.3, 0.2), (0.01, -0.01, 0.005)) @ invert_pose(j.wTc) @ i.wTc
    pair = guided_flow(
        DisFlow(), i.image, j.image, 1.02 * i.depth, 1.02 * j.depth, i.intrinsics, j.intrinsics, wrong_jTi,
        FlowConfig(),
    )  # fmt: skip
    for flow, weight, (truth, seen) in (
        (pair.forward, pair.forward_weight, _truth(i, j)),
        (pair.backward, pair.backward_weight, _truth(j, i)),
    ):
        assert flow.shape[:2] == weight.shape == seen.shape
        seed_error = np.linalg.norm(
            predicted_flow(1.02 * i.depth, i.intrinsics, j.intrinsics, wrong_jTi, j.shape) - _truth(i, j)[0],
            axis=2,
        )
        assert np.nanmedian(seed_error) > 1.0
        error = np.linalg.norm(flow - truth, axis=2)
        trusted = (weight > 0.5) & seen
        assert trusted.sum() > 0.5 * seen.sum()
        assert np.median(error[trusted]) < 0.15 and np.percentile(error[trusted], 90) < 0.6


def test_occluded_points_lose_their_weight(views: tuple[View, View]) -> None:
    i, j = views
    pair = guided_flow(
        DisFlow(), i.image, j.image, i.depth, j.depth, i.intrinsics, j.intrinsics,
        invert_pose(j.wTc) @ i.wTc, FlowConfig(),
    )  # fmt: skip
    truth, seen = _truth(i, j)
    target = truth + pixel_raster(i.shape)
    inside = (target >= 4).all(axis=2) & (target <= np.array(j.shape[::-1]) - 5).all(axis=2)
    hidden = inside & ~seen
    assert hidden.sum() > 200
    assert np.mean(pair.forward_weight[hidden] > 0.5) < 0.05
    assert np.mean(pair.forward_weight[inside & seen] > 0.5) > 0.7


def test_correlation_ignores_exposure_and_sees_nothing_in_flat_walls() -> None:
    image = texture((60, 80))
    darker = to_image(0.6 * image.astype(np.float64) + 20.0)
    assert local_correlation(image, darker, 9, 2.0)[8:-8, 8:-8].min() > 0.8
    assert abs(local_correlation(image, texture((60, 80), seed=9), 9, 2.0).mean()) < 0.2
    rng = np.random.default_rng(0)
    flat, also = (to_image(100.0 + rng.standard_normal((60, 80))) for _ in range(2))
    assert np.abs(local_correlation(flat, also, 9, 2.0)).max() < 0.3
