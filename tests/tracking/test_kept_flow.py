"""Flow in fixed point: how far it is rounded, and what happens beyond the image."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.frontend.dense_flow import GridFlow
from mvdyn_gtsam.tracking.kept_flow import KeptFlow


def test_targets_and_weights_come_back_to_half_a_step() -> None:
    random = np.random.default_rng(0)
    target = (random.random((500, 2)) * [511, 383]).astype(np.float32)
    weight = random.random(500).astype(np.float32)
    kept = KeptFlow.of(GridFlow(target, weight), 512, 384)
    assert np.abs(kept.target - target).max() < 0.5 / 128 + 1e-4
    assert np.abs(kept.weight - weight).max() < 0.5 / 255 + 1e-6
    assert kept.target.dtype == kept.weight.dtype == np.float32
    np.testing.assert_allclose(kept.mean_weight, kept.weight.mean(), rtol=1e-5)


def test_both_ends_of_the_longer_side_fit() -> None:
    target = np.array([[0.0, 0.0], [383.0, 511.0], [383.0, 0.0]], np.float32)
    kept = KeptFlow.of(GridFlow(target, np.ones(3, np.float32)), 384, 512)
    np.testing.assert_allclose(kept.target, target, atol=0.01)
    np.testing.assert_array_equal(kept.weight, 1.0)


def test_targets_outside_move_to_the_border_and_take_five_bytes_like_all() -> None:
    target = np.array([[-1e4, 20.0], [9e4, 400.0]], np.float32)
    kept = KeptFlow.of(GridFlow(target, np.zeros(2, np.float32)), 512, 384)
    np.testing.assert_allclose(kept.target, [[0.0, 20.0], [511.0, 383.0]], atol=0.01)
    assert kept.steps.nbytes + kept.weight_steps.nbytes == 2 * 5
    assert kept.mean_weight == 0.0
