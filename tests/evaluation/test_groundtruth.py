from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.groundtruth import load_groundtruth, read_tum
from tests.evaluation.fakes import random_poses, write_groundtruth, write_tum


def test_trajectories_depth_and_masks_come_back(tmp_path: Path) -> None:
    poses = {"cam0": random_poses(np.random.default_rng(0), 4)}
    depth = np.array([[0.0, 1.5], [2.0, 6.5]], dtype=np.float32)
    mask = np.array([[True, False], [False, True]])
    folder = write_groundtruth(tmp_path, poses, {("cam0", 2): depth}, {("cam0", 2): mask}, depth_scale=2e-4)
    groundtruth = load_groundtruth(folder)
    np.testing.assert_allclose(groundtruth.trajectories["cam0"][1], poses["cam0"], atol=1e-9)
    assert groundtruth.depth_frames("cam0") == [2]
    np.testing.assert_allclose(groundtruth.depth("cam0", 2), [[np.nan, 1.5], [2.0, 6.5]], rtol=1e-6)
    np.testing.assert_array_equal(groundtruth.moving("cam0", 2), mask)
    assert groundtruth.moving("cam0", 1) is None


def test_depth_is_in_millimetres_unless_said_otherwise(tmp_path: Path) -> None:
    poses = {"cam0": random_poses(np.random.default_rng(0), 2)}
    folder = write_groundtruth(tmp_path, poses, {("cam0", 0): np.full((2, 2), 1.5, dtype=np.float32)})
    np.testing.assert_allclose(load_groundtruth(folder).depth("cam0", 0), 1.5)
    np.testing.assert_allclose(load_groundtruth(folder, depth_scale=0.01).depth("cam0", 0), 15.0)


def test_masks_may_lie_in_a_folder_called_masks(tmp_path: Path) -> None:
    poses = {"cam0": random_poses(np.random.default_rng(0), 2)}
    mask = np.array([[True, False]])
    folder = write_groundtruth(tmp_path, poses, masks={("cam0", 0): mask}, mask_folder="masks")
    np.testing.assert_array_equal(load_groundtruth(folder).moving("cam0", 0), mask)


def test_lines_out_of_order_are_sorted_and_nan_lines_have_no_pose(tmp_path: Path) -> None:
    path = tmp_path / "cam0.txt"
    path.write_text("0.2 1 2 3 0 0 0 1\n0.0 4 5 6 0 0 0 1\n0.1 nan nan nan nan nan nan nan\n")
    times, wTc = read_tum(path)
    assert times.tolist() == [0.0, 0.1, 0.2]
    assert wTc[0, :3, 3].tolist() == [4, 5, 6]
    assert np.isnan(wTc[1]).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0.0 1 2 3 0 0 0\n", "cam0.txt:1: 7 numbers"),
        ("0.0 1 2 3 0 0 0 one\n", "cam0.txt:1: not a line of 8 numbers"),
        ("# nothing\n", "holds no pose"),
        ("0.0 1 2 3 0 0 0 2\n", "not of unit length"),
    ],
)
def test_a_damaged_trajectory_is_named(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "cam0.txt"
    path.write_text(content)
    with pytest.raises(EvaluationError, match=message):
        read_tum(path)


def test_missing_folder_and_missing_trajectories_are_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="no such ground-truth folder"):
        load_groundtruth(tmp_path / "groundtruth")
    with pytest.raises(EvaluationError, match="holds no <camera>.txt"):
        load_groundtruth(tmp_path)


def test_a_depth_image_of_the_wrong_kind_is_named(tmp_path: Path) -> None:
    folder = write_groundtruth(tmp_path, {"cam0": random_poses(np.random.default_rng(0), 2)})
    path = folder / "depth" / "cam0" / "000000.png"
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), np.zeros((2, 2), dtype=np.uint8))
    with pytest.raises(EvaluationError, match="000000.png: not a readable 16-bit"):
        load_groundtruth(folder).depth("cam0", 0)


@pytest.mark.parametrize("content", ["{broken", '{"depth_scale": "far"}', '{"depth_scale": 0}'])
def test_a_bad_depth_scale_is_named(tmp_path: Path, content: str) -> None:
    write_tum(tmp_path / "groundtruth" / "cam0.txt", np.zeros(1), np.eye(4)[None])
    (tmp_path / "capture.json").write_text(content)
    with pytest.raises(EvaluationError, match="capture.json: depth_scale"):
        load_groundtruth(tmp_path / "groundtruth")


def test_intrinsics_are_those_that_the_capture_knows(tmp_path: Path) -> None:
    folder = write_groundtruth(tmp_path, {"cam0": np.eye(4)[None]})
    assert load_groundtruth(folder).intrinsics == {}
    known = {"name": "cam0", "fx": 50, "fy": 51.0, "cx": 31.5, "cy": 23.5}
    guess = {**known, "name": "cam1", "estimate_focal": True}
    (tmp_path / "capture.json").write_text(json.dumps({"cameras": [known, guess, {"name": "cam2"}]}))
    found = load_groundtruth(folder).intrinsics
    assert list(found) == ["cam0"]
    np.testing.assert_array_equal(found["cam0"], [[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]])
