"""Which keyframes to connect, from their poses and depths: what tracker and polish ask of graph/."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.config import GraphConfig
from mvdyn_gtsam.graph.connections import ConnectionGraph, Edge, EdgeKind
from mvdyn_gtsam.graph.selection import View as CandidateView
from mvdyn_gtsam.graph.selection import choose_spread, edge_score, predicted_overlap
from mvdyn_gtsam.tracking.model import Keyframe, View
from mvdyn_gtsam.tracking.motion import world_points

Array = npt.NDArray[np.float64]

MAXIMUM_CANDIDATES = 64
"""Keyframes of another camera looked at per step, spread over its past: keeps a step's cost flat."""


def inter_camera_edges(
    keyframe: Keyframe,
    others: Sequence[Keyframe],
    views: tuple[View, ...],
    graph: ConnectionGraph,
    config: GraphConfig,
    count: int,
) -> list[Edge]:
    """Spatial and spatio-temporal edges of a keyframe to keyframes ``others`` of one other camera.

    The spatial edge of the same instant is made wherever the 75 % rule holds; at most ``count`` edges.
    """
    candidates = _spread(others, MAXIMUM_CANDIDATES)
    if not candidates or count < 1:
        return []
    inside, score = _scores(keyframe, candidates, views, config)
    times = np.array([other.time for other in candidates])
    edges: list[Edge] = []
    same_instant = np.flatnonzero(times == keyframe.time)
    for index in same_instant.tolist():
        if inside[index] > config.spatial_overlap and score[index] > 0:
            edges.append(Edge(keyframe.frame, candidates[index].frame, EdgeKind.SPATIAL))
            score[index] = 0.0
    taken = [keyframe.time] * len(edges)
    for index in choose_spread(score, times, config.st_separation, count - len(edges), taken):
        edges.append(Edge(keyframe.frame, candidates[index].frame, EdgeKind.SPATIO_TEMPORAL))
    return [edge for edge in edges if not graph.connected(edge.i, edge.j)]


def long_range_edges(
    keyframe: Keyframe,
    track: Sequence[Keyframe],
    views: tuple[View, ...],
    graph: ConnectionGraph,
    config: GraphConfig,
) -> list[Edge]:
    """Edges to earlier keyframes of the same camera, far enough back that temporal edges do not reach."""
    position = next(index for index, other in enumerate(track) if other is keyframe)
    last = position - config.long_range_separation
    candidates = _spread(track[: max(0, last + 1)], MAXIMUM_CANDIDATES)
    if not candidates:
        return []
    _, score = _scores(keyframe, candidates, views, config)
    times = np.array([other.time for other in candidates])
    chosen = choose_spread(score, times, config.long_range_separation, config.long_range_per_frame)
    edges = [Edge(keyframe.frame, candidates[index].frame, EdgeKind.LONG_RANGE) for index in chosen]
    return [edge for edge in edges if not graph.connected(edge.i, edge.j)]


def _scores(
    keyframe: Keyframe, candidates: Sequence[Keyframe], views: tuple[View, ...], config: GraphConfig
) -> tuple[Array, Array]:
    view = views[keyframe.camera]
    # every third point of the grid is plenty to estimate a share
    points = world_points(view.rays[::3], keyframe.log_depth[::3], keyframe.wTc)
    overlap = predicted_overlap(
        points,
        keyframe.wTc[:3, 3],
        [_candidate(other, views[other.camera]) for other in candidates],
        config.occlusion_tolerance,
    )
    return overlap.inside, edge_score(overlap, config.st_overlap, config.max_parallax_deg)


def _candidate(keyframe: Keyframe, view: View) -> CandidateView:
    grid = view.grid
    return CandidateView(
        wTc=keyframe.wTc,
        intrinsics=view.intrinsics,
        size=(view.camera.width, view.camera.height),
        depth=np.exp(keyframe.log_depth).reshape(grid.shape),
        origin=(float(grid.pixels[0, 0]), float(grid.pixels[0, 1])),
        stride=grid.stride,
    )


def _spread(keyframes: Sequence[Keyframe], maximum: int) -> list[Keyframe]:
    """At most ``maximum`` of them, evenly spread, the last one always among them."""
    if len(keyframes) <= maximum:
        return list(keyframes)
    indices = np.unique(np.linspace(0, len(keyframes) - 1, maximum).round().astype(int))
    return [keyframes[index] for index in indices]
