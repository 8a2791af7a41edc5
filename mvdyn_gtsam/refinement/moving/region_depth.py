"""Depth of what moves, region by region: what the views of one instant say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.moving.free_space import AGREES, depth_beyond
from mvdyn_gtsam.refinement.moving.ground import Footing
from mvdyn_gtsam.refinement.patches import likeness

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.int32]

TOLERANCE = 0.15
"""Pixels of a region whose own depth is within this (relative) of the region's keep it."""
BIN = 0.1
"""Of the histogram of log depth that finds the commonest."""
PATCH = 9
"""Side of the patches compared, px of the view."""
NO_SUPPORT, FULL_SUPPORT = 0.08, 0.2
"""Correlation at which a depth counts nothing and fully. Source: wrong depths of regions of dynamic_human had
0.07 to 0.13, right ones 0.15 to 0.3."""
HIDDEN = 0.15
"""Log of the depth of a point over that of what a view sees there from which on it is hidden from it. Source:
as ``free_space.BEHIND``."""
HULL_STEP, HULL_STEPS = 0.03, 15
"""Step of log depth towards the camera, and how many are tried. Source: choice; things are no deeper."""
SIDE_ANGLES_DEG = (30.0, 75.0)
"""Angles between views up to which they see the same side of a thing, and from which they do not. Source: 15
to 60, 30 to 75 and 40 to 80 compared on five rendered scenes: what is thin wants less, people more."""
LEAST_SAY = 0.6
"""Say that is left to a view that sees another side. Source: 0.3, 0.6 and 1 compared on four rendered scenes,
all within 3 %."""
WITNESSED = 0.5
"""Share of a region that another view must see move for full evidence. Source: choice: half of a thing is
hidden from it."""
UNCONFIRMED, CONFIRMED = 0.05, 0.15
"""Share of a region that another view must find there itself, for no and for full evidence. Source: 142 right
depths of five rendered scenes had 0.13 and more; those of a plain box, wrong by a factor, 0.11 at most."""
STILL = 0.3
"""Share of a region that another view must see as a still surface for it to stand still. Source: of the
regions of robodog_overlap and multicamvideo still ones had 0.2 to 1, moving ones 0; of those of three_cameras
some moving ones more than 0.2."""
MATCHED = 0.5
"""Support from which images match. Source: choice."""
LEAST_SHARE = 0.1
"""Of a region's pixels whose own depth is not denied, for these to decide, and of those whose hull ends, for
it to. Source: choice."""


@dataclass(frozen=True)
class RegionDepth:
    """A moving region and what the views of its instant say."""

    frame: Frame
    label: int
    log_inverse_depth: float
    """Commonest of the region."""
    evidence: float
    """In [0, 1]: how far the images support it."""
    matched: float = np.nan
    """Commonest where the images match, whatever the views deny; NaN where they do not match."""
    still: bool = False
    """Whether another view sees something that stands still just there."""
    footing: Footing | None = None
    """Where it stands, if that can be told."""


@dataclass(frozen=True)
class InstantView:
    """Another camera at the same instant."""

    grey: Float32
    """``(h_j, w_j)``"""
    intrinsics: Array
    """``(3, 3)``"""
    jTi: Array
    """``(4, 4)``"""
    theta: Float32
    """``(h_j, w_j)`` log inverse depth of what stands still."""
    moves: Mask
    """``(h_j, w_j)`` where something moves, or near."""
    instant: Float32
    """``(h_j, w_j)`` log inverse depth that the views of the instant alone tell it."""


