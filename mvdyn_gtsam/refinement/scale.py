"""Phase 1: scale and offset of every frame's depth with the poses held fixed (paper, "Per-frame scale
alignment").

``D_i' = s_i D_i + beta_i`` minimises ``w_f L_flow + w_d L_disp``. The poses fix the scale of the world, so
wherever there is parallax nothing is left free; a weak prior holds the rest. What phase 2 shares with it lies
here too: the robust terms of one pair, the sparse system over frames, and the descent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import spsolve

from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.refinement.depth import FLOW_FLOOR_PX, RATIO_FLOOR
from mvdyn_gtsam.refinement.residuals import (
    Float,
    FlowTerms,
    RatioTerms,
    confidence,
    flow_terms,
    ratio_terms,
    reweighted,
)
from mvdyn_gtsam.refinement.samples import FrameSample
from mvdyn_gtsam.refinement.settings import RefinementConfig

Array = npt.NDArray[np.float64]
Samples = Callable[[], Iterable[FrameSample]]
"""Streams the samples from the start each time it is called: the same pixels in the same order."""
State = TypeVar("State")
Direction = TypeVar("Direction")

LOG_SCALE_SIGMA = 0.3
"""Standard deviation of ``log s`` in the prior: monocular depth drifts by some ten per cent between frames,
rarely by a third. Next to thousands of pixels it only counts where there is no parallax."""
OFFSET_SIGMA = 0.1
"""Standard deviation of ``beta`` in the prior, in median depths of the frame. Smaller than that of the scale,
so that a frame with hardly any depth range, where the two cannot be told apart, is scaled rather than
shifted."""
LARGEST_LOG_STEP = 0.5
"""Of ``log s`` per step: the linearisation holds about that far."""
NEAREST_KEEPS = 0.5
"""Share of its present depth that a step leaves at least to the nearest sampled pixel: so depth stays
positive."""
CORRELATED_PX = 8.0
"""Pixels over which the error of the flow is one and the same: about a patch of DIS (8 px)."""
BEHIND = 20.0
"""A point behind the other camera costs as much as a residual of this many lambdas: it must not pay to go
there."""
SMALLEST_STEP = 1.0 / 128.0
"""Share of a Gauss-Newton step below which the descent gives up."""
CONVERGED = 1e-10
"""Relative decrease of the cost below which another iteration is not worth its pass over the disk."""


@dataclass(frozen=True)
class Scales:
    """Affine correction of every frame's depth: ``scale * D + offset``."""

    scale: Array
    """``(N, T)``"""
    offset: Array
    """``(N, T)`` in the unit of the depth."""


def solve_scales(
    samples: Samples, wTc: Array, config: RefinementConfig, iterations: int | None = None
) -> Scales:
    """Scale and offset of every frame that minimise L_reproj with poses ``wTc (N, T, 4, 4)`` held fixed.

    ``samples`` is called about once per iteration (``config.affine_iterations`` where not given) and none of
    what it yields is kept. Frames that neither have samples nor are seen by any keep scale 1 and offset 0,
    and corrected depth is positive at every pixel sampled.
    """
    problem = _ScaleProblem(samples, wTc, config)
    identity = Scales(np.ones(wTc.shape[:2]), np.zeros(wTc.shape[:2]))
    count = config.affine_iterations if iterations is None else iterations
    return descend(identity, problem.evaluate, problem.direction, problem.move, count)


@dataclass(frozen=True)
class PairTerms:
    """L_reproj of one frame towards one neighbour at its ``n`` pixels with evidence, confidences
    eliminated."""

    cost: float
    points: npt.NDArray[np.int64]
    """``(n,)`` which of the sample's pixels."""
    flow: FlowTerms
    ratio: RatioTerms
    """0 where the neighbour has no depth."""
    residual: Array
    """``(n, 3)``: the flow in x and y, px, and the ratio of depths."""
    information: Array
    """``(n, 3)`` weights under which the squares stand for the robust cost: cost and half the weighted
    squares have the same gradient, and the squares lie above."""


