"""Noisy depth of plain surfaces on planes."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.refinement.plain.local_planes import FARTHEST, on_local_planes

SHAPE, SIDE = (60, 80), 21


def slanted() -> np.ndarray:
    """Inverse depth of a ground plane."""
    return np.repeat(np.linspace(0.1, 0.5, SHAPE[0])[:, None], SHAPE[1], axis=1).astype(np.float32)


def test_a_slanting_plane_stays_as_it_is() -> None:
    plane = slanted()
    found = on_local_planes(plane, np.ones(SHAPE, np.float32), SIDE)
    # an average over the square would err by 30 % at the upper border
    assert np.abs(found / plane - 1.0).max() < 0.02


def test_noise_falls_and_a_thing_before_the_plane_does_not_spread() -> None:
    plane = slanted()
    noisy = plane * np.exp(0.05 * np.random.default_rng(0).standard_normal(SHAPE)).astype(np.float32)
    noisy[20:24, 30:34] = 2.0
    found = on_local_planes(noisy, np.ones(SHAPE, np.float32), SIDE)
    around = np.ones(SHAPE, bool)
    around[18:26, 28:36] = False
    assert np.abs(found / plane - 1.0)[around].mean() < 0.4 * np.abs(noisy / plane - 1.0)[around].mean()
    # nor is it put on the plane behind
    assert np.allclose(found[20:24, 30:34], 2.0 / FARTHEST)


def test_what_does_not_count_is_not_asked_and_stays_where_nothing_counts() -> None:
    plane, weight = slanted(), np.ones(SHAPE, np.float32)
    wrong = plane.copy()
    wrong[:, 40:] *= 1.3
    weight[:, 40:] = 0.0
    found = on_local_planes(wrong, weight, SIDE)
    assert np.abs(found / plane - 1.0)[15:45, 15:40].max() < 0.01
    far = found[:, 40 + SIDE // 2 + 1 :]
    assert np.array_equal(far, wrong[:, 40 + SIDE // 2 + 1 :])
