"""The shape of what moves, from the views of its instant.

What the planes of two cameras agree on is its surface. From there depth spreads to neighbours of like
colour, such as those on a side that no other camera sees; a region in which nothing is agreed on stays as a
sweep left it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import LABELS, Context
from mvdyn_gtsam.refinement.moving.free_space import depth_beyond
from mvdyn_gtsam.refinement.moving.region_depth import own_say
from mvdyn_gtsam.refinement.moving.relief import RELIEF
from mvdyn_gtsam.refinement.moving.slanted_patches import PatchView, fitted_planes
from mvdyn_gtsam.refinement.solve.lattice import Lattice, lattice_solution, neighbour_likeness

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.integer]

FITTED = "fitted"
"""The array ``(h, w, 4)`` of what ``fitted_planes`` finds in regions that move: log inverse depth, its
slopes, likeness; NaN elsewhere."""
LEAST_ALIKE = 0.4
"""From which a plane counts. Source: none, 0.4 and 0.55 compared on four rendered scenes: with none two
cameras that see different sides of a person agree on nonsense."""
AGREES = 0.02
"""Difference of log depths up to which two cameras agree. Source: 0.02, 0.03 and 0.05 compared there:
each is better than the next by 1 to 5 %."""
AGREED, STAYS = np.float32(4.0), np.float32(0.05)
"""What it counts, beside ``TIE``, that a pixel lies where two cameras agree, and where it was."""
TIE, CONTRAST, KINK = np.float32(200.0), 5.0, np.float32(0.02)
"""How far neighbours of one colour share their depth, grey levels at which that has fallen to 1/e, and the
difference of log depths at which it has to a half. Source: ties of 2 to 800 and 0.01 to 0.2 that a pixel
stays compared there: moving depth of robodog_overlap is better by a third, of three_cameras by a tenth, than
without; 0.01 costs roboarm a tenth."""
EVEN, FEW = 6.0, 0.2
"""Standard deviation, px of the view, of the mean of slopes, and share of them around that must be sure for
it to count fully. Source: this mean, each pixel's own slope and none compared there: the mean is 0.5 to 3 %
better than none."""
STEPS = 4
"""Reweighted solutions."""
TOLERANCE, MOST_STEPS = 0.001, 300
"""Of conjugate gradients. Source: choice."""


@dataclass(frozen=True)
class FittedView:
    """The planes that another camera of the instant found."""

    theta: Float32
    """``(h_j, w_j)`` log inverse depth; NaN where it found none."""
    intrinsics: Array
    """``(3, 3)``"""
    jTi: Array
    """``(4, 4)``"""


def fit_task(context: Context, frame: Frame) -> None:
    """Fit planes to the regions of a frame that move and whose depth its instant tells."""
    workspace, theta = context.workspace, context.image("prior", frame)
    regions = _regions(context, frame)
    fitted = np.full((*theta.shape, 4), np.nan, np.float32)
    view, colour = workspace.views[frame[0]], context.colour(frame)
    for label in range(1, int(regions.max()) + 1):
        region = regions == label
        if not region.any():
            continue
        own, middle = view.rays[region.ravel()], float(np.median(theta[region]))
        views = [
            PatchView(context.colour(j), workspace.views[j[0]].intrinsics, jTi, own_say(middle, own, jTi))
            for j, jTi in _others(context, frame)
        ]
        fit = fitted_planes(theta, region, colour, view.intrinsics, views, (*frame, label))
        fitted[region] = np.column_stack([fit.theta, fit.slope, fit.likeness])
    workspace.write(FITTED, frame, fitted)


def shape_task(context: Context, frame: Frame) -> None:
    """Where phase 2 begins, with the shape that the cameras of an instant agree on."""
    workspace, regions = context.workspace, _regions(context, frame)
    if not regions.any():
        return
    fitted = context.image(FITTED, frame)
    views = [
        FittedView(context.image(FITTED, j)[..., 0], workspace.views[j[0]].intrinsics, jTi)
        for j, jTi in _others(context, frame)
    ]
    agreed = np.zeros(regions.shape, bool)
    asked = np.nan_to_num(fitted[..., 3]) > LEAST_ALIKE
    agreed[asked] = agreed_on(fitted[asked, 0], workspace.views[frame[0]].rays[asked.ravel()], views)
    before = context.image("prior", frame)
    theta = shaped(before, regions, fitted[..., :3], agreed, context.colour(frame))
    workspace.write("prior", frame, theta)
    workspace.write("begun", frame, np.exp(theta))
    workspace.write(RELIEF, frame, context.image(RELIEF, frame) + theta - before)


def _regions(context: Context, frame: Frame) -> Labels:
    """``(h, w)`` labels of what moves and has a relief, 0 elsewhere."""
    labels = np.asarray(context.workspace.read(LABELS, frame), np.int32)
    return np.where(np.isfinite(context.image(RELIEF, frame)), labels, 0)


def _others(context: Context, frame: Frame) -> list[tuple[Frame, Array]]:
    """The other cameras of an instant, and their ``jTi (4, 4)``."""
    wTc, (camera, time) = context.poses(), frame
    others = [(other, time) for other in context.group_of(camera) if other != camera]
    return [(j, invert_pose(wTc[j]) @ wTc[frame]) for j in others]


def agreed_on(theta: Float32, rays: Float32, views: Sequence[FittedView]) -> Mask:
    """``(M,)`` which points at log inverse depth ``theta (M,)`` along ``rays (M, 3)`` another view finds
    there."""
    found = np.zeros(len(theta), bool)
    for view in views:
        farther, _ = depth_beyond(theta, rays, view)
        found |= np.abs(farther) < AGREES
    return found


def shaped(theta: Float32, regions: Labels, fitted: Float32, agreed: Mask, colour: Float32) -> Float32:
    """Log inverse depth ``theta (h, w)`` with ``regions (h, w)``, numbered from 1, shaped as ``fitted (h, w,
    3)`` is, depths and slopes, where it is ``agreed (h, w)`` on.

    ``colour (h, w, C)`` is the image. Elsewhere, and in regions where nothing is agreed on, nothing changes.
    """
    regions = np.where(np.isin(regions, regions[agreed]), regions, 0)
    if not regions.any():
        return theta
    rows, columns = (slice(int(at.min()), int(at.max()) + 1) for at in np.nonzero(regions))
    labels, start, sure = regions[rows, columns], theta[rows, columns], agreed[rows, columns]
    known = np.where(sure, fitted[rows, columns, 0], np.float32(0.0))
    to_right, to_below = _slopes(fitted[rows, columns, 1:], sure)
    across, down = neighbour_likeness(colour[rows, columns], CONTRAST)
    across[:, :-1] *= (labels[:, :-1] == labels[:, 1:]) & (labels[:, 1:] > 0)
    down[:-1] *= (labels[:-1] == labels[1:]) & (labels[1:] > 0)
    stays = np.where(labels > 0, STAYS, np.float32(1.0))
    found, counts = start, np.where(sure, AGREED, np.float32(0.0))
    for step in range(STEPS):
        tie_across, tie_down = TIE * across, TIE * down
        if step > 0:
            # depth has kinks and jumps, and some of what is agreed on is wrong
            tie_across[:, :-1] /= 1.0 + ((np.diff(found, axis=1) - to_right[:, :-1]) / KINK) ** 2
            tie_down[:-1] /= 1.0 + ((np.diff(found, axis=0) - to_below[:-1]) / KINK) ** 2
            off = np.abs(found - known) / np.float32(AGREES)
            counts = np.where(sure, AGREED / np.maximum(off, np.float32(1.0)), np.float32(0.0))
        right = stays * start + counts * known
        for pull, axis in ((tie_across * to_right, 1), (tie_down * to_below, 0)):
            # ties are 0 in the last column and row, so that nothing comes round
            right += np.roll(pull, 1, axis) - pull
        found = lattice_solution(Lattice(stays + counts, tie_across, tie_down), right, TOLERANCE, MOST_STEPS)
    result = theta.copy()
    result[rows, columns] = np.where(labels > 0, found, start)
    return result


def _slopes(fitted: Float32, sure: Mask) -> tuple[Float32, Float32]:
    """Change ``(h, w)`` of log inverse depth to the right and lower neighbours.

    The mean of the slopes ``fitted (h, w, 2)`` that are ``sure (h, w)`` around, less where these are few.
    """
    count = cv2.GaussianBlur(sure.astype(np.float32), (0, 0), EVEN) + np.float32(1e-3)
    total = cv2.GaussianBlur(np.where(sure[..., None], fitted, np.float32(0.0)), (0, 0), EVEN)
    mean = total / np.maximum(count, np.float32(FEW))[..., None]
    return mean[..., 0], mean[..., 1]