def pair_terms(
    sample: FrameSample, k: int, rho: Array, rho_there: Array, jTi: Array, config: RefinementConfig
) -> PairTerms:
    """L_reproj of a sample towards its neighbour ``k`` for inverse depths ``rho (M,)`` of its pixels and
    ``rho_there (M,)`` of the neighbour at their targets, NaN where it has none."""
    target, weight = sample.target[k], sample.weight[k]
    known = (weight > 0.0) & np.isfinite(rho) & (rho > 0.0) & np.isfinite(target).all(axis=1)
    points = np.flatnonzero(known)
    terms = flow_terms(rho[points], sample.rays[points], jTi, sample.intrinsics[k], target[points])
    behind = float(weight[points[~terms.valid]].sum()) * config.flow_weight
    cost = behind * config.flow_lambda * (1.0 + np.log(BEHIND))
    points = points[terms.valid]
    terms = FlowTerms(
        terms.residual[terms.valid],
        terms.by_inverse_depth[terms.valid],
        terms.depth_ratio[terms.valid],
        np.ones(len(points), bool),
    )
    there = rho_there[points]
    has_depth = np.isfinite(there) & (there > 0.0)
    # any positive number in place of an unknown depth: its weight is zero
    ratio = ratio_terms(rho[points], np.where(has_depth, there, 1.0), terms.depth_ratio, jTi)
    trust = weight[points]
    flow_cost, flow_information = robust(
        terms.residual, config.flow_weight * trust, FLOW_FLOOR_PX, config.flow_lambda
    )
    ratio_cost, ratio_information = robust(
        ratio.residual[:, None],
        config.disparity_weight * trust * has_depth,
        RATIO_FLOOR,
        config.disparity_lambda,
    )
    return PairTerms(
        cost + flow_cost + ratio_cost,
        points,
        terms,
        ratio,
        np.concatenate([terms.residual, ratio.residual[:, None]], axis=1),
        np.concatenate([flow_information, ratio_information], axis=1),
    )


def robust(residual: Float, weight: Array, floor: float, scale: float) -> tuple[float, Array]:
    """``sum of weight * (c * |r|_1 + scale * log(1 / c))`` of residuals ``(n, C)`` at the best confidences
    ``c``, and the weight ``(n, C)`` of each squared residual that has the same gradient.

    Absolute values are rounded off below ``floor`` (Huber), where residuals are noise.
    """
    size = np.abs(residual)
    absolute = np.where(size < floor, 0.5 * size**2 / floor, size - 0.5 * floor).sum(axis=1)
    trust = confidence(absolute, scale)
    cost = float(weight @ (trust * absolute - scale * np.log(trust)))
    return cost, (weight * trust)[:, None] * reweighted(residual, floor)


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


