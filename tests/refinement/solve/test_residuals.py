"""Residuals' derivatives against finite differences; the eliminated confidence against an explicit one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from factors.projection import adjoint
from mvdyn_gtsam.geometry import invert_pose, project, transform_points
from mvdyn_gtsam.refinement.solve.poses import retracted
from mvdyn_gtsam.refinement.solve.residuals import (
    Array,
    confidence,
    flow_terms,
    ratio_terms,
    reweighted,
    turned_rays,
    twist_derivative,
)
from tests.refinement.scenes import INTRINSICS

STEP = 1e-6
COUNT = 20


def _state(seed: int) -> tuple[Array, Array, Array, Array, Array]:
    """Inverse depths, rays, two poses and targets at random, all points in front of both cameras."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.5, 0.5, (COUNT, 2)), np.ones((COUNT, 1))], axis=1)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, (2, 3))).as_matrix()
    poses[:, :3, 3] = rng.uniform(-0.5, 0.5, (2, 3))
    target = rng.uniform(0.0, 160.0, (COUNT, 2))
    return 1.0 / rng.uniform(2.0, 8.0, COUNT), rays, poses[0], poses[1], target


def _jTi(wTi: Array, wTj: Array) -> Array:
    return invert_pose(wTj) @ wTi


seeds = st.integers(0, 10**6)


@given(seeds)
def test_flow_residual_is_reprojection_minus_flow(seed: int) -> None:
    rho, rays, wTi, wTj, target = _state(seed)
    terms = flow_terms(rho, rays, _jTi(wTi, wTj), INTRINSICS, target)
    pixels, depth = project(transform_points(_jTi(wTi, wTj), rays / rho[:, None]), INTRINSICS)
    np.testing.assert_allclose(terms.residual, pixels - target, atol=1e-9)
    np.testing.assert_allclose(terms.depth_ratio, depth * rho, atol=1e-12)
    assert terms.valid.all()


@given(seeds)
def test_flow_derivative_by_inverse_depth(seed: int) -> None:
    rho, rays, wTi, wTj, target = _state(seed)
    jTi = _jTi(wTi, wTj)
    up, down = (flow_terms(rho + s * STEP, rays, jTi, INTRINSICS, target).residual for s in (1, -1))
    terms = flow_terms(rho, rays, jTi, INTRINSICS, target)
    np.testing.assert_allclose(terms.by_inverse_depth, (up - down) / (2 * STEP), rtol=1e-5, atol=1e-4)


def test_a_point_behind_the_other_camera_has_no_residual() -> None:
    jTi = np.eye(4)
    jTi[2, 3] = -3.0
    rho, rays = np.array([0.5, 0.2]), np.array([[0.1, 0.0, 1.0], [0.1, 0.0, 1.0]])
    terms = flow_terms(rho, rays, jTi, INTRINSICS, np.zeros((2, 2)))
    assert terms.valid.tolist() == [False, True]
    assert (terms.residual[0] == 0.0).all() and (terms.by_inverse_depth[0] == 0.0).all()
    assert (terms.residual[1] != 0.0).any()


def test_a_point_at_infinity_moves_by_rotation_alone() -> None:
    jTi = np.eye(4)
    jTi[:3, 3] = [0.5, -0.2, 0.3]
    rays = np.array([[0.1, -0.2, 1.0]])
    terms = flow_terms(np.zeros(1), rays, jTi, INTRINSICS, np.zeros((1, 2)))
    np.testing.assert_allclose(terms.residual, rays @ INTRINSICS[:2].T)


def _by_poses(rho: Array, rays: Array, jTi: Array) -> list[Array]:
    """Derivatives ``(3, 6, N)`` of flow and ratio by right perturbations of ``wTi`` and ``wTj``."""
    point = turned_rays(rays, jTi) + jTi[:3, 3:] * rho
    by_twist = twist_derivative(point, rho, INTRINSICS)
    return [np.einsum("cmn,mk->ckn", by_twist, adjoint(jTi[None])[0]), -by_twist]


