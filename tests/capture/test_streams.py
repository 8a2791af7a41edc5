from __future__ import annotations

import multiprocessing
import pickle
import signal
import subprocess
import sys
from pathlib import Path
from time import sleep
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mvdyn_gtsam.capture import images, streams
from mvdyn_gtsam.capture.streams import (
    CroppedStream,
    Image,
    ImageStream,
    MediaStream,
    TrimmedStream,
    UndistortedStream,
    VideoStream,
)
from mvdyn_gtsam.errors import CaptureError
from tests.capture.media import HEIGHT, WIDTH, frame_number, numbered_frame, write_images, write_video

COUNT = 40


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("media") / "cam0.mp4", COUNT)


class _Frames(MediaStream):
    """Frames from memory."""

    def __init__(self, *frames: Image) -> None:
        self.frames = frames
        self.height, self.width = frames[0].shape[:2]
        self.label, self.fps = "memory", None

    def __len__(self) -> int:
        return len(self.frames)

    def read(self, time: int) -> Image:
        return self.frames[time]


class _InexactCapture:
    """cv2.VideoCapture in a container where seeking lands some frames off."""

    error = 0
    opened = 0

    def __init__(self, *arguments: Any) -> None:
        self._video = _REAL_CAPTURE(*arguments)
        type(self).opened += 1

    def __getattr__(self, name: str) -> Any:
        return getattr(self._video, name)

    def set(self, key: int, value: float) -> bool:
        return bool(self._video.set(key, max(0, value + self.error)))


_REAL_CAPTURE = cv2.VideoCapture


def test_video_in_order(video: Path) -> None:
    stream = VideoStream(video)
    assert (len(stream), stream.width, stream.height, stream.fps) == (COUNT, WIDTH, HEIGHT, 30.0)
    frames = [stream.read(time) for time in range(COUNT)]
    assert [frame_number(frame) for frame in frames] == list(range(COUNT))
    assert all(frame.shape == (HEIGHT, WIDTH, 3) and frame.dtype == np.uint8 for frame in frames)


@given(times=st.lists(st.integers(0, COUNT - 1), min_size=1, max_size=15))
@settings(max_examples=20)
def test_video_in_any_order(video: Path, times: list[int]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streams, "KEPT_BYTES", 0)
        stream = VideoStream(video)
    assert [frame_number(stream.read(time)) for time in times] == times


@pytest.mark.parametrize("error", [-3, -1, 1, 4])
def test_inexact_seeking_is_noticed(video: Path, monkeypatch: pytest.MonkeyPatch, error: int) -> None:
    stream = VideoStream(video)
    monkeypatch.setattr(cv2, "VideoCapture", _InexactCapture)
    monkeypatch.setattr(_InexactCapture, "error", error)
    times = [30, 12, 13, 38, 0, 25, 39, 3]
    assert [frame_number(stream.read(time)) for time in times] == times


def test_exact_seeking_does_not_reopen(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = VideoStream(video)
    monkeypatch.setattr(cv2, "VideoCapture", _InexactCapture)
    monkeypatch.setattr(_InexactCapture, "opened", 0)
    for time in (30, 12, 38, 5):
        stream.read(time)
    assert _InexactCapture.opened == 1


def test_video_colours_are_rgb(tmp_path: Path) -> None:
    path = tmp_path / "red.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (WIDTH, HEIGHT))
    for _ in range(3):
        writer.write(np.full((HEIGHT, WIDTH, 3), (0, 0, 255), dtype=np.uint8))
    writer.release()
    red, green, blue = VideoStream(path).read(1).mean(axis=(0, 1))
    assert red > 200 and green < 50 and blue < 50


def test_cached_frames_cannot_be_changed(video: Path) -> None:
    stream = VideoStream(video)
    with pytest.raises(ValueError, match="read-only"):
        stream.read(0)[0, 0] = 0
    assert stream.read(0) is stream.read(0)


def test_frames_outside_are_refused(video: Path) -> None:
    stream = VideoStream(video)
    for time in (-1, COUNT):
        with pytest.raises(IndexError, match=f"frame {time} of {COUNT}"):
            stream.read(time)


def test_video_survives_pickling_while_open(video: Path) -> None:
    stream = VideoStream(video)
    stream.read(20)
    copy = pickle.loads(pickle.dumps(stream))
    assert [frame_number(s.read(t)) for s, t in ((copy, 7), (stream, 21), (copy, 8))] == [7, 21, 8]


def _report(stream: VideoStream, times: list[int], queue: Any) -> None:
    queue.put([frame_number(stream.read(time)) for time in times])


def test_forked_process_opens_its_own_decoder(video: Path) -> None:
    stream = VideoStream(video)
    stream.read(5)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=_report, args=(stream, [6, 2, 30], queue), daemon=True)
    process.start()
    try:
        assert queue.get(timeout=30) == [6, 2, 30]
    finally:
        process.kill()
    assert frame_number(stream.read(6)) == 6