class FrameSystem:
    """Normal equations over frames of ``width`` unknowns each: cost, gradient and the blocks of coupled
    frames."""

    def __init__(self, frames: int, width: int) -> None:
        self.cost = 0.0
        self.gradient = np.zeros((frames, width))
        self.diagonal = np.zeros((frames, width, width))
        self._coupled: dict[tuple[int, int], Array] = {}

    def add(self, frames: Sequence[int], hessian: Array, gradient: Array, cost: float) -> None:
        """Add a term of some frames: ``hessian (n width, n width)``, ``gradient (n width,)``."""
        self.cost += cost
        width = self.gradient.shape[1]
        for p, a in enumerate(frames):
            rows = slice(p * width, (p + 1) * width)
            self.gradient[a] += gradient[rows]
            self.diagonal[a] += hessian[rows, rows]
            for q in range(p + 1, len(frames)):
                self._couple(a, frames[q], hessian[rows, q * width : (q + 1) * width])

    def _couple(self, a: int, b: int, block: Array) -> None:
        if a == b:
            self.diagonal[a] += block + block.T
            return
        key, block = ((a, b), block) if a < b else ((b, a), block.T)
        self._coupled[key] = self._coupled[key] + block if key in self._coupled else block.copy()

    def step(self, free: npt.NDArray[np.bool_]) -> Array:
        """Gauss-Newton step ``(frames, width)``; zero for frames that are not ``free (frames,)``."""
        width = self.gradient.shape[1]
        step = np.zeros_like(self.gradient)
        if not free.any():
            return step
        position = np.cumsum(free) - 1
        blocks = [(int(a), int(a), self.diagonal[a]) for a in np.flatnonzero(free)]
        for (a, b), block in self._coupled.items():
            if free[a] and free[b]:
                blocks += [(a, b, block), (b, a, block.T)]
        inner_row, inner_col = (index.ravel() for index in np.indices((width, width)))
        rows = np.concatenate([position[a] * width + inner_row for a, _, _ in blocks])
        cols = np.concatenate([position[b] * width + inner_col for _, b, _ in blocks])
        values = np.concatenate([block.ravel() for _, _, block in blocks])
        size = int(free.sum()) * width
        matrix = sparse.coo_array((values, (rows, cols)), shape=(size, size)).tocsc()
        step[free] = spsolve(matrix, -self.gradient[free].ravel()).reshape(-1, width)
        return step


def descend(
    state: State,
    evaluate: Callable[[State], FrameSystem],
    direction: Callable[[State, FrameSystem], Direction],
    move: Callable[[State, Direction, float], State],
    iterations: int,
) -> State:
    """Gauss-Newton with a step that is halved until the cost falls; the cost never rises.

    ``move(state, direction, share)`` goes a share of the way. A system evaluated to judge a step is the next
    iteration's, so that a step taken at once costs one pass over the data.
    """
    system = evaluate(state)
    for _ in range(iterations):
        way, share = direction(state, system), 1.0
        while True:
            candidate = move(state, way, share)
            found = evaluate(candidate)
            if found.cost < system.cost:
                break
            share *= 0.5
            if share < SMALLEST_STEP:
                return state
        small = system.cost - found.cost < CONVERGED * system.cost
        state, system = candidate, found
        if small:
            break
    return state


