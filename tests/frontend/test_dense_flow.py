"""Dense flow recovers known motions, with and without a seed, and knows where it cannot."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import (
    DisFlow,
    FlowConfig,
    FlowPair,
    invert_flow,
    pixel_raster,
    sample_pair,
)
from mvdyn_gtsam.frontend.grid import Grid
from tests.frontend.textures import texture, warped

SHAPE = (120, 160)


def _homography(dx: float, dy: float, degrees: float = 0.0, zoom: float = 1.0) -> np.ndarray:
    centre = cv2.getRotationMatrix2D((SHAPE[1] / 2, SHAPE[0] / 2), degrees, zoom)
    centre[:, 2] += dx, dy
    return np.vstack([centre, [0.0, 0.0, 1.0]])


def _truth(homography: np.ndarray, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    raster = pixel_raster(shape)
    target = cv2.perspectiveTransform(raster.reshape(1, -1, 2), homography).reshape(raster.shape)
    return target - raster


def _errors(pair: FlowPair, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    trusted = pair.forward_weight > 0.5
    return np.linalg.norm(pair.forward - truth, axis=2)[trusted], trusted


@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(-2, 2), st.floats(0.97, 1.03))
@settings(max_examples=10, deadline=None)
def test_a_small_homography_is_recovered(dx: float, dy: float, degrees: float, zoom: float) -> None:
    homography = _homography(dx, dy, degrees, zoom)
    pair = DisFlow(FlowConfig(finest_scale=0)).measure(*_images(homography))
    errors, trusted = _errors(pair, _truth(homography))
    assert trusted.mean() > 0.6
    assert np.median(errors) < 0.1 and np.percentile(errors, 95) < 0.5


def _images(homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return texture(SHAPE), warped(homography, SHAPE)


@pytest.mark.parametrize("with_backward", [True, False])
def test_a_seed_bridges_a_motion_far_too_large(with_backward: bool) -> None:
    homography = _homography(47.3, -21.8, 12.0, 1.1)
    truth, inverse = _truth(homography), _truth(np.linalg.inv(homography))
    off = np.array([2.3, -1.7], np.float32)
    image_i, image_j = _images(homography)
    alone, trusted = _errors(DisFlow().measure(image_i, image_j), truth)
    assert not (trusted.mean() > 0.3 and np.median(alone) < 1.0)
    pair = DisFlow().measure(image_i, image_j, truth + off, inverse - off if with_backward else None)
    errors, trusted = _errors(pair, truth)
    assert trusted.mean() > 0.25
    assert np.median(errors) < 0.12 and np.percentile(errors, 90) < 0.5


def test_weights_vanish_where_the_target_leaves_the_image() -> None:
    homography = _homography(30.0, 0.0)
    truth = _truth(homography)
    pair = DisFlow().measure(*_images(homography), truth, -truth)
    assert pair.forward_weight[:, -30:].max() == 0.0
    assert pair.forward_weight[10:-10, 10:-45].mean() > 0.8
    assert pair.backward_weight[:, :30].max() == 0.0


def test_unpredicted_points_have_no_weight_but_a_finite_flow() -> None:
    homography = _homography(2.0, 1.0)
    seed = _truth(homography)
    seed[40:60, 50:80] = np.nan
    pair = DisFlow().measure(*_images(homography), seed, _truth(np.linalg.inv(homography)))
    assert pair.forward_weight[40:60, 50:80].max() == 0.0
    assert all(np.isfinite(field).all() for field in vars(pair).values())


def test_unrelated_images_are_not_trusted() -> None:
    pair = DisFlow().measure(texture(SHAPE, seed=1), texture(SHAPE, seed=2))
    assert (pair.forward_weight > 0.5).mean() < 0.2


def test_measuring_from_the_other_side_is_the_reversed_pair() -> None:
    image_i, image_j = _images(_homography(3.3, -2.1))
    there, back = DisFlow().measure(image_i, image_j), DisFlow().measure(image_j, image_i).reversed()
    for name, field in vars(there).items():
        np.testing.assert_array_equal(field, getattr(back, name))


def test_images_of_different_size_need_a_seed() -> None:
    with pytest.raises(ValueError, match="seed"):
        DisFlow().measure(texture(SHAPE), texture((100, 160)))


def test_a_smooth_flow_is_inverted() -> None:
    homography = _homography(6.0, -4.0, 5.0, 1.05)
    inverse = invert_flow(_truth(homography), SHAPE)
    error = np.linalg.norm(inverse - _truth(np.linalg.inv(homography)), axis=2)
    assert np.isfinite(error).mean() > 0.7
    assert np.nanpercentile(error, 99) < 0.1


def test_the_grid_keeps_targets_and_weights() -> None:
    homography = _homography(3.0, -2.0)
    pair = DisFlow().measure(*_images(homography))
    grid_i, grid_j = Grid.covering(SHAPE[1], SHAPE[0], 8), Grid.covering(SHAPE[1], SHAPE[0], 16)
    there, back = sample_pair(pair, grid_i, grid_j)
    assert there.target.shape == (len(grid_i), 2) and back.weight.shape == (len(grid_j),)
    assert there.target.dtype == there.weight.dtype == np.float32
    moved = there.target[there.weight > 0.5] - grid_i.pixels[there.weight > 0.5]
    np.testing.assert_allclose(np.median(moved, axis=0), [3.0, -2.0], atol=0.05)


def test_flow_can_be_sent_to_another_process() -> None:
    flow = pickle.loads(pickle.dumps(DisFlow(FlowConfig(finest_scale=2))))
    assert flow.config.finest_scale == 2


@pytest.mark.parametrize(
    "change", [{"finest_scale": -1}, {"forward_backward_sigma": 0.0}, {"ncc_low": 0.9}, {"patch_size": 2}]
)
def test_settings_out_of_range_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(change))):
        FlowConfig(**change)  # type: ignore[arg-type]
