"""Phase 2, poses: all poses at once with the depth held fixed (paper, "Iterative pose and depth refinement").

Minimises ``L_reproj + L_prior + L_smooth`` over right perturbations ``wTi exp(delta)``, tangent ``[omega,
v]``. With ``config.joint`` the inverse depth of every sampled pixel is an unknown too (the ablation of the
paper's supplement) and is eliminated from the system, one division per pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from factors.projection import adjoint
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.depth import LARGEST_STEP
from mvdyn_gtsam.refinement.solve.descent import FrameSystem, descend
from mvdyn_gtsam.refinement.solve.reprojection import (
    Samples,
    independent_share,
    normal_terms,
    reprojection_terms,
)
from mvdyn_gtsam.refinement.solve.residuals import twist_derivative
from mvdyn_gtsam.refinement.solve.samples import FrameSample

Array = npt.NDArray[np.float64]


def solve_poses(
    samples: Samples,
    wTc: Array,
    prior_wTc: Array,
    groups: Sequence[Sequence[int]],
    config: RefinementConfig,
    iterations: int | None = None,
    prior_covariance: Array | None = None,
) -> Array:
    """Poses ``(N, T, 4, 4)`` that minimise ``L_reproj + L_prior + L_smooth``, starting from ``wTc``.

    ``prior_wTc`` are the tracked poses of L_prior and ``prior_covariance (N, T, 6, 6)`` theirs, in the unit
    of the poses; where it is not given or not finite the configured standard deviations hold. ``groups``
    are the cameras that share a world: the first frame of the first camera of each is held fixed, as is
    every camera of a group without samples. ``samples`` is called once per iteration
    (``config.pose_iterations`` where not given), twice with ``config.joint``; the cost never rises.
    """
    problem = PoseProblem(samples, prior_wTc, groups, config, prior_covariance)
    count = config.pose_iterations if iterations is None else iterations
    state = PoseState(np.array(wTc, np.float64), None)
    return descend(state, problem.evaluate, problem.direction, problem.move, count).wTc


@dataclass(frozen=True)
class PoseState:
    """What the solve changes."""

    wTc: Array
    """``(N, T, 4, 4)``"""
    depth_change: tuple[Array, ...] | None
    """In joint mode, for every sample ``(M,)`` what was added to the logarithm of its inverse depth; None
    before the first step."""


@dataclass(frozen=True)
class _Direction:
    poses: Array
    """``(N, T, 6)``"""
    depth: tuple[Array, ...] | None


@dataclass(frozen=True)
class _SampleTerms:
    """One sample linearised over its frame and its neighbours."""

    frames: list[int]
    pairs: list[tuple[Array, Array]]
    """Matrix ``(12, 12)`` and gradient ``(12,)`` of the frame and each of its neighbours."""
    cost: float
    depth_information: Array
    """``(M,)`` of each pixel's log inverse depth."""
    depth_gradient: Array
    """``(M,)``"""
    depth_by_pose: Array
    """``(M, 6 (1 + K))`` the part of the matrix that couples them; of no rows outside joint mode."""