@pytest.mark.slow
def test_a_suspended_process_goes_on(video: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path; from mvdyn_gtsam.capture.streams import VideoStream\n"
        "stream = VideoStream(Path(sys.argv[1])); print('reads', flush=True)\n"
        "while time.process_time() < 5.0:\n"
        "    for number in range(len(stream)): stream.read(number)\n"
    )
    command = [sys.executable, "-c", program, str(video)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "reads\n"
        sleep(0.5)
        process.send_signal(signal.SIGSTOP)
        # OpenCV gives a read up after 30 s
        sleep(31.0)
        process.send_signal(signal.SIGCONT)
        assert process.wait() == 0, process.stderr.read()


def test_truncated_video_without_index(tmp_path: Path, video: Path) -> None:
    path = tmp_path / "cut.mp4"
    path.write_bytes(video.read_bytes()[:-2000])
    with pytest.raises(CaptureError, match=r"cut\.mp4: cannot be decoded as a video"):
        VideoStream(path)


def test_decoder_adds_no_lines_of_its_own(tmp_path: Path, video: Path) -> None:
    path = tmp_path / "cut.mp4"
    path.write_bytes(video.read_bytes()[:-2000])
    program = (
        "import sys; from pathlib import Path; from mvdyn_gtsam.capture.streams import VideoStream\n"
        "try: VideoStream(Path(sys.argv[1]))\n"
        "except Exception as error: print(error)"
    )
    # A process of its own: FFmpeg takes its log level when it is first used.
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith(f"{path}: cannot be decoded") and done.stderr == ""


def test_truncated_video_with_count_in_header(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.avi", COUNT, codec="MJPG")
    path = tmp_path / "cut.avi"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    with pytest.raises(CaptureError, match=rf"cut\.avi: truncated: \d+ of the {COUNT} frames.*--truncate"):
        VideoStream(path)
    stream = VideoStream(path, accept_truncated=True)
    assert 10 < len(stream) < COUNT
    assert frame_number(stream.read(len(stream) - 2)) == len(stream) - 2


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "there is no such file"), (b"", "the file is empty"), (b"words" * 99, "cannot be decoded")],
)
def test_what_is_no_video_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "cam0.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CaptureError, match=rf"cam0\.mp4: {message}"):
        VideoStream(path)


