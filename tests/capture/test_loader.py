from __future__ import annotations

import json
import logging
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.capture import FIRST_FOCAL, Camera, Capture, capture_from_cameras, load_capture
from mvdyn_gtsam.errors import CaptureError
from tests.capture.media import (
    HEIGHT,
    WIDTH,
    camera_entry,
    frame_number,
    write_capture_json,
    write_images,
    write_video,
)

INTRINSICS = (60.0, 60.0, 31.5, 23.5)


@pytest.fixture
def two_videos(tmp_path: Path) -> Path:
    write_video(tmp_path / "cam0.mp4", 10)
    write_video(tmp_path / "cam1.mp4", 10)
    return tmp_path


def _two(**changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """The cameras of ``two_videos``, the second with changes."""
    return camera_entry("cam0", "cam0.mp4"), camera_entry("cam1", "cam1.mp4", **changes)


def _numbers(capture: Capture, camera: int) -> list[int]:
    return [frame_number(capture.read(camera, time)) for time in range(capture.frame_count)]


def _refused(folder: Path, *, truncate: bool = False) -> str:
    with pytest.raises(CaptureError) as caught:
        load_capture(folder, truncate=truncate)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_videos_load(two_videos: Path) -> None:
    extras = {"num_frames": 10, "depth_scale": 0.001, "about": {"seed": 1}}
    write_capture_json(two_videos, *_two(), **extras)
    capture = load_capture(two_videos)
    assert (capture.name, capture.fps, capture.frame_count) == ("tiny", 30.0, 10)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1"]
    assert _numbers(capture, 0) == _numbers(capture, 1) == list(range(10))
    np.testing.assert_allclose(capture.timestamps, np.arange(10) / 30.0)
    expected = [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]
    np.testing.assert_array_equal(capture.cameras[1].intrinsics, expected)
    assert load_capture(two_videos / "capture.json").frame_count == 10
    assert _numbers(pickle.loads(pickle.dumps(capture)), 1) == list(range(10))


def test_image_globs_load_in_natural_order(tmp_path: Path) -> None:
    write_images(tmp_path / "cam0", range(12), "frame{}.png")
    write_images(tmp_path / "cam1", range(12), "frame{}.png")
    (tmp_path / "cam1" / "notes.txt").write_text("not a frame")
    write_capture_json(tmp_path, camera_entry("a", "cam0/*.png"), camera_entry("b", "cam1/*.png"))
    capture = load_capture(tmp_path)
    assert _numbers(capture, 0) == _numbers(capture, 1) == list(range(12))


def test_distortion_is_taken_out(two_videos: Path) -> None:
    write_capture_json(two_videos, *_two(distortion=[-0.3, 0.1, 0, 0, 0]))
    capture = load_capture(two_videos)
    assert capture.cameras[1].distortion == (-0.3, 0.1, 0.0, 0.0, 0.0)
    assert not np.array_equal(capture.read(0, 5), capture.read(1, 5))


def test_zero_distortion_changes_nothing(two_videos: Path) -> None:
    write_capture_json(two_videos, *_two(distortion=[0, 0, 0, 0, 0]))
    capture = load_capture(two_videos)
    assert np.array_equal(capture.read(0, 5), capture.read(1, 5))


def test_one_camera_works_with_a_note(two_videos: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_capture_json(two_videos, _two()[0])
    assert load_capture(two_videos).frame_count == 10
    assert "one camera only" in caplog.text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.0}, "camera cam1: focal lengths fx=0"),
        ({"fy": -5.0}, "must be positive"),
        ({"cx": 64.0}, "the principal point (64, 23.5) is outside the 64x48 image"),
        ({"cy": -1.0}, "outside"),
        ({"name": "cam0"}, "two cameras are named 'cam0'"),
        ({"name": "CAM0"}, "two cameras are named"),
        ({"name": "../cam1"}, "cannot be a file name"),
        ({"name": ""}, "cannot be a file name"),
        ({"distortion": [0.1, 0.2]}, "distortion has 2 numbers"),
        ({"distortion": 0.1}, '"distortion" must be a list'),
        ({"distortion": ["a"]}, '"distortion" must be a finite number'),
        ({"distorsion": [0, 0, 0, 0, 0]}, "did you mean 'distortion'?"),
        ({"width": "64"}, 'cameras[1]: "width" must be a finite number, not "64"'),
        ({"width": 64.5}, '"width" must be a positive whole number'),
        ({"fx": True}, '"fx" must be a finite number, not true'),
        ({"fx": float("nan")}, '"fx" must be a finite number'),
        ({"fx": 10**400}, '"fx" must be a finite number'),
        ({"name": 1}, '"name" must be a text, not 1'),
        ({"source": ["cam1.mp4"]}, '"source" must be a text'),
        ({"source": "cam9.mp4"}, "cam9.mp4: there is no such file"),
        ({"source": "cam1/*.png"}, "cam1/*.png: no file matches this pattern"),
        ({"source": "."}, "is a folder"),
        ({"estimate_focal": 1}, 'cameras[1]: "estimate_focal" must be true or false, not 1'),
        ({"estimate_focal": None}, '"estimate_focal" must be true or false, not null'),
        ({"estimate_focl": True}, "did you mean 'estimate_focal'?"),
        ({"estimate_focal": True, "fy": 61}, "cameras[1]: fx and fy differ: 60 and 61"),
        ({"estimate_focal": True, "fx": -60, "fy": -60}, "must be positive"),
        ({"estimate_focal": True, "cx": 64.0}, "the principal point (64, 23.5) is outside"),
        (
            {"estimate_focal": True, "distortion": [0, 0, 0.1, 0, 0]},
            "capture.json: cameras[1]: has distortion",
        ),
        (
            {"estimate_focal": True, "width": 128, "height": 96},
            "cam1.mp4: frames are 64x48, but camera cam1 is said to have 128x96; correct its width",
        ),
        ({"time_offset": 100.0}, "no instant is seen by every camera (cam1 starts last"),
    ],
)
def test_bad_cameras_are_refused(two_videos: Path, changes: dict[str, Any], message: str) -> None:
    assert message in _refused(write_capture_json(two_videos, *_two(**changes)))


