"""Depth of what moves made one over time.

The views of one instant tell a moving region's depth, but only where they see it, and not always rightly. A
thing does not jump: regions of consecutive frames that overlap are the same thing, and its depth changes
evenly, by as much as it grows in the image. So every region gets a depth from its own observation and those
before and after, each counting as far as the images of its instant support it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import LABELS, MOVING, STATIC, UNEXPLAINED, Context
from mvdyn_gtsam.refinement.moving.growth import Growth, is_one_thing
from mvdyn_gtsam.refinement.moving.region_depth import RegionDepth

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.int32]
Link = tuple[int, int, bool]
"""Two regions of consecutive frames that have a thing in common, and whether they are that one alone: where
people meet or part, the depth of what is called one region jumps."""

SCATTER = 0.05
"""Error of an observed log depth that is common. Source: 0.05 to 0.2 compared on two scenes."""
CHANGE_PER_STEP = 0.2
"""Change of log depth between consecutive frames that is possible. Source: 0.05 to 0.3 compared on three
scenes; it only bounds what ``CHANGE_OF_SPEED`` continues."""
CHANGE_OF_SPEED = 0.01
"""Change of that change from one frame to the next that is common: 18 m/s^2 at 2 m and 30 frames per second.
Source: 0.004 to 0.02 compared on four rendered scenes, all within 2 % where the growth is measured."""
LEAST_OVERLAP = 0.2
"""Of two regions of consecutive frames that have a thing in common: shared pixels over those of the
smaller."""
SEEN, FARTHEST = 0.2, 0.3
"""Evidence from which a region's own depth bounds those of the same thing, and how far beyond, in log depth,
they may lie where no growth is measured. Source: choice; a third nearer or farther."""
FADING_STEPS = 24.0
"""Frames after which another frame's evidence counts 1/e."""
LEAST_WEIGHT = 1e-5
"""Of an observation without evidence: a region that nothing else tells of keeps it. Source: choice."""
FEET, FEET_SCATTER = 0.3, 0.1
"""Evidence of the ground below feet where images have no more than ``SEEN``, and its common error. Source:
0.1 to 1 compared on five rendered and eight generated scenes, within 1 %: without it a scene with people whom
nobody else sees is worse by two fifths, the mean by 4 %."""
FEET_OUTSIDE = 0.02
"""Evidence of the ground at the border for a thing that reaches out of the image; of that below feet it is 1.
Source: choice."""
NEARER = 0.1
"""By how much nearer, in log depth, than the ground at the border a thing that reaches out of the image there
is at least if no other camera sees it: its feet are farther down. Source: 0 to 0.2 compared on five rendered
and four generated scenes: 0 is worse by 3 %, 0.05 to 0.15 within 1 %."""
ITERATIONS = 10
STILL_STEPS = 5
"""Frames before and after that have a say in whether a thing stands still. Source: choice; frames that differ
from those around them came in ones and twos."""


@dataclass(frozen=True)
class KnownDepth:
    """Of a moving region of a frame."""

    log_inverse_depth: float
    moving: int
    """``MOVING`` where the images of this instant or those near support that it moves there; ``STATIC`` where
    another camera sees it stand still; else ``UNEXPLAINED``."""
    flat: bool = False
    """Whether all of it lies there, whatever the views of the instant say of its pixels."""


def depth_of_regions(
    context: Context, frames: list[Frame], found: list[list[RegionDepth]], grown: list[list[Growth]]
) -> list[dict[int, KnownDepth]]:
    """Depth by label of the moving regions of each of ``frames``, as far as anything is known of it.

    ``found`` is what ``observe_task`` returned for each, ``grown`` what ``growth_task`` did.
    """
    regions_found = [region for each in found for region in each]
    number = {(region.frame, region.label): k for k, region in enumerate(regions_found)}
    links = []
    with_regions = {region.frame for region in regions_found}
    for camera, time in with_regions:
        before = (camera, time - 1)
        if before in with_regions:
            labels = [
                np.asarray(context.workspace.read(LABELS, f), np.int32) for f in (before, (camera, time))
            ]
            for a, b, alone in link(labels[0], labels[1]):
                links.append((number[before, a], number[(camera, time), b], alone))
    result: dict[Frame, dict[int, KnownDepth]] = {frame: {} for frame in frames}
    if regions_found:
        still = standing_still(regions_found, links)
        growths = [
            (number[one.first], number[one.second], one.log_growth, one.sigma)
            for each in grown
            for one in each
            if one.first in number and one.second in number
        ]
        solved, belief = smooth_over_time(regions_found, sorted(links), growths)
        solved = np.maximum(solved, ground_at_border(regions_found))
        ground = on_the_ground(regions_found, sorted(links), growths)
        for region, stands, theta, believed, below in zip(
            regions_found, still, solved, belief, ground, strict=True
        ):
            if stands:
                result[region.frame][region.label] = KnownDepth(region.matched, STATIC)
            elif believed > context.config.moving_evidence:
                result[region.frame][region.label] = KnownDepth(float(theta), MOVING)
            elif np.isfinite(region.matched):
                # nobody can believe that it moves, and there it would stand still
                result[region.frame][region.label] = KnownDepth(region.matched, UNEXPLAINED)
            elif np.isfinite(below):
                result[region.frame][region.label] = KnownDepth(float(below), UNEXPLAINED, flat=True)
    return [result[frame] for frame in frames]


