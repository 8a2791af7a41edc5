from __future__ import annotations

import numpy as np
import pytest

from factors.compression import compress, compress_gram, gram_matrix, rotate_residual_to_last


def _random_rows(seed: int, rows: int, columns: int, rank: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, columns))
    # columns of very different size, as rotations and translations have
    return jacobian * np.geomspace(1e-3, 1e3, columns), rng.normal(size=rows)


@pytest.mark.parametrize(("rows", "columns", "rank"), [(500, 13, 13), (500, 13, 6), (5, 13, 5), (40, 1, 1)])
def test_same_gram_and_same_cost(rows: int, columns: int, rank: int) -> None:
    jacobian, residual = _random_rows(rows + rank, rows, columns, rank)
    small_jacobian, small_residual = compress(jacobian, residual)
    assert small_jacobian.shape == (columns + 1, columns)
    expected = gram_matrix(jacobian, residual)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(gram_matrix(small_jacobian, small_residual) - expected) / scale).max() < 1e-10
    step = np.random.default_rng(1).normal(size=columns) / np.geomspace(1e-3, 1e3, columns)
    np.testing.assert_allclose(
        np.sum((small_jacobian @ step + small_residual) ** 2),
        np.sum((jacobian @ step + residual) ** 2),
        rtol=1e-9,
    )


def test_unused_columns_and_zero_residuals_stay_zero() -> None:
    jacobian, residual = _random_rows(3, 100, 7, 7)
    jacobian[:, 2] = 0.0
    small_jacobian, small_residual = compress(jacobian, 0.0 * residual)
    assert not small_jacobian[:, 2].any()
    assert not small_residual.any()


def test_slightly_indefinite_gram_is_clipped() -> None:
    gram = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    root = compress_gram(gram)
    assert np.isfinite(root).all()
    np.testing.assert_allclose(root.T @ root, gram, atol=2e-9)


@pytest.mark.parametrize("factor", [1.0, 1e-9, 1e9, -1.0])
def test_rotation_keeps_the_gram_and_collects_the_residual(factor: float) -> None:
    rng = np.random.default_rng(7)
    root = np.triu(rng.normal(size=(6, 6)))
    root[:-1, -1] *= factor
    root[-1, -1] *= np.sign(factor)
    rotated = rotate_residual_to_last(root)
    np.testing.assert_allclose(
        rotated.T @ rotated, root.T @ root, rtol=1e-12, atol=1e-14 * max(1.0, factor**2)
    )
    assert not rotated[:-1, -1].any()
    assert rotated[-1, -1] > 0.0
