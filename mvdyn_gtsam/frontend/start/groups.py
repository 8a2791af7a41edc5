"""Groups of connected cameras, out of links between pairs of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from mvdyn_gtsam.frontend.start.verification import Verdict
from mvdyn_gtsam.geometry import Similarity


@dataclass(frozen=True)
class Placement:
    """A verified link between two cameras' maps."""

    first: int
    second: int
    aSb: Similarity
    verdict: Verdict
    doubted: bool = False
    """Whether others came near it, in matches and in dense warping, before any was mended."""


Judge = Callable[[int, int, Similarity], float]
"""What speaks for a placement ``aSb`` of two cameras' maps, less what speaks against it."""


def balance(verdict: Verdict) -> float:
    """What speaks for a placement less what speaks against it."""
    return verdict.agreement - verdict.contradiction


def connect(
    cameras: list[int], links: list[Placement], judge: Judge | None = None
) -> list[dict[int, Similarity]]:
    """Groups of connected cameras, each camera's map placed in its group's world (``wSm``).

    Groups grow by one link at a time, the one with most in its favour first. With ``judge``, which says
    what speaks for a placement of any two cameras, a link counts for what it implies for *every* pair of
    cameras it brings together: a shift along a repeated texture can satisfy one pair, hardly all. A link
    with more against it than for it joins nothing. The world of a group is the map of its lowest-numbered
    camera.
    """
    group_of = {camera: {camera: Similarity.identity()} for camera in cameras}
    known: dict[int, float] = {}
    while True:
        open_links = [
            index for index, link in enumerate(links) if group_of[link.first] is not group_of[link.second]
        ]
        for index in open_links:
            if index not in known:
                known[index] = _value(links[index], group_of, judge)
        if not open_links or known[best := max(open_links, key=lambda index: known[index])] <= 0.0:
            break
        first, second = group_of[links[best].first], group_of[links[best].second]
        bridge = _bridge(links[best], group_of)
        for camera, similarity in second.items():
            first[camera] = bridge.compose(similarity)
            group_of[camera] = first
        # What a link into this group brings together has changed.
        known = {
            index: value
            for index, value in known.items()
            if group_of[links[index].first] is not first and group_of[links[index].second] is not first
        }
    groups: list[dict[int, Similarity]] = []
    for camera in cameras:
        group = group_of[camera]
        if not any(group is other for other in groups):
            groups.append(group)
    return [
        {camera: group[min(group)].inverse().compose(group[camera]) for camera in sorted(group)}
        for group in groups
    ]


def _bridge(link: Placement, group_of: Mapping[int, Mapping[int, Similarity]]) -> Similarity:
    """World of the first camera's group from the world of the second's."""
    first, second = group_of[link.first], group_of[link.second]
    return first[link.first].compose(link.aSb).compose(second[link.second].inverse())


def _value(link: Placement, group_of: Mapping[int, Mapping[int, Similarity]], judge: Judge | None) -> float:
    if judge is None:
        return balance(link.verdict)
    bridge = _bridge(link, group_of)
    first, second = group_of[link.first], group_of[link.second]
    # The link's own verdict is that of maps bent to fit, which the judge has not seen.
    return balance(link.verdict) + sum(
        judge(a, b, first[a].inverse().compose(bridge).compose(second[b]))
        for a in first
        for b in second
        if {a, b} != {link.first, link.second}
    )
