"""From verified links to groups of cameras, and the classical start as a whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start import Start
from mvdyn_gtsam.frontend.verification import Verdict
from mvdyn_gtsam.frontend.wide_baseline import (
    ClassicalInitializer,
    Placement,
    WideBaselineConfig,
    balance,
    connect,
)
from mvdyn_gtsam.geometry import Similarity, rotation_angle_deg
from tests.frontend.synthetic_maps import similarity
from tests.tracking.synthetic_scene import Scene, two_cameras

STRONG, WEAK = Verdict(5.0, 0.1, 10), Verdict(3.0, 2.5, 10)
WORLD = {  # the world in each camera's map
    0: similarity(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    1: similarity(2.0, (0.0, 0.4, 0.0), (1.0, 0.0, 0.0)),
    2: similarity(0.5, (0.2, 0.0, 0.1), (0.0, 1.0, 0.3)),
    3: similarity(1.5, (0.0, -0.3, 0.2), (0.4, 0.0, 2.0)),
}


def link(first: int, second: int, verdict: Verdict = STRONG, error: Similarity | None = None) -> Placement:
    aSb = WORLD[first].compose(WORLD[second].inverse())
    return Placement(first, second, aSb if error is None else error.compose(aSb), verdict)


def assert_true(group: dict[int, Similarity]) -> None:
    """Every map where it truly stands in the map of the group's lowest camera."""
    for camera, wSm in group.items():
        expected = WORLD[min(group)].compose(WORLD[camera].inverse())
        np.testing.assert_allclose(wSm.matrix(), expected.matrix(), atol=1e-12)


@pytest.mark.parametrize(
    "links",
    [[(0, 1), (1, 2), (2, 3)], [(2, 3), (0, 1), (1, 3)], [(1, 3), (2, 3), (0, 3)]],
    ids=["chain", "two pairs joined", "star around the last"],
)
def test_links_join_all_in_the_world_of_the_lowest(links: list[tuple[int, int]]) -> None:
    groups = connect([0, 1, 2, 3], [link(*pair) for pair in links])
    assert [sorted(group) for group in groups] == [[0, 1, 2, 3]]
    assert_true(groups[0])
    np.testing.assert_array_equal(groups[0][0].matrix(), np.eye(4))


def test_unlinked_cameras_stay_apart() -> None:
    groups = connect([0, 1, 2, 3], [link(1, 3)])
    assert [sorted(group) for group in groups] == [[0], [1, 3], [2]]
    for group in groups:
        assert_true(group)
    assert [sorted(group) for group in connect([2, 3], [])] == [[2], [3]]
    assert connect([], []) == []


def test_a_weak_link_that_contradicts_strong_ones_loses() -> None:
    wrong = similarity(1.0, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    links = [link(0, 2, WEAK, wrong), link(0, 1), link(1, 2)]
    for order in (links, links[::-1]):
        (group,) = connect([0, 1, 2], order)
        assert_true(group)


def test_a_repeated_texture_that_satisfies_one_pair_loses_against_what_all_pairs_say() -> None:
    wrong = similarity(1.0, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    favour = {(0, 1): 2.0, (1, 2): 0.5, (0, 2): 1.0}
    links = [link(0, 1, Verdict(2.0, 0.0, 4)), link(1, 2, WEAK), link(0, 2, Verdict(1.2, 0.0, 4), wrong)]

    def judge(a: int, b: int, aSb: Similarity) -> float:
        a, b, aSb = (a, b, aSb) if a < b else (b, a, aSb.inverse())
        true = WORLD[a].compose(WORLD[b].inverse())
        if np.allclose(aSb.matrix(), true.matrix(), atol=1e-9):
            return favour[a, b]
        return 1.2 if (a, b) == (0, 2) else -3.0  # the shifted texture suits 0 and 2 better than the truth

    (group,) = connect([0, 1, 2], links, judge)
    assert_true(group)
    # Without the third camera's word it wins.
    (misled,) = connect([0, 2], [link(0, 2, Verdict(1.0, 0.0, 4)), links[2]], judge)
    assert not np.allclose(misled[2].matrix(), group[2].matrix())


def test_a_link_with_more_against_it_than_for_it_joins_nothing() -> None:
    against = Verdict(1.0, 1.1, 4)
    groups = connect([0, 1], [link(0, 1, against)], lambda a, b, aSb: 1.0)
    assert [sorted(group) for group in groups] == [[0], [1]]
    # The third camera's word counts as well.
    links = [link(0, 1), link(1, 2, WEAK)]
    groups = connect([0, 1, 2], links, lambda a, b, aSb: -1.0)
    assert [sorted(group) for group in groups] == [[0, 1], [2]]


def test_balance_weighs_both_sides() -> None:
    assert balance(Verdict(2.0, 0.5, 4)) == 1.5
    assert balance(Verdict(1.0, 3.0, 4)) == -2.0


def test_nonsense_is_refused() -> None:
    for values in ({"neighbours": 1}, {"features": 10}, {"frame_step": 0.0}):
        with pytest.raises(ConfigError, match="wide_baseline"):
            WideBaselineConfig(**values)


def start_errors(start: Start, scene: Scene) -> tuple[float, float]:
    """Largest position error after one scale about the first camera, and rotation error, deg."""
    frames = [(camera, frame) for camera, own in enumerate(start.frames) for frame in own]
    origin, truth = start.frames[0][0].wTc, scene.wTc[0, start.frames[0][0].time]
    own = np.array([np.linalg.inv(origin) @ frame.wTc for _, frame in frames])
    true = np.array([np.linalg.inv(truth) @ scene.wTc[camera, frame.time] for camera, frame in frames])
    a, b = own[:, :3, 3], true[:, :3, 3]
    scale = (a * b).sum() / (a * a).sum()
    turns = np.swapaxes(true[:, :3, :3], 1, 2) @ own[:, :3, :3]
    return float(np.linalg.norm(scale * a - b, axis=1).max()), float(rotation_angle_deg(turns).max())


@pytest.mark.slow
def test_two_cameras_of_one_scene_are_placed() -> None:
    scene = two_cameras()
    start = ClassicalInitializer(DisFlow())(scene.capture())
    assert start.groups == ((0, 1),)
    position, rotation = start_errors(start, scene)
    assert position < 0.05  # of 5 units of depth
    assert rotation < 0.5
    for camera, frames in enumerate(start.frames):
        assert [frame.time for frame in frames] == sorted(frame.time for frame in frames)
        assert frames[0].time == 0 and frames[-1].time == 8
        for frame in frames:
            x, y = np.rint(frame.pixels).astype(int).T
            ratio = frame.depth / scene.depths[camera][frame.time][y, x]
            assert len(ratio) > 50
            assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.03


@pytest.mark.slow
def test_cameras_that_never_share_a_view_stay_apart(shared_data: Path) -> None:
    capture = load_capture(shared_data / "rendered" / "robodog_nonoverlap")
    config = WideBaselineConfig(maximum_frames=10, features=1500)  # less than the defaults, for the time
    start = ClassicalInitializer(DisFlow(), config)(capture)
    assert sorted(start.groups) == [(0,), (1,)]
    assert all(len(frames) > 3 for frames in start.frames)
