"""Depth of what moves, region by region, made one over time.

The views of one instant tell a moving region's depth, but only where they see it, and not always rightly. A
thing does not jump: regions of consecutive frames that overlap are the same thing, and its depth changes
evenly. So every region gets a depth from its own observation and those before and after, each counting as far
as the images of its instant support it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.free_space import AGREES, depth_beyond
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
SCATTER = 0.05
"""Error of an observed log depth that is common. Source: 0.05 to 0.2 compared on two scenes."""
CHANGE_PER_STEP = 0.2
"""Change of log depth between consecutive frames that is possible. Source: 0.05 to 0.3 compared on three
scenes; it only bounds what ``CHANGE_OF_SPEED`` continues."""
CHANGE_OF_SPEED = 0.004
"""Change of that change from one frame to the next that is common: 7 m/s^2 at 2 m and 30 frames per second.
Source: 0.002 to 0.02 and none compared on three scenes."""
LEAST_OVERLAP = 0.2
"""Of two regions of consecutive frames that are one thing: shared pixels over those of the smaller."""
SEEN, FARTHEST = 0.2, 0.3
"""Evidence from which a region's own depth bounds those of the same thing, and how far beyond, in log depth,
they may lie. Source: choice; a third nearer or farther."""
FADING_STEPS = 24.0
"""Frames after which another frame's evidence counts 1/e."""
ITERATIONS = 10
HIDDEN = 0.15
"""Log of the depth of a point over that of what a view sees there from which on it is hidden from it. Source:
as ``free_space.BEHIND``."""
HULL_STEP, HULL_STEPS = 0.03, 15
"""Step of log depth towards the camera, and how many are tried. Source: choice; things are no deeper."""
SIDE_ANGLES_DEG = (15.0, 60.0)
"""Angles between views up to which they see the same side of a thing, and from which they do not. Source:
half the way compared with none on three rendered scenes: better from 45 degrees on but for a thin thing."""
WITNESSED = 0.5
"""Share of a region that another view must see move for full evidence. Source: choice: half of a thing is
hidden from it."""
STILL = 0.3
"""Share of a region that another view must see as a still surface for it to stand still. Source: of the
regions of robodog_overlap and multicamvideo still ones had 0.2 to 1, moving ones 0; of those of three_cameras
some moving ones more than 0.2."""
STILL_STEPS = 5
"""Frames before and after that have a say in whether a thing stands still. Source: choice; frames that differ
from those around them came in ones and twos."""
MATCHED = 0.5
"""Support from which images match. Source: choice."""
LEAST_SHARE = 0.1
"""Of a region's pixels whose own depth is not denied, for these to decide. Source: choice."""


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


