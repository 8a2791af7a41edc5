"""Systems over the pixels of an image, against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import cg, spsolve

from mvdyn_gtsam.refinement.solve.lattice import Lattice, lattice_solution, neighbour_likeness

Float32 = np.typing.NDArray[np.float32]


def random_lattice(seed: int, shape: tuple[int, int]) -> Lattice:
    """Of weights that differ from pixel to pixel."""
    rng = np.random.default_rng(seed)
    diagonal, across, down = rng.uniform(0.1, 3.0, (3, *shape)).astype(np.float32)
    across[:, -1], down[-1] = 0.0, 0.0
    return Lattice(diagonal, across, down)


@pytest.mark.parametrize("seed", range(3))
def test_the_matrix_is_that_of_the_quadratic_form(seed: int) -> None:
    lattice = random_lattice(seed, (5, 7))
    matrix = lattice.matrix().toarray()
    x = np.random.default_rng(seed + 10).normal(size=(5, 7)).astype(np.float32)
    form = (lattice.diagonal * x**2).sum() + (lattice.across[:, :-1] * np.diff(x, axis=1) ** 2).sum()
    form += (lattice.down[:-1] * np.diff(x, axis=0) ** 2).sum()
    assert x.ravel() @ matrix @ x.ravel() == pytest.approx(form, rel=1e-5)
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_array_equal(matrix.diagonal(), lattice.total().ravel())


@pytest.mark.parametrize("shape", [(5, 7), (1, 6), (6, 2), (6, 1), (4, 8), (7, 8), (1, 1)])
def test_the_solution_is_that_of_a_dense_solver(shape: tuple[int, int]) -> None:
    lattice = random_lattice(4, shape)
    right = np.random.default_rng(5).normal(size=shape).astype(np.float32)
    found = lattice_solution(lattice, right, 1e-6, 200)
    expected = np.linalg.solve(lattice.matrix().toarray(), right.ravel())
    np.testing.assert_allclose(found.ravel(), expected, rtol=1e-4, atol=1e-5)
    assert found.dtype == np.float32


def test_the_solution_takes_half_the_steps_of_the_whole_system() -> None:
    lattice = random_lattice(7, (40, 50))
    lattice = replace(lattice, diagonal=0.01 * lattice.diagonal)
    right = np.random.default_rng(8).normal(size=(40, 50)).astype(np.float32)
    matrix, root = lattice.matrix().tocsr(), sparse.diags_array(lattice.total().ravel() ** -0.5)
    whole: list[object] = []
    cg(root @ matrix @ root, root @ right.ravel(), rtol=1e-3, callback=whole.append)
    exact = spsolve(matrix.tocsc().astype(np.float64), right.ravel().astype(np.float64))
    found = lattice_solution(lattice, right, 0.0, len(whole) // 2)
    assert np.abs(found.ravel() - exact).max() < 0.01 * np.abs(exact).max()


def test_what_nothing_pulls_stays_zero() -> None:
    assert not lattice_solution(random_lattice(6, (4, 4)), np.zeros((4, 4), np.float32), 0.005, 10).any()


def test_neighbours_are_less_alike_the_more_they_differ() -> None:
    grey = np.array([[0.0, 0.0, 5.0], [10.0, 0.0, 5.0]], np.float32)[..., None]
    across, down = neighbour_likeness(grey, 5.0)
    np.testing.assert_allclose(across, np.exp([[0.0, -1.0, -np.inf], [-2.0, -1.0, -np.inf]]), rtol=1e-6)
    np.testing.assert_allclose(down, [[np.exp(-2.0), 1.0, 1.0], [0.0, 0.0, 0.0]], rtol=1e-6)
    # of one luminance, but not of one hue
    colour = np.zeros((1, 2, 3), np.float32)
    colour[0, 1] = 0.0, 3.0, 4.0
    np.testing.assert_allclose(neighbour_likeness(colour, 5.0)[0], [[np.exp(-1.0), 0.0]], rtol=1e-6)