class _ScaleProblem:
    """Cost and normal equations of phase 1; unknowns of a frame are ``log s`` and ``beta``."""

    def __init__(self, samples: Samples, wTc: Array, config: RefinementConfig) -> None:
        self._samples, self._wTc, self._config = samples, wTc, config
        self._shape = (wTc.shape[0], wTc.shape[1])
        self._nearest = np.full(self._shape, np.inf)
        """Least depth of the pixels that bear on a frame, its own and those seen in it."""

    def evaluate(self, scales: Scales) -> FrameSystem:
        """One pass over the samples."""
        system = FrameSystem(self._shape[0] * self._shape[1], 2)
        typical = np.full(self._shape, np.nan)
        for sample in self._samples():
            usable = sample.inverse_depth[sample.inverse_depth > 0.0]
            if len(usable) == 0:
                continue
            typical[sample.i] = 1.0 / np.median(usable)
            share = independent_share(sample)
            for k in range(len(sample.neighbours)):
                self._add_pair(system, sample, k, scales, share)
        self._add_prior(system, scales, typical)
        return system

    def _add_pair(
        self, system: FrameSystem, sample: FrameSample, k: int, scales: Scales, share: float
    ) -> None:
        i, j = sample.i, sample.neighbours[k]
        rho, slope = _corrected(sample.inverse_depth, scales.scale[i], scales.offset[i])
        there, slope_there = _corrected(sample.inverse_depth_there[k], scales.scale[j], scales.offset[j])
        self._note_nearest(i, sample.inverse_depth[sample.weight[k] > 0.0])
        self._note_nearest(j, sample.inverse_depth_there[k][sample.weight[k] > 0.0])
        jTi = invert_pose(self._wTc[j]) @ self._wTc[i]
        terms = pair_terms(sample, k, rho, there, jTi, self._config)
        points = terms.points
        if len(points) == 0:
            system.cost += share * terms.cost
            return
        seen = terms.information[:, 2] > 0.0
        jacobian = np.zeros((len(points), 3, 4))
        jacobian[:, :2, :2] = terms.flow.by_inverse_depth[:, :, None] * slope[points][:, None]
        jacobian[:, 2, :2] = terms.ratio.by_inverse_depth_i[:, None] * slope[points]
        jacobian[seen, 2, 2:] = terms.ratio.by_inverse_depth_j[seen, None] * slope_there[points[seen]]
        hessian, gradient = normal_terms(jacobian, terms)
        width = self._shape[1]
        frames = [i[0] * width + i[1], j[0] * width + j[1]]
        system.add(frames, share * hessian, share * gradient, share * terms.cost)

    def _note_nearest(self, frame: tuple[int, int], inverse_depth: Array) -> None:
        largest = float(np.max(inverse_depth, initial=0.0, where=inverse_depth > 0.0))
        if largest > 0.0:
            self._nearest[frame] = min(self._nearest[frame], 1.0 / largest)

    def _add_prior(self, system: FrameSystem, scales: Scales, typical: Array) -> None:
        # a frame without pixels of its own is only seen by others: their depth is its scale of length
        known = typical[np.isfinite(typical)]
        typical = np.where(np.isfinite(typical), typical, np.median(known) if len(known) else 1.0).ravel()
        deviation = np.stack([np.log(scales.scale).ravel(), scales.offset.ravel()], axis=1)
        sigma = np.stack([np.full_like(typical, LOG_SCALE_SIGMA), OFFSET_SIGMA * typical], axis=1)
        system.diagonal[:, [0, 1], [0, 1]] += sigma**-2
        system.gradient += deviation / sigma**2
        system.cost += 0.5 * float(((deviation / sigma) ** 2).sum())

    def direction(self, scales: Scales, system: FrameSystem) -> Array:
        """Step ``(N, T, 2)``, shortened for each frame so that its depth stays positive."""
        step = system.step(np.ones(len(system.gradient), bool)).reshape(*self._shape, 2)
        step[..., 0] = np.clip(step[..., 0], -LARGEST_LOG_STEP, LARGEST_LOG_STEP)
        bounded = np.isfinite(self._nearest)
        nearest = np.where(bounded, self._nearest, 0.0)
        least = NEAREST_KEEPS * (scales.scale * nearest + scales.offset)
        while True:
            new = scales.scale * np.exp(step[..., 0]) * nearest + scales.offset + step[..., 1]
            short = bounded & (new < least)
            if not short.any():
                return step
            step[short] *= 0.5

    def move(self, scales: Scales, step: Array, share: float) -> Scales:
        """A share of a step, straight in ``s``: depth that is positive at both ends is so in between."""
        growth = share * np.expm1(step[..., 0])
        return Scales(scales.scale * (1.0 + growth), scales.offset + share * step[..., 1])


def normal_terms(jacobian: Array, terms: PairTerms) -> tuple[Array, Array]:
    """Gauss-Newton matrix ``(m, m)`` and gradient ``(m,)`` of a pair for ``jacobian (n, 3, m)``."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    weighted = rows * terms.information.reshape(-1, 1)
    return weighted.T @ rows, weighted.T @ terms.residual.ravel()


def _corrected(inverse_depth: Array, scale: float, offset: float) -> tuple[Array, Array]:
    """Inverse depth ``(M,)`` after scale and offset, NaN where it is none, and its derivatives ``(M, 2)`` by
    the logarithm of the scale and by the offset."""
    divisor = scale + offset * inverse_depth
    positive = (divisor > 0.0) & (inverse_depth > 0.0)
    rho = np.where(positive, inverse_depth / np.where(positive, divisor, 1.0), np.nan)
    by_log_scale = -scale * rho / np.where(positive, divisor, 1.0)
    return rho, np.stack([by_log_scale, -(rho**2)], axis=1)
