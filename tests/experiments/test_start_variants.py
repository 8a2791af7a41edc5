"""Altered captures keep their truth, and verdicts name the worst pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.altered_captures import (
    Alteration,
    AlteredCapture,
    Part,
    alter,
    alter_capture,
    altered_camera,
)
from experiments.records import ExperimentError
from experiments.start_errors import PairError, StartScore
from experiments.start_variants import (
    ORDER,
    SCENES,
    VARIANTS,
    main,
    random_scene,
    random_variants,
    scene_of,
    verdict,
)
from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.geometry import project
from mvdyn_gtsam.scenes import SceneSettings, make_scene

SCENE = SceneSettings(cameras=2, frames=7, width=96, height=64, every=2, overlap=0.6, seed=1)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {"scene": make_scene(SCENE, tmp_path_factory.mktemp("altered") / "scene")}


def test_a_crop_at_half_size_shows_a_point_where_its_camera_projects_it() -> None:
    camera = Camera("a", 96, 64, 80.0, 80.0, 47.5, 31.5)
    alteration = Alteration(left=0.25, right=0.125, scale=0.5)
    altered = altered_camera(camera, alteration, "b")
    # the four pixels around (40.5, 20.5) become one
    image = np.zeros((64, 96, 3), np.uint8)
    image[20:22, 40:42] = 200
    shown = alter(image, alteration, 0.0, 0)
    assert shown.shape == (altered.height, altered.width, 3) == (32, 30, 3)
    point = np.array([[(40.5 - camera.cx) / camera.fx, (20.5 - camera.cy) / camera.fy, 1.0]])
    x, y = project(point, altered.intrinsics)[0][0]
    assert shown[round(y), round(x)].tolist() == [200, 200, 200] and (shown > 0).sum() == 3


def test_frames_are_picked_and_keep_their_poses(folders: dict[str, Path]) -> None:
    parts = (
        Part("scene", "cam0", start=1, stop=6, step=2),
        Part("scene", "cam0", start=2, step=2, reverse=True),
    )
    with pytest.raises(ExperimentError, match="no true depth"):
        alter_capture("x", parts, folders)
    altered = alter_capture("x", (replace(parts[0], step=1, stop=4), parts[1]), folders)
    source = load_capture(folders["scene"])
    assert [camera.name for camera in altered.capture.cameras] == ["cam0", "cam0_1"]
    np.testing.assert_array_equal(altered.capture.read(0, 2), source.read(0, 3))
    np.testing.assert_array_equal(altered.capture.read(1, 0), source.read(0, 6))
    plain = alter_capture("x", (Part("scene", "cam0"), Part("scene", "cam1")), folders)
    np.testing.assert_array_equal(altered.truth["cam0_1"][0], plain.truth["cam0"][6])
    np.testing.assert_array_equal(altered.truth["cam0"][0], plain.truth["cam0"][1])


def test_common_view_is_whole_with_oneself_less_when_cut_and_none_in_another_world(
    folders: dict[str, Path],
) -> None:
    whole = Part("scene", "cam0")
    pair = ("cam0", "cam0_1")
    same = alter_capture("x", (whole, whole), folders)
    assert same.shared_at_once[pair] == pytest.approx(1.0, abs=0.06)  # edges of things, by nearest pixel
    left = replace(whole, alteration=Alteration(right=0.5))
    right = replace(whole, alteration=Alteration(left=0.5))
    halves = alter_capture("x", (left, right), folders)
    assert halves.shared_at_once[pair] < 0.05 <= same.shared[pair]
    other = replace(whole, capture="other")
    assert alter_capture("x", (whole, other), {**folders, "other": folders["scene"]}).shared[pair] == 0.0


def test_worse_images_repeat_exactly_and_differ_from_frame_to_frame() -> None:
    image = np.full((32, 48, 3), 100, np.uint8)
    worse = Alteration(noise=5.0, gain=(0.5, 1.5), blur_px=3, jpeg=60)
    np.testing.assert_array_equal(alter(image, worse, 0.5, 3), alter(image, worse, 0.5, 3))
    assert (alter(image, worse, 0.5, 3) != alter(image, worse, 0.5, 4)).any()
    assert alter(image, worse, 0.0, 3).mean() == pytest.approx(50.0, abs=2.0)
    assert alter(image, worse, 1.0, 3).mean() == pytest.approx(150.0, abs=2.0)


def score_of(deg: float, metres: float, apart: bool = False) -> StartScore:
    pair = PairError(("a", "b"), 3, deg, metres, deg, metres)
    if apart:
        return StartScore((("a",), ("b",)), {"a": 1, "b": 1}, (), (("a", "b"),), None)
    return StartScore((("a", "b"),), {"a": 1, "b": 1}, (pair,), (), None)


@pytest.mark.parametrize(
    ("shared", "score", "expected"),
    [
        (0.4, score_of(0.1, 0.01), "right"),
        (0.4, score_of(0.8, 0.01), "rough"),
        (0.4, score_of(0.1, 0.16), "rough"),
        (0.4, score_of(3.0, 0.01), "WRONG"),
        (0.4, score_of(0.1, 0.5), "WRONG"),
        (0.4, score_of(0.0, 0.0, apart=True), "apart"),
        (0.1, score_of(0.0, 0.0, apart=True), "right"),
        (0.0, score_of(0.1, 0.01), "WRONG"),
        (0.0, score_of(0.0, 0.0, apart=True), "right"),
    ],
)
def test_verdict(shared: float, score: StartScore, expected: str) -> None:
    camera = Camera("a", 8, 8, 8.0, 8.0, 3.5, 3.5)
    capture = Capture("x", 30.0, (camera, replace(camera, name="b")), ())
    pair = {("a", "b"): shared}
    altered = AlteredCapture(capture, {}, 4.0, pair, pair)
    assert verdict(altered, score) == expected and expected in ORDER


def test_every_variant_has_its_own_name_and_the_generated_scenes_exist() -> None:
    names = [variant.name for variant in VARIANTS]
    assert len(set(names)) == len(names) >= 20
    rendered = {
        "robodog_overlap", "dynamic_human", "roboarm", "three_cameras", "multicamvideo", "robodog_nonoverlap",
    }  # fmt: skip
    assert {part.capture for variant in VARIANTS for part in variant.parts} <= rendered | set(SCENES)


def test_random_scenes_are_those_of_their_seeds_and_have_all_cameras() -> None:
    variants = random_variants(100, 105)
    assert [variant.name for variant in variants] == [f"random_{seed}" for seed in range(100, 106)]
    for variant in variants:
        scene = scene_of(variant.name)
        assert scene is not None and scene == random_scene(scene.seed)
        assert [part.camera for part in variant.parts] == [f"cam{k}" for k in range(scene.cameras)]
    assert len({scene_of(variant.name) for variant in variants}) == 6
    assert scene_of("robodog_overlap") is None and scene_of("room_3") is SCENES["room_3"]


def test_an_unknown_word_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--only", "nosuchthing", "--results", str(tmp_path)]) == 1
    assert "nosuchthing" in capsys.readouterr().err
