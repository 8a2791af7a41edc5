"""Long captures made of short ones, growth told from size, and failures that stay in sight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from experiments import scaling
from experiments.records import ExperimentError
from experiments.scaling import COLUMNS, folder_mb, forwards_and_backwards, rows, write_long_capture
from mvdyn_gtsam.capture import Camera, Capture, load_capture, write_capture
from mvdyn_gtsam.evaluation import load_groundtruth


class NumberedFrames:
    """Frame k has the value k everywhere, 10 more for the second camera."""

    def __init__(self, count: int, offset: int) -> None:
        self.count, self.offset = count, offset

    def __len__(self) -> int:
        return self.count

    def read(self, time: int) -> npt.NDArray[np.uint8]:
        return np.full((24, 32, 3), self.offset + time, np.uint8)


def numbered_poses(frames: int, offset: int) -> npt.NDArray[np.float64]:
    """Frame k stands at x = k, the second camera 10 further."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = offset + np.arange(frames)
    return poses


def short_capture(folder: Path, frames: int, cameras: int = 3) -> Path:
    capture = Capture(
        "clip",
        30.0,
        tuple(Camera(f"cam{k}", 32, 24, 30.0, 30.0, 15.5, 11.5) for k in range(cameras)),
        tuple(NumberedFrames(frames, 10 * k) for k in range(cameras)),
    )
    poses = {camera.name: numbered_poses(frames, 10 * k) for k, camera in enumerate(capture.cameras)}
    write_capture(capture, folder, poses=poses)
    return folder


@given(st.integers(2, 20), st.integers(1, 100))
def test_playing_moves_by_one_frame_and_reaches_both_ends(available: int, length: int) -> None:
    order = forwards_and_backwards(available, length)
    assert len(order) == length and order[0] == 0
    assert all(abs(b - a) == 1 for a, b in zip(order, order[1:], strict=False))
    assert set(order) == set(range(min(available, length)))


@pytest.mark.parametrize("length", [3, 5, 14])
def test_the_long_capture_is_read_as_played_and_its_poses_follow(tmp_path: Path, length: int) -> None:
    write_long_capture(short_capture(tmp_path / "short", 5), 2, length, tmp_path / "long")
    played, truth = load_capture(tmp_path / "long"), load_groundtruth(tmp_path / "long" / "groundtruth")
    assert [camera.name for camera in played.cameras] == ["cam0", "cam1"] == truth.cameras
    assert played.frame_count == length
    for number in range(2):
        seen = [int(played.read(number, time)[0, 0, 0]) - 10 * number for time in range(length)]
        assert seen == forwards_and_backwards(5, length)
        times, wTc = truth.trajectories[f"cam{number}"]
        np.testing.assert_allclose(times, played.timestamps, atol=1e-6)
        np.testing.assert_allclose(wTc[:, 0, 3] - 10 * number, seen, atol=1e-6)


def test_too_few_cameras_or_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="1 cameras"):
        write_long_capture(short_capture(tmp_path / "short", 5, cameras=1), 2, 9, tmp_path / "long")
    with pytest.raises(ExperimentError, match="1 frames"):
        forwards_and_backwards(1, 9)


def test_folder_size(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "a").write_bytes(bytes(2**20))
    (tmp_path / "b").write_bytes(bytes(2**19))
    assert folder_mb(tmp_path) == 1.5


def entry(frames: int, peak: float, result: float, seconds: float, **changes: Any) -> dict[str, Any]:
    content = {"study": "frames", "capture": "clip", "cameras": 2, "frames": frames, "problem": None,
               "peak_mb": peak, "libraries_mb": 200.0, "result_mb": result, "seconds": seconds, "commit": "a",
               "phase_seconds": {"start": 30.0, "tracking": seconds - 30.0},
               "scores": {"registered": 1.0, "ate_m": 0.002}}  # fmt: skip
    return {**content, **changes}


def test_growth_is_against_the_size_before_that_was_finished() -> None:
    failed = entry(200, 0.0, 0.0, 5.0, problem="out of memory", peak_mb=None)
    cells = rows([entry(150, 900.0, 100.0, 90.0), failed, entry(300, 960.0, 200.0, 150.0)])
    assert all(len(line) == len(COLUMNS) for line in cells)
    assert cells == [
        ["2 x 150", "100.0", "2.0", "90", "0.300", "0.100", "0.200", "-", "-", "900", "700", "-", "100", "-"],
        ["2 x 200 (failed)", *["-"] * (len(COLUMNS) - 1)],
        ["2 x 300", "100.0", "2.0", "150", "0.250", "0.050", "0.200", "-", "0.200", "960", "760", "60", "200",
         "100"],
    ]  # fmt: skip


def test_a_failure_is_named_below_the_table_and_left_out_of_the_plot() -> None:
    failed = entry(200, 0.0, 0.0, 5.0, problem="out of memory", peak_mb=None, scores=None)
    text = scaling.render("frames", [entry(150, 900.0, 100.0, 90.0), failed])
    assert "* 2 x 200: out of memory" in text
    apart = entry(150, 900.0, 1.0, 9.0, scores={"groups": [{"cameras": ["cam0"]}, {"cameras": ["cam1"]}]})
    assert "* 2 x 150: the start leaves cameras apart (cam0 / cam1)" in scaling.render("frames", [apart])
    figure = Figure()
    scaling.draw("frames", figure, [entry(150, 900.0, 100.0, 90.0), failed])
    seconds, memory, error = figure.axes
    assert [line.get_label() for line in seconds.lines] == ["start", "tracking"]
    assert [np.asarray(line.get_xdata()).tolist() for line in error.lines] == [[150]] and len(
        memory.lines
    ) == 2


def test_a_study_is_run_in_parts_and_one_that_failed_does_not_stop_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run: list[int] = []

    def fake(size: scaling.Size, options: object) -> dict[str, Any]:
        run.append(size.frames)
        made = entry(size.frames, 900.0, 100.0, 90.0, problem="boom" if size.frames == 20 else None)
        return {key: value for key, value in made.items() if key != "commit"}

    monkeypatch.setattr(scaling, "measure", fake)
    (tmp_path / "clip").mkdir()
    words = [str(tmp_path / "clip"), "--studies", "frames", "--results", str(tmp_path), "--frames"]
    assert scaling.main([*words, "30", "20"]) == 0
    assert scaling.main([*words, "20", "30", "40"]) == 0
    assert run == [20, 30, 40]
    text = (tmp_path / "scaling_frames.md").read_text()
    assert "| 2 x 20 (failed) |" in text and "| 2 x 30 |" in text and "| 2 x 40 |" in text
    assert (tmp_path / "scaling_frames.png").is_file()
    assert not (tmp_path / "scaling_cameras.md").exists()
