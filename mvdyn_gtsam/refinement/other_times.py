"""What images of other times say of a frame's first depth.

Flow is smooth: around plain things it mixes what is before and behind, or makes something up, and no static
depth explains it; of things that move fast it finds nothing. A static surface looks alike at other times, at
the depth that the sweep found, whatever the flow says. What moves is alike at no static depth.
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
from mvdyn_gtsam.refinement.context import TRUSTED_SIGMA, Context, trust_of
from mvdyn_gtsam.refinement.initial import closed, regions
from mvdyn_gtsam.refinement.medians import known_median
from mvdyn_gtsam.refinement.neighbours import times_in_view
from mvdyn_gtsam.refinement.patches import Picture, PictureView, contrast, likeness
from mvdyn_gtsam.refinement.plain.local_planes import on_local_planes
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView

Labels = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

PATCH = 5
"""Side of the patches compared, px of the swept size."""
TEXTURE = 6.0
"""Contrast of a patch, grey levels, from which it tells a depth from another. Source: choice, three times the
noise."""
TEXTURED_SHARE = 0.1
"""Of a region below which it is bare: flow without texture is no evidence. Source: choice."""
LEAST_VIEWS = 5
"""Other times that must see a pixel for it to be nowhere alike: it may be hidden in a few. Source: 1, 3 and 5
compared on three rendered scenes and HoloLens: 5 find a sixth less of what moves and next to nothing else."""
BETTER = 0.3
"""By how much more alike the swept depth must look for it to replace one without trust. Source: choice."""
DIFFERENT = 0.1
"""Difference of two log depths from which a pixel can tell which is right. Source: choice."""
RIM = 3
"""Width of the rim that speaks for a plain region, px of the swept size. Source: choice, half a patch."""
RIM_SHARE = np.float32(0.05)
"""Information of what its rim speaks for, of that of a pixel that speaks for itself. Source: shares to 0.5
compared on HoloLens, to 0.05 on multicamvideo: none let fills lean to what is behind, half kept noise."""
AROUND = 15
"""Side of the squares over which plain pixels judge two depths together, px of the swept size: one patch of
hardly any contrast is noise. Source: 9, 15 and 25 compared on HoloLens and KITTI, when textured pixels still
had a say."""
LIKELIER = 0.05
"""By how much more alike the swept depth must look in their mean. Source: 0.03 to 0.1 compared there and on
robodog_overlap, likewise."""
HELD_SHARE = np.float32(0.3)
"""Information of what they say, of that of a pixel that speaks for itself. Source: 0.05 to 1 compared there,
likewise: less lets the road of KITTI go flat, more keeps the noise of HoloLens."""
PLANE_SIDE = 0.12
"""Side of the squares whose planes smooth what they say, as a share of the width. Source: 25 and 41 px
compared on HoloLens, without them noise stays."""
UNLIKE_SHARE = 0.5
"""Of a region whose gaps were closed that must be unlike itself. Source: choice."""
NO_TRUST = 0.2
"""Trust in its depth below which a pixel may move: flow that a static depth explains is the better witness.
Source: choice."""
MATCHED_INFORMATION = TRUSTED_SIGMA**-2
"""On log depth of a pixel that stands still by its likeness alone. Source: choice, half as good as sure."""


@dataclass(frozen=True)
class FirstDepth:
    """Depth of a frame as if nothing moved, and where that fails."""

    theta: Float32
    """``(h, w)`` log inverse depth."""
    information: Float32
    """``(h, w)`` inverse variance of ``theta`` by the flow."""
    fails: npt.NDArray[np.uint8]
    """``(h, w)`` 1 where no static depth explains what is seen."""
    held: npt.NDArray[np.uint8]
    """``(h, w)`` 1 on plain surfaces that have their depth from images of other times alone."""


@dataclass(frozen=True)
class StaticRegions:
    """Pixels of regions that stand still."""

    still: Mask
    """``(h, w)`` of all such regions."""
    matched: Mask
    """``(h, w)`` of those which look alike at the swept depth; the others are bare."""


@dataclass(frozen=True)
class Testimony:
    """What images of other times say of each pixel of a frame, all ``(h, w)``."""

    alike: Float32
    """How alike they are at the swept depth; NaN where none sees it."""
    textured: Mask
    """Where that tells anything."""
    unlike: Mask
    """Alike neither at the swept nor at the first depth, and no flow to trust."""
    better: Mask
    """Clearly more alike at the swept than at the first depth, and no flow to trust."""
    likelier: Mask
    """Plain, with no flow to trust, and more alike at the swept than at the first depth in the mean of those
    around."""
    inside: Mask
    """Within a plain region on whose rim most is ``better``."""


def told_by_other_times(context: Context, frame: Frame, first: FirstDepth) -> FirstDepth:
    """``first`` after the images of other times of the camera were asked.

    Failing regions that look alike there at the swept depth take it and fail no more; nor do bare ones, of
    which flow cannot tell that they move. What looks alike at neither depth, and has no flow, fails too. The
    swept depth also replaces one without trust where it looks clearly better, within plain regions whose rims
    say so, and on plain surfaces, smoothed by planes, where it looks better in the mean.
    """
    said = _testimony(context, frame, first)
    if said is None:
        return first
    config, swept = context.config, np.log(context.image("swept", frame))
    matched = np.float32(MATCHED_INFORMATION)
    theta = np.where(said.better | said.inside | said.likelier, swept, first.theta)
    information = first.information
    for mask, share in ((said.inside, RIM_SHARE), (said.likelier, HELD_SHARE)):
        information = np.where(mask, np.maximum(information, share * matched), information)
    if said.likelier.any():
        counts = np.maximum(said.likelier, trust_of(first.information)).astype(np.float32)
        planes = on_local_planes(np.exp(theta), counts, round(PLANE_SIDE * theta.shape[1]))
        theta = np.where(said.likelier, np.log(planes), theta)
    information = np.where(said.better, matched, information)
    found = static_regions(regions(first.fails, config), said.alike, said.textured, config.match_likeness)
    sure = said.textured & (np.nan_to_num(said.alike) > config.match_likeness)
    return FirstDepth(
        np.where(found.matched, swept, theta),
        np.where(found.matched, np.where(sure, matched, np.float32(0.0)), information),
        (((first.fails > 0) & ~found.still) | said.unlike).astype(np.uint8),
        said.likelier.astype(np.uint8),
    )


def _testimony(context: Context, frame: Frame, first: FirstDepth) -> Testimony | None:
    """At the swept size, brought up to that of ``first``; None where no other time shares the view."""
    config, size = context.config, first.theta.shape[::-1]
    view = DenseView.of(context.workspace.views[frame[0]].camera, config.sweep.scale)
    others = _other_times(context, frame, view)
    if not others:
        return None
    grey = _grey(context, frame, view)
    swept, at_first, trust = (
        np.asarray(view.shrink(image), np.float32)
        for image in (context.image("swept", frame), np.exp(first.theta), trust_of(first.information))
    )
    by_view, by_view_first = (likenesses(grey, depth, view.rays, others) for depth in (swept, at_first))
    alike, alike_first = known_median(by_view), known_median(by_view_first)
    textured, unsure = contrast(grey, PATCH) > TEXTURE, trust < NO_TRUST
    views, views_first = (np.isfinite(table).sum(axis=0) for table in (by_view, by_view_first))
    seen = np.minimum(views, views_first) >= LEAST_VIEWS
    unlike = unlike_regions(np.fmax(alike, alike_first), textured & unsure & seen, config)
    differ = np.abs(np.log(swept / at_first)) > DIFFERENT
    better = better_swept(alike, alike_first, textured & unsure & differ, config)
    worse = textured & differ & ~better & (np.nan_to_num(alike_first) > config.match_likeness)
    # no textured pixels: they speak for what they lie on, which is often the outline of something plain
    likelier = likelier_around(by_view - by_view_first, ~textured & unsure & differ)
    # specks are noise
    likelier = regions(likelier.astype(np.uint8), config) > 0
    inside = plain_inside(regions((~textured & unsure).astype(np.uint8), config), better, worse)
    masks = (
        cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        for mask in (textured, unlike, better, likelier, inside)
    )
    enlarged = cv2.resize(alike, size, interpolation=cv2.INTER_NEAREST)
    return Testimony(np.asarray(enlarged, np.float32), *masks)


def better_swept(alike_swept: Float32, alike_first: Float32, telling: Mask, config: RefinementConfig) -> Mask:
    """``(h, w)`` where the swept depth looks alike and clearly better than the first.

    Likenesses are medians of ``likenesses``; ``telling (h, w)`` has texture, no flow to trust, and two depths
    that are not the same.
    """
    gain = np.nan_to_num(alike_swept - alike_first)
    return telling & (np.nan_to_num(alike_swept) > config.match_likeness) & (gain > BETTER)


def likelier_around(gain: Float32, telling: Mask) -> Mask:
    """``(h, w)`` where the pixels ``telling (h, w)`` around look more alike at the swept than at the first
    depth, in their mean; of those alone.

    ``gain (K, h, w)`` is the difference by view, NaN where it does not see the pixel at both depths: at the
    rim of an image one depth may be seen by other views than the other.
    """
    both = np.isfinite(gain) & telling
    # pixels that few views see count less
    count = cv2.blur(both.sum(axis=0, dtype=np.float32), (AROUND, AROUND))
    total = cv2.blur(np.where(both, gain, np.float32(0.0)).sum(axis=0), (AROUND, AROUND))
    return both.any(axis=0) & (total > LIKELIER * count)


def plain_inside(labels: Labels, better: Mask, worse: Mask) -> Mask:
    """``(h, w)`` the plain regions of ``labels (h, w)``, numbered from 1, at whose rims ``better`` outnumbers
    ``worse``: the depth of what is plain inside is that of its outline."""
    inside = np.zeros(labels.shape, bool)
    kernel = np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
    for label in range(1, int(labels.max(initial=0)) + 1):
        region = labels == label
        rim = (cv2.dilate(region.astype(np.uint8), kernel) > 0) & ~region
        if (better & rim).sum() > (worse & rim).sum():
            inside |= region
    return inside


def static_regions(labels: Labels, alike: Float32, textured: Mask, least_likeness: float) -> StaticRegions:
    """Which regions of ``labels (h, w)``, numbered from 1, stand still.

    ``alike (h, w)`` is the median of ``likenesses`` at the swept depth. A region stands still where most of
    its ``textured (h, w)`` pixels that other times see are alike by ``least_likeness``, and where it has
    none.
    """
    telling = textured & np.isfinite(alike)
    still, matched = (np.zeros(labels.shape, bool) for _ in range(2))
    for label in range(1, int(labels.max(initial=0)) + 1):
        region = labels == label
        if textured[region].mean() < TEXTURED_SHARE:
            still |= region
        elif (region & telling).any() and np.median(alike[region & telling]) > least_likeness:
            still |= region
            matched |= region
    return StaticRegions(still, matched)


def unlike_regions(alike: Float32, telling: Mask, config: RefinementConfig) -> Mask:
    """``(h, w)`` the regions that are nowhere alike: ``alike (h, w)`` at the best static depth, judged by the
    pixels ``telling (h, w)``."""
    unlike = telling & (np.nan_to_num(alike, nan=1.0) < config.unlike_likeness)
    unlike = cv2.medianBlur(unlike.astype(np.uint8), 3)
    labels = regions(closed(unlike, config), config)
    found = np.zeros(alike.shape, bool)
    for label in range(1, int(labels.max(initial=0)) + 1):
        region = labels == label
        if unlike[region].mean() > UNLIKE_SHARE:
            found |= region
    return found


def likenesses(
    grey: Float32, inverse_depth: Float32, rays: Float32, others: Sequence[PictureView]
) -> Float32:
    """Correlation ``(K, h, w)`` of an image's patches with those of ``others`` at ``inverse_depth (h, w)``.

    NaN where a view does not see the pixel. ``rays (h w, 3)`` are those of the pixels of ``grey (h, w)``.
    """
    table = np.full((len(others), *grey.shape), np.nan, np.float32)
    for row, view in zip(table, others, strict=True):
        alike, seen = likeness(grey, inverse_depth.ravel(), rays, view, PATCH)
        row[seen] = alike[seen]
    return table


def _other_times(context: Context, frame: Frame, view: DenseView) -> list[Picture]:
    workspace, wTc, config, camera = context.workspace, context.poses(), context.config, frame[0]
    times = times_in_view(workspace, frame, wTc, config.match_offsets, config.sweep.least_shared)
    return [
        Picture(_grey(context, (camera, t), view), view.intrinsics, invert_pose(wTc[camera, t]) @ wTc[frame])
        for t in times
    ]


def _grey(context: Context, frame: Frame, view: DenseView) -> Float32:
    return np.asarray(view.shrink(context.workspace.read("grey", frame)), np.float32)
