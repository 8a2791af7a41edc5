"""Dense depth from grid or sparse points: exact on planes, sharp at image edges, never NaN."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mvdyn_gtsam.frontend.dense_depth import interpolate_sparse_depth, upsample_depth
from mvdyn_gtsam.frontend.grid import Grid

WIDTH, HEIGHT = 96, 64
GRID = Grid.covering(WIDTH, HEIGHT, 8)


def _step() -> tuple[np.ndarray, np.ndarray]:
    """An image and a depth with one vertical edge that no grid column touches."""
    edge = int(GRID.pixels[4, 0]) + 2
    depth = np.full((HEIGHT, WIDTH), 4.0, np.float32)
    depth[:, :edge] = 1.0
    image = np.where(depth[..., None] > 2.0, np.uint8(180), np.uint8(60)).repeat(3, axis=2)
    return image, depth


def test_depth_edges_follow_image_edges() -> None:
    image, depth = _step()
    dense, confidence = upsample_depth(image, GRID, GRID.sample(depth), np.ones(len(GRID)))
    wrong = np.abs(np.log(dense / depth)) > 0.05
    bilinear_wrong = np.abs(np.log(GRID.expand(GRID.sample(depth), WIDTH, HEIGHT) / depth)) > 0.05
    assert wrong.mean() < 0.4 * bilinear_wrong.mean()
    np.testing.assert_allclose(confidence, 1.0, atol=1e-5)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.95))
@settings(max_examples=25, deadline=None)
def test_weightless_and_invalid_points_never_poison(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth, weight = rng.uniform(1.0, 9.0, len(GRID)), np.ones(len(GRID))
    bad = rng.random(len(GRID)) < share
    bad[0] = False
    depth[bad] = rng.choice([np.nan, np.inf, -1.0, 0.0], bad.sum())
    weight[bad] = rng.choice([0.0, 1.0, np.nan], bad.sum())
    dense, confidence = upsample_depth(image, GRID, depth, weight)
    good = depth[~bad]
    assert dense.dtype == confidence.dtype == np.float32
    assert np.isfinite(dense).all() and np.isfinite(confidence).all()
    assert dense.min() >= good.min() * (1 - 1e-4) and dense.max() <= good.max() * (1 + 1e-4)
    assert confidence.min() >= 0.0 and confidence.max() <= 1.0 + 1e-5
    assert GRID.sample(confidence)[bad].mean() < 0.2 if bad.any() else True


def test_holes_are_filled_from_beside_them_with_little_confidence() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    depth = np.where(GRID.pixels[:, 0] < WIDTH / 2, 2.0, 6.0)
    hole = GRID.pixels[:, 0] > WIDTH * 0.7
    dense, confidence = upsample_depth(image, GRID, np.where(hole, np.nan, depth), np.where(hole, 0.0, 1.0))
    np.testing.assert_allclose(dense[:, -4:], 6.0, rtol=0.05)
    assert confidence[:, -8:].max() < 0.05 and confidence[:, :40].min() > 0.9


def _plain_image_of_a_thin_thing() -> tuple[np.ndarray, np.ndarray]:
    """An image without an edge, and a depth with a pole between grid columns that no grid point sees."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    depth = (4.0 + 0.02 * x + 0.01 * y).astype(np.float32)
    pole = int(GRID.pixels[4, 0]) + 3
    depth[:, pole : pole + 3] = 1.5
    return np.full((HEIGHT, WIDTH, 3), 128, np.uint8), depth


def test_detail_between_grid_points_is_the_priors() -> None:
    image, depth = _plain_image_of_a_thin_thing()
    prior = np.log(0.8 * depth)  # off by a scale, which the grid knows
    dense, confidence = upsample_depth(
        image, GRID, GRID.sample(depth), np.ones(len(GRID)), log_prior=prior.astype(np.float32)
    )
    np.testing.assert_allclose(dense, depth, rtol=1e-4)
    np.testing.assert_allclose(confidence, 1.0, atol=1e-5)
    without, _ = upsample_depth(image, GRID, GRID.sample(depth), np.ones(len(GRID)))
    assert np.abs(np.log(without / depth)).max() > 0.5