class PoseProblem:
    """Cost, gradient and normal equations of the poses."""

    def __init__(
        self,
        samples: Samples,
        prior_wTc: Array,
        groups: Sequence[Sequence[int]],
        config: RefinementConfig,
        prior_covariance: Array | None = None,
    ) -> None:
        self._samples, self._prior, self._groups, self._config = samples, prior_wTc, groups, config
        self._prior_covariance = prior_covariance
        self._shape = (prior_wTc.shape[0], prior_wTc.shape[1])
        self.free = np.zeros(self._shape, bool)
        """``(N, T)`` which frames move; known once the cost has been evaluated."""

    def evaluate(self, state: PoseState) -> FrameSystem:
        """One pass over the samples."""
        system = FrameSystem(self.free.size, 6)
        typical = np.full(self._shape, np.nan)
        for number, sample in enumerate(self._samples()):
            usable = sample.inverse_depth[sample.inverse_depth > 0.0]
            if len(usable) == 0:
                continue
            typical[sample.i] = 1.0 / np.median(usable)
            terms = self._linearised(sample, number, state)
            share = independent_share(sample)
            system.cost += share * terms.cost
            for frame, (hessian, gradient) in zip(terms.frames[1:], terms.pairs, strict=True):
                system.add([terms.frames[0], frame], share * hessian, share * gradient)
            if self._config.joint:
                scaled = share * terms.depth_by_pose / terms.depth_information[:, None]
                system.add(terms.frames, -scaled.T @ terms.depth_by_pose, -scaled.T @ terms.depth_gradient)
        self._add_pose_terms(system, state.wTc, typical)
        return system

    def direction(self, state: PoseState, system: FrameSystem) -> _Direction:
        """Gauss-Newton step of the poses, and in joint mode of the depths that go with it."""
        step = system.step(self.free.ravel())
        if not self._config.joint:
            return _Direction(step.reshape(*self._shape, 6), None)
        depth = []
        for number, sample in enumerate(self._samples()):
            terms = self._linearised(sample, number, state)
            moved = terms.depth_gradient + terms.depth_by_pose @ step[terms.frames].ravel()
            depth.append(np.clip(-moved / terms.depth_information, -LARGEST_STEP, LARGEST_STEP))
        return _Direction(step.reshape(*self._shape, 6), tuple(depth))

    def move(self, state: PoseState, way: _Direction, share: float) -> PoseState:
        """A share of a step."""
        moved = replace(state, wTc=retracted(state.wTc, share * way.poses))
        if way.depth is None:
            return moved
        if state.depth_change is None:
            return replace(moved, depth_change=tuple(share * step for step in way.depth))
        before = state.depth_change
        changes = tuple(old + share * step for old, step in zip(before, way.depth, strict=True))
        return replace(moved, depth_change=changes)

    def _linearised(self, sample: FrameSample, number: int, state: PoseState) -> _SampleTerms:
        joint, size = self._config.joint, len(sample.neighbours) + 1
        count = len(sample.rays) if joint else 0
        change = np.zeros(count) if state.depth_change is None else state.depth_change[number]
        rho = sample.inverse_depth * np.exp(change) if joint else sample.inverse_depth
        hold = self._config.prior_sigma**-2
        cameras, times = np.array(sample.neighbours, int).reshape(-1, 2).T
        jTi = invert_pose(state.wTc[cameras, times]) @ state.wTc[sample.i]
        terms = reprojection_terms(sample, rho, sample.inverse_depth_there, jTi, self._config)
        by_twist = twist_derivative(terms.seen, rho[terms.points], sample.intrinsics[terms.neighbour])
        by_poses = [_by_both_poses(twist) for twist in adjoint(jTi)]
        pairs = []
        for part, both in zip(terms.parts, by_poses, strict=True):
            hessian, gradient = normal_terms(by_twist, terms, part)
            pairs.append((both.T @ hessian @ both, both.T @ gradient))
        information, depth_gradient = np.full(count, hold), hold * change
        coupling = np.zeros((count, 6 * size))
        if joint:
            by_depth = terms.by_inverse_depth * rho[terms.points]
            weighted = terms.information * by_depth
            information += np.bincount(terms.points, (weighted * by_depth).sum(axis=0), count)
            depth_gradient += np.bincount(terms.points, (weighted * terms.residual).sum(axis=0), count)
            coupled = np.einsum("cn,cmn->nm", weighted, by_twist)
            for k, (part, both) in enumerate(zip(terms.parts, by_poses, strict=True)):
                columns = np.r_[0:6, 6 * (k + 1) : 6 * (k + 2)]
                coupling[np.ix_(terms.points[part], columns)] += coupled[part] @ both
        frames = [camera * self._shape[1] + time for camera, time in (sample.i, *sample.neighbours)]
        cost = terms.cost + 0.5 * hold * float(change @ change)
        return _SampleTerms(frames, pairs, cost, information, depth_gradient, coupling)

    def _add_pose_terms(self, system: FrameSystem, wTc: Array, typical: Array) -> None:
        self.free[:] = False
        rotation_sigma = np.radians(self._config.prior_rotation_deg)
        for group in self._groups:
            cameras = list(group)
            depths = typical[cameras][np.isfinite(typical[cameras])]
            if len(depths) == 0:
                continue
            self.free[cameras] = True
            self.free[cameras[0], 0] = False
            sigma = np.repeat([rotation_sigma, self._config.prior_translation * float(np.median(depths))], 3)
            for camera in cameras:
                self._add_prior(system, camera, wTc[camera], sigma)
                self._add_smoothness(system, camera, wTc[camera], sigma)

    def _add_prior(self, system: FrameSystem, camera: int, wTc: Array, sigma: Array) -> None:
        for time, pose in enumerate(wTc):
            residual, jacobian = prior_terms(self._prior[camera, time], pose)
            root = self._prior_root(camera, time, sigma)
            residual, jacobian = root @ residual, root @ jacobian
            frame = camera * self._shape[1] + time
            cost = 0.5 * float(residual @ residual)
            system.add([frame], jacobian.T @ jacobian, jacobian.T @ residual, cost)

    def _prior_root(self, camera: int, time: int, sigma: Array) -> Array:
        """``(6, 6)`` whose square is the information of L_prior."""
        if self._prior_covariance is not None and np.isfinite(self._prior_covariance[camera, time]).all():
            # the gauge frame's covariance is all but zero
            covariance = self._prior_covariance[camera, time] + np.diag((1e-3 * sigma) ** 2)
            return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        return np.diag(1.0 / sigma)

    def _add_smoothness(self, system: FrameSystem, camera: int, wTc: Array, sigma: Array) -> None:
        config = self._config
        weights = np.sqrt(np.repeat([config.smooth_rotation, config.smooth_translation], [9, 3]))
        weights = weights / np.repeat(sigma[[0, 3]], [9, 3])
        if not weights.any():
            return
        for time in range(self._shape[1] - 1):
            residual, jacobian = smoothness_terms(wTc[time], wTc[time + 1])
            residual, jacobian = residual * weights, jacobian * weights[:, None]
            frame = camera * self._shape[1] + time
            cost = 0.5 * float(residual @ residual)
            system.add([frame, frame + 1], jacobian.T @ jacobian, jacobian.T @ residual, cost)


