from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from mvdyn_gtsam.capture import FIRST_FOCAL, Camera, Capture, load_capture, with_unknown_focal
from mvdyn_gtsam.capture.focal import camera_with_unknown_focal, first_intrinsics
from mvdyn_gtsam.errors import CaptureError
from tests.capture.media import camera_entry, write_capture_json, write_images

CAMERA = Camera("left", 64, 48, 60.0, 61.0, 30.0, 23.0, time_offset=0.5)


def test_the_first_guess_is_a_share_of_the_longer_side_and_the_centre() -> None:
    assert first_intrinsics(64, 48) == (64 * FIRST_FOCAL, 64 * FIRST_FOCAL, 31.5, 23.5)
    assert first_intrinsics(48, 64) == (64 * FIRST_FOCAL, 64 * FIRST_FOCAL, 23.5, 31.5)


def test_fx_is_the_first_guess_of_both_and_the_rest_stays() -> None:
    expected = replace(CAMERA, fy=60.0, focal_known=False)
    assert camera_with_unknown_focal(CAMERA) == expected
    assert camera_with_unknown_focal(expected) == expected
    zeros = replace(CAMERA, distortion=(0.0,) * 5)
    assert camera_with_unknown_focal(zeros).distortion == ()


def test_distortion_is_refused_and_its_camera_named() -> None:
    distorted = replace(CAMERA, distortion=(0.0, 0.1, 0.0, 0.0))
    with pytest.raises(CaptureError, match=r"^camera left: has distortion.*undistort the frames.*intrinsics"):
        camera_with_unknown_focal(distorted)
    with pytest.raises(CaptureError, match=r"^somewhere: has distortion"):
        camera_with_unknown_focal(distorted, "somewhere")


def _capture(folder: Path, **changes: object) -> Capture:
    write_images(folder / "a", range(3))
    entries = camera_entry("a", "a/*.png"), camera_entry("b", "a/*.png", **changes)
    return load_capture(write_capture_json(folder, *entries))


def test_a_whole_capture_is_marked_and_nothing_else_changes(tmp_path: Path) -> None:
    capture = _capture(tmp_path, fx=70.0, cx=30.0)
    marked = with_unknown_focal(capture)
    assert [camera.focal_known for camera in marked.cameras] == [False, False]
    assert [(camera.fx, camera.fy, camera.cx) for camera in marked.cameras] == [(60, 60, 31.5), (70, 70, 30)]
    assert replace(marked, cameras=capture.cameras) == capture
    assert all(camera.focal_known for camera in capture.cameras)
    # As cameras reach other processes.
    assert pickle.loads(pickle.dumps(marked.cameras)) == marked.cameras


def test_a_capture_with_a_distorted_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="camera b: has distortion"):
        with_unknown_focal(_capture(tmp_path, distortion=[0.1, 0, 0, 0, 0]))
