"""Depth of the pixels of a moving region: a sweep about the region's depth.

A region's one depth is right for most of it at best: two things that meet in the image make one region, an
arm reaches out of its body, and what is thick is nearer in its middle. So depths about the region's are
compared in the views of the instant, at the resolution that is solved. What one patch says is noise;
aggregated over the region, with large steps dear, it is a shape.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.frontend.plane_sweep import SweepConfig, SweepView, lowest, patch_likeness, semi_global
from mvdyn_gtsam.refinement.moving.region_depth import PATCH, InstantView, contradicted, own_say, side_seen
from mvdyn_gtsam.refinement.patches import contrast

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

STEP, STEPS = 0.03, 20
"""Step of log depth, and how many are tried either way. Source: steps of 0.03 and 0.04, to 0.5 and 0.6
compared on three rendered scenes, all within 4 %; two people far apart in depth want the wider reach."""
SWEEP = SweepConfig(window=PATCH, unseen=np.nan, small_step=2.0, large_step=100.0)
"""Costs of a step and of a jump between neighbours. Source: 0.4 to 2 and 4 to 100 compared on four rendered
scenes: each patch alone is right within 5 % for a third to two thirds of the pixels only."""
UNSEEN = np.float32(0.3)
"""How alike patches with texture are at some wrong depth by chance, which is what a depth gets from a view
that would not see it. Source: 0 to 0.5 compared on five rendered and four generated scenes, 0.2 to 0.35
within 3 %; with 0 people whom no other camera saw were taken for others, twice as near, and moving depth was
worse by a tenth."""
SAY = np.float32(4.5)
"""Of how alike patches are. Source: 2, 3 and 4.5 compared there, within 3 %. On the first four 6 told two
things that meet apart better, by 4 %, and an arm of few colours was worse by 15 %."""
DENIED = np.float32(2.0)
"""Cost of a depth that a view denies. Source: 0.5, 2 and 4 compared there: 0.5 is worse, 4 within 2 %."""
PRIOR, PRIOR_REACH = np.float32(0.6), np.float32(0.3)
"""Cost of a log depth so far or farther from the region's. Source: 0.4 to 3 and 0.15 to 0.6 compared there:
more keeps what meets in the image together."""


def swept_region(
    log_inverse_depth: float,
    region: Mask,
    grey: Float32,
    intrinsics: Array,
    rays: Float32,
    views: Sequence[InstantView],
) -> Float32:
    """Log inverse depth ``(M,)`` of the pixels of ``region (h, w)``, which lies about ``log_inverse_depth``.

    ``grey (h, w)`` is the image, ``intrinsics (3, 3)`` and ``rays (h w, 3)`` are its. A depth costs what it
    looks less alike in the view that likes it best, as much as by chance where none sees it, and more where
    another view sees something still, and not before it. Views from the side see another side of a thing:
    they have less of a say in how it looks, and tell where it ends.
    """
    rows, columns = (_around(np.flatnonzero(region.any(axis)), region.shape[1 - axis]) for axis in (1, 0))
    inside, own = region[rows, columns], rays[region.ravel()]
    tried = np.float32(log_inverse_depth) + np.float32(STEP) * np.arange(-STEPS, STEPS + 1, dtype=np.float32)
    shifted = intrinsics.copy()
    shifted[:2, 2] -= columns.start, rows.start
    crop = np.ascontiguousarray(grey[rows, columns].astype(np.uint8))
    best = np.zeros((len(tried), len(own)), np.float32)
    texture = contrast(crop.astype(np.float32), PATCH)[inside] ** 2
    by_chance = UNSEEN * texture / (texture + np.float32(SWEEP.noise**2))
    for view in views:
        alike = patch_likeness(crop, shifted, _sweep_view(view), np.exp(tried), SWEEP)[:, inside]
        np.copyto(alike, by_chance, where=np.isnan(alike))
        np.maximum(best, np.float32(own_say(log_inverse_depth, own, view.jTi)) * alike, out=best)
    cost = PRIOR * np.minimum(np.abs(tried - tried[STEPS]) / PRIOR_REACH, 1.0)[:, None] - SAY * best
    for each, theta in zip(cost, tried, strict=True):
        each += DENIED * contradicted(np.full(len(own), theta, np.float32), own, views)
    volume = np.zeros((*crop.shape, len(tried)), np.float32)
    volume[inside] = cost.T
    level, fraction = (found[inside] for found in lowest(semi_global(volume, crop, SWEEP)))
    theta = tried[level] + np.float32(STEP) * fraction
    return np.asarray(theta + side_seen(theta, own, views), np.float32)


def _sweep_view(view: InstantView) -> SweepView:
    return SweepView(view.grey.astype(np.uint8), view.intrinsics, view.jTi, same_instant=True)


def _around(positions: npt.NDArray[np.int64], length: int) -> slice:
    """From the first to the last of increasing positions, and what the patches there reach into."""
    return slice(max(0, int(positions[0]) - PATCH), min(length, int(positions[-1]) + PATCH + 1))
