"""Directions in which a scene is built."""

from __future__ import annotations

import tracemalloc

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.refinement.plain.axes import bases, basis_of, main_axes

Array = npt.NDArray[np.float64]

UP, ACROSS = np.array([0.0, 0.96, 0.28]), np.array([1.0, 0.0, 0.0])


def about(axis: Array, count: int, degrees: float, seed: int) -> Array:
    """Unit normals ``(count, 3)`` about an axis, of either sign."""
    rng = np.random.default_rng(seed)
    normals = axis + rng.normal(0.0, np.radians(degrees), (count, 3))
    normals *= rng.choice([-1.0, 1.0], (count, 1))
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def test_the_commonest_directions_are_found_in_their_order() -> None:
    scattered = np.random.default_rng(2).normal(size=(30, 3))
    scattered /= np.linalg.norm(scattered, axis=1, keepdims=True)
    normals = np.concatenate([about(UP, 40, 1.0, 0), about(ACROSS, 40, 1.0, 1), scattered])
    share = np.concatenate([np.full(40, 0.6), np.full(40, 0.3), np.full(30, 0.2)])
    axes = main_axes(normals, share, np.concatenate([np.arange(40), np.arange(40), np.arange(30)]))
    np.testing.assert_allclose(np.abs(axes[0] @ UP), 1.0, atol=np.radians(1.0) ** 2)
    np.testing.assert_allclose(np.abs(axes[1] @ ACROSS), 1.0, atol=np.radians(1.0) ** 2)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)


def test_what_few_frames_see_is_no_direction() -> None:
    normals = np.concatenate([about(UP, 40, 1.0, 0), about(ACROSS, 4, 1.0, 1)])
    share = np.concatenate([np.full(40, 0.3), np.full(4, 0.9)])
    axes = main_axes(normals, share, np.concatenate([np.arange(40), np.arange(4)]))
    assert len(axes) == 1
    assert np.abs(axes[0] @ UP) > 0.999


def test_without_a_surface_there_is_no_direction() -> None:
    assert main_axes(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)).shape == (0, 3)


def test_a_long_video_is_asked_here_and_there() -> None:
    count = 20000
    tracemalloc.start()
    axes = main_axes(about(UP, count, 1.0, 0), np.ones(count), np.arange(count))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.abs(axes[0] @ UP) > 0.999
    assert peak < 50e6


def test_planes_are_made_of_what_their_constraint_leaves() -> None:
    free, upright, parallel = bases(UP[None])
    np.testing.assert_array_equal(free, np.eye(3))
    np.testing.assert_allclose(upright.T @ UP, 0.0, atol=1e-12)
    np.testing.assert_allclose(upright.T @ upright, np.eye(2), atol=1e-12)
    np.testing.assert_array_equal(parallel[:, 0], UP)
    assert len(bases(np.zeros((0, 3)))) == 1


@pytest.mark.parametrize(
    ("degrees", "numbers"), [(0.0, 1), (2.0, 1), (5.0, 3), (45.0, 3), (86.0, 3), (88.5, 2)]
)
def test_a_plane_is_as_free_as_it_must_be(degrees: float, numbers: int) -> None:
    turn = np.radians(degrees)
    plane = 0.3 * (np.cos(turn) * UP + np.sin(turn) * ACROSS)
    assert basis_of(plane, UP[None]).shape == (3, numbers)
    assert basis_of(plane, np.zeros((0, 3))).shape == (3, 3)


@given(st.floats(-3.0, 3.0), st.floats(0.1, 5.0))
def test_upright_planes_are_made_of_their_basis(angle: float, size: float) -> None:
    across = np.cross(UP, ACROSS)
    plane = size * (np.cos(angle) * ACROSS + np.sin(angle) * across)
    basis = basis_of(plane, UP[None])
    np.testing.assert_allclose(basis @ (basis.T @ plane), plane, atol=1e-9)
