"""Where a thing stands: its depth if no other camera sees it.

Most things stand on the ground, and most cameras are held upright: a thing is as far as the ground below it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32

Mask = npt.NDArray[np.bool_]

FEET = 0.1
"""Lowest share of a thing's height at which it touches the ground."""
GROUND_ROWS = 2
"""Rows of the view below it that are the ground."""


@dataclass(frozen=True)
class Footing:
    """Of a thing in an image."""

    log_inverse_depth: float
    """Of the ground there."""
    feet_seen: bool
    """Else the thing reaches out of the image below, and stands there or nearer."""


def footing(theta: Float32, region: Mask, still: Mask) -> Footing | None:
    """Where the thing in ``region (h, w)`` stands; None where nothing tells.

    ``theta (h, w)`` is log inverse depth of the background. Where the lower end is not in the image, what is
    ``still (h, w)`` beside it at the border stands for the ground, which it hides there.
    """
    rows, columns = np.nonzero(region)
    lowest = int(rows.max())
    if lowest + GROUND_ROWS < len(theta):
        height = lowest - int(rows.min()) + 1
        feet = np.unique(columns[rows > lowest - max(1, round(FEET * height))])
        return Footing(float(np.median(theta[lowest + 1 : lowest + 1 + GROUND_ROWS, feet])), True)
    beside = _beside(columns[rows >= len(theta) - GROUND_ROWS], np.all(still[-GROUND_ROWS:], axis=0))
    if not len(beside):
        return None
    return Footing(float(np.median(theta[-GROUND_ROWS:, beside])), False)


def _beside(columns: npt.NDArray[np.int64], usable: Mask) -> npt.NDArray[np.int64]:
    """Of the columns ``usable (w,)`` the nearest to those from the least to the greatest of ``columns``, as
    many as there are in between."""
    first, last = int(columns.min()), int(columns.max())
    there = np.flatnonzero(usable)
    distance = np.maximum(first - there, there - last)
    return there[np.argsort(distance, kind="stable")[: last - first + 1]]