def contradicted(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> Mask:
    """Which moving points at log inverse depth ``theta (M,)`` along ``rays (M, 3)`` a view denies, ``(M,)``.

    It sees something at the instant that stands still, and not before the point: a moving thing seen by two
    cameras moves in both.
    """
    return _judged(theta, rays, views)[1]


def still_there(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> float:
    """Largest share of the points, as in ``contradicted``, where a view sees a still surface at their
    depth."""
    seen = _seen_by(views, theta, rays)
    return max((float(((np.abs(farther) < AGREES) & ~moves).mean()) for farther, moves in seen), default=0.0)


def moving_there(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> float:
    """Largest share of the points, as in ``contradicted``, that a view sees where something moves."""
    seen = _seen_by(views, theta, rays)
    return max((float((np.isfinite(farther) & moves).mean()) for farther, moves in seen), default=0.0)


def confirmed_there(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> float:
    """Largest share of the points, as in ``contradicted``, that a view itself finds at their depth, where
    something moves: two views seldom make the same mistake."""
    seen = _seen_by([replace(view, theta=view.instant) for view in views], theta, rays)
    return max(
        (float(((np.abs(farther) < TOLERANCE) & moves).mean()) for farther, moves in seen), default=0.0
    )


def _judged(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> tuple[Mask, Mask]:
    """Which points any view sees ``(M,)``, and which any denies ``(M,)``, as in ``contradicted``."""
    told, denied = np.zeros(len(theta), bool), np.zeros(len(theta), bool)
    for farther, moves in _seen_by(views, theta, rays):
        told |= np.isfinite(farther)
        denied |= (farther > -HIDDEN) & ~moves
    return told, denied


def _seen_by(views: Sequence[InstantView], theta: Float32, rays: Float32) -> Iterator[tuple[Float32, Mask]]:
    """Per view how much farther than the points, ``(M,)`` as ``depth_beyond`` says, it sees a still surface,
    and whether something moves ``(M,)`` there."""
    for view in views:
        farther, pixel = depth_beyond(theta, rays, view)
        yield farther, view.moves.ravel()[pixel]


def commonest(values: Float32) -> float:
    """Log of the inverse depth that most of ``values (M,)`` have."""
    edges = np.arange(values.min() - BIN, values.max() + 2.0 * BIN, BIN)
    histogram = np.histogram(values, edges)[0]
    around = np.convolve(histogram, np.ones(3), "same")
    centre = edges[around.argmax()] + 0.5 * BIN
    return float(np.median(values[np.abs(values - centre) < TOLERANCE]))


def observed_region(
    frame: Frame,
    label: int,
    instant: Float32,
    region: Mask,
    grey: Float32,
    rays: Float32,
    views: Sequence[InstantView],
) -> RegionDepth:
    """What ``views`` say of ``region (h, w)``, the one of that ``label`` in ``frame``.

    Its depth is what most of its pixels have in ``instant (h, w)``, inverse depths; the evidence is how alike
    the images are there, as far as another view sees it move there and none denies it. ``grey (h, w)`` is the
    image and ``rays (h w, 3)`` those of its pixels.
    """
    values, own = np.log(instant[region]), rays[region.ravel()]
    matched = commonest(values)
    if support(grey, region, matched, rays, views) < MATCHED:
        matched = np.nan
    elif still_there(np.full(len(own), matched, np.float32), own, views) > STILL:
        return RegionDepth(frame, label, matched, 0.0, matched, still=True)
    kept = ~contradicted(values, own, views)
    if kept.mean() > LEAST_SHARE:
        values = values[kept]
    depth = commonest(values)
    even = np.full(len(own), depth, np.float32)
    witnessed = min(1.0, moving_there(even, own, views) / WITNESSED)
    witnessed *= 1.0 - float(contradicted(even, own, views).mean())
    confirmed = confirmed_there(np.log(region_depth(instant, region, depth)), own, views)
    confirmed = float(np.clip((confirmed - UNCONFIRMED) / (CONFIRMED - UNCONFIRMED), 0.0, 1.0))
    evidence = support(grey, region, depth, rays, views) * witnessed * confirmed
    return RegionDepth(frame, label, depth, evidence, matched)


def region_depth(instant: Float32, region: Mask, log_inverse_depth: float) -> Float32:
    """Inverse depth of the region's pixels, in the order of ``instant[region]``: their own where it is near
    the region's, which a thing has about everywhere."""
    values = np.log(instant[region])
    near = np.abs(values - log_inverse_depth) < TOLERANCE
    return np.exp(np.where(near, values, log_inverse_depth)).astype(np.float32)


def side_seen(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> Float32:
    """How much nearer, in log depth, than where views from the side match them the ``M`` points of a moving
    thing are.

    ``theta (M,)`` is that log inverse depth, along ``rays (M, 3)``. Cameras to the side see another side of a
    thing, so that what they match best lies in its middle. The nearest depth that none of them denies is the
    front of its visual hull (https://doi.org/10.1109/34.273735), which is nearer than its surface: half the
    way is taken, the less the smaller the angle between the views.
    """
    told, denied = _judged(theta, rays, views)
    alive, ended = told & ~denied, np.zeros(len(theta), bool)
    way = np.zeros(len(theta), np.float32)
    for step in range(1, HULL_STEPS + 1):
        told, denied = _judged(theta + np.float32(step * HULL_STEP), rays, views)
        ended |= alive & denied
        alive &= told & ~denied
        way += np.float32(HULL_STEP) * alive
    # where no view sees the hull end it says nothing
    if ended.mean() < LEAST_SHARE:
        return np.zeros(len(theta), np.float32)
    way[~ended] = np.median(way[ended])
    middle = float(np.median(theta))
    same = [same_side(middle, rays, view.jTi) for view in views if _sees_middle(middle, rays, view)]
    return np.float32(0.5 * (1.0 - max(same, default=1.0))) * way


def _sees_middle(log_inverse_depth: float, rays: Float32, view: InstantView) -> bool:
    """Whether the middle of a thing at that log inverse depth along ``rays (M, 3)`` lies in the image of a
    view."""
    ray = np.median(rays, axis=0)[None].astype(np.float32)
    return bool(np.isfinite(depth_beyond(np.full(1, log_inverse_depth, np.float32), ray, view)[0]).all())


def own_say(log_inverse_depth: float, rays: Float32, jTi: Array) -> float:
    """In [0, 1] what it counts how a thing at that log inverse depth along ``rays (M, 3)`` looks in a view:
    those from the side see another side of it."""
    return LEAST_SAY + (1.0 - LEAST_SAY) * same_side(log_inverse_depth, rays, jTi)


def same_side(log_inverse_depth: float, rays: Float32, jTi: Array) -> float:
    """In [0, 1] how far a view sees the same side of a thing at that log inverse depth along ``rays (M, 3)``:
    1 up to the smaller of ``SIDE_ANGLES_DEG``, 0 from the greater on; by the angle alone, whether or not the
    thing lies in its image."""
    ray = np.median(rays, axis=0)
    middle = ray / np.exp(log_inverse_depth)
    line = middle - invert_pose(jTi)[:3, 3]
    cosine = line @ middle / (np.linalg.norm(line) * np.linalg.norm(middle))
    low, high = SIDE_ANGLES_DEG
    return 1.0 - float(
        np.clip((np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) - low) / (high - low), 0.0, 1.0)
    )


def support(
    grey: Float32, region: Mask, log_inverse_depth: float, rays: Float32, views: Sequence[InstantView]
) -> float:
    """Evidence in [0, 1] that ``region (h, w)`` of the image ``grey (h, w)`` lies at one inverse depth.

    Mean correlation of its patches with the view that agrees best; what the view does not see counts as no
    correlation. ``rays (h w, 3)`` has z = 1.
    """
    best, inverse_depth = 0.0, np.full(len(rays), np.exp(log_inverse_depth), np.float32)
    for view in views:
        alike, inside = likeness(grey, inverse_depth, rays, view, PATCH)
        seen = inside & region
        best = max(best, float(alike[seen].sum() / np.count_nonzero(region)))
    return float(np.clip((best - NO_SUPPORT) / (FULL_SUPPORT - NO_SUPPORT), 0.0, 1.0))
