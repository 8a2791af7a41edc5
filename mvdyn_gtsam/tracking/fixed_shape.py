"""A keyframe's flow with the shape of its depth map held fixed: the sum of pairwise factors.

For the ablation. The pairwise factor over ``X_i, X_j, S_i`` is ``factors.flow``'s; all of one keyframe make
one factor of the structureless one's form, so that window, polish and covariance need not know which it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from factors.compression import compress_gram, rotate_residual_to_last
from factors.flow import FlowMeasurement, evaluate_flow, linearize_flow
from factors.measurement import StructurelessMeasurement
from factors.projection import adjoint, relative_poses

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FixedShapeMeasurement(StructurelessMeasurement):
    """What the structureless factor would take, and the shape that replaces its unknown depths."""

    log_shape: Array = field(kw_only=True)
    """``(N,)`` log z-depth before the scale."""
    pairs: tuple[FlowMeasurement, ...] = field(init=False, repr=False)
    """One per neighbour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        pairs = tuple(
            FlowMeasurement(
                self.rays,
                self.log_shape,
                self.intrinsics_j[edge],
                self.target[edge],
                self.weight[edge],
                robust_px=self.robust_px,
                noise_px=self.noise_px,
                loss=self.loss,
            )
            for edge in range(len(self.weight))
        )
        object.__setattr__(self, "pairs", pairs)


def evaluate_fixed(measurement: FixedShapeMeasurement, wTi: Array, wTj: Array, log_scale: float) -> float:
    """Robust cost at ``wTi (4, 4)``, ``wTj (E, 4, 4)``."""
    pairs = zip(measurement.pairs, wTj, strict=True)
    return sum(evaluate_flow(pair, wTi, neighbour, log_scale) for pair, neighbour in pairs)


def linearize_fixed(measurement: FixedShapeMeasurement, wTi: Array, wTj: Array, log_scale: float) -> Array:
    """Compressed rows ``(6 E + 2, 6 (E + 1) + 2)``, laid out as ``factors.structureless.linearize`` does."""
    edges = len(wTj)
    twists = 6 * edges
    gram = np.zeros((twists + 2, twists + 2))
    for edge, pair in enumerate(measurement.pairs):
        rows = linearize_flow(pair, wTi, wTj[edge], log_scale)
        # the change of jTi, which is minus that of wTj, then scale and residual
        own = np.column_stack([-rows[:, 6:12], rows[:, 12:]])
        columns = np.r_[6 * edge : 6 * edge + 6, twists, twists + 1]
        gram[np.ix_(columns, columns)] += own.T @ own
    root = rotate_residual_to_last(compress_gram(gram))
    result = np.empty((len(root), twists + 8))
    result[:, :6] = root[:, :twists] @ adjoint(relative_poses(wTi, wTj)).reshape(twists, 6)
    np.negative(root[:, :twists], out=result[:, 6 : twists + 6])
    result[:, twists + 6 :] = root[:, twists:]
    return result
