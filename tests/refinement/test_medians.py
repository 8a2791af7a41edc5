"""Medians of what is known, and the network of exchanges that sorts whole rows."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mvdyn_gtsam.refinement.medians import exchanges, known_median, sorted_rows


@pytest.mark.parametrize("count", range(1, 11))
def test_the_network_sorts_everything(count: int) -> None:
    """One that sorts all rows of zeros and ones sorts all (Knuth's 0-1 principle)."""
    table = np.array(list(itertools.product([0.0, 1.0], repeat=count)), np.float32).T
    np.testing.assert_array_equal(sorted_rows(table.copy()), np.sort(table, axis=0))


@pytest.mark.parametrize("count", [16, 17, 33])
def test_many_rows_are_sorted_like_numpy_does(count: int) -> None:
    table = np.random.default_rng(count).normal(size=(count, 3, 50)).astype(np.float32)
    np.testing.assert_array_equal(sorted_rows(table.copy()), np.sort(table, axis=0))
    assert len(exchanges(count)) < count**2 / 3


@pytest.mark.parametrize("count", [1, 2, 7, 12])
def test_the_median_is_the_lower_one_of_what_is_known(count: int) -> None:
    random = np.random.default_rng(3)
    table = random.normal(size=(count, 20, 30)).astype(np.float32)
    table[random.random(table.shape) < 0.4] = np.nan
    table[:, 0, 0] = np.nan
    before = table.copy()
    median = known_median(table)
    assert median.dtype == np.float32 and np.isnan(median[0, 0])
    for pixel in np.ndindex(20, 30):
        known = np.sort(table[(slice(None), *pixel)])[: np.isfinite(table[(slice(None), *pixel)]).sum()]
        if len(known):
            assert median[pixel] == known[(len(known) - 1) // 2]
    np.testing.assert_array_equal(table, before)


def test_the_median_of_no_rows_is_unknown() -> None:
    assert np.isnan(known_median(np.zeros((0, 2, 3), np.float32))).all()
