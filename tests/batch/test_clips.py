from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.batch.clips import BatchError, find_clips, groundtruth_of, has_groundtruth
from mvdyn_gtsam.reconstruction import Reconstruction
from tests.batch.stand_in import write_result


def touch(path: Path, content: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def scene(folder: Path) -> Path:
    """A MultiCamVideo scene of one camera and three frames, its camera at x = 1 m."""
    matrix = "[1 0 0 0] [0 1 0 0] [0 0 1 0] [100 0 0 1]"
    touch(folder / "videos" / "cam01.mp4")
    touch(
        folder / "cameras" / "camera_extrinsics.json",
        json.dumps({f"frame{time}": {"cam01": matrix} for time in range(3)}),
    )
    return folder


def test_every_layout_is_found_and_named_by_its_path(tmp_path: Path) -> None:
    touch(tmp_path / "clip10" / "capture.json")
    touch(tmp_path / "clip2" / "capture.json")
    touch(tmp_path / "drone" / "mav0" / "cam0" / "sensor.yaml")
    touch(tmp_path / "phones" / "left" / "intrinsics.txt")
    for lens in ("f18_aperture10", "f24_aperture5"):
        scene(tmp_path / "train" / lens / "scene1")
    assert [(clip.name, clip.folder.relative_to(tmp_path).as_posix()) for clip in find_clips(tmp_path)] == [
        ("clip2", "clip2"),
        ("clip10", "clip10"),
        ("drone", "drone"),
        ("phones", "phones"),
        ("train-f18_aperture10-scene1", "train/f18_aperture10/scene1"),
        ("train-f24_aperture5-scene1", "train/f24_aperture5/scene1"),
    ]


def test_the_results_are_not_searched(tmp_path: Path) -> None:
    touch(tmp_path / "clip" / "capture.json")
    touch(tmp_path / "out" / "copy" / "capture.json")
    assert [clip.name for clip in find_clips(tmp_path, tmp_path / "out")] == ["clip"]


def test_what_is_left_out_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    touch(tmp_path / "clip" / "capture.json")
    touch(tmp_path / "broken" / "videos" / "cam01.mp4")
    with caplog.at_level(logging.WARNING, "mvdyn_gtsam"):
        find_clips(tmp_path)
    assert "no capture in broken" in caplog.text


def test_two_of_one_name_are_refused(tmp_path: Path) -> None:
    touch(tmp_path / "a" / "b" / "capture.json")
    touch(tmp_path / "a-b" / "capture.json")
    with pytest.raises(BatchError, match="both would be named a-b; rename one"):
        find_clips(tmp_path)


def test_folders_that_are_no_batch_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BatchError, match="there is no such folder"):
        find_clips(tmp_path / "nothing")
    with pytest.raises(BatchError, match="holds no captures; each must be a folder with capture.json"):
        find_clips(tmp_path)
    touch(tmp_path / "one" / "capture.json")
    with pytest.raises(BatchError, match="is one capture itself"):
        find_clips(tmp_path / "one")


def test_ground_truth_of_a_multicamvideo_scene_and_of_a_folder_per_camera(tmp_path: Path) -> None:
    write_result(tmp_path / "result", ("cam01",), frames=3)
    result = Reconstruction.load(tmp_path / "result")
    folder = scene(tmp_path / "f24_aperture5" / "scene1")
    assert has_groundtruth(folder)
    times, wTc = groundtruth_of(folder, result).trajectories["cam01"]
    assert np.allclose(times, result.trajectory("cam01")[0])
    assert np.allclose(wTc[:, :3, 3], [1.0, 0.0, 0.0])

    phones = tmp_path / "phones"
    touch(phones / "cam01" / "intrinsics.txt")
    assert not has_groundtruth(phones)
    touch(phones / "cam01" / "groundtruth.txt", "0 1 2 3 0 0 0 1\n")
    assert has_groundtruth(phones)
    assert np.allclose(groundtruth_of(phones, result).trajectories["cam01"][1][0, :3, 3], [1.0, 2.0, 3.0])