def test_what_the_grid_knows_better_bends_the_prior() -> None:
    image, depth = _plain_image_of_a_thin_thing()
    bend = 1.0 + 0.005 * np.arange(WIDTH, dtype=np.float32)
    dense, _ = upsample_depth(
        image, GRID, GRID.sample(depth), np.ones(len(GRID)), log_prior=np.log(depth / bend)
    )
    left, right = int(GRID.pixels[0, 0]), int(GRID.pixels[-1, 0])
    np.testing.assert_allclose(dense[:, left:right], depth[:, left:right], rtol=2e-3)


def test_where_the_prior_is_unknown_all_is_as_without() -> None:
    image, depth = _step()
    values, weight = GRID.sample(depth), np.ones(len(GRID))
    expected, trust = upsample_depth(image, GRID, values, weight)
    prior = np.log(2.0 * depth)
    prior[20:50, 30:70] = np.nan
    dense, confidence = upsample_depth(image, GRID, values, weight, log_prior=prior)
    unknown = np.isnan(prior)
    np.testing.assert_array_equal(dense[unknown], expected[unknown])
    np.testing.assert_array_equal(confidence[unknown], trust[unknown])
    np.testing.assert_allclose(dense[~unknown], depth[~unknown], rtol=1e-3)


def test_a_prior_that_no_grid_point_sees_changes_nothing() -> None:
    image, depth = _step()
    values, weight = GRID.sample(depth), np.ones(len(GRID))
    prior = np.log(2.0 * depth)
    x, y = GRID.pixels.astype(int).T
    prior[y, x] = np.nan
    for expected, found in zip(
        upsample_depth(image, GRID, values, weight),
        upsample_depth(image, GRID, values, weight, log_prior=prior),
        strict=True,
    ):
        np.testing.assert_array_equal(found, expected)


def test_nothing_usable_is_refused() -> None:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with pytest.raises(ValueError, match="no grid point"):
        upsample_depth(image, GRID, np.full(len(GRID), np.nan), np.ones(len(GRID)))
    with pytest.raises(ValueError, match="no sparse point"):
        interpolate_sparse_depth(np.array([[-5.0, 2.0], [3.0, 3.0]]), np.array([1.0, np.nan]), WIDTH, HEIGHT)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_sparse_points_of_a_plane_give_the_plane(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (120, 2))
    corners = np.array([[0, 0], [WIDTH - 1, 0], [0, HEIGHT - 1], [WIDTH - 1, HEIGHT - 1]], float)
    pixels = np.vstack([pixels, corners])
    slope = rng.uniform(-0.001, 0.001, 2)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    truth = 1.0 / (0.4 + slope[0] * x + slope[1] * y)
    dense = interpolate_sparse_depth(pixels, 1.0 / (0.4 + pixels @ slope), WIDTH, HEIGHT)
    np.testing.assert_allclose(dense, truth, rtol=0.01)


def test_sparse_outliers_are_dropped_and_borders_continued() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([20, 15], [75, 48], (300, 2))
    depth = np.full(300, 3.0)
    depth[:6] = [0.1, 50.0, 0.5, 20.0, 9.0, 1.0]
    dense = interpolate_sparse_depth(pixels, depth, WIDTH, HEIGHT)
    np.testing.assert_allclose(dense, 3.0, rtol=1e-4)


@pytest.mark.parametrize("pixels", [[[5.0, 5.0]], [[5.0, 5.0], [9.0, 9.0], [20.0, 20.0]], [[5.0, 5.0]] * 4])
def test_points_that_span_no_triangle_still_give_a_depth(pixels: list[list[float]]) -> None:
    dense = interpolate_sparse_depth(np.array(pixels), np.full(len(pixels), 2.5), WIDTH, HEIGHT)
    np.testing.assert_allclose(dense, 2.5, rtol=1e-5)
