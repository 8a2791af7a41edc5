"""What stands still though its flow contradicts every static depth.

Flow is smooth: around plain things it mixes what is before and behind, or makes something up, and no depth
explains it. A static surface looks alike at other times all the same, at the depth that the sweep found; what
moves does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.initial import known_median
from mvdyn_gtsam.refinement.patches import PictureView, contrast, likeness

Labels = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

TEXTURE = 6.0
"""Contrast of a patch, grey levels, from which it tells a depth from another. Source: choice, three times the
noise."""
TEXTURED_SHARE = 0.1
"""Of a region below which it is bare: flow without texture is no evidence. Source: choice."""


@dataclass(frozen=True)
class StaticRegions:
    """Pixels of regions that stand still."""

    still: Mask
    """``(h, w)`` of all such regions."""
    matched: Mask
    """``(h, w)`` of those which look alike at the swept depth; the others are bare."""
    seen: Mask
    """``(h, w)`` the pixels among them that say so themselves."""


def static_regions(
    labels: Labels,
    grey: Float32,
    inverse_depth: Float32,
    rays: Float32,
    others: Sequence[PictureView],
    least_likeness: float,
) -> StaticRegions:
    """Which regions of ``labels (h, w)``, numbered from 1, stand still.

    ``grey (h, w)`` is the image, ``rays (h w, 3)`` those of its pixels, ``inverse_depth (h, w)`` that of a
    sweep; ``others`` are views of other times. A region stands still where most of its textured pixels that
    are seen there are alike by ``least_likeness`` in most of these views, and where it has no texture.
    """
    alike = _median_likeness(grey, inverse_depth, rays, others)
    textured = contrast(grey) > TEXTURE
    telling = textured & np.isfinite(alike)
    still, matched = (np.zeros(labels.shape, bool) for _ in range(2))
    for label in range(1, int(labels.max(initial=0)) + 1):
        region = labels == label
        if textured[region].mean() < TEXTURED_SHARE:
            still |= region
        elif (region & telling).any() and np.median(alike[region & telling]) > least_likeness:
            still |= region
            matched |= region
    return StaticRegions(still, matched, matched & telling & (np.nan_to_num(alike) > least_likeness))


def _median_likeness(
    grey: Float32, inverse_depth: Float32, rays: Float32, others: Sequence[PictureView]
) -> Float32:
    """``(h, w)`` over the views that see a pixel; NaN where none does."""
    table = np.full((len(others), *grey.shape), np.nan, np.float32)
    for row, view in zip(table, others, strict=True):
        alike, seen = likeness(grey, inverse_depth.ravel(), rays, view)
        row[seen] = alike[seen]
    return known_median(table)