@given(seeds)
def test_flow_derivative_by_poses(seed: int) -> None:
    rho, rays, wTi, wTj, target = _state(seed)
    analytic = [by_pose[:2] for by_pose in _by_poses(rho, rays, _jTi(wTi, wTj))]

    def residual(delta: Array, which: int) -> Array:
        moved = [wTi, wTj]
        moved[which] = retracted(moved[which], delta)
        found = flow_terms(rho, rays, _jTi(moved[0], moved[1]), INTRINSICS, target).residual
        return np.asarray(found, np.float64)

    for which in range(2):
        for axis in range(6):
            delta = STEP * np.eye(6)[axis]
            numeric = (residual(delta, which) - residual(-delta, which)) / (2 * STEP)
            np.testing.assert_allclose(analytic[which][:, axis].T, numeric, rtol=1e-5, atol=1e-4)


def _ratio(rho: Array, rho_there: Array, rays: Array, wTi: Array, wTj: Array) -> Array:
    """L_disp's residual from its definition."""
    depth = transform_points(_jTi(wTi, wTj), rays / rho[:, None])[:, 2]
    return np.log(1.0 / rho_there) - np.log(depth)


@given(seeds)
def test_ratio_and_its_derivatives(seed: int) -> None:
    rho, rays, wTi, wTj, target = _state(seed)
    jTi = _jTi(wTi, wTj)
    there = 1.0 / np.random.default_rng(seed + 1).uniform(2.0, 8.0, COUNT)
    terms = ratio_terms(rho, there, flow_terms(rho, rays, jTi, INTRINSICS, target).depth_ratio, jTi[2, 3])
    np.testing.assert_allclose(terms.residual, _ratio(rho, there, rays, wTi, wTj), atol=1e-12)
    h = STEP
    by_i = (_ratio(rho + h, there, rays, wTi, wTj) - _ratio(rho - h, there, rays, wTi, wTj)) / (2 * h)
    by_j = (_ratio(rho, there + h, rays, wTi, wTj) - _ratio(rho, there - h, rays, wTi, wTj)) / (2 * h)
    np.testing.assert_allclose(terms.by_inverse_depth_i, by_i, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(terms.by_inverse_depth_j, by_j, rtol=1e-6, atol=1e-6)


@given(seeds)
def test_ratio_derivative_by_poses(seed: int) -> None:
    rho, rays, wTi, wTj, _ = _state(seed)
    analytic = [by_pose[2] for by_pose in _by_poses(rho, rays, _jTi(wTi, wTj))]
    for which in range(2):
        for axis in range(6):
            found = []
            for sign in (1, -1):
                moved = [wTi, wTj]
                moved[which] = retracted(moved[which], sign * STEP * np.eye(6)[axis])
                found.append(_ratio(rho, rho, rays, moved[0], moved[1]))
            numeric = (found[0] - found[1]) / (2 * STEP)
            np.testing.assert_allclose(analytic[which][axis], numeric, rtol=1e-6, atol=1e-7)


def test_ratio_is_the_papers_to_first_order() -> None:
    """``max / min - 1`` of the two depths, whichever is larger."""
    jTi = np.eye(4)
    for depth_there in (4.04, 3.96):
        terms = ratio_terms(np.array([0.25]), np.array([1.0 / depth_there]), np.ones(1), jTi[2, 3])
        paper = max(depth_there, 4.0) / min(depth_there, 4.0) - 1.0
        assert abs(terms.residual[0]) == pytest.approx(paper, rel=0.01)


@given(st.floats(1e-4, 50.0), st.floats(0.01, 5.0))
def test_confidence_is_the_minimum_over_the_papers_variable(cost: float, scale: float) -> None:
    def loss(c: float) -> float:
        return c * cost + scale * float(np.log(1.0 / c))

    found = minimize_scalar(loss, bounds=(1e-9, 1.0), method="bounded", options={"xatol": 1e-10})
    closed = float(confidence(np.array([cost]), scale)[0])
    assert closed == pytest.approx(found.x, rel=1e-3)
    assert loss(closed) <= found.fun + 1e-9


def test_reweighted_square_has_the_slope_of_the_absolute_value() -> None:
    residual = np.array([-3.0, -0.2, 0.5, 0.05])
    np.testing.assert_allclose(residual * reweighted(residual, 0.1), [-1.0, -1.0, 1.0, 0.5])