def link(before: Labels, now: Labels) -> list[Link]:
    """Labels of regions in images ``(h, w)`` of consecutive frames that overlap, and whether they are one
    thing."""
    both = (before > 0) & (now > 0)
    pairs, shared = np.unique(np.stack([before[both], now[both]]), axis=1, return_counts=True)
    sizes = (np.bincount(before.ravel()), np.bincount(now.ravel()))
    return [
        (int(a), int(b), is_one_thing(count, sizes[0][a], sizes[1][b]))
        for (a, b), count in zip(pairs.T, shared, strict=True)
        if count >= LEAST_OVERLAP * min(sizes[0][a], sizes[1][b])
    ]


def standing_still(regions: Sequence[RegionDepth], links: Sequence[Link]) -> Mask:
    """Which of ``regions`` stand still ``(N,)``: what other views say of each, if they mostly say so of those
    linked to it, up to ``STILL_STEPS`` frames away.

    A thing that moves before and after does not stop for a frame. ``links`` as in ``smooth_over_time``.
    """
    count = len(regions)
    still = np.array([region.still for region in regions], dtype=bool)
    first, second = np.array([pair[:2] for pair in links], dtype=np.int64).reshape(-1, 2).T
    ones = np.ones(len(first), dtype=np.int64)
    steps = sparse.csr_array((ones, (first, second)), shape=(count, count))
    steps = sparse.csr_array(steps + steps.T + sparse.eye_array(count, dtype=np.int64))
    near = sparse.csr_array(sparse.eye_array(count, dtype=np.int64))
    for _ in range(STILL_STEPS):
        near = sparse.csr_array((near @ steps) > 0, dtype=np.int64)
    return np.asarray(still & (2 * (near @ still.astype(np.int64)) > near.sum(axis=1)))


def smooth_over_time(
    regions: Sequence[RegionDepth],
    links: Sequence[Link],
    growths: Sequence[tuple[int, int, float, float]] = (),
) -> tuple[Array, Array]:
    """Log inverse depth ``(N,)`` of ``regions``, and the evidence ``(N,)`` it has from all linked regions.

    ``links`` are pairs of their numbers in consecutive frames and whether they are one thing, ``growths``
    pairs of any two frames with the log growth from the first to the second and its standard deviation.
    Robust least squares: an observation counts by its evidence, and less the more the others contradict it.
    What images do not tell the ground below its feet does, but is no evidence that it moves.
    """
    count = len(regions)
    observed, evidence, scatter, by_images = _observations(regions)
    change = _differences([(a, b) for a, b, _, _ in growths], count)
    growth, sigma = np.array([pair[2:] for pair in growths]).reshape(-1, 2).T
    stiffness = _evenness(links, count)
    solved, weight, sure = observed, evidence, sigma**-2
    for _ in range(ITERATIONS):
        # without any evidence a region keeps what it saw
        data = np.maximum(weight, LEAST_WEIGHT) / scatter**2
        grown = change.T @ (change * sure[:, None])
        matrix = sparse.csc_array(stiffness + grown + sparse.diags_array(data))
        solved = spsolve(matrix, data * observed + change.T @ (sure * growth))
        weight = evidence / (1.0 + ((solved - observed) / scatter) ** 2)
        sure = sigma**-2 / (1.0 + ((change @ solved - growth) / sigma) ** 2)
    group = connected_components(sparse.csr_array(stiffness + change.T @ change), directed=False)[1]
    times = np.array([region.frame[1] for region in regions], dtype=np.float64)
    solved = np.asarray(solved).reshape(count).copy()
    weight = np.where(by_images, weight, 0.0)
    belief, measured = np.zeros(count), grown.diagonal() > 0.0
    for number in np.unique(group):
        same = np.flatnonzero(group == number)
        belief[same] = strongest_around(weight[same], times[same])
        seen, unmeasured = solved[same[weight[same] > SEEN]], same[~measured[same]]
        if len(seen):
            # motion that goes on evenly would leave the scene
            solved[unmeasured] = np.clip(solved[unmeasured], seen.min() - FARTHEST, seen.max() + FARTHEST)
    return solved, belief


