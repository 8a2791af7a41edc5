"""Flow of one keyframe to its neighbours with every grid point's log depth eliminated inside the factor.

Unknowns of keyframe i: its pose, the poses of E neighbours j, a log depth scale S_i and, per grid point k,
the log depth l_k. Cost, in the metric ``1/2 ||.||^2``::

    sum_e,k  weight_ek / noise_px^2 * rho(||pi(K_j, jTi exp(l_k) ray_k) - target_ek||)
  + sum_k    1/2 ((l_k - S_i - prior_log_depth_k) / prior_sigma_k)^2

At every evaluation the l_k are minimised over at the given poses by a fixed number of damped Gauss-Newton
steps from the stored start (no state is kept), and the Gauss-Newton system in the poses is what remains after
eliminating them: one scalar Schur complement per point, cf. "smart factors" (Carlone et al., ICRA 2014) and
the point elimination of bundle adjustment (Triggs et al., 2000).

The factor returns the system in square-root form of 6 E + 2 rows. Its error vector is ``[0, ..., 0, sqrt(2
cost)]`` with and without Jacobians, so ``error()`` is exactly the robust cost, and ``J^T e`` is the
gradient of the re-weighted system with the log depths eliminated, which is the gradient of the robust cost
once the log depths have converged. Levenberg-Marquardt therefore accepts or rejects by the true robust cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt

from factors.compression import compress_gram, rotate_residual_to_last
from factors.flow_terms import FlowTerms, edge_rays, flow_terms, weighted_rows
from factors.measurement import StructurelessMeasurement
from factors.projection import adjoint, relative_poses

__all__ = [
    "EdgeResiduals",
    "StructurelessMeasurement",
    "edge_residuals",
    "evaluate",
    "linearize",
    "solve_log_depths",
    "structureless_flow_factor",
]

Array = npt.NDArray[np.float64]

LOG_DEPTH_RANGE = 4.0
"""A log depth stays within this of its start (a factor of 55); a point at the limit counts as known, not as
free."""
MAXIMUM_STEP = 0.7
"""Longest single log-depth step (a factor of 2)."""


@dataclass(frozen=True)
class EdgeResiduals:
    """How well each edge of a keyframe fits, for choosing, re-measuring and diagnosing edges."""

    count: npt.NDArray[np.int64]
    """``(E,)`` points with a measurement."""
    rms_px: Array
    """``(E,)`` root mean square residual weighted by measurement weight, behind-camera points left out; NaN
    if none."""
    median_px: Array
    """``(E,)`` median residual of the measured points; NaN if none."""
    inlier_fraction: Array
    """``(E,)`` weighted fraction of measurement with residual below twice the robust scale; 0 if none."""
    norms_px: Array
    """``(E, N)`` residual norms; NaN where nothing is measured, inf behind the camera."""


@dataclass(frozen=True, slots=True)
class _Solution:
    """Everything known after the log depths were solved."""

    cost: float
    log_depth: Array
    free: npt.NDArray[np.bool_]
    gradient: Array
    hessian: Array
    prior_gradient: Array
    jTi: Array
    terms: FlowTerms


def evaluate(
    measurement: StructurelessMeasurement, wTi: Array, wTj: Array, log_scale: float
) -> tuple[float, Array]:
    """Robust cost and the solved log depths ``(N,)`` at ``wTi (4, 4)``, ``wTj (E, 4, 4)`` and
    ``log_scale``."""
    solution = _solve(measurement, wTi, wTj, log_scale)
    return solution.cost, solution.log_depth


def solve_log_depths(
    measurement: StructurelessMeasurement, wTi: Array, wTj: Array, log_scale: float
) -> tuple[Array, Array]:
    """Log depths ``(N,)`` at given poses and their information ``(N,)`` (inverse variance, poses held
    fixed)."""
    solution = _solve(measurement, wTi, wTj, log_scale)
    return solution.log_depth, solution.hessian


def linearize(
    measurement: StructurelessMeasurement,
    wTi: Array,
    wTj: Array,
    log_scale: float,
    solved: Array | None = None,
) -> Array:
    """Compressed rows ``(6 E + 2, 6 (E + 1) + 2)`` = ``[d/dwTi | d/dwTj_1 | ... | d/dlog_scale | error]``.

    Derivatives are for right perturbations of the poses. The last column is ``[0, ..., 0, sqrt(2 cost)]``.
    ``solved`` may hand in the log depths that ``evaluate`` found at the same poses, which saves solving them.
    """
    solution = _solve(measurement, wTi, wTj, log_scale, solved)
    root = rotate_residual_to_last(compress_gram(_reduced_gram(measurement, solution)))
    twists = 6 * len(wTj)
    rows = np.empty((len(root), twists + 8))
    # jTi changes by Ad(jTi) of the change of wTi, minus the change of wTj
    rows[:, :6] = root[:, :twists] @ adjoint(solution.jTi).reshape(twists, 6)
    np.negative(root[:, :twists], out=rows[:, 6 : twists + 6])
    rows[:, twists + 6 :] = root[:, twists:]
    return rows


def edge_residuals(
    measurement: StructurelessMeasurement, wTi: Array, wTj: Array, log_scale: float
) -> EdgeResiduals:
    """Residual statistics per edge at the solved log depths."""
    solution = _solve(measurement, wTi, wTj, log_scale)
    weight = measurement.weight
    measured = weight > 0.0
    seen = measured & (solution.terms.weight > 0.0)
    squared = solution.terms.squared_norm
    norms = np.where(measured, np.where(seen, np.sqrt(squared), np.inf), np.nan)
    count = measured.sum(axis=1)
    edges = range(len(weight))
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt((weight * squared * seen).sum(axis=1) / (weight * seen).sum(axis=1))
    inlier_weight = (weight * (norms < 2.0 * measurement.robust_px)).sum(axis=1)
    total_weight = weight.sum(axis=1)
    return EdgeResiduals(
        count=count,
        rms_px=rms,
        median_px=np.array([np.median(norms[e, measured[e]]) if count[e] else np.nan for e in edges]),
        inlier_fraction=np.divide(
            inlier_weight, total_weight, out=np.zeros_like(total_weight), where=count > 0
        ),
        norms_px=norms,
    )


def structureless_flow_factor(
    measurement: StructurelessMeasurement,
    pose_i_key: int,
    pose_j_keys: list[int],
    scale_key: int | None,
    log_scale: float = 0.0,
) -> gtsam.CustomFactor:
    """The factor over ``[X_i, X_j1, ..., X_jE, S_i]``; poses are ``Pose3``, the scale is a double.

    With ``scale_key=None`` the scale is no variable but fixed at ``log_scale``. Raises ValueError when the
    number of keys does not match the measurement or a pose appears twice.
    """
    edges = len(measurement.weight)
    if len(pose_j_keys) != edges:
        raise ValueError(f"measurement has {edges} edges but {len(pose_j_keys)} neighbour keys were given")
    keys = [pose_i_key, *pose_j_keys] + ([] if scale_key is None else [scale_key])
    if len(set(keys)) != len(keys):
        raise ValueError(
            "every key of a structureless factor must be different: merge edges to the same frame"
        )
    error = partial(_factor_error, measurement, scale_key is not None, log_scale)
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * edges + 2), keys, error)


def _factor_error(
    measurement: StructurelessMeasurement,
    has_scale: bool,
    log_scale: float,
    this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    keys = this.keys()
    edges = len(measurement.weight)
    wTi = values.atPose3(keys[0]).matrix()
    wTj = np.stack([values.atPose3(key).matrix() for key in keys[1 : edges + 1]])
    if has_scale:
        log_scale = values.atDouble(keys[edges + 1])
    if jacobians is None:
        error = np.zeros(6 * edges + 2)
        error[-1] = np.sqrt(2.0 * _solve(measurement, wTi, wTj, log_scale).cost)
        return error
    rows = linearize(measurement, wTi, wTj, log_scale)
    for pose in range(edges + 1):
        jacobians[pose] = np.asfortranarray(rows[:, 6 * pose : 6 * pose + 6])
    if has_scale:
        jacobians[edges + 1] = np.asfortranarray(rows[:, -2:-1])
    return rows[:, -1]


def _solve(
    measurement: StructurelessMeasurement,
    wTi: Array,
    wTj: Array,
    log_scale: float,
    solved: Array | None = None,
) -> _Solution:
    """Minimise over each log depth, a scalar Levenberg-Marquardt per point, all points at once; or take
    ``solved``, the result of doing so before."""
    jTi = relative_poses(wTi, wTj)
    rays = edge_rays(measurement.planar_rays, jTi, measurement.intrinsics_j)
    mean = measurement.prior_log_depth + log_scale
    kernel = measurement.kernel
    lower = measurement.initial_log_depth - LOG_DEPTH_RANGE
    upper = measurement.initial_log_depth + LOG_DEPTH_RANGE

    terms = FlowTerms.empty(*measurement.weight.shape)

    def at(log_depth: Array) -> tuple[Array, Array, Array]:
        flow_terms(
            rays, np.exp(log_depth), measurement.planar_target, measurement.information, kernel, out=terms
        )
        return _point_sums(measurement, terms, log_depth - mean)

    log_depth = measurement.initial_log_depth if solved is None else solved
    cost, gradient, hessian = at(log_depth)
    curvature = hessian
    damping = np.full(len(log_depth), 1e-4)
    current = True
    for _ in range(measurement.steps if solved is None else 0):
        step = -gradient / (curvature * (1.0 + damping) + 1e-12)
        candidate = np.clip(log_depth + np.clip(step, -MAXIMUM_STEP, MAXIMUM_STEP), lower, upper)
        new_cost, new_gradient, new_hessian = at(candidate)
        curvature = _secant_curvature(candidate - log_depth, new_gradient - gradient, new_hessian)
        # the margin keeps rounding at convergence from being taken for a failed step
        better = new_cost <= cost * (1.0 + 1e-12)
        current = bool(better.all())
        if current:
            log_depth, cost, gradient, hessian = candidate, new_cost, new_gradient, new_hessian
        else:
            log_depth = np.where(better, candidate, log_depth)
            cost = np.where(better, new_cost, cost)
            gradient = np.where(better, new_gradient, gradient)
            hessian = np.where(better, new_hessian, hessian)
        damping = np.where(better, damping * 0.1, damping * 100.0)
    if not current:
        cost, gradient, hessian = at(log_depth)
    return _Solution(
        cost=float(cost.sum()),
        log_depth=log_depth,
        free=(log_depth > lower) & (log_depth < upper),
        gradient=gradient,
        hessian=hessian,
        prior_gradient=measurement.prior_information * (log_depth - mean),
        jTi=jTi,
        terms=terms,
    )


def _secant_curvature(step: Array, gradient_change: Array, hessian: Array) -> Array:
    """Second derivative along the last step where that is trustworthy, else the Gauss-Newton Hessian;
    ``(N,)``.

    Re-weighting alone converges linearly where measurements of a point disagree; near the solution the secant
    also sees how the weights change. The bounds are those that never did worse than the Hessian alone on
    noisy scenes.
    """
    length = np.abs(step)
    usable = (length > 1e-9) & (length < 0.03)
    secant = np.divide(gradient_change, step, out=hessian.copy(), where=usable)
    return np.where((secant > 0.5 * hessian) & (secant < 1.1 * hessian), secant, hessian)


def _point_sums(
    measurement: StructurelessMeasurement, terms: FlowTerms, prior_offset: Array
) -> tuple[Array, Array, Array]:
    """Cost, gradient and Gauss-Newton Hessian ``(N,)`` of each log depth; overwrites ``terms.scratch``."""
    prior_gradient = measurement.prior_information * prior_offset
    edge_cost = measurement.kernel.cost(terms.squared_norm)
    edge_cost *= measurement.information
    cost = edge_cost.sum(axis=0)
    cost += 0.5 * prior_gradient * prior_offset
    scratch = terms.scratch
    by_row = scratch.reshape(-1, len(prior_offset))
    np.multiply(terms.by_log_depth, terms.residual, out=scratch)
    scratch *= terms.weight
    gradient = by_row.sum(axis=0)
    gradient += prior_gradient
    np.multiply(terms.by_log_depth, terms.by_log_depth, out=scratch)
    scratch *= terms.weight
    hessian = by_row.sum(axis=0)
    hessian += measurement.prior_information
    return cost, gradient, hessian


def _reduced_gram(measurement: StructurelessMeasurement, solution: _Solution) -> Array:
    """Gram matrix ``(6 E + 2, 6 E + 2)`` over ``[twists of jTi | log scale | residual]``, log depths
    eliminated."""
    terms = solution.terms
    edges, points = terms.weight.shape
    twists = 6 * edges
    inverse_root = _inverse_root(solution.hessian, solution.free)
    blocks = np.empty((edges, 7, 7))
    # per point: derivative of the log-depth gradient by [twists | log scale], and that gradient itself
    columns = np.empty((twists + 2, points))
    rows = np.empty((7, 2, points))
    for edge in range(edges):
        root_weight = weighted_rows(
            terms, edge, measurement.planar_target[:, edge], measurement.intrinsics_j[edge], out=rows
        )
        flat = rows.reshape(7, 2 * points)
        np.matmul(flat, flat.T, out=blocks[edge])
        root_weight *= inverse_root
        slope = terms.by_log_depth[:, edge] * root_weight
        coupling = columns[6 * edge : 6 * edge + 6]
        np.multiply(rows[:6, 0], slope[0], out=coupling)
        rows[:6, 1] *= slope[1]
        coupling += rows[:6, 1]
    np.multiply(-measurement.prior_information, inverse_root, out=columns[twists])
    np.multiply(solution.gradient, inverse_root, out=columns[twists + 1])
    gram = -_outer_sum(columns)
    for edge in range(edges):
        span = slice(6 * edge, 6 * edge + 6)
        gram[span, span] += blocks[edge, :6, :6]
        gram[span, -1] += blocks[edge, :6, 6]
        gram[-1, span] += blocks[edge, :6, 6]
    scale_gradient = solution.prior_gradient.sum()
    gram[twists, twists] += measurement.prior_information.sum()
    gram[twists, -1] -= scale_gradient
    gram[-1, twists] -= scale_gradient
    # the true robust cost; never below the quadratic's own constant, because robust losses are concave
    gram[-1, -1] = 2.0 * solution.cost
    return gram


def _outer_sum(columns: Array) -> Array:
    """``columns @ columns.T`` in pieces too small for the BLAS to hand to threads.

    Threads gain nothing at this size and, on a busy machine, waiting for them took ten times the product
    itself.
    """
    rows, points = columns.shape
    if rows < 64:
        return columns @ columns.T
    total = np.zeros((rows, rows))
    length = max(1, 2**18 // rows**2)
    for start in range(0, points, length):
        piece = columns[:, start : start + length]
        total += piece @ piece.T
    return total


def _inverse_root(hessian: Array, free: npt.NDArray[np.bool_]) -> Array:
    return np.sqrt(np.divide(1.0, hessian, out=np.zeros_like(hessian), where=free & (hessian > 1e-12)))
