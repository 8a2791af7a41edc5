"""What moves in a frame, and where phase 2 begins with it.

Ten steps, since a frame asks others: ``free_space_task`` adds what other views see through to where the
static model fails; ``carry_task`` what moves before and after; ``settle_task`` finds what moves and its
outline; ``observe_task`` asks the cameras of the instant for the depth of each region, ``growth_task`` the
frames after for how it grows; ``depth_of_regions`` makes that one over time; ``moving_depth_task`` writes it;
``fit_task`` and ``shape_task`` give it the shape that the cameras of the instant agree on; ``relief_task``
makes one over time how the points of a region lie about its depth.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_depth import filled
from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import LABELS, MOVING, STATIC, UNEXPLAINED, Context
from mvdyn_gtsam.refinement.initial import (
    before_all_around,
    carried_regions,
    closed,
    moving_regions,
    proven_still,
    regions,
    static_residual,
)
from mvdyn_gtsam.refinement.moving.free_space import (
    BEHIND,
    SEEN_THROUGH,
    SIGHT,
    STANDS,
    TRUSTED,
    DepthView,
    sight,
    without_outlines,
)
from mvdyn_gtsam.refinement.moving.ground import footing
from mvdyn_gtsam.refinement.moving.outline import OtherTime, background, depth_behind, grown, outlined
from mvdyn_gtsam.refinement.moving.over_time import KnownDepth
from mvdyn_gtsam.refinement.moving.pixel_sweep import swept_region
from mvdyn_gtsam.refinement.moving.region_depth import (
    InstantView,
    RegionDepth,
    observed_region,
    region_depth,
)
from mvdyn_gtsam.refinement.moving.relief import RELIEF
from mvdyn_gtsam.refinement.views import pixels_seen

Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.int32]

LEAST_TRUST = 0.05
"""Of the best pixel of a frame; below, there is nothing to continue into the rest."""

LEAK_REACH = 0.2
"""Up to how far the depth of what moves leaks into plain walls, as a share of the image's width; twice as far
it does no more. Source: 0.1 to 0.3 compared on four rendered scenes."""
OWN_SHARE = 0.4
"""Of its own depth that a pixel keeps there, whatever the flow says. Source: 0.3 to 1 compared there."""
FREE_SPACE_RASTER = 2
"""Pixels of the view between those asked whether others see through them. Source: time; things are
larger."""
SETTLED = 0.3
"""Trust in its depth from which a point must be where it seems or else move. Source: of the points seen
through in three rendered scenes, most of the moving ones had more and most of the still ones less."""
SETTLED_SHARE = 0.25
"""Of a region's points seen through that must have it. Source: 0.1 to 0.5 compared there."""
MARGIN = 9
"""Side of the square by which moving regions of other cameras grow before they deny a depth, px of the view.
Source: choice, what their outlines err by."""
SHAPE_MARGIN = 3
"""The same where a depth is denied to single pixels. Source: 1, 3 and 5 compared on four rendered scenes, all
within 3 %."""