def _by_both_poses(adjoint_jTi: Array) -> Array:
    """Twist ``(6, 12)`` of the points in frame j by right perturbations of ``wTi`` and ``wTj``."""
    return np.hstack([adjoint_jTi, -np.eye(6)])


def prior_terms(prior_wTc: Array, wTc: Array) -> tuple[Array, Array]:
    """L_prior of one pose: residual ``(6,)`` ``[log(R0^T R), R0^T (t - t0)]`` and its derivative ``(6, 6)``.

    The paper's ``delta`` with its translation not bent by its rotation, which at the hundredths of a degree
    in question is the same.
    """
    turn = prior_wTc[:3, :3].T @ wTc[:3, :3]
    omega = Rotation.from_matrix(turn).as_rotvec()
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = _inverse_right_jacobian(omega)
    jacobian[3:, 3:] = turn
    return np.concatenate([omega, prior_wTc[:3, :3].T @ (wTc[:3, 3] - prior_wTc[:3, 3])]), jacobian


def smoothness_terms(wTc: Array, next_wTc: Array) -> tuple[Array, Array]:
    """L_smooth of two consecutive poses: residual ``(12,)`` of ``R_t^T R_t+1 - I`` by rows and ``t_t -
    t_t+1``, and its derivative ``(12, 12)`` by right perturbations of both."""
    turn = wTc[:3, :3].T @ next_wTc[:3, :3]
    residual = np.concatenate([(turn - np.eye(3)).ravel(), wTc[:3, 3] - next_wTc[:3, 3]])
    jacobian = np.zeros((12, 12))
    for axis, generator in enumerate(_cross_matrix(np.eye(3))):
        jacobian[:9, axis] = (-generator @ turn).ravel()
        jacobian[:9, 6 + axis] = (turn @ generator).ravel()
    jacobian[9:, 3:6] = wTc[:3, :3]
    jacobian[9:, 9:] = -next_wTc[:3, :3]
    return residual, jacobian


def retracted(wTc: Array, delta: Array) -> Array:
    """``wTc exp(delta)`` of poses ``(..., 4, 4)`` and tangents ``(..., 6)``, ``[omega, v]``."""
    omega, v = delta[..., :3], delta[..., 3:]
    shape = omega.shape[:-1]
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    cross = _cross_matrix(omega)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    # integral of the rotation over the way: I + (1 - cos a)/a^2 [w] + (a - sin a)/a^3 [w]^2
    first = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    way = (np.eye(3) + first * cross + second * cross @ cross) @ v[..., None]
    turn = Rotation.from_rotvec(omega.reshape(-1, 3)).as_matrix().reshape(*shape, 3, 3)
    result = wTc.copy()
    result[..., :3, :3] = wTc[..., :3, :3] @ turn
    result[..., :3, 3] += (wTc[..., :3, :3] @ way)[..., 0]
    return result


def _cross_matrix(vectors: Array) -> Array:
    """``[v]x`` of vectors ``(..., 3)``."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, axis=-2)


def _inverse_right_jacobian(omega: Array) -> Array:
    """``(3, 3)`` derivative of ``log(exp(omega) exp(d))`` by ``d``."""
    angle, cross = float(np.linalg.norm(omega)), _cross_matrix(omega)
    if angle < 1e-3:
        factor = 1.0 / 12.0 + angle**2 / 720.0
    else:
        factor = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return np.asarray(np.eye(3) + 0.5 * cross + factor * cross @ cross)
