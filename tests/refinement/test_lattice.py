"""Systems over the pixels of an image, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.refinement.lattice import lattice_solution, lattice_system, neighbour_likeness

Float32 = np.typing.NDArray[np.float32]


def random_weights(seed: int, shape: tuple[int, int]) -> tuple[Float32, Float32, Float32]:
    """Diagonal, and weights to the right and below."""
    rng = np.random.default_rng(seed)
    diagonal, across, down = rng.uniform(0.1, 3.0, (3, *shape)).astype(np.float32)
    across[:, -1], down[-1] = 0.0, 0.0
    return diagonal, across, down


@pytest.mark.parametrize("seed", range(3))
def test_the_matrix_is_that_of_the_quadratic_form(seed: int) -> None:
    diagonal, across, down = random_weights(seed, (5, 7))
    matrix = lattice_system(diagonal, across, down)
    x = np.random.default_rng(seed + 10).normal(size=(5, 7)).astype(np.float32)
    form = (diagonal * x**2).sum() + (across[:, :-1] * np.diff(x, axis=1) ** 2).sum()
    form += (down[:-1] * np.diff(x, axis=0) ** 2).sum()
    assert x.ravel() @ (matrix @ x.ravel()) == pytest.approx(form, rel=1e-5)
    np.testing.assert_array_equal(matrix.toarray(), matrix.toarray().T)


@pytest.mark.parametrize("shape", [(5, 7), (1, 6), (6, 2)])
def test_the_solution_is_that_of_a_dense_solver(shape: tuple[int, int]) -> None:
    weights = random_weights(4, shape)
    matrix = lattice_system(*weights)
    right = np.random.default_rng(5).normal(size=matrix.shape[0]).astype(np.float32)
    found = lattice_solution(matrix, right, 1e-6, 200)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), right), rtol=1e-4, atol=1e-5)


def test_what_nothing_pulls_stays_zero() -> None:
    matrix = lattice_system(*random_weights(6, (4, 4)))
    assert not lattice_solution(matrix, np.zeros(16, np.float32), 0.005, 10).any()


def test_neighbours_are_less_alike_the_more_they_differ() -> None:
    grey = np.array([[0.0, 0.0, 5.0], [10.0, 0.0, 5.0]], np.float32)[..., None]
    across, down = neighbour_likeness(grey, 5.0)
    np.testing.assert_allclose(across, np.exp([[0.0, -1.0, -np.inf], [-2.0, -1.0, -np.inf]]), rtol=1e-6)
    np.testing.assert_allclose(down, [[np.exp(-2.0), 1.0, 1.0], [0.0, 0.0, 0.0]], rtol=1e-6)
    # of one luminance, but not of one hue
    colour = np.zeros((1, 2, 3), np.float32)
    colour[0, 1] = 0.0, 3.0, 4.0
    np.testing.assert_allclose(neighbour_likeness(colour, 5.0)[0], [[np.exp(-1.0), 0.0]], rtol=1e-6)
