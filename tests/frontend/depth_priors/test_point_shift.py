"""The shift along the axis comes back from the rays of the pixels, whatever a part of the points says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.frontend.depth_priors.point_shift import recover_shift

WIDTH, HEIGHT, FOCAL = 96, 64, (80.0, 84.0)


def points(seed: int = 0) -> np.ndarray:
    """On a slanting wall with boxes before it."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    z = 4.0 + 0.02 * x
    for _ in range(6):
        left, top = rng.integers(0, WIDTH - 20), rng.integers(0, HEIGHT - 20)
        z[top : top + 20, left : left + 20] = rng.uniform(1.0, 3.0)
    return np.stack([x / FOCAL[0] * z, y / FOCAL[1] * z, z], axis=-1)


KNOWN = np.ones((HEIGHT, WIDTH), bool)


@given(st.floats(-20.0, 3.0), st.integers(0, 50))
def test_it_comes_back(shift: float, seed: int) -> None:
    given_points = points(seed) - [0.0, 0.0, shift]
    assert recover_shift(given_points, KNOWN, FOCAL) == pytest.approx(shift, abs=1e-4)


def test_a_quarter_of_nonsense_and_noise_do_not_pull() -> None:
    rng = np.random.default_rng(1)
    given_points = points() - [0.0, 0.0, 0.8]
    given_points += 0.01 * rng.standard_normal(given_points.shape)
    wrong = rng.random(KNOWN.shape) < 0.25
    given_points[wrong] = rng.uniform(-3.0, 8.0, (wrong.sum(), 3))
    found = recover_shift(given_points, KNOWN, FOCAL)
    assert found == pytest.approx(0.8, abs=0.02)


def test_only_what_is_known_and_finite_counts() -> None:
    given_points = points() - [0.0, 0.0, -1.2]
    known = KNOWN.copy()
    known[:, 60:] = False
    given_points[:, 60:] = 7.0
    given_points[:20, :30] = np.nan
    assert recover_shift(given_points, known, FOCAL) == pytest.approx(-1.2, abs=1e-4)


@pytest.mark.parametrize(
    ("given_points", "known"),
    [
        (points(), np.zeros_like(KNOWN)),
        (np.full((HEIGHT, WIDTH, 3), np.nan), KNOWN),
        (np.zeros((HEIGHT, WIDTH, 3)), KNOWN),
        (points() * [-1.0, -1.0, 1.0], KNOWN),  # behind, were they turned
    ],
)
def test_what_no_shift_explains_has_none(given_points: np.ndarray, known: np.ndarray) -> None:
    assert recover_shift(given_points, known, FOCAL) is None
