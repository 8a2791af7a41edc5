"""L_reproj of sampled frames: what phase 1 and phase 2's poses minimise, over all neighbours of a frame at
once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.depth import FLOW_FLOOR_PX, RATIO_FLOOR
from mvdyn_gtsam.refinement.solve.residuals import (
    Float,
    confidence,
    ratio_terms,
    reweighted,
    turned_flow_terms,
)
from mvdyn_gtsam.refinement.solve.samples import FrameSample

Array = npt.NDArray[np.float64]
Samples = Callable[[], Iterable[FrameSample]]
"""Streams the samples from the start each time it is called: the same pixels in the same order."""

CORRELATED_PX = 8.0
"""Pixels over which the error of the flow is one and the same: about a patch of DIS (8 px)."""
BEHIND = 20.0
"""A point behind the other camera costs as much as a residual of this many lambdas: it must not pay to go
there."""


@dataclass(frozen=True)
class ReprojectionTerms:
    """L_reproj of one sample at its ``n`` pixels with evidence, confidences eliminated, neighbour after
    neighbour."""

    cost: float
    parts: tuple[slice, ...]
    """Which of the ``n`` are towards each neighbour."""
    neighbour: npt.NDArray[np.int64]
    """``(n,)`` ascending."""
    points: npt.NDArray[np.int64]
    """``(n,)`` which of the sample's pixels."""
    seen: Array
    """``(3, n)`` the points in the neighbour, divided by their depths in the sample."""
    residual: Array
    """``(3, n)``: the flow in x and y, px, and the logarithm of the ratio of depths."""
    information: Array
    """``(3, n)`` weights under which the squares stand for the robust cost: cost and half the weighted
    squares have the same gradient, and the squares lie above. 0 where the neighbour has no depth."""
    by_inverse_depth: Array
    """``(3, n)`` of the residuals, by that of the sample."""
    by_inverse_depth_there: Array
    """``(n,)`` of the ratio, by that of the neighbour."""


def reprojection_terms(
    sample: FrameSample, rho: Array, rho_there: Array, jTi: Array, config: RefinementConfig
) -> ReprojectionTerms:
    """L_reproj of a sample for inverse depths ``rho (M,)`` of its pixels and ``rho_there (K, M)`` of its
    neighbours at their targets, NaN where there is none; ``jTi (K, 4, 4)``."""
    known = (sample.weight > 0.0) & np.isfinite(rho) & (rho > 0.0) & np.isfinite(sample.target).all(axis=2)
    turned = (jTi[:, :3, :3] @ sample.rays.T).transpose(1, 0, 2)
    shift = jTi[:, :3, 3].T
    ahead = turned[2] + shift[2][:, None] * np.where(known, rho, 1.0) > 1e-3
    behind = float(sample.weight[known & ~ahead].sum()) * config.flow_weight
    neighbour, points = np.nonzero(known & ahead)
    chosen, depth, trust = turned[:, neighbour, points], rho[points], sample.weight[neighbour, points]
    translation = shift[:, neighbour]
    flow = turned_flow_terms(
        depth, chosen, translation, sample.intrinsics[neighbour], sample.target[neighbour, points]
    )
    there = rho_there[neighbour, points]
    has_depth = np.isfinite(there) & (there > 0.0)
    # any positive number in place of an unknown depth: its weight is zero
    ratio = ratio_terms(depth, np.where(has_depth, there, 1.0), flow.depth_ratio, translation[2])
    residual = np.concatenate([flow.residual.T, ratio.residual[None]])
    flow_cost, flow_information = robust(
        residual[:2], config.flow_weight * trust, FLOW_FLOOR_PX, config.flow_lambda
    )
    ratio_cost, ratio_information = robust(
        residual[2:], config.disparity_weight * trust * has_depth, RATIO_FLOOR, config.disparity_lambda
    )
    ends = np.searchsorted(neighbour, np.arange(len(jTi) + 1))
    return ReprojectionTerms(
        cost=behind * config.flow_lambda * (1.0 + np.log(BEHIND)) + flow_cost + ratio_cost,
        parts=tuple(slice(int(a), int(b)) for a, b in zip(ends, ends[1:], strict=False)),
        neighbour=neighbour,
        points=points,
        seen=chosen + translation * depth,
        residual=residual,
        information=np.concatenate([flow_information, ratio_information]),
        by_inverse_depth=np.concatenate([flow.by_inverse_depth.T, ratio.by_inverse_depth_i[None]]),
        by_inverse_depth_there=np.asarray(ratio.by_inverse_depth_j * has_depth, np.float64),
    )


def normal_terms(jacobian: Array, terms: ReprojectionTerms, part: slice) -> tuple[Array, Array]:
    """Gauss-Newton matrix ``(m, m)`` and gradient ``(m,)`` towards one neighbour; ``jacobian (3, m, n)``."""
    rows = jacobian[:, :, part]
    weighted = rows * terms.information[:, None, part]
    hessian = (weighted @ rows.transpose(0, 2, 1)).sum(axis=0)
    return hessian, (weighted @ terms.residual[:, part, None]).sum(axis=0)[:, 0]


def robust(residual: Float, weight: Array, floor: float, scale: float) -> tuple[float, Array]:
    """``sum of weight * (c * |r|_1 + scale * log(1 / c))`` of residuals ``(C, n)`` at the best confidences
    ``c``, and the weight ``(C, n)`` of each squared residual that has the same gradient.

    Absolute values are rounded off below ``floor`` (Huber), where residuals are noise.
    """
    size = np.abs(residual)
    absolute = np.where(size < floor, 0.5 * size**2 / floor, size - 0.5 * floor).sum(axis=0)
    trust = confidence(absolute, scale)
    cost = float(weight @ (trust * absolute - scale * np.log(trust)))
    return cost, weight * trust * reweighted(residual, floor)


def independent_share(sample: FrameSample) -> float:
    """Share of a sample's pixels that count as independent measurements, at most 1.

    Neighbouring pixels share the error of their flow, so that a sample spaced ``d`` px apart knows no more
    than ``(d / CORRELATED_PX)^2`` of what its pixel count says. Without this the data would drown every
    prior. The spacing is that of pixels spread evenly over the sample's extent, at the focal length of its
    neighbours.
    """
    if len(sample.rays) == 0 or len(sample.intrinsics) == 0:
        return 0.0
    focal = sample.intrinsics[:, [0, 1], [0, 1]].mean(axis=0)
    extent = np.ptp(sample.rays[:, :2], axis=0) * focal + CORRELATED_PX
    return min(1.0, float(np.prod(extent)) / (CORRELATED_PX**2 * len(sample.rays)))
