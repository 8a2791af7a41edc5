"""Flow of one edge (i, j) with the shape of frame i's depth map held fixed: only its log scale S_i is free.

Cost ``sum_k weight_k / noise_px^2 * rho(||pi(K_j, jTi exp(S_i) D_ik ray_k) - target_k||)`` over ``X_i, X_j,
S_i``. The factor returns eight square-root rows; its error vector is ``[0, ..., 0, sqrt(2 cost)]`` (see
``structureless``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt

from factors.compression import compress_gram, rotate_residual_to_last
from factors.flow_terms import FlowTerms, edge_rays, flow_terms, read_only_copy, weighted_rows
from factors.projection import adjoint, relative_poses
from factors.robust import Loss, LossName, make_loss

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlowMeasurement:
    """Dense flow of the N grid points of frame i to one frame j; arrays are copied and made read-only.

    Points with a NaN target, weight or depth count as no measurement. Raises ValueError when shapes disagree.
    """

    rays: Array
    """``(N, 3)`` with z = 1, in frame i."""
    log_depth: Array
    """``(N,)`` log z-depth before the scale."""
    intrinsics_j: Array
    """``(4,)`` fx fy cx cy, px."""
    target: Array
    """``(N, 2)`` where the flow leads, px in frame j."""
    weight: Array
    """``(N,)`` in [0, 1]; 0 is no measurement."""
    robust_px: float = 1.0
    """Scale of the robust loss, px."""
    noise_px: float = 1.0
    """Standard deviation of a flow component of weight one, px."""
    loss: LossName = "cauchy"
    kernel: Loss = field(init=False, repr=False)
    """The robust loss itself."""
    information: Array = field(init=False, repr=False)
    """``(N,)`` weight over squared noise."""

    def __post_init__(self) -> None:
        points = len(self.rays)
        expected = {
            "rays": (points, 3),
            "log_depth": (points,),
            "intrinsics_j": (4,),
            "target": (points, 2),
            "weight": (points,),
        }
        for name, shape in expected.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name} must have shape {shape}, got {np.shape(getattr(self, name))}")
        if not self.noise_px > 0.0:
            raise ValueError(f"noise_px must be positive, got {self.noise_px}")
        target, weight = np.asarray(self.target, dtype=np.float64), np.asarray(self.weight, dtype=np.float64)
        log_depth = np.asarray(self.log_depth, dtype=np.float64)
        measured = np.isfinite(target).all(axis=1) & np.isfinite(weight) & np.isfinite(log_depth)
        weight = np.where(measured, weight, 0.0)
        if (weight < 0.0).any():
            raise ValueError("weights must not be negative")
        arrays = {
            "rays": self.rays,
            "log_depth": np.where(measured, log_depth, 0.0),
            "intrinsics_j": self.intrinsics_j,
            "target": np.where(measured[:, None], target, 0.0),
            "weight": weight,
            "information": weight / self.noise_px**2,
        }
        for name, array in arrays.items():
            object.__setattr__(self, name, read_only_copy(array))
        object.__setattr__(self, "kernel", make_loss(self.loss, self.robust_px))


def evaluate_flow(measurement: FlowMeasurement, wTi: Array, wTj: Array, log_scale: float) -> float:
    """Robust cost at ``wTi (4, 4)``, ``wTj (4, 4)``."""
    terms, _ = _terms(measurement, relative_poses(wTi, wTj[None]), log_scale)
    return _cost(measurement, terms)


def linearize_flow(measurement: FlowMeasurement, wTi: Array, wTj: Array, log_scale: float) -> Array:
    """Compressed rows ``(8, 14)`` = ``[d/dwTi | d/dwTj | d/dlog_scale | error]``, right perturbations."""
    jTi = relative_poses(wTi, wTj[None])
    terms, target = _terms(measurement, jTi, log_scale)
    points = len(measurement.rays)
    augmented = np.empty((8, 2, points))
    root_weight = weighted_rows(terms, 0, target[:, 0], measurement.intrinsics_j, out=augmented[:7])
    augmented[7] = augmented[6]
    np.multiply(terms.by_log_depth[:, 0], root_weight, out=augmented[6])
    flat = augmented.reshape(8, 2 * points)
    gram = flat @ flat.T
    # the true robust cost; never below the quadratic's own constant, because robust losses are concave
    gram[-1, -1] = 2.0 * _cost(measurement, terms)
    root = rotate_residual_to_last(compress_gram(gram))
    return np.hstack([root[:, :6] @ adjoint(jTi)[0], -root[:, :6], root[:, 6:]])


def flow_factor(
    measurement: FlowMeasurement, pose_i_key: int, pose_j_key: int, scale_key: int
) -> gtsam.CustomFactor:
    """The factor over ``[X_i, X_j, S_i]``: two ``Pose3`` and a double."""
    keys = [pose_i_key, pose_j_key, scale_key]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(8), keys, partial(_factor_error, measurement))


def _factor_error(
    measurement: FlowMeasurement,
    this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    pose_i_key, pose_j_key, scale_key = this.keys()
    wTi, wTj = values.atPose3(pose_i_key).matrix(), values.atPose3(pose_j_key).matrix()
    log_scale = values.atDouble(scale_key)
    if jacobians is None:
        error = np.zeros(8)
        error[-1] = np.sqrt(2.0 * evaluate_flow(measurement, wTi, wTj, log_scale))
        return error
    rows = linearize_flow(measurement, wTi, wTj, log_scale)
    jacobians[0] = np.asfortranarray(rows[:, :6])
    jacobians[1] = np.asfortranarray(rows[:, 6:12])
    jacobians[2] = np.asfortranarray(rows[:, 12:13])
    return rows[:, -1]


def _terms(measurement: FlowMeasurement, jTi: Array, log_scale: float) -> tuple[FlowTerms, Array]:
    rays = edge_rays(measurement.rays.T, jTi, measurement.intrinsics_j[None])
    target = measurement.target.T[:, None]
    terms = FlowTerms.empty(1, len(measurement.rays))
    depth = np.exp(measurement.log_depth + log_scale)
    flow_terms(rays, depth, target, measurement.information[None], measurement.kernel, out=terms)
    return terms, target


def _cost(measurement: FlowMeasurement, terms: FlowTerms) -> float:
    return float(measurement.kernel.cost(terms.squared_norm[0]) @ measurement.information)
