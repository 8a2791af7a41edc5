"""What the tracker asks of its state: connections that are worth measuring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mvdyn_gtsam.config import load_config
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.graph.connections import ConnectionGraph, Edge, Frame
from mvdyn_gtsam.tracking.state import NEAR, TrackState
from mvdyn_gtsam.tracking.tracker import Tracker
from tests.tracking.synthetic_scene import two_cameras


@pytest.fixture(scope="module")
def state() -> TrackState:
    """Of two cameras that were tracked, every frame a keyframe, and whose connections are forgotten."""
    scene = two_cameras()
    config = load_config(None, ["tracking.grid_points=300", "tracking.keyframe_px=0.0"])
    tracker = Tracker(scene.cameras, scene.start(((0, 1),)), DisFlow(config.frontend.flow), config)
    for time in range(9):
        tracker.step(time, [images[time] for images in scene.images])
    tracker.state.graph = ConnectionGraph(96)
    return tracker.state


def wanted(state: TrackState, frame: Frame) -> set[frozenset[Frame]]:
    return {edge.frames for edge in state.edges_to_other_cameras(state.frames[frame], 4)}


def make_vain(state: TrackState, which: Callable[[Frame, Frame], bool]) -> Callable[[], None]:
    """Let flow between the cameras have no weight where ``which`` says so; returns what undoes it."""
    kept = {frame: dict(keyframe.flows) for frame, keyframe in state.frames.items()}
    for frame, keyframe in state.frames.items():
        for other, flow in keyframe.flows.items():
            if other[0] != frame[0] and which(frame, other):
                keyframe.flows[other] = replace(flow, weight_steps=np.zeros_like(flow.weight_steps))

    def undo() -> None:
        for frame, flows in kept.items():
            state.frames[frame].flows.update(flows)

    return undo


def test_every_frame_is_a_keyframe_and_the_cameras_were_connected(state: TrackState) -> None:
    assert [len(track) for track in state.tracks] == [9, 9]
    assert wanted(state, (0, 4))
    assert any(other[0] == 1 for keyframe in state.tracks[0] for other in keyframe.flows)


def test_where_all_around_found_nothing_no_more_is_asked_for(state: TrackState) -> None:
    undo = make_vain(state, lambda i, j: True)
    try:
        measured = [(i, j) for i in state.frames for j in state.frames[i].flows if i[0] == 0 and j[0] == 1]
        for time in range(9):
            for pair in wanted(state, (0, time)):
                (_, first), (_, second) = sorted(pair)
                assert not any(abs(first - i[1]) <= NEAR and abs(second - j[1]) <= NEAR for i, j in measured)
    finally:
        undo()


def test_one_neighbour_that_found_something_suffices(state: TrackState) -> None:
    before = wanted(state, (0, 4))
    (_, first), (_, second) = sorted(next(iter(before)))
    near = [
        (i, j)
        for i in state.frames
        for j in state.frames[i].flows
        if i[0] == 0 and j[0] == 1 and abs(i[1] - first) <= NEAR and abs(j[1] - second) <= NEAR
    ]
    assert near
    undo = make_vain(state, lambda i, j: {i, j} != set(near[0]))
    try:
        assert frozenset(((0, first), (1, second))) in wanted(state, (0, 4))
    finally:
        undo()


def test_what_nobody_tried_is_tried(state: TrackState) -> None:
    far = Edge((0, 0), (1, 8), next(iter(state.kinds.values())))
    tried = [j for k in state.tracks[0][: NEAR + 1] for j in k.flows if j[0] == 1 and j[1] >= 8 - NEAR]
    undo = make_vain(state, lambda i, j: True)
    try:
        assert state._in_vain(far) == bool(tried)
    finally:
        undo()