def _observations(regions: Sequence[RegionDepth]) -> tuple[Array, Array, Array, Mask]:
    """Log inverse depth, its evidence, its common error, and whether images tell it, ``(N,)`` each."""
    rows = [
        (region.footing.log_inverse_depth, FEET, FEET_SCATTER, False)
        if region.footing is not None and region.footing.feet_seen and region.evidence <= SEEN
        else (region.log_inverse_depth, region.evidence, SCATTER, True)
        for region in regions
    ]
    observed, evidence, scatter, by_images = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return observed, evidence, scatter, by_images > 0.0


def strongest_around(evidence: Array, times: Array) -> Array:
    """``(N,)``: the greatest of all ``evidence (N,)``, each faded by how far its time is from that of the
    entry; ``times (N,)`` in frames."""
    order = np.argsort(times)
    steps = times[order] / FADING_STEPS
    with np.errstate(divide="ignore"):
        strength = np.log(evidence[order])
    # what fades evenly is a maximum that runs along
    before = np.maximum.accumulate(strength + steps) - steps
    after = np.maximum.accumulate((strength - steps)[::-1])[::-1] + steps
    result = np.empty_like(evidence)
    result[order] = np.exp(np.maximum(before, after))
    return result


def on_the_ground(
    regions: Sequence[RegionDepth],
    links: Sequence[Link],
    growths: Sequence[tuple[int, int, float, float]],
) -> Array:
    """Log inverse depth ``(N,)`` of ``regions`` by where they stand, at this time or others; NaN where that
    is never seen. Arguments as in ``smooth_over_time``."""
    standing = [
        replace(region, evidence=0.0)
        if region.footing is None
        else replace(
            region,
            log_inverse_depth=region.footing.log_inverse_depth,
            evidence=1.0 if region.footing.feet_seen else FEET_OUTSIDE,
        )
        for region in regions
    ]
    solved, belief = smooth_over_time(standing, links, growths)
    return np.where(belief > 0.0, np.maximum(solved, ground_at_border(regions)), np.nan)


def ground_at_border(regions: Sequence[RegionDepth]) -> Array:
    """``(N,)`` the least log inverse depth of ``regions``: those whose feet are outside of the image stand on
    the ground at its border or nearer, by ``NEARER`` where no other camera sees them. Minus infinity for
    others."""
    least = np.full(len(regions), -np.inf)
    for number, region in enumerate(regions):
        if region.footing is not None and not region.footing.feet_seen:
            seen = region.evidence > SEEN
            least[number] = region.footing.log_inverse_depth + (0.0 if seen else NEARER)
    return least


def _evenness(links: Sequence[Link], count: int) -> sparse.csr_array:
    """What pulls linked regions to one depth, and those that are one thing to a change of it that goes on,
    ``(N, N)``."""
    linked = _differences([pair[:2] for pair in links], count)
    difference = linked[np.flatnonzero([alone for _, _, alone in links])]
    starts, stops = sparse.csr_array(difference < 0.0), sparse.csr_array(difference > 0.0)
    # consecutive links: one stops where the next starts
    first, second = (stops.astype(np.int64) @ starts.T.astype(np.int64)).nonzero()
    bend = difference[first] - difference[second]
    return sparse.csr_array(linked.T @ linked / CHANGE_PER_STEP**2 + bend.T @ bend / CHANGE_OF_SPEED**2)


def _differences(pairs: Sequence[tuple[int, int]], count: int) -> sparse.csr_array:
    """``(M, N)`` that subtracts the first of every pair of ``count`` numbers from the second."""
    ends = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    rows = np.repeat(np.arange(len(ends)), 2)
    signs = np.tile([-1.0, 1.0], len(ends))
    return sparse.csr_array((signs, (rows, ends.ravel())), shape=(len(ends), count))
