"""Phase 1: scale and offset of every frame's depth with the poses held fixed (paper, "Per-frame scale
alignment").

``D_i' = s_i D_i + beta_i`` minimises ``w_f L_flow + w_d L_disp``. The poses fix the scale of the world, so
wherever there is parallax nothing is left free; a weak prior holds the rest. What phase 2 shares with it lies
here too: the robust terms of one pair, the sparse system over frames, and the descent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.descent import FrameSystem, descend
from mvdyn_gtsam.refinement.solve.reprojection import (
    Samples,
    independent_share,
    normal_terms,
    reprojection_terms,
)
from mvdyn_gtsam.refinement.solve.samples import FrameSample

Array = npt.NDArray[np.float64]

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
            self._add_sample(system, sample, scales)
        self._add_prior(system, scales, typical)
        return system

    def _add_sample(self, system: FrameSystem, sample: FrameSample, scales: Scales) -> None:
        i, (cameras, times) = sample.i, np.array(sample.neighbours, int).reshape(-1, 2).T
        rho, slope = _corrected(sample.inverse_depth, scales.scale[i], scales.offset[i])
        there, slope_there = _corrected(
            sample.inverse_depth_there,
            scales.scale[cameras, times][:, None],
            scales.offset[cameras, times][:, None],
        )
        self._note_nearest(sample)
        jTi = invert_pose(self._wTc[cameras, times]) @ self._wTc[i]
        terms = reprojection_terms(sample, rho, there, jTi, self._config)
        jacobian = np.zeros((3, 4, len(terms.points)))
        jacobian[:, :2] = terms.by_inverse_depth[:, None] * slope[:, terms.points]
        # an unknown depth has no derivative; its weight is zero
        by_there = np.nan_to_num(slope_there[:, terms.neighbour, terms.points])
        jacobian[2, 2:] = terms.by_inverse_depth_there * by_there
        share, width = independent_share(sample), self._shape[1]
        system.cost += share * terms.cost
        for part, (camera, time) in zip(terms.parts, sample.neighbours, strict=True):
            hessian, gradient = normal_terms(jacobian, terms, part)
            system.add([i[0] * width + i[1], camera * width + time], share * hessian, share * gradient)

    def _note_nearest(self, sample: FrameSample) -> None:
        used = sample.weight > 0.0
        own = np.where(used.any(axis=0), sample.inverse_depth, 0.0)
        largest = (
            np.nanmax(own, initial=0.0),
            *np.nanmax(np.where(used, sample.inverse_depth_there, 0.0), axis=1, initial=0.0),
        )
        for frame, inverse_depth in zip((sample.i, *sample.neighbours), largest, strict=True):
            if inverse_depth > 0.0:
                self._nearest[frame] = min(self._nearest[frame], 1.0 / float(inverse_depth))

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


def _corrected(inverse_depth: Array, scale: Array | float, offset: Array | float) -> tuple[Array, Array]:
    """Inverse depth ``(..., M)`` after scale and offset, NaN where it is none, and its derivatives ``(2, ...,
    M)`` by the logarithm of the scale and by the offset."""
    divisor = scale + offset * inverse_depth
    positive = (divisor > 0.0) & (inverse_depth > 0.0)
    divisor = np.where(positive, divisor, 1.0)
    rho = np.where(positive, inverse_depth / divisor, np.nan)
    return rho, np.stack([-scale * rho / divisor, -(rho**2)])
