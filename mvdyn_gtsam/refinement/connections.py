"""The refinement graph: Omega of the tracking and dense temporal offsets (paper, "Dense correspondence
estimation"), and what each frame is swept against."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mvdyn_gtsam.graph.connections import Frame

Pair = tuple[Frame, Frame]


def refinement_pairs(
    omega: Iterable[Pair], groups: Sequence[Sequence[int]], frame_count: int, offsets: Sequence[int]
) -> tuple[Pair, ...]:
    """Pairs of frames to measure, each once, ordered by time: ``omega``, every frame to those ``offsets``
    later, and the frames of one instant of all cameras of a group."""
    pairs = {_ordered(i, j) for i, j in omega}
    for group in groups:
        for camera in group:
            for offset in offsets:
                pairs |= {((camera, t), (camera, t + offset)) for t in range(frame_count - offset)}
        for position, camera in enumerate(sorted(group)):
            for other in sorted(group)[position + 1 :]:
                pairs |= {((camera, t), (other, t)) for t in range(frame_count)}
    return tuple(sorted(pairs, key=lambda pair: (pair[0][1], pair[1][1], pair[0][0], pair[1][0])))


def _ordered(i: Frame, j: Frame) -> Pair:
    """The earlier frame first, of one instant the lower camera."""
    return (i, j) if (i[1], i[0]) <= (j[1], j[0]) else (j, i)


def neighbours_of(pairs: Iterable[Pair]) -> dict[Frame, tuple[Frame, ...]]:
    """Every frame's partners, in the order of the pairs."""
    found: dict[Frame, list[Frame]] = {}
    for i, j in pairs:
        found.setdefault(i, []).append(j)
        found.setdefault(j, []).append(i)
    return {frame: tuple(partners) for frame, partners in found.items()}


def is_first(i: Frame, j: Frame) -> bool:
    """Whether a pair of these frames is kept as (i, j) rather than (j, i)."""
    return _ordered(i, j) == (i, j)
