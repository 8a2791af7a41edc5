"""Guided flow on two planes seen by two different cameras, whose true flow is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig, pixel_raster
from mvdyn_gtsam.frontend.guided_flow import guided_flow, local_correlation, predicted_flow
from mvdyn_gtsam.geometry import invert_pose
from tests.frontend.textures import texture, to_image
from tests.frontend.two_planes import View, pose, true_flow, two_views


@pytest.fixture(scope="module")
def views() -> tuple[View, View]:
    return two_views()


def test_the_prediction_is_the_geometry(views: tuple[View, View]) -> None:
    i, j = views
    depth = i.depth.copy()
    depth[5, 7] = np.nan
    depth[6, 7] = -1.0
    flow = predicted_flow(depth, i.intrinsics, j.intrinsics, invert_pose(j.wTc) @ i.wTc, j.shape)
    truth, _ = true_flow(i, j)
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
        np.full((24, 32), depth), intrinsics, intrinsics, pose((0, 180, 0), (shift, 0, 0)), (24, 32)
    )
    assert np.isnan(flow).all()


@pytest.mark.parametrize("swap", [False, True])
def test_true_flow_is_found_from_a_wrong_depth_and_pose(views: tuple[View, View], swap: bool) -> None:
    i, j = views[::-1] if swap else views
    wrong_jTi = pose((0.3, -0.3, 0.2), (0.01, -0.01, 0.005)) @ invert_pose(j.wTc) @ i.wTc
    pair = guided_flow(
        DisFlow(), i.image, j.image, 1.02 * i.depth, 1.02 * j.depth, i.intrinsics, j.intrinsics, wrong_jTi,
        FlowConfig(),
    )  # fmt: skip
    for flow, weight, (truth, seen) in (
        (pair.forward, pair.forward_weight, true_flow(i, j)),
        (pair.backward, pair.backward_weight, true_flow(j, i)),
    ):
        assert flow.shape[:2] == weight.shape == seen.shape
        seed_error = np.linalg.norm(
            predicted_flow(1.02 * i.depth, i.intrinsics, j.intrinsics, wrong_jTi, j.shape)
            - true_flow(i, j)[0],
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
    truth, seen = true_flow(i, j)
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
