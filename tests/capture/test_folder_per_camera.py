from __future__ import annotations

from pathlib import Path

import pytest

from mvdyn_gtsam.capture import FIRST_FOCAL, Camera, load_folder_per_camera
from mvdyn_gtsam.errors import CaptureError
from tests.capture.media import HEIGHT, WIDTH, frame_number, write_images


def write_camera(
    folder: Path, count: int = 4, intrinsics: str = "60 60 31.5 23.5\n", inner: str = "."
) -> None:
    write_images(folder / inner, range(count))
    (folder / "intrinsics.txt").write_text(intrinsics)


@pytest.mark.parametrize("inner", [".", "rgb", "color", "images"])
def test_cameras_load(tmp_path: Path, inner: str, caplog: pytest.LogCaptureFixture) -> None:
    write_camera(tmp_path / "cam0", inner=inner)
    write_camera(tmp_path / "cam1", inner=inner, intrinsics="# factory\n61, 62, 31, 23\n-0.1 0.02 0 0 0\n")
    (tmp_path / "calibration").mkdir()
    capture = load_folder_per_camera(tmp_path)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1"]
    assert (capture.cameras[1].fx, capture.cameras[1].cy) == (61.0, 23.0)
    assert capture.cameras[1].distortion == (-0.1, 0.02, 0.0, 0.0, 0.0)
    assert [frame_number(capture.read(0, t)) for t in range(4)] == [0, 1, 2, 3]
    assert capture.fps == 30.0 and "the frame rate is not stated" in caplog.text


def test_stated_rate_and_chosen_cameras(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_camera(tmp_path / name)
    capture = load_folder_per_camera(tmp_path, cameras=["c", "a"], fps=15.0)
    assert capture.fps == 15.0 and [camera.name for camera in capture.cameras] == ["c", "a"]


def test_one_word_leaves_the_focal_length_to_find(tmp_path: Path) -> None:
    write_camera(tmp_path / "cam0")
    write_camera(tmp_path / "cam1", intrinsics="# a phone\nestimate\n")
    known, unknown = load_folder_per_camera(tmp_path).cameras
    focal = FIRST_FOCAL * WIDTH
    assert known.focal_known
    assert unknown == Camera("cam1", WIDTH, HEIGHT, focal, focal, 31.5, 23.5, focal_known=False)


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        ("60 60 31.5", r"cam0/intrinsics\.txt: has 3 numbers"),
        ("60 60 31.5 23.5 0.1", "has 5 numbers.*or only estimate to have the focal length found"),
        ("estimate 60", "could not convert.*or only estimate"),
        ("fx=60 60 31.5 23.5", r"intrinsics\.txt: could not convert"),
        ("", r"intrinsics\.txt: the file is empty"),
        ("60 60 nan 23.5", "must be finite"),
    ],
)
def test_bad_intrinsics_are_named(tmp_path: Path, intrinsics: str, message: str) -> None:
    write_camera(tmp_path / "cam0", intrinsics=intrinsics)
    with pytest.raises(CaptureError, match=message):
        load_folder_per_camera(tmp_path)


def test_short_missing_and_empty_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"no folder here holds an intrinsics\.txt"):
        load_folder_per_camera(tmp_path)
    write_camera(tmp_path / "cam0")
    write_camera(tmp_path / "cam1", count=3)
    with pytest.raises(CaptureError, match="camera cam1 is short: 3 frames, but cam0 has 4"):
        load_folder_per_camera(tmp_path)
    assert load_folder_per_camera(tmp_path, truncate=True).frame_count == 3
    with pytest.raises(CaptureError, match="there is no camera folder cam7"):
        load_folder_per_camera(tmp_path, cameras=["cam7"])
    write_camera(tmp_path / "cam2", count=0)
    with pytest.raises(CaptureError, match="cam2: holds no images"):
        load_folder_per_camera(tmp_path)