@pytest.mark.parametrize("key", ["name", "source", "width", "height", "fx", "fy", "cx", "cy"])
def test_missing_camera_keys_are_named(two_videos: Path, key: str) -> None:
    cameras = _two()
    del cameras[1][key]
    message = _refused(write_capture_json(two_videos, *cameras))
    assert f'cameras[1]: the key "{key}" is missing' in message and "capture.json" in message
    hint = 'add it, or "estimate_focal": true to have the focal length found'
    assert (hint in message) == (key in ("fx", "fy"))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, (64 * FIRST_FOCAL, 64 * FIRST_FOCAL, 31.5, 23.5)),
        ({"fx": 70}, (70, 70, 31.5, 23.5)),
        ({"fy": 70, "cy": 20}, (70, 70, 31.5, 20)),
        ({"fx": 70, "fy": 70.0, "cx": 30, "cy": 20}, (70, 70, 30, 20)),
        ({"distortion": [0, 0, 0, 0, 0]}, (64 * FIRST_FOCAL, 64 * FIRST_FOCAL, 31.5, 23.5)),
    ],
)
def test_a_focal_length_may_be_left_to_find(
    two_videos: Path, given: dict[str, Any], expected: tuple[float, float, float, float]
) -> None:
    known, entry = _two()
    for key in ("fx", "fy", "cx", "cy"):
        del entry[key]
    write_capture_json(two_videos, known, entry | given | {"estimate_focal": True})
    cameras = load_capture(two_videos).cameras
    assert cameras[1] == Camera("cam1", WIDTH, HEIGHT, *expected, focal_known=False)
    assert cameras[0].focal_known


