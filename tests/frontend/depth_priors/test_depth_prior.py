"""Scale and offset are the paper's least squares, and the robust variant survives what moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.frontend.depth_priors.depth_prior import (
    DepthPrior,
    NoDepthPrior,
    ScaleOffset,
    align_scale_offset,
)


def _depths(seed: int, frames: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(1.0, 8.0, (6, 9)) for _ in range(frames)]


@given(st.floats(0.01, 100.0), st.floats(-0.5, 20.0), st.integers(0, 1000), st.booleans())
def test_an_exact_relation_is_found(scale: float, offset: float, seed: int, robust: bool) -> None:
    prior = _depths(seed)
    initial = [scale * depth + offset for depth in prior]
    initial[1][2:4] = np.nan
    found = align_scale_offset(prior, initial, robust=robust)
    assert found.scale == pytest.approx(scale, rel=1e-8)
    assert found.offset == pytest.approx(offset, abs=1e-7 * (scale + abs(offset)))


def test_least_squares_is_numpys() -> None:
    rng = np.random.default_rng(3)
    prior = _depths(3)
    initial = [1.7 * depth - 0.3 + 0.2 * rng.standard_normal(depth.shape) for depth in prior]
    found = align_scale_offset(prior, initial)
    slope, intercept = np.polyfit(np.concatenate(prior).ravel(), np.concatenate(initial).ravel(), 1)
    assert (found.scale, found.offset) == pytest.approx((slope, intercept), rel=1e-9)


def test_robust_alignment_ignores_a_fifth_of_nonsense() -> None:
    rng = np.random.default_rng(4)
    prior = _depths(4, 8)
    initial = [2.0 * depth + 1.0 + 0.01 * rng.standard_normal(depth.shape) for depth in prior]
    for depth in initial:
        depth[rng.random(depth.shape) < 0.2] = 30.0
    plain, robust = align_scale_offset(prior, initial), align_scale_offset(prior, initial, robust=True)
    assert abs(plain.offset - 1.0) > 1.0
    assert (robust.scale, robust.offset) == pytest.approx((2.0, 1.0), abs=0.02)


def test_robust_alignment_ignores_a_fifth_of_nonsense_in_the_prior() -> None:
    rng = np.random.default_rng(5)
    initial = _depths(5, 8)
    prior = [2.0 * depth + 1.0 + 0.01 * rng.standard_normal(depth.shape) for depth in initial]
    for depth in prior:
        depth[rng.random(depth.shape) < 0.2] = 100.0
    with pytest.raises(ValueError, match="falls"):
        align_scale_offset(prior, initial)
    robust = align_scale_offset(prior, initial, robust=True)
    assert (robust.scale, robust.offset) == pytest.approx((0.5, -0.5), abs=0.01)


def test_what_cannot_be_determined_is_refused() -> None:
    depth = _depths(5, 1)
    with pytest.raises(ValueError, match="no valid pixel"):
        align_scale_offset(depth, [np.full_like(depth[0], np.nan)])
    with pytest.raises(ValueError, match="constant"):
        align_scale_offset([np.full((4, 4), 2.0)], [np.full((4, 4), 3.0)])
    with pytest.raises(ValueError, match="falls"):
        align_scale_offset(depth, [10.0 - depth[0]])
    with pytest.raises(ValueError, match="shape"):
        align_scale_offset(depth, [depth[0][:3]])
    with pytest.raises(ValueError, match="1 prior"):
        align_scale_offset(depth, [])


def test_applying_marks_what_falls_behind_the_camera() -> None:
    aligned = ScaleOffset(2.0, -3.0).apply(np.array([[1.0, 2.0, np.nan]]))
    np.testing.assert_array_equal(aligned, np.array([[np.nan, 1.0, np.nan]], np.float32))


def test_the_default_has_no_opinion() -> None:
    prior: DepthPrior = NoDepthPrior()
    assert prior.predict(np.zeros((4, 4, 3), np.uint8), np.eye(3), "cam0", 0) is None
