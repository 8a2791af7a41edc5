"""The classical start as a whole, and what it believes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start import wide_baseline
from mvdyn_gtsam.frontend.start.groups import Placement
from mvdyn_gtsam.frontend.start.lifted_points import LiftConfig
from mvdyn_gtsam.frontend.start.model import Start
from mvdyn_gtsam.frontend.start.placement import PlacementConfig
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.frontend.start.verification import Verdict
from mvdyn_gtsam.frontend.start.wide_baseline import NEAR, Candidate, ClassicalInitializer
from mvdyn_gtsam.geometry import Similarity, rotation_angle_deg
from tests.frontend.start.synthetic_maps import similarity
from tests.tracking.synthetic_scene import Scene, two_cameras


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
def test_cameras_that_triangulated_points_leave_apart_are_connected_on_a_second_look() -> None:
    scene = two_cameras()
    config = WideBaselineConfig(
        placement=PlacementConfig(match_ratio=0.05)
    )  # hardly anything is that distinct
    without = replace(config, lift=LiftConfig(match_ratio=0.05))
    assert ClassicalInitializer(DisFlow(), without)(scene.capture()).groups == ((0,), (1,))
    start = ClassicalInitializer(DisFlow(), config)(scene.capture())
    assert start.groups == ((0, 1),)
    position, rotation = start_errors(start, scene)
    assert position < 0.05
    assert rotation < 0.5


@pytest.mark.slow
def test_cameras_that_know_too_little_depth_are_not_placed() -> None:
    start = ClassicalInitializer(DisFlow(), WideBaselineConfig(minimum_known=0.99))(two_cameras().capture())
    assert start.groups == ((0,), (1,))
    assert all(len(frames) > 3 for frames in start.frames)


class Judged(ClassicalInitializer):
    """A start whose trials have come out already."""

    inliers = 40

    def __init__(self, candidates: list[tuple[Verdict, bool]], apart: float = 1.0) -> None:
        super().__init__(DisFlow())
        self.candidates = [
            Candidate(
                Placement(0, 1, similarity(1.0, (0.0, 0.0, 0.0), (apart * number, 0.0, 0.0)), verdict),
                self.inliers,
                NEAR * 20.0 if alone else 20.0,
                alone,
            )
            for number, (verdict, alone) in enumerate(candidates)
        ]

    def _likely(self, *_: object) -> list[Candidate]:
        return self.candidates

    def _tried(self, *arguments: object) -> Placement:
        (placement,) = (argument for argument in arguments if isinstance(argument, Placement))
        return placement


def judged(*candidates: tuple[Verdict, bool], apart: float = 1.0) -> list[Verdict]:
    start = Judged(list(candidates), apart)
    capture, dense, matches = (None,) * 3
    return [placement.verdict for placement in start._place_lifted(capture, dense, dense, matches)]  # type: ignore[arg-type]


def test_a_second_look_asks_for_more_unless_the_matches_leave_no_choice() -> None:
    sure, fair, doubtful = (Verdict(a, c, 10, 5.0) for a, c in ((4.0, 0.1), (4.0, 0.9), (4.0, 1.5)))
    rival = Verdict(2.0, 1.5, 10, 5.0)
    assert judged((sure, False), (rival, False)) == [sure]
    assert judged((fair, False), (rival, False)) == []
    assert judged((fair, True), (rival, False)) == [fair]
    assert judged((doubtful, True)) == []
    # a pattern that repeats: little of what could be compared agrees
    assert judged((replace(sure, comparable=12.0), True)) == []
    # next to nothing to go by
    assert judged((Verdict(0.05, 0.0, 10, 0.06), True)) == []


def test_what_trials_refute_or_bring_to_the_same_place_is_no_rival() -> None:
    fair, rival, refuted = Verdict(4.0, 0.9, 10, 5.0), Verdict(2.0, 1.5, 10, 5.0), Verdict(2.0, 2.5, 10, 5.0)
    assert judged((fair, False), (rival, False)) == []
    assert judged((fair, False), (refuted, False)) == [fair]
    assert judged((fair, False), (rival, False), apart=0.01) == [fair]


def test_a_second_look_needs_matches_enough_to_place_by(monkeypatch: pytest.MonkeyPatch) -> None:
    sure = Verdict(4.0, 0.1, 10, 5.0)
    assert judged((sure, True)) == [sure]
    monkeypatch.setattr(Judged, "inliers", 19)
    assert judged((sure, True)) == []


def test_a_second_look_believes_one_placement_at_most() -> None:
    shifted, true = Verdict(3.0, 0.1, 10, 4.0), Verdict(4.0, 0.1, 10, 4.2)
    assert judged((shifted, False), (true, False)) == [true]


def placed(*candidates: tuple[Verdict, bool]) -> list[Placement]:
    """What the first look believes of two cameras."""
    nothing = (None,) * 4
    return Judged(list(candidates))._place(*nothing)  # type: ignore[arg-type]


def test_what_others_come_near_to_is_doubted() -> None:
    best, near, far = (Verdict(a, 0.1, 10, 5.0) for a in (4.0, 3.0, 1.0))
    assert [link.doubted for link in placed((best, False), (far, False))] == [False]
    assert [link.doubted for link in placed((best, False), (near, False))] == [True, True]
    # matches leave no choice
    assert [link.doubted for link in placed((best, True), (near, False))] == [False, True]


ELSEWHERE = Similarity(1.0, np.eye(3), np.array([0.7, 0.0, 0.0]))
"""One period of a pattern aside."""


@pytest.mark.parametrize(
    ("doubted", "placement", "favour", "taken"),
    [
        (True, ELSEWHERE, 4.0, True),
        (True, ELSEWHERE, 2.0, False),  # less speaks for it
        (True, Similarity.identity(), 4.0, False),  # nothing new
        (False, ELSEWHERE, 4.0, False),  # nobody asked
    ],
)
def test_a_placement_in_doubt_gives_way_to_a_better_one_only(
    monkeypatch: pytest.MonkeyPatch, doubted: bool, placement: Similarity, favour: float, taken: bool
) -> None:
    believed = Placement(0, 1, Similarity.identity(), Verdict(2.5, 0.1, 10, 4.0), doubted)
    better = Placement(0, 1, placement, Verdict(favour, 0.0, 10, 4.2))
    monkeypatch.setattr(wide_baseline, "lift_map", lambda _, dense, *__: f"lifted {dense}")
    monkeypatch.setattr(wide_baseline, "match_lifted", lambda *_: "more matches")
    monkeypatch.setattr(ClassicalInitializer, "_place_lifted", lambda *_: [better])
    capture = SimpleNamespace(cameras=[SimpleNamespace(name=name) for name in ("cam0", "cam1")])
    dense: Any = {0: "0", 1: "1"}
    first_look: Any = {(0, 1): "matches"}
    start: Any = ClassicalInitializer(DisFlow())
    more, matches, lifted = start._look_again(capture, dense, [believed], first_look)
    assert more == ([better] if taken else [])
    assert matches == {(0, 1): "more matches" if taken else "matches"}
    # maps that found nothing new stay as they were
    assert lifted == ({0: "lifted 0", 1: "lifted 1"} if taken else {})


@pytest.mark.slow
def test_cameras_that_never_share_a_view_stay_apart(shared_data: Path) -> None:
    capture = load_capture(shared_data / "rendered" / "robodog_nonoverlap")
    config = WideBaselineConfig(maximum_frames=10, features=1500)  # less than the defaults, for the time
    start = ClassicalInitializer(DisFlow(), config)(capture)
    assert sorted(start.groups) == [(0,), (1,)]
    assert all(len(frames) > 3 for frames in start.frames)