def contradicted(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> Mask:
    """Which moving points at log inverse depth ``theta (M,)`` along ``rays (M, 3)`` a view denies, ``(M,)``.

    It sees something at the instant that stands still, and not before the point: a moving thing seen by two
    cameras moves in both.
    """
    denied = np.zeros(len(theta), bool)
    for farther, moves in _seen_by(views, theta, rays):
        denied |= (farther > -HIDDEN) & ~moves
    return denied


def still_there(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> float:
    """Largest share of the points, as in ``contradicted``, where a view sees a still surface at their
    depth."""
    seen = _seen_by(views, theta, rays)
    return max((float(((np.abs(farther) < AGREES) & ~moves).mean()) for farther, moves in seen), default=0.0)


def moving_there(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> float:
    """Largest share of the points, as in ``contradicted``, that a view sees where something moves."""
    seen = _seen_by(views, theta, rays)
    return max((float((np.isfinite(farther) & moves).mean()) for farther, moves in seen), default=0.0)


def _seen_by(views: Sequence[InstantView], theta: Float32, rays: Float32) -> Iterator[tuple[Float32, Mask]]:
    """Per view how much farther than the points, ``(M,)`` as ``depth_beyond`` says, it sees a still surface,
    and whether something moves ``(M,)`` there."""
    for view in views:
        farther, (row, column) = depth_beyond(theta, rays, view)
        yield farther, view.moves[row, column]


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
    evidence = support(grey, region, depth, rays, views) * witnessed
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
    told, denied = np.zeros(len(theta), bool), contradicted(theta, rays, views)
    for view in views:
        told |= np.isfinite(depth_beyond(theta, rays, view)[0])
    free, way = told & ~denied, np.zeros(len(theta), np.float32)
    if not free.any():
        return way
    alive = free.copy()
    for step in range(1, HULL_STEPS + 1):
        alive &= ~contradicted(theta + np.float32(step * HULL_STEP), rays, views)
        way += HULL_STEP * alive
    way[~free] = np.median(way[free])
    return np.float32(_share_of_way(theta, rays, views)) * way


def _share_of_way(theta: Float32, rays: Float32, views: Sequence[InstantView]) -> float:
    """In [0, 1/2], by the smallest angle at which a view that sees the middle of the points looks at it."""
    middle = np.median(rays / np.exp(theta)[:, None], axis=0)
    angles = []
    for view in views:
        inverse_depth = np.full(1, 1.0 / middle[2], np.float32)
        if not np.isfinite(depth_beyond(np.log(inverse_depth), middle[None] / middle[2], view)[0]).all():
            continue
        line = middle - invert_pose(view.jTi)[:3, 3]
        cosine = line @ middle / (np.linalg.norm(line) * np.linalg.norm(middle))
        angles.append(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    low, high = SIDE_ANGLES_DEG
    return 0.5 * float(np.clip((min(angles, default=0.0) - low) / (high - low), 0.0, 1.0))


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


def link(before: Labels, now: Labels) -> list[tuple[int, int]]:
    """Labels of regions in images ``(h, w)`` of consecutive frames that overlap."""
    both = (before > 0) & (now > 0)
    pairs, shared = np.unique(np.stack([before[both], now[both]]), axis=1, return_counts=True)
    sizes = (np.bincount(before.ravel()), np.bincount(now.ravel()))
    return [
        (int(a), int(b))
        for (a, b), count in zip(pairs.T, shared, strict=True)
        if count >= LEAST_OVERLAP * min(sizes[0][a], sizes[1][b])
    ]


def standing_still(regions: Sequence[RegionDepth], links: Sequence[tuple[int, int]]) -> Mask:
    """Which of ``regions`` stand still ``(N,)``: what other views say of each, if they mostly say so of those
    linked to it, up to ``STILL_STEPS`` frames away.

    A thing that moves before and after does not stop for a frame. ``links`` as in ``smooth_over_time``.
    """
    count = len(regions)
    still = np.array([region.still for region in regions], dtype=bool)
    first, second = np.array(links, dtype=np.int64).reshape(-1, 2).T
    ones = np.ones(len(first), dtype=np.int64)
    steps = sparse.csr_array((ones, (first, second)), shape=(count, count))
    steps = sparse.csr_array(steps + steps.T + sparse.eye_array(count, dtype=np.int64))
    near = sparse.csr_array(sparse.eye_array(count, dtype=np.int64))
    for _ in range(STILL_STEPS):
        near = sparse.csr_array((near @ steps) > 0, dtype=np.int64)
    return np.asarray(still & (2 * (near @ still.astype(np.int64)) > near.sum(axis=1)))


def smooth_over_time(regions: Sequence[RegionDepth], links: Sequence[tuple[int, int]]) -> tuple[Array, Array]:
    """Log inverse depth ``(N,)`` of ``regions``, and the evidence ``(N,)`` it has from all linked regions.

    ``links`` are pairs of their numbers in consecutive frames. Robust least squares: an observation counts by
    its evidence, and less the more the others contradict it.
    """
    count = len(regions)
    observed = np.array([region.log_inverse_depth for region in regions])
    evidence = np.array([region.evidence for region in regions])
    ends = np.array(links, dtype=np.int64).reshape(-1, 2)
    rows = np.repeat(np.arange(len(ends)), 2)
    difference = sparse.csr_array(
        (np.tile([1.0, -1.0], len(ends)), (rows, ends.ravel())), shape=(len(ends), count)
    )
    stiffness = difference.T @ difference / CHANGE_PER_STEP**2
    starts, stops = (
        sparse.csr_array((np.ones(len(ends)), (np.arange(len(ends)), end)), shape=(len(ends), count))
        for end in ends.T
    )
    # consecutive links: one stops where the next starts
    first, second = (stops @ starts.T).nonzero()
    bend = difference[first] - difference[second]
    stiffness = stiffness + bend.T @ bend / CHANGE_OF_SPEED**2
    solved, weight = observed, evidence
    for _ in range(ITERATIONS):
        # without any evidence a region keeps what it saw
        data = np.maximum(weight, 1e-3) / SCATTER**2
        solved = spsolve(sparse.csc_array(stiffness + sparse.diags_array(data)), data * observed)
        weight = evidence / (1.0 + ((solved - observed) / SCATTER) ** 2)
    group = connected_components(sparse.csr_array(stiffness), directed=False)[1]
    times = np.array([region.frame[1] for region in regions], dtype=np.float64)
    belief = np.zeros(count)
    for number in range(count):
        same = group == group[number]
        fading = np.exp(-np.abs(times[same] - times[number]) / FADING_STEPS)
        belief[number] = (weight[same] * fading).max()
    solved = np.asarray(solved).reshape(count).copy()
    for number in np.unique(group):
        same = group == number
        seen = same & (weight > SEEN)
        if seen.any():
            # motion that goes on evenly would leave the scene
            solved[same] = np.clip(solved[same], solved[seen].min() - FARTHEST, solved[seen].max() + FARTHEST)
    return solved, belief
