"""The outline of what moves: where an image differs from what stands behind it.

Flow is smooth and says where something moves, but not where it ends. What stands behind it is seen at other
times: they know its depth, and its pixels there, found through that depth, have the colour that this pixel
would have if nothing stood before it. Where that leaves it open, the edges of the image decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.refinement.medians import known_median
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.lattice import Lattice, lattice_solution, neighbour_likeness
from mvdyn_gtsam.refinement.views import pixels_seen

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NOTHING = -1000.0
"""Colour outside an image."""
BLUR = 0.6
"""Standard deviation of the blur against noise, px of the view. Source: 0.6 and 1 compared on four rendered
scenes: the wider made a ring of what stands still move, up to 6 % of the error there."""
PEAK, PEAK_SHARE = 5, 0.35
"""Side of the square in which the strongest difference is looked for, px of the view, and the share of it
that a pixel on an outline has. Source: as of the next three, 150 settings compared on every tenth frame of
four rendered scenes by what was missed and what was called moving, the latter counting 0.4 since its relative
error is less; a script that is not kept. Shares of 0.2 to 0.4 were within 2 %, none at all worse by 7 %."""
SURE_OVER = 0.5
"""Share by which a difference exceeds that for full evidence."""
HELD, HELD_OUTSIDE = 0.3, 0.1
"""What it counts, beside evidence of 1, that a pixel seems to move, and that it does not."""
LIKENESS, CONTRAST = 8.0, 5.0
"""How far neighbours of one colour share their evidence, and the grey levels at which that has fallen to
1/e."""
STANDS = 10.0
"""What it counts that a pixel certainly stands still. Source: choice."""
TOLERANCE, MOST_STEPS = 0.01, 200
"""Of conjugate gradients. Source: choice; only the sign counts."""
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
    """Pixels of ``around (h, w)`` that hide what stands behind them.

    Their ``colour (h, w, 3)`` differs from what stands ``behind`` them; where that is NaN, and a little
    everywhere, ``mask (h, w)`` counts: where it seems to move. Pixels persuade neighbours of like colour (a
    random walk as in https://doi.org/10.1109/TPAMI.2006.233, with evidence for seeds), so that an outline
    lies where the image has one, gaps that only look like the background are closed and those through which
    it is seen are not.
    """
    if not around.any():
        return np.zeros_like(mask)
    known = np.isfinite(behind[..., 0]) & around
    held = np.where(mask, np.float32(HELD), np.float32(HELD_OUTSIDE))
    pull = np.where(known, _evidence(colour, behind, known, config), 0.0) + np.where(mask, held, -held)
    rows, columns = (_with_margin(positions) for positions in np.nonzero(around))
    total = np.where(around, known + held, STANDS)[rows, columns].astype(np.float32)
    right = np.where(around, pull, -STANDS)[rows, columns].astype(np.float32)
    likely = _persuaded(right, total, colour[rows, columns])
    moves = np.zeros_like(mask)
    moves[rows, columns] = likely > 0.0
    return np.asarray(cv2.medianBlur((moves & around).astype(np.uint8), 3) > 0)


def _evidence(colour: Float32, behind: Float32, known: Mask, config: RefinementConfig) -> Float32:
    """``(h, w)`` from -1, just like what stands behind, to 1; any where that is not ``known (h, w)``.

    0 at a share of the strongest difference around: so far a pixel on an outline is hidden, however much the
    two sides differ.
    """
    difference = np.where(known, np.linalg.norm(colour - behind, axis=2), 0.0).astype(np.float32)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), BLUR)
    difference = cv2.GaussianBlur(difference, (0, 0), BLUR) / np.maximum(weight, 1e-3)
    strongest = cv2.dilate(difference, np.ones((PEAK, PEAK), np.uint8))
    limit = np.maximum(np.float32(config.moving_contrast), np.float32(PEAK_SHARE) * strongest)
    over = (difference - limit) / limit
    return np.asarray(np.where(over > 0.0, np.minimum(over / np.float32(SURE_OVER), 1.0), over), np.float32)


def _persuaded(pull: Float32, total: Float32, colour: Float32) -> Float32:
    """``(h, w)`` evidence ``pull / total`` after neighbours of like ``colour (h, w, 3)`` shared it."""
    across, down = neighbour_likeness(colour, CONTRAST)
    lattice = Lattice(total, np.float32(LIKENESS) * across, np.float32(LIKENESS) * down)
    return lattice_solution(lattice, pull, TOLERANCE, MOST_STEPS)


def _with_margin(positions: npt.NDArray[np.int64]) -> slice:
    """From the first to the last of ``positions``, and a pixel more that stands still."""
    return slice(max(0, int(positions.min()) - 1), int(positions.max()) + 2)


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