def test_estimate_focal_may_be_false(two_videos: Path) -> None:
    known = load_capture(write_capture_json(two_videos, *_two())).cameras
    assert load_capture(write_capture_json(two_videos, *_two(estimate_focal=False))).cameras == known


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"cameras": None}, 'the key "cameras" is missing'),
        ({"fps": None}, 'the key "fps" is missing'),
        ({"fps": 0}, "fps is 0"),
        ({"fps": "30"}, '"fps" must be a finite number'),
        ({"cameras": []}, "there are no cameras"),
        ({"cameras": {}}, '"cameras" must be a list'),
        ({"cameras": ["cam0.mp4"]}, "cameras[0]: must be an object"),
        ({"num_frames": 12}, "cam0.mp4: 10 frames, but the capture says num_frames 12"),
    ],
)
def test_bad_content_is_refused(two_videos: Path, content: dict[str, Any], message: str) -> None:
    assert message in _refused(write_capture_json(two_videos, *_two(), **content))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"fps": 30,}', "not valid JSON at line 1, column 12"),
        ("", "not valid JSON"),
        ("[]", "must hold an object"),
        ("\udcff", "is not UTF-8"),
    ],
)
def test_files_that_are_no_json_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "capture.json").write_bytes(text.encode(errors="surrogateescape"))
    refused = _refused(tmp_path)
    assert message in refused and "capture.json" in refused


def test_missing_capture_file_is_named(tmp_path: Path) -> None:
    assert "capture.json: there is no such file" in _refused(tmp_path)
    assert "nowhere: there is no such file" in _refused(tmp_path / "nowhere")


def test_wrong_size_says_how_to_scale(two_videos: Path) -> None:
    entry = camera_entry("cam1", "cam1.mp4", width=128, height=96, fx=120.0, fy=124.0, cx=63.5, cy=47.5)
    message = _refused(write_capture_json(two_videos, _two()[0], entry))
    assert "cam1.mp4: frames are 64x48, but camera cam1 has intrinsics for 128x96" in message
    assert "fx=60, fy=62, cx=31.5, cy=23.5" in message


def test_wrong_aspect_offers_no_scale(two_videos: Path) -> None:
    message = _refused(write_capture_json(two_videos, *_two(width=80, height=48)))
    assert "aspect ratio differs" in message and "fx=" not in message


