"""The outline of what moves: where an image differs from what stands behind it.

Flow is smooth and says where something moves, but not where it ends. What stands behind it is seen at other
times: they know its depth, and its pixels there, found through that depth, have the colour that this pixel
would have if nothing stood before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.refinement.initial import closed, known_median
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import pixels_seen

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NOTHING = -1000.0
"""Colour outside an image."""
BLUR = 0.6
"""Standard deviation of the blur against noise, px of the view. Source: 0.6 and 1 compared on four rendered
scenes: the wider made a ring of what stands still move, up to 6 % of the error there."""
ROW = 1024
"""Pixels are sampled in rows of so many: cv2.remap takes none of 2^15 and more."""


@dataclass(frozen=True)
class OtherTime:
    """The same camera at another time."""

    colour: Float32
    """``(h, w, 3)``"""
    moves: npt.NDArray[np.uint8]
    """``(h, w)`` 1 where something may move: no background."""
    jTi: Array
    """``(4, 4)``"""
    theta: Float32
    """``(h, w)`` log inverse depth."""
    settled: Mask
    """``(h, w)`` where that is to be trusted."""


def depth_behind(around: Mask, rays: Float32, intrinsics: Array, others: Sequence[OtherTime]) -> Float32:
    """Log inverse depth ``(h, w)`` of what stands ``around (h, w)``, and behind what moves there.

    The median of the other times that see it, NaN without any. Their points are brought into this view, and
    of each time the nearest is kept. ``rays (h w, 3)`` and ``intrinsics (3, 3)`` are those of all the views.
    """
    height, width = around.shape
    seen = np.full((len(others), around.size), np.nan, np.float32)
    for row, other in zip(seen, others, strict=True):
        still = np.flatnonzero(other.settled & (other.moves == 0))
        inverse_depth, iTj = np.exp(other.theta.ravel()[still]), invert_pose(other.jTi)
        at, front = pixels_seen(inverse_depth, rays[still], iTj, intrinsics)
        column, line = np.rint(at.T)
        inside = front & (column >= 0) & (line >= 0) & (column < width) & (line < height)
        pixel = np.where(inside, line * width + column, 0).astype(np.int64)
        kept = np.flatnonzero(inside & around.ravel()[pixel])
        pixel, inverse_depth = pixel[kept], inverse_depth[kept]
        # depth here over depth there
        ratio = rays[still[kept]] @ iTj[2, :3].astype(np.float32) + inverse_depth * np.float32(iTj[2, 3])
        here = np.log(inverse_depth / ratio)
        order = np.argsort(here)  # the nearest is written last, and stays
        row[pixel[order]] = here[order]
    return known_median(seen).reshape(around.shape)


def background(
    inverse_depth: Float32, rays: Float32, intrinsics: Array, others: Sequence[OtherTime]
) -> Float32:
    """Colour ``(M, 3)`` of what stands at ``inverse_depth (M,)`` along ``rays (M, 3)``.

    The median of the other times that see it, NaN without any. ``intrinsics (3, 3)`` are those of the
    images.
    """
    seen = np.full((len(others), len(rays), 3), np.nan, np.float32)
    for row, other in zip(seen, others, strict=True):
        at, front = pixels_seen(inverse_depth, rays, other.jTi, intrinsics)
        value = _sampled(other.colour, at, NOTHING)
        free = front & (value[:, 0] >= 0.0) & (_sampled(other.moves.astype(np.float32), at, 1.0) < 0.1)
        row[free] = value[free]
    return known_median(seen)


def grown(mask: Mask, reach: float) -> Mask:
    """``mask (h, w)`` and what is as near as ``reach``, a share of the width."""
    radius = max(1, round(reach * mask.shape[1]))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0)


def outlined(mask: Mask, around: Mask, colour: Float32, behind: Float32, config: RefinementConfig) -> Mask:
    """Pixels of ``around (h, w)`` whose ``colour (h, w, 3)`` differs from what stands ``behind`` them; where
    that is NaN, those of ``mask (h, w)``.

    Of ``mask`` also the gaps between these, which only look like the background.
    """
    known = np.isfinite(behind[..., 0]) & around
    difference = np.where(known, np.linalg.norm(colour - behind, axis=2), 0.0).astype(np.float32)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), BLUR)
    difference = cv2.GaussianBlur(difference, (0, 0), BLUR) / np.maximum(weight, 1e-3)
    moves = np.where(known, difference > config.moving_contrast, mask & around).astype(np.uint8)
    moves = cv2.medianBlur(moves, 5)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    moves = np.asarray(cv2.morphologyEx(moves, cv2.MORPH_CLOSE, kernel), np.uint8)
    return np.asarray(((moves > 0) | (closed(moves, config) > 0) & mask) & around)


def _sampled(image: Float32, at: Float32, outside: float) -> Float32:
    """``(M[, C])`` of ``image (h, w[, C])`` at pixels ``(M, 2)``."""
    rows = -(-len(at) // ROW)
    pixels = np.zeros((rows * ROW, 2), np.float32)
    pixels[: len(at)] = at
    value = cv2.remap(
        image,
        pixels.reshape(rows, ROW, 2),
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(outside,) * 4,
    )
    return np.asarray(value.reshape(-1, *image.shape[2:])[: len(at)], np.float32)
