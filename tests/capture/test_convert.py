from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.capture import Capture, load_capture, write_capture
from mvdyn_gtsam.errors import CaptureError
from tests.capture.media import camera_entry, write_capture_json, write_video


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    for name in ("cam0.mp4", "cam1.mp4"):
        write_video(tmp_path / "in" / name, 6)
    offset = camera_entry("cam1", "cam1.mp4", time_offset=2 / 30, distortion=[-0.2, 0.05, 0, 0, 0])
    return load_capture(write_capture_json(tmp_path / "in", camera_entry("cam0", "cam0.mp4"), offset))


def test_written_captures_show_the_same_frames(capture: Capture, tmp_path: Path) -> None:
    wTc = np.tile(np.eye(4), (capture.frame_count, 1, 1))
    wTc[:, 0, 3] = np.arange(capture.frame_count)
    write_capture(capture, tmp_path / "out", poses={"cam1": wTc})
    again = load_capture(tmp_path / "out")
    assert (again.frame_count, again.fps, again.name) == (4, 30.0, "tiny")
    for camera in range(2):
        for time in range(4):
            assert np.array_equal(again.read(camera, time), capture.read(camera, time))
    assert again.cameras[1].distortion == () and again.cameras[1].time_offset == 0.0
    rows = np.loadtxt(tmp_path / "out" / "groundtruth" / "cam1.txt")
    np.testing.assert_allclose(rows[:, 0], again.timestamps, atol=1e-8)
    np.testing.assert_allclose(rows[:, 1:], np.c_[np.arange(4), np.zeros((4, 5)), np.ones(4)])


def test_an_unknown_focal_length_stays_unknown(capture: Capture, tmp_path: Path) -> None:
    cameras = (replace(capture.cameras[0], focal_known=False), capture.cameras[1])
    write_capture(replace(capture, cameras=cameras), tmp_path / "out")
    again = load_capture(tmp_path / "out")
    assert again.cameras[0] == cameras[0]
    assert again.cameras[1].focal_known


def test_nothing_is_overwritten(capture: Capture, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(CaptureError, match="out: exists already"):
        write_capture(capture, tmp_path / "out")


def test_poses_must_match_frames(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="camera cam0 has 4 frames but 6 poses"):
        write_capture(capture, tmp_path / "out", poses={"cam0": np.tile(np.eye(4), (6, 1, 1))})


def test_a_full_disk_leaves_no_half_capture(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Path] = []
    real_write = Path.write_bytes

    def write_until_full(path: Path, data: Any) -> int:
        if len(written) == 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(path)
        return real_write(path, data)

    monkeypatch.setattr(Path, "write_bytes", write_until_full)
    with pytest.raises(CaptureError, match=r"out: cannot be written \(No space left on device\)"):
        write_capture(capture, tmp_path / "out")
    assert len(written) == 5
    assert not (tmp_path / "out").exists() and not (tmp_path / "out.partial").exists()