def test_short_camera_is_named_and_truncate_accepts(
    two_videos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_video(two_videos / "cam1.mp4", 8)
    write_capture_json(two_videos, *_two(), num_frames=10)
    message = _refused(two_videos)
    assert "cam1.mp4: camera cam1 is short: 8 frames, but cam0 has 10" in message and "--truncate" in message
    capture = load_capture(two_videos, truncate=True)
    assert _numbers(capture, 0) == _numbers(capture, 1) == list(range(8))
    assert "cut to the 8 frames of cam1" in caplog.text


def test_truncated_video_is_named_and_truncate_accepts(tmp_path: Path) -> None:
    for name in ("cam0.avi", "cam1.avi"):
        write_video(tmp_path / name, 40, codec="MJPG")
    cut = tmp_path / "cam1.avi"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 6 // 10])
    write_capture_json(tmp_path, camera_entry("cam0", "cam0.avi"), camera_entry("cam1", "cam1.avi"))
    assert "cam1.avi: truncated" in _refused(tmp_path)
    assert 0 < load_capture(tmp_path, truncate=True).frame_count < 40


@pytest.mark.parametrize("truncate", [False, True])
def test_image_missing_in_the_middle_is_refused(tmp_path: Path, truncate: bool) -> None:
    write_images(tmp_path / "cam0", range(10))
    write_images(tmp_path / "cam1", [0, 1, 2, 4, 5, 6, 7, 8, 9])
    write_capture_json(tmp_path, camera_entry("cam0", "cam0/*.png"), camera_entry("cam1", "cam1/*.png"))
    message = _refused(tmp_path, truncate=truncate)
    assert "cam1 misses frames that other cameras have: the numbers jump after 000002.png" in message


def test_images_left_out_of_every_camera_are_fine(tmp_path: Path) -> None:
    for name in ("cam0", "cam1"):
        write_images(tmp_path / name, [0, 1, 2, 4, 5, 6])
    write_capture_json(tmp_path, camera_entry("cam0", "cam0/*.png"), camera_entry("cam1", "cam1/*.png"))
    assert load_capture(tmp_path).frame_count == 6


def test_cameras_of_different_rate_are_refused(two_videos: Path) -> None:
    write_video(two_videos / "cam1.mp4", 10, fps=25.0)
    message = _refused(write_capture_json(two_videos, *_two()), truncate=True)
    assert "cam1.mp4: 25 frames per second" in message and "cam0.mp4 has 30" in message


def test_rate_other_than_the_containers_is_reported(
    two_videos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert load_capture(write_capture_json(two_videos, *_two(), fps=10.0)).fps == 10.0
    assert "the container says 30 frames per second" in caplog.text


@pytest.mark.parametrize(
    ("offset", "first", "second", "start"),
    [(0.1, list(range(3, 10)), list(range(7)), 0.1), (-0.1, list(range(7)), list(range(3, 10)), 0.0)],
)
def test_whole_frame_offsets_shift(
    two_videos: Path, offset: float, first: list[int], second: list[int], start: float
) -> None:
    # cam1 started `offset` later on the common clock: its frame k shows the instant k / fps + offset.
    capture = load_capture(write_capture_json(two_videos, *_two(time_offset=offset)))
    assert _numbers(capture, 0) == first and _numbers(capture, 1) == second
    np.testing.assert_allclose(capture.timestamps, start + np.arange(7) / 30.0)


def test_the_rest_of_an_offset_is_reported(two_videos: Path, caplog: pytest.LogCaptureFixture) -> None:
    capture = load_capture(write_capture_json(two_videos, *_two(time_offset=0.11)))
    assert _numbers(capture, 1) == list(range(7))
    assert "camera cam1: of its time offset 0.11 s, 10 ms are not a whole frame" in caplog.text


def test_exact_offsets_are_not_reported(two_videos: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        load_capture(write_capture_json(two_videos, *_two(time_offset=0.1)))
    assert caplog.text == ""


def test_one_file_for_two_cameras_is_reported(two_videos: Path, caplog: pytest.LogCaptureFixture) -> None:
    load_capture(write_capture_json(two_videos, *_two(source="cam0.mp4")))
    assert "cam0.mp4: cameras cam0 and cam1 read the same frames" in caplog.text


def test_loading_keeps_no_frames(two_videos: Path) -> None:
    capture = load_capture(write_capture_json(two_videos, *_two()))
    assert len(pickle.dumps(capture)) < 5000


def test_cameras_from_the_command_line(two_videos: Path) -> None:
    capture = capture_from_cameras([two_videos / "cam0.mp4", str(two_videos / "cam1.mp4")], [INTRINSICS] * 2)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1"]
    assert (capture.cameras[0].width, capture.cameras[0].height, capture.fps) == (WIDTH, HEIGHT, 30.0)
    assert _numbers(capture, 1) == list(range(10))


def test_cameras_without_intrinsics_have_a_focal_length_to_find(two_videos: Path) -> None:
    videos = [two_videos / "cam0.mp4", two_videos / "cam1.mp4"]
    guess = (64 * FIRST_FOCAL, 64 * FIRST_FOCAL, 31.5, 23.5)
    unknown = [Camera(f"cam{index}", WIDTH, HEIGHT, *guess, focal_known=False) for index in (0, 1)]
    capture = capture_from_cameras(videos)
    assert list(capture.cameras) == unknown
    assert _numbers(capture, 1) == list(range(10))
    given = Camera("cam0", WIDTH, HEIGHT, *INTRINSICS)
    assert list(capture_from_cameras(videos, [INTRINSICS, None]).cameras) == [given, unknown[1]]
    distortion = [(0.1, 0, 0, 0, 0), (0, 0, 0, 0, 0)]
    mixed = capture_from_cameras(videos, [INTRINSICS, None], distortion=distortion)
    assert mixed.cameras[0].distortion == distortion[0] and mixed.cameras[1].distortion == ()
    with pytest.raises(CaptureError, match="camera cam0: has distortion"):
        capture_from_cameras(videos, distortion=distortion)


def test_command_line_patterns_are_named_after_folders(tmp_path: Path) -> None:
    for name in ("left", "right"):
        write_images(tmp_path / name, range(4))
    patterns = [str(tmp_path / name / "*.png") for name in ("left", "right")]
    capture = capture_from_cameras(
        patterns, [INTRINSICS] * 2, fps=15.0, distortion=[(0.1, 0, 0, 0, 0)] * 2, time_offsets=[0, 1 / 15]
    )
    assert [camera.name for camera in capture.cameras] == ["left", "right"]
    assert (capture.fps, capture.frame_count) == (15.0, 3)


def test_clashing_or_unusable_file_names_become_numbers(tmp_path: Path) -> None:
    paths = [write_video(tmp_path / name, 3) for name in ("a/clip.mp4", "b/clip.mp4")]
    assert [c.name for c in capture_from_cameras(paths, [INTRINSICS] * 2).cameras] == ["cam0", "cam1"]
    spaced = write_video(tmp_path / "my phone.mp4", 3)
    assert capture_from_cameras([spaced], [INTRINSICS]).cameras[0].name == "cam0"


def test_command_line_mistakes_are_refused(two_videos: Path) -> None:
    videos = [two_videos / "cam0.mp4", two_videos / "cam1.mp4"]
    cases: list[tuple[dict[str, Any], str]] = [
        ({"videos": [], "intrinsics": []}, "no cameras given"),
        ({"videos": videos, "intrinsics": [INTRINSICS]}, "2 cameras but 1 intrinsics; give one per camera"),
        ({"videos": videos, "intrinsics": []}, "or none with --estimate-focal (intrinsics=None)"),
        ({"videos": videos, "intrinsics": [INTRINSICS, INTRINSICS[:3]]}, "fx,fy,cx,cy: 4 numbers, not 3"),
        ({"videos": videos, "intrinsics": [INTRINSICS] * 2, "time_offsets": [0.0]}, "1 time offsets"),
        ({"videos": [two_videos / "x.mp4"], "intrinsics": [INTRINSICS]}, "x.mp4: there is no such file"),
        ({"videos": videos[:1], "intrinsics": [(60, 60, 900, 9)]}, "principal point"),
        ({"videos": videos[:1], "intrinsics": [INTRINSICS], "fps": -1.0}, "fps is -1"),
    ]
    for arguments, message in cases:
        with pytest.raises(CaptureError) as caught:
            capture_from_cameras(**arguments)
        assert message in str(caught.value)


def test_images_need_a_rate(tmp_path: Path) -> None:
    write_images(tmp_path, range(3))
    with pytest.raises(CaptureError, match="images do not say their rate"):
        capture_from_cameras([str(tmp_path / "*.png")], [INTRINSICS])


def test_video_with_reordered_frames_in_any_order(shared_data: Path) -> None:
    # H.264 as phones write it: long groups of pictures and frames stored out of order.
    folder = shared_data / "rendered" / "robodog_overlap"
    in_order, jumping = (load_capture(folder).streams[0] for _ in range(2))
    frames = {time: in_order.read(time) for time in range(60)}
    for time in (41, 7, 59, 58, 12, 13, 0, 33):
        assert np.array_equal(jumping.read(time), frames[time])


def test_shared_captures_load(shared_data: Path) -> None:
    folders = sorted(path.parent for path in shared_data.glob("*/*/capture.json"))
    assert folders
    for folder in folders:
        content = json.loads((folder / "capture.json").read_text())
        capture = load_capture(folder)
        assert capture.frame_count == content["num_frames"]
        camera = capture.cameras[-1]
        last = capture.read(len(capture.cameras) - 1, capture.frame_count - 1)
        assert last.shape == (camera.height, camera.width, 3)
