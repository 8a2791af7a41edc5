"""Parts of a moving region at depths of their own.

Two things that meet in the image make one region, and an arm reaches out of its body. A region's one depth is
right for most of it at best. What the cameras see at one instant, each patch alone, is too noisy to do
better; added up over a wide window of what moves, no more, it tells the parts from each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.moving_depth import PATCH, InstantView, contradicted
from mvdyn_gtsam.refinement.patches import likeness

Mask = npt.NDArray[np.bool_]

WINDOW = 0.16
"""Side of the window, as a share of the image's width. Source: 0.12, 0.16 and 0.24 compared on three rendered
scenes, all better than none and little apart."""
STEP, STEPS = 0.07, 7
"""Step of log depth, and how many are tried either way. Source: 4, 5, 6, 7 and 11 compared there; farther off
more looks alike by chance."""
LEAD = 0.1
"""How much more alike, on average over the window, a part must look at another depth than at the region's.
Source: 0 to 0.3 compared there; what moves was 9.9 % off instead of 13.8, 9.1 and 9.3, 2.9 and 3.4."""
LEAST = 0.2
"""How alike it must look there at all. Source: ``moving_depth.FULL_SUPPORT``; what no view sees looks a
little like anything."""


def depth_of_parts(
    theta: Float32, region: Mask, grey: Float32, rays: Float32, views: Sequence[InstantView]
) -> Float32:
    """Log inverse depth ``(M,)`` of the pixels of ``region (h, w)``: ``theta (M,)``, but where the views of
    the instant look clearly more alike at another depth, that one.

    A depth at which another view sees something still, and not before it, counts as unlike. ``grey (h, w)``
    is the image and ``rays (h w, 3)`` those of its pixels.
    """
    rows, columns = (_around(np.flatnonzero(region.any(axis)), region.shape[1 - axis]) for axis in (1, 0))
    inside = region[rows, columns]
    crop, own = grey[rows, columns], rays.reshape(*region.shape, 3)[rows, columns]
    tried = np.float32(np.median(theta)) + np.float32(STEP) * np.arange(-STEPS, STEPS + 1, dtype=np.float32)
    side = 2 * round(0.5 * WINDOW * region.shape[1]) + 1
    alike = np.stack([_alike(depth, inside, crop, own, views, side) for depth in tried])
    there = np.clip(np.rint((theta - tried[0]) / STEP), 0, 2 * STEPS).astype(np.int64)
    pixel = np.arange(len(theta))
    # a step to either side is the same depth
    kept = np.max([alike[np.clip(there + k, 0, 2 * STEPS), pixel] for k in (-1, 0, 1)], axis=0)
    best = alike.argmax(axis=0)
    most = alike[best, pixel]
    return np.where((most > kept + LEAD) & (most > LEAST), tried[best], theta).astype(np.float32)


def _alike(
    theta: np.float32, inside: Mask, grey: Float32, rays: Float32, views: Sequence[InstantView], side: int
) -> Float32:
    """Likeness ``(M,)`` at one depth of what lies ``inside (h, w)``: mean of the window about each pixel."""
    inverse_depth = np.full(grey.size, np.exp(theta), np.float32)
    best = np.zeros(grey.shape, np.float32)
    for view in views:
        found, seen = likeness(grey, inverse_depth, rays.reshape(-1, 3), view, PATCH)
        best = np.maximum(best, np.where(seen, found, 0.0))
    values = best[inside]
    values[contradicted(np.full(len(values), theta, np.float32), rays[inside], views)] = 0.0
    field, count = np.zeros(grey.shape, np.float32), inside.astype(np.float32)
    field[inside] = values
    total, weight = (
        cv2.boxFilter(x, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for x in (field, count)
    )
    return np.asarray(total[inside] / weight[inside], np.float32)


def _around(positions: npt.NDArray[np.int64], length: int) -> slice:
    """From the first to the last of increasing positions, and what the patches there reach into."""
    return slice(max(0, int(positions[0]) - PATCH), min(length, int(positions[-1]) + PATCH + 1))