def free_space_task(context: Context, frame: Frame) -> None:
    """Add to where the static model fails in a frame what other times and cameras see through.

    Keeps where they see the surface itself, too.
    """
    workspace, config, view = context.workspace, context.config, context.workspace.views[frame[0]]
    views = _witnesses(context, frame)
    theta = context.image("first", frame)
    every = (slice(FREE_SPACE_RASTER // 2, None, FREE_SPACE_RASTER),) * 2
    rays = view.rays.reshape(*view.shape, 3)[every]
    seen = sight(theta[every].ravel(), rays.reshape(-1, 3), views)
    through, there = (mask.reshape(rays.shape[:2]) for mask in (seen.seen_through, seen.seen_there))
    trusted = through & (context.trust(frame)[every] > SETTLED)
    told = np.where(through, SEEN_THROUGH, np.where(there, STANDS, 0))
    marked, settled, told = (
        cv2.resize(np.asarray(mask, np.uint8), view.shape[::-1], interpolation=cv2.INTER_NEAREST)
        for mask in (without_outlines(through), trusted, told)
    )
    found = regions(closed(marked, config), config)
    for label in range(1, int(found.max()) + 1):
        region = (found == label) & (marked > 0)
        # where the flow says nothing a depth may be wrong without any motion
        if settled[region].mean() < SETTLED_SHARE:
            found[found == label] = 0
    workspace.write("fails", frame, np.maximum(np.asarray(workspace.read("fails", frame)), found > 0))
    workspace.write(SIGHT, frame, told)


def _witnesses(context: Context, frame: Frame) -> list[DepthView]:
    """All cameras of the group at other times, and the other cameras at this one, with their first depth."""
    workspace, wTc, (camera, time) = context.workspace, context.poses(), frame
    offsets = [sign * offset for offset in context.config.witness_offsets for sign in (-1, 1)]
    others = [(camera, time + offset) for offset in offsets]
    others += [
        (other, time + offset)
        for other in context.group_of(camera)
        if other != camera
        for offset in (0, *offsets)
    ]
    return [
        DepthView(
            context.image("first", j),
            context.trust(j),
            workspace.views[j[0]].intrinsics,
            invert_pose(wTc[j]) @ wTc[frame],
        )
        for j in others
        if 0 <= j[1] < workspace.frame_count
    ]


def carry_task(context: Context, job: tuple[str, str, Frame]) -> None:
    """Carry what moves before and after into a frame: ``(read from, write to, frame)``, arrays."""
    source, target, frame = job
    workspace = context.workspace
    targets = context.flow_targets(frame)
    there = [np.asarray(workspace.read(source, (frame[0], int(time)))) for time in targets.times]
    own, seen = (np.asarray(workspace.read(name, frame)) for name in (source, SIGHT))
    beside = _seen_beside(context, source, frame) & (context.trust(frame) < TRUSTED)
    found = carried_regions(own, frame[1], targets, there, beside, seen == STANDS, context.config)
    workspace.write(target, frame, found)


def _seen_beside(context: Context, name: str, frame: Frame) -> Mask:
    """Where both the frame before and the one after, of those there are, have the array ``name`` set,
    ``(h, w)``, if the pixel stood still."""
    workspace, wTc, (camera, time) = context.workspace, context.poses(), frame
    times = [t for t in (time - 1, time + 1) if 0 <= t < workspace.frame_count]
    view = workspace.views[camera]
    found = np.full(view.shape, len(times) > 0)
    inverse_depth = np.exp(context.image("first", frame)).ravel()
    for t in times:
        jTi = invert_pose(wTc[camera, t]) @ wTc[frame]
        at, front = pixels_seen(inverse_depth, view.rays, jTi, view.intrinsics)
        there = cv2.remap(
            np.asarray(workspace.read(name, (camera, t)), np.uint8),
            at.reshape(*view.shape, 2),
            None,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
        )
        found &= (there > 0) & front.reshape(view.shape)
    return found


def settle_task(context: Context, frame: Frame) -> None:
    """What moves in a frame, by the vote of the frames around it, and the depth of what stands still."""
    workspace, config = context.workspace, context.config
    labels, around = _what_moves(context, frame)
    trust, behind = context.trust(frame), np.zeros(labels.shape, bool)
    trust[around] = 0.0
    if trust.max() > LEAST_TRUST:
        theta = _without_leaks(context.image("first", frame), trust, around)
        if (labels > 0).any():
            labels, theta, behind = _outlined(context, frame, labels > 0, around, theta)
    else:
        # a camera that stands still has no parallax of its own: the others' flow will tell
        theta = np.log(context.image("aligned", frame))
    weight = np.maximum(trust, 1e-3) / np.float32(config.prior_sigma**2)
    held = (np.asarray(workspace.read("held", frame)) > 0) & ~around
    for known, sigma in ((held, config.held_sigma), (behind, config.behind_sigma)):
        weight = np.where(known, np.maximum(weight, np.float32(sigma**-2)), weight)
    workspace.write("prior", frame, theta)
    workspace.write("prior_weight", frame, weight)
    workspace.write(LABELS, frame, labels.astype(np.uint8))


def _what_moves(context: Context, frame: Frame) -> tuple[Labels, Mask]:
    """Label ``(h, w)`` of the regions that move, and where their outlines are to be looked for."""
    config = context.config
    targets, own = context.flow_targets(frame), np.asarray(context.workspace.read("fails", frame))
    there = [np.asarray(context.workspace.read("fails", (frame[0], int(time)))) for time in targets.times]
    labels = moving_regions(own, targets, there, config)
    near = grown(labels > 0, config.moving_reach)
    edges = context.edges(frame, context.poses(), own_camera=True, among=np.flatnonzero(near))
    # flow that a static depth explains is the best evidence against motion
    residual = static_residual(np.exp(context.image("first", frame)), edges)
    explained = (residual < config.moving_px) & (own == 0)
    around = near & ~explained | (labels > 0)
    # between things that move, their regions close over what stands there; but what moves evenly past the
    # camera has the flow of a still thing, too, so near that nothing else is
    seen = np.asarray(context.workspace.read(SIGHT, frame))
    known = (context.trust(frame) > TRUSTED) & (own == 0)
    nearest = before_all_around(context.image("first", frame), labels, known)
    unlikely = (seen == SEEN_THROUGH) | (seen != STANDS) & nearest
    still = proven_still(residual, edges, config) & ~unlikely
    labels[still] = 0
    return labels, around & ~still


def _without_leaks(theta: Float32, trust: Float32, around: Mask) -> Float32:
    """Log inverse depth ``theta (h, w)`` filled in from where there is ``trust (h, w)``.

    Depth of what moves, ``around (h, w)``, must not leak into the plain wall behind it, and what is plain
    mostly stands behind: an average of depth cubed leans to the far side.
    """
    cubed = filled(np.exp(-3.0 * theta).astype(np.float32), np.maximum(trust, kept_far_off(around)))
    return np.asarray(-np.log(cubed) / 3.0, np.float32)


def observe_task(context: Context, frame: Frame) -> list[RegionDepth]:
    """What the other cameras of the instant say of each moving region of a frame, and where it stands."""
    workspace = context.workspace
    labels = np.asarray(workspace.read(LABELS, frame))
    if not labels.any():
        return []
    views, rays = _instant_views(context, frame, MARGIN), workspace.views[frame[0]].rays
    grey, instant = context.luminance(frame), context.image("instant", frame)
    theta, found = context.image("prior", frame), []
    for label in range(1, int(labels.max()) + 1):
        region = labels == label
        seen = observed_region(frame, label, instant, region, grey, rays, views)
        found.append(replace(seen, footing=footing(theta, region, labels == 0)))
    return found


def _instant_views(context: Context, frame: Frame, margin: int) -> list[InstantView]:
    """The other cameras of the instant; what moves in them grows by a square of side ``margin`` px, since
    outlines are right to some pixels only."""
    workspace, wTc = context.workspace, context.poses()
    square = np.ones((margin, margin), np.uint8)
    return [
        InstantView(
            grey=context.luminance(j),
            intrinsics=workspace.views[j[0]].intrinsics,
            jTi=invert_pose(wTc[j]) @ wTc[frame],
            theta=context.image("prior", j),
            moves=cv2.dilate((np.asarray(workspace.read(LABELS, j)) > 0).astype(np.uint8), square) > 0,
            instant=np.log(context.image("instant", j)),
        )
        for j in ((camera, frame[1]) for camera in context.group_of(frame[0]) if camera != frame[0])
    ]


def moving_depth_task(context: Context, job: tuple[Frame, dict[int, KnownDepth]]) -> None:
    """Where phase 2 begins: what stands still as settled, moving regions at the depth given.

    Regions without one stay where their background is; these and those not believed stay unexplained.
    """
    frame, depths = job
    workspace, config = context.workspace, context.config
    labels = np.asarray(workspace.read(LABELS, frame))
    theta, weight = context.image("prior", frame), context.image("prior_weight", frame)
    moving = np.where(labels > 0, UNEXPLAINED, STATIC).astype(np.uint8)
    instant, view = context.image("instant", frame), workspace.views[frame[0]]
    # what other frames' tasks change of these views meanwhile lies where something moves, and is not read
    views = _instant_views(context, frame, SHAPE_MARGIN) if depths else []
    grey, relief = context.luminance(frame), np.full(labels.shape, np.nan, np.float32)
    for label, known in depths.items():
        region = labels == label
        moving[region] = known.moving
        if known.flat:
            # nothing stands behind its background
            theta[region] = np.maximum(theta[region], np.float32(known.log_inverse_depth))
            continue
        if known.moving == MOVING:
            matched = swept_region(known.log_inverse_depth, region, grey, view.intrinsics, view.rays, views)
        else:
            matched = np.log(region_depth(instant, region, known.log_inverse_depth))
        # nothing lies behind its background, which is known only about
        theta[region] = np.maximum(matched, theta[region] - BEHIND)
        if known.moving == MOVING:
            relief[region] = theta[region] - np.float32(known.log_inverse_depth)
    weight[labels > 0] = config.moving_sigma**-2
    workspace.write("prior", frame, theta)
    workspace.write("prior_weight", frame, weight)
    workspace.write("moving", frame, moving)
    workspace.write("begun", frame, np.exp(theta))
    workspace.write(RELIEF, frame, relief)


def kept_far_off(moves: Mask) -> Float32:
    """``(h, w)`` share of its own depth that every pixel keeps: what is far from what ``moves (h, w)``
    needs no depth from behind, and a plain thing in the foreground would be pushed back by it."""
    if not moves.any():
        return np.full(moves.shape, OWN_SHARE, np.float32)
    distance = cv2.distanceTransform((~moves).astype(np.uint8), cv2.DIST_L2, 5) / moves.shape[1]
    return np.asarray(OWN_SHARE * np.clip(distance / LEAK_REACH - 1.0, 0.0, 1.0), np.float32)


def _other_times(context: Context, frame: Frame) -> list[OtherTime]:
    """The same camera at the times that are asked what stands behind what moves."""
    workspace, wTc, config, (camera, time) = context.workspace, context.poses(), context.config, frame
    times = [t for k in config.background_offsets for t in (time - k, time + k)]
    return [
        OtherTime(
            colour=context.colour((camera, t)),
            moves=grown(
                np.asarray(workspace.read("fails", (camera, t))) > 0, config.background_margin
            ).astype(np.uint8),
            jTi=invert_pose(wTc[camera, t]) @ wTc[frame],
            theta=context.image("first", (camera, t)),
            settled=context.trust((camera, t)) > TRUSTED,
        )
        for t in times
        if 0 <= t < workspace.frame_count
    ]


def _outlined(
    context: Context, frame: Frame, moves: Mask, around: Mask, theta: Float32
) -> tuple[Labels, Float32, Mask]:
    """Label ``(h, w)`` of the regions that move, with outlines found against what other times see behind
    them, ``theta (h, w)`` of the background with the depth at which they see it, and where they do."""
    view, others = context.workspace.views[frame[0]], _other_times(context, frame)
    known = depth_behind(around, view.rays, view.intrinsics, others)
    theta = np.where(np.isfinite(known), known, theta)
    pixels = np.flatnonzero(around)
    colour = np.full((*moves.shape, 3), np.nan, np.float32)
    colour.reshape(-1, 3)[pixels] = background(
        np.exp(theta.ravel()[pixels]), view.rays[pixels], view.intrinsics, others
    )
    found = outlined(moves, around, context.colour(frame), colour, context.config)
    return regions(found.astype(np.uint8), context.config), theta, np.isfinite(known)
