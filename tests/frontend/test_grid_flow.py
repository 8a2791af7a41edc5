"""Flow at grid points: the same as the dense measurement sampled there, and true on two planes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig, GridFlow, sample_pair
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.grid_flow import (
    GridView,
    OneWayFlow,
    guide_grid,
    measure_grid,
    measure_grid_predicted,
    predict_grid_flow,
)
from mvdyn_gtsam.frontend.guided_flow import guided_flow, predicted_flow
from mvdyn_gtsam.geometry import invert_pose
from tests.frontend.textures import texture, warped
from tests.frontend.two_planes import View, pose, true_flow, two_views


@pytest.fixture(scope="module")
def views() -> tuple[View, View]:
    return two_views()


def grid_view(view: View, stride: int, factor: float = 1.0) -> GridView:
    height, width = view.shape
    grid = Grid.covering(width, height, stride)
    return GridView(grid, (width, height), view.intrinsics, factor * grid.sample(view.depth).astype(float))


def agree(sampled: GridFlow, dense: GridFlow, px: float) -> None:
    trusted = dense.weight > 0.5
    assert trusted.sum() > 20
    distance = np.linalg.norm(sampled.target - dense.target, axis=1)[trusted]
    assert np.median(distance) < px
    assert np.abs(sampled.weight - dense.weight).mean() < 0.05


def test_dis_can_measure_one_direction_alone() -> None:
    assert isinstance(DisFlow(), OneWayFlow)


def test_halved_images_need_one_level_less() -> None:
    image, moved = texture((96, 128)), warped(np.array([[1, 0, 3.0], [0, 1, -2.0], [0, 0, 1]]), (96, 128))
    small = [np.asarray(cv2.resize(one, (64, 48), interpolation=cv2.INTER_AREA)) for one in (image, moved)]
    flow = DisFlow(FlowConfig(finest_scale=1))
    whole, halved = flow.flow(image, moved), 2.0 * flow.flow(small[0], small[1], 1)
    inner = np.s_[8:-8, 8:-8]
    np.testing.assert_allclose(cv2.resize(halved, (128, 96))[inner], whole[inner], atol=0.02)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("stride", [8, 12])
def test_predicted_flow_is_corrected_at_any_finest_level(
    views: tuple[View, View], level: int, stride: int
) -> None:
    i, j = views
    wrong_jTi = pose((0.3, -0.3, 0.2), (0.01, -0.01, 0.005)) @ invert_pose(j.wTc) @ i.wTc
    a, b = grid_view(i, stride, 1.02), grid_view(j, stride, 1.02)
    grids = Grid.covering(i.shape[1], i.shape[0], 4), Grid.covering(j.shape[1], j.shape[0], 4)
    flow = DisFlow(FlowConfig(finest_scale=level))
    found = measure_grid_predicted(flow, i.image, j.image, *grids, a, b, wrong_jTi)
    for one, grid, (truth, seen) in zip(found, grids, (true_flow(i, j), true_flow(j, i)), strict=True):
        trusted = (one.weight > 0.5) & grid.sample(seen)
        assert trusted.sum() > 0.35 * grid.sample(seen).sum()
        error = np.linalg.norm(one.target - grid.pixels - grid.sample(truth), axis=1)[trusted]
        assert np.median(error) < 0.2


def test_plain_flow_is_the_dense_one_at_the_grid() -> None:
    image, moved = texture((96, 128)), warped(np.array([[1, 0, 3.0], [0, 1, -2.0], [0, 0, 1]]), (96, 128))
    flow, grid, other = DisFlow(), Grid.covering(128, 96, 8), Grid.covering(128, 96, 5)
    dense = sample_pair(flow.measure(image, moved), grid, other)
    for sampled, expected in zip(measure_grid(flow, image, moved, grid, other), dense, strict=True):
        assert sampled.target.dtype == sampled.weight.dtype == np.float32
        np.testing.assert_allclose(sampled.target, expected.target, atol=1e-4)
        np.testing.assert_allclose(sampled.weight, expected.weight, atol=1e-3)
    with pytest.raises(ValueError, match="need a seed"):
        measure_grid(flow, image, moved[:-8], grid, grid)


def test_predicted_flow_is_the_seeded_dense_one_at_the_grid(views: tuple[View, View]) -> None:
    i, j = views
    # at level 0: otherwise the dense one still warps at full resolution, and this one does not
    jTi, flow = invert_pose(j.wTc) @ i.wTc, DisFlow(FlowConfig(finest_scale=0))
    seed_i = predicted_flow(i.depth, i.intrinsics, j.intrinsics, jTi, j.shape)
    seed_j = predicted_flow(j.depth, j.intrinsics, i.intrinsics, invert_pose(jTi), i.shape)
    grids = (Grid.covering(i.shape[1], i.shape[0], 7), Grid.covering(j.shape[1], j.shape[0], 7))
    dense = sample_pair(flow.measure(i.image, j.image, seed_i, seed_j), *grids)
    every_pixel = grid_view(i, 1), grid_view(j, 1)
    sampled = measure_grid_predicted(flow, i.image, j.image, *grids, *every_pixel, jTi)
    for one, expected in zip(sampled, dense, strict=True):
        agree(one, expected, 0.05)


def test_guided_flow_is_the_dense_one_at_the_grid(views: tuple[View, View]) -> None:
    i, j = views
    jTi, config = invert_pose(j.wTc) @ i.wTc, FlowConfig(finest_scale=0)
    a, b = grid_view(i, 4), grid_view(j, 4)
    depth_i, depth_j = (v.grid.expand(v.depth, *v.size) for v in (a, b))
    flow = DisFlow(config)
    pair = guided_flow(flow, i.image, j.image, depth_i, depth_j, i.intrinsics, j.intrinsics, jTi, config)
    dense = sample_pair(pair, a.grid, b.grid)
    for one, expected in zip(guide_grid(flow, i.image, j.image, a, b, jTi, config), dense, strict=True):
        agree(one, expected, 0.1)


@pytest.mark.parametrize("stride", [9, 12])
def test_true_flow_is_found_from_a_wrong_depth_and_pose(views: tuple[View, View], stride: int) -> None:
    i, j = views
    wrong_jTi = pose((0.3, -0.3, 0.2), (0.01, -0.01, 0.005)) @ invert_pose(j.wTc) @ i.wTc
    a, b = grid_view(i, stride, 1.02), grid_view(j, stride, 1.02)
    found = guide_grid(DisFlow(), i.image, j.image, a, b, wrong_jTi, FlowConfig())
    for one, grid, (truth, seen) in (
        (found[0], a.grid, true_flow(i, j)),
        (found[1], b.grid, true_flow(j, i)),
    ):
        assert one.target.shape == (len(grid), 2) and np.isfinite(one.target).all()
        error = np.linalg.norm(one.target - grid.pixels - grid.sample(truth), axis=1)
        trusted = (one.weight > 0.5) & grid.sample(seen)
        assert trusted.sum() > 0.35 * grid.sample(seen).sum()
        assert np.median(error[trusted]) < 0.2
        assert np.mean(one.weight[~grid.sample(seen)] > 0.5) < 0.05


@pytest.mark.parametrize("stride", [7, 8, 16])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_prediction_is_the_geometry_of_a_plane(stride: int, level: int) -> None:
    width, height = 131, 90
    intrinsics = np.array([[120.0, 0, 65.0], [0, 120.0, 44.5], [0, 0, 1]])
    grid = Grid.covering(width, height, stride)
    view = GridView(grid, (width, height), intrinsics, np.full(len(grid), 2.0))
    jTi = pose((1.0, -1.5, 2.0), (0.1, -0.05, 0.02))
    small = (width >> level, height >> level)
    scale = np.array([[small[0] / width], [small[1] / height], [1.0]])
    halved = np.vstack([scale[:2] * intrinsics[:2], intrinsics[2:]])
    halved[:2, 2] += 0.5 * scale[:2, 0] - 0.5
    depth = np.full(small[::-1], 2.0)
    expected = predicted_flow(depth, halved, halved, jTi, (10 * height, 10 * width))
    found = predict_grid_flow(view, view, jTi, level)
    assert found.shape == expected.shape and found.flags.c_contiguous
    known = np.isfinite(expected).all(axis=2)
    assert known.mean() > 0.7
    np.testing.assert_allclose(found[known], expected[known], atol=0.05)


def test_points_behind_the_other_camera_get_no_weight() -> None:
    image = texture((48, 64))
    grid = Grid.covering(64, 48, 8)
    intrinsics = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    view = GridView(grid, (64, 48), intrinsics, np.full(len(grid), 2.0))
    found = guide_grid(DisFlow(), image, image, view, view, pose((0, 180, 0), (0, 0, 0)), FlowConfig())
    for one in found:
        assert np.isfinite(one.target).all() and not one.weight.any()