def test_video_that_vanishes_is_named(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam0.mp4", 5)
    stream = VideoStream(path)
    path.unlink()
    with pytest.raises(CaptureError, match=r"cam0\.mp4"):
        stream.read(0)


def test_images_in_the_order_given(tmp_path: Path) -> None:
    stream = ImageStream(write_images(tmp_path, range(6)))
    assert [frame_number(stream.read(t)) for t in (5, 0, 3, 3)] == [5, 0, 3, 3]
    assert frame_number(pickle.loads(pickle.dumps(stream)).read(4)) == 4
    with pytest.raises(IndexError):
        stream.read(6)


@pytest.mark.parametrize("kept", [3, 8, 100])
def test_frames_are_decoded_again_only_where_they_no_longer_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    monkeypatch.setattr(streams, "KEPT_BYTES", kept * WIDTH * HEIGHT * 3)
    stream = ImageStream(write_images(tmp_path, range(10)))
    decoded: list[Path] = []

    def read_image(path: Path) -> Image:
        decoded.append(path)
        return images.read_image(path)

    monkeypatch.setattr(streams, "read_image", read_image)
    room = max(kept, streams.FEWEST_KEPT)
    for time in [*range(10), *range(9, -1, -1)]:
        assert frame_number(stream.read(time)) == time
    assert len(decoded) == 10 + max(0, 10 - room)
    sent = pickle.loads(pickle.dumps(stream))
    assert [frame_number(sent.read(time)) for time in range(10)] == list(range(10))
    assert len(sent._cache._frames) == streams.FEWEST_KEPT


def test_of_a_video_a_second_look_decodes_nothing(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = VideoStream(video)
    monkeypatch.setattr(cv2, "VideoCapture", _InexactCapture)
    monkeypatch.setattr(_InexactCapture, "opened", 0)
    for _ in range(2):
        assert [frame_number(stream.read(time)) for time in range(COUNT)] == list(range(COUNT))
    assert _InexactCapture.opened == 1
    assert len(stream._cache._frames) == COUNT


def test_image_of_another_size_is_named(tmp_path: Path) -> None:
    paths = write_images(tmp_path, range(3))
    write_images(tmp_path, [1], size=(32, 24))
    with pytest.raises(CaptureError, match=r"000001\.png: 32x24 pixels, but 000000\.png .* has 64x48"):
        ImageStream(paths)


def test_image_that_vanishes_is_named(tmp_path: Path) -> None:
    paths = write_images(tmp_path, range(3))
    stream = ImageStream(paths)
    paths[2].unlink()
    with pytest.raises(CaptureError, match=r"000002\.png"):
        stream.read(2)


def test_trimming_shifts(tmp_path: Path) -> None:
    stream = TrimmedStream(ImageStream(write_images(tmp_path, range(8))), 2, 4)
    assert [frame_number(stream.read(t)) for t in range(len(stream))] == [2, 3, 4, 5]
    for time in (-1, 4):
        with pytest.raises(IndexError):
            stream.read(time)


def test_cropping_and_resizing_keep_pixel_centres() -> None:
    # A ramp over x: the resized pixel x' holds the mean of the source around (x' + 0.5) / s - 0.5 + left.
    ramp = np.repeat(np.arange(100, dtype=np.uint8)[None, :, None], 60, axis=0).repeat(3, axis=2)
    stream = CroppedStream(_Frames(np.ascontiguousarray(ramp)), (10, 6, 80, 48), (20, 12))
    assert stream.read(0).shape == (12, 20, 3)
    expected = (np.arange(20) + 0.5) * 4 - 0.5 + 10
    assert np.abs(stream.read(0)[5, :, 0] - expected).max() <= 0.5


def _spot_centre(image: Image) -> np.ndarray[Any, np.dtype[np.float64]]:
    weights = image[..., 0].astype(float)
    y, x = np.indices(weights.shape)
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


@pytest.mark.parametrize("distortion", [(-0.3, 0.1, 0.001, -0.002), (0.1, -0.05, 0.0, 0.001, 0.01)])
def test_undistortion_moves_a_spot_where_the_model_says(distortion: tuple[float, ...]) -> None:
    intrinsics = np.array([[150.0, 0, 79.5], [0, 148.0, 59.5], [0, 0, 1]])
    spot = np.zeros((120, 160, 3), dtype=np.uint8)
    cv2.circle(spot, (120, 30), 3, (255, 255, 255), -1)
    spot = cv2.GaussianBlur(spot, (0, 0), 2)
    moved = _spot_centre(UndistortedStream(_Frames(spot), intrinsics, distortion).read(0))
    expected = cv2.undistortPoints(
        _spot_centre(spot).reshape(1, 1, 2), intrinsics, np.array(distortion), P=intrinsics
    ).reshape(2)
    assert np.linalg.norm(expected - (120, 30)) > 0.5
    np.testing.assert_allclose(moved, expected, atol=0.1)


def test_undistorted_stream_survives_pickling() -> None:
    stream = UndistortedStream(
        _Frames(numbered_frame(9)), np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), (-0.1, 0, 0, 0)
    )
    before = stream.read(0)
    assert np.array_equal(pickle.loads(pickle.dumps(stream)).read(0), before)
