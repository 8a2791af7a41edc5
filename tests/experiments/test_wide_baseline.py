"""Errors of the start: exact for the truth in any frame and scale, right for a known mistake."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from experiments.start_errors import Frames, nearest_pairs, score_start
from experiments.wide_baseline import render, variants
from mvdyn_gtsam.errors import ConfigError, MvdynError
from mvdyn_gtsam.geometry import Similarity

CAMERAS = ("cam0", "cam1", "cam2")


def random_poses(rng: np.random.Generator, count: int) -> Frames:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return {3 * number: pose for number, pose in enumerate(poses)}


def scene(seed: int) -> dict[str, Frames]:
    rng = np.random.default_rng(seed)
    return {camera: random_poses(rng, 5) for camera in CAMERAS}


def moved(frames: Frames, gSe: Similarity) -> Frames:
    return {number: gSe.transform_poses(pose) for number, pose in frames.items()}


@given(st.integers(0, 10**6), st.floats(0.01, 100.0))
def test_the_truth_in_another_frame_and_scale_has_no_error(seed: int, scale: float) -> None:
    truth = scene(seed)
    rng = np.random.default_rng(seed + 1)
    eSg = Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    score = score_start([CAMERAS], {camera: moved(own, eSg) for camera, own in truth.items()}, truth)
    assert [pair.cameras for pair in score.pairs] == [("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam2")]
    for pair in score.pairs:
        assert pair.worst_rotation_deg < 1e-5
        assert pair.worst_translation_m < 1e-6
    assert score.apart == () and score.problem is None


def test_a_camera_turned_in_place_shows_its_angle() -> None:
    truth = scene(0)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, np.radians(2.0)]).as_matrix()
    wrong = {**truth, "cam1": {number: pose @ turn for number, pose in truth["cam1"].items()}}
    pair = score_start([("cam0", "cam1")], wrong, truth).pairs[0]
    assert pair.rotation_deg == pytest.approx(2.0, abs=1e-6)
    # Positions are right, so the translation aTb in the frame of camera a is right as well.
    assert pair.translation_m < 1e-9


def test_one_wrong_frame_is_the_worst_and_the_rms_less() -> None:
    truth = scene(1)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([np.radians(3.0), 0.0, 0.0]).as_matrix()
    wrong = {**truth, "cam1": {**truth["cam1"], 6: truth["cam1"][6] @ turn}}
    pair = score_start([("cam0", "cam1")], wrong, truth).pairs[0]
    assert pair.frame_pairs == 5
    assert pair.worst_rotation_deg == pytest.approx(3.0, abs=1e-6)
    assert pair.rotation_deg == pytest.approx(3.0 / np.sqrt(5.0), abs=1e-6)


def test_cameras_in_different_groups_are_apart_and_not_scored() -> None:
    truth = scene(2)
    score = score_start([("cam0", "cam2"), ("cam1",)], truth, truth)
    assert [pair.cameras for pair in score.pairs] == [("cam0", "cam2")]
    assert score.apart == (("cam0", "cam1"), ("cam1", "cam2"))


def test_no_start_at_all_leaves_every_pair_apart() -> None:
    score = score_start([[camera] for camera in CAMERAS], {}, scene(3))
    assert score.pairs == () and len(score.apart) == 3
    assert score.frames == {"cam0": 0, "cam1": 0, "cam2": 0}


def test_positions_that_coincide_are_a_problem_and_not_a_crash() -> None:
    truth = scene(4)
    still: dict[str, Frames] = {camera: dict.fromkeys(own, np.eye(4)) for camera, own in truth.items()}
    score = score_start([CAMERAS], still, truth)
    assert score.pairs == () and score.problem is not None and "coincide" in score.problem


@given(
    st.lists(st.integers(0, 60), min_size=1, unique=True),
    st.lists(st.integers(0, 60), min_size=1, unique=True),
)
def test_nearest_pairs_take_every_frame_and_no_nearer_one_is_left(a: list[int], b: list[int]) -> None:
    pairs = nearest_pairs(sorted(a), sorted(b))
    assert {first for first, _ in pairs} == set(a) and {second for _, second in pairs} == set(b)
    assert len(set(pairs)) == len(pairs)
    for first, second in pairs:
        gap = abs(first - second)
        assert gap == min(abs(first - other) for other in b) or gap == min(abs(second - o) for o in a)


def test_a_sweep_changes_one_setting_at_a_time() -> None:
    key = "frontend.wide_baseline.placement"
    chosen = variants([], [f"{key}.match_ratio=0.7,0.8", f"{key}.samples=100"], joint_frames=8)
    assert [v.name for v in chosen] == [
        "default", "match_ratio=0.7", "match_ratio=0.8", "samples=100", "joint SfM, 8 frames",
    ]  # fmt: skip
    placements = [v.config.frontend.wide_baseline.placement for v in chosen]
    assert [p.match_ratio for p in placements[:3]] == [placements[0].match_ratio, 0.7, 0.8]
    assert placements[3].samples == 100 and placements[3].match_ratio == placements[0].match_ratio


@pytest.mark.parametrize("sweep", ["frontend.flow", "x=", "frontend.flow.patch_size=8,"])
def test_a_malformed_sweep_is_refused(sweep: str) -> None:
    with pytest.raises(MvdynError, match="--sweep"):
        variants([], [sweep], 0)


def test_an_unknown_swept_setting_is_refused() -> None:
    with pytest.raises(ConfigError, match="match_ratio"):
        variants([], ["frontend.wide_baseline.placement.match_ration=0.5"], 0)


def entry(**changes: Any) -> dict[str, Any]:
    truth = scene(5)
    score = score_start([("cam0", "cam1"), ("cam2",)], truth, truth)
    content = {
        "capture": "clip",
        "variant": "default",
        "seconds": 12.0,
        "median_depth_m": 2.0,
        "commit": "abc",
    }
    return {**content, **asdict(score), **changes}


def test_table_names_the_worst_pair_and_the_cameras_left_apart() -> None:
    pairs = [
        {"cameras": ("cam0", "cam1"), "frame_pairs": 3, "rotation_deg": 0.4, "translation_m": 0.05,
         "worst_rotation_deg": 0.45, "worst_translation_m": 0.06},
    ]  # fmt: skip
    text = render([entry(pairs=pairs)])
    assert "| clip | default | cam0+cam1 / cam2 | 5 5 5 | 0.40 | 50 | 2.50 | yes, some apart | 12 |" in text
    assert "| clip | default | cam0 - cam2 | 0 | apart | apart | apart |" in text
    assert "| no, some apart |" in render([entry(pairs=[{**pairs[0], "rotation_deg": 0.51}])])
    assert "| no, some apart |" in render([entry(pairs=[{**pairs[0], "translation_m": 0.061}])])
    failed = render([entry(problem="nothing moves", pairs=[])])
    assert "| failed |" in failed and "nothing moves" in failed
