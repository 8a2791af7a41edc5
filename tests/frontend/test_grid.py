"""The grid holds pixel centres, samples exactly and expands back through its own values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.frontend.grid import Grid

SIZES = st.tuples(st.integers(1, 70), st.integers(1, 70), st.integers(1, 20))


@given(SIZES)
def test_grid_lies_inside_and_is_centred(size: tuple[int, int, int]) -> None:
    width, height, stride = size
    grid = Grid.covering(width, height, stride)
    assert len(grid) == grid.shape[0] * grid.shape[1] == len(grid.pixels)
    for axis, length in enumerate((width, height)):
        low, high = grid.pixels[:, axis].min(), grid.pixels[:, axis].max()
        assert 0 <= low and high <= length - 1
        assert 0 <= (length - 1 - high) - low <= 1
        assert low < stride


@given(SIZES)
def test_sampling_reads_the_fields_own_pixels(size: tuple[int, int, int]) -> None:
    width, height, stride = size
    grid = Grid.covering(width, height, stride)
    y, x = np.mgrid[:height, :width]
    np.testing.assert_array_equal(grid.sample(np.stack([x, y], axis=-1)), grid.pixels)


@given(SIZES, st.integers(0, 2**32 - 1))
def test_expanding_and_sampling_gives_the_values_back(size: tuple[int, int, int], seed: int) -> None:
    width, height, stride = size
    grid = Grid.covering(width, height, stride)
    values = np.random.default_rng(seed).standard_normal(len(grid)).astype(np.float32)
    dense = grid.expand(values, width, height)
    assert dense.shape == (height, width) and dense.dtype == np.float32
    np.testing.assert_array_equal(grid.sample(dense), values)
    assert dense.min() >= values.min() and dense.max() <= values.max()


def test_expanding_is_linear_between_points_and_constant_beyond() -> None:
    grid = Grid.covering(40, 24, 8)
    dense = grid.expand(3.0 * grid.pixels[:, 0] - 2.0 * grid.pixels[:, 1], 40, 24)
    x = np.clip(np.arange(40), grid.pixels[:, 0].min(), grid.pixels[:, 0].max())
    y = np.clip(np.arange(24), grid.pixels[:, 1].min(), grid.pixels[:, 1].max())
    np.testing.assert_allclose(dense, 3.0 * x - 2.0 * y[:, None], atol=1e-4)


def test_a_grid_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="does not hold pixel"):
        Grid.covering(40, 24, 8).sample(np.zeros((19, 40)))
    with pytest.raises(ValueError, match="empty"):
        Grid.covering(40, 24, 0)
