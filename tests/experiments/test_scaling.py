"""Long captures made of short ones, growth told from size, and failures that stay in sight."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from experiments import scaling, scaling_pages
from experiments.records import ExperimentError
from experiments.scaling import folder_mb, forwards_and_backwards, totals, write_long_capture
from experiments.scaling_pages import columns, refinement_columns, render, rows
from mvdyn_gtsam.baselines.process import ProcessUsage
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


def refined(frames: int, **changes: Any) -> dict[str, Any]:
    """30 s of start, 60 s of tracking, 50 s of refinement: 25 s of it flow, in three processes."""
    phases = {"start": 30.0, "tracking": 60.0, "refinement": 50.0}
    steps = {"images": 5.0, "temporal flow": 15.0, "wide flow": 10.0, "depth 1": 12.0}
    made = entry(frames, 900.0, 100.0, 140.0, phase_seconds=phases, refinement_seconds=steps)
    made |= {"refinement_processes": 3, "stage_peak_mb": {"tracking": 900.0, "refinement": 500.0}}
    return {**made, **changes}


def cells_of(study: str, shown: list[scaling_pages.Column], *entries: dict[str, Any]) -> list[dict[str, str]]:
    """Cells by heading, for headings that are there once."""
    return [
        dict(zip([column.heading for column in shown], cells[1:], strict=True))
        for cells in rows(study, shown, entries)
    ]


def test_growth_is_against_the_size_before_that_was_finished() -> None:
    failed = entry(200, 0.0, 0.0, 5.0, problem="out of memory", peak_mb=None)
    shown = columns("frames")
    first, last = entry(150, 900.0, 100.0, 90.0), entry(300, 960.0, 200.0, 150.0)
    assert rows("frames", shown, [first, failed, last]) == [
        ["2 x 150", "100.0", "2.0", "90", "0.300", "0.100", "0.200", "-", "-", "900", "700", "-", "100", "-"],
        ["2 x 200 (failed)", *["-"] * len(shown)],
        ["2 x 300", "100.0", "2.0", "150", "0.250", "0.050", "0.200", "-", "0.200", "960", "760", "60", "200",
         "100"],
    ]  # fmt: skip


def test_a_failure_is_named_below_the_table_and_left_out_of_the_plot() -> None:
    failed = entry(200, 0.0, 0.0, 5.0, problem="out of memory", peak_mb=None, scores=None)
    text = render("frames", "tracking", [entry(150, 900.0, 100.0, 90.0), failed])
    assert "* 2 x 200: out of memory" in text and "largest single process" in text
    apart = entry(150, 900.0, 1.0, 9.0, scores={"groups": [{"cameras": ["cam0"]}, {"cameras": ["cam1"]}]})
    assert "* 2 x 150: the start leaves cameras apart (cam0 / cam1)" in render("frames", "tracking", [apart])
    figure = Figure()
    scaling_pages.draw("frames", "tracking", figure, [entry(150, 900.0, 100.0, 90.0), failed])
    seconds, memory, error = figure.axes
    assert [line.get_label() for line in seconds.lines] == ["start", "tracking"]
    assert [np.asarray(line.get_xdata()).tolist() for line in error.lines] == [[150]] and len(
        memory.lines
    ) == 2


def test_work_in_proportion_to_pixels_is_the_same_per_megapixel() -> None:
    """Four times the pixels in four times the time."""
    small = entry(100, 900.0, 100.0, 80.0, width=500, height=400, phase_seconds={"tracking": 80.0})
    large = entry(100, 990.0, 400.0, 320.0, width=1000, height=800, phase_seconds={"tracking": 320.0})
    shown = columns("pixels")
    first, second = cells_of("pixels", shown, small, large)
    assert (first["s per image"], second["s per image"]) == ("0.400", "1.600")
    assert first["tracking per Mpx"] == second["tracking per Mpx"] == second["s per added Mpx"] == "2.000"
    assert first["s per added Mpx"] == "-" and second["peak MB"] == "990"
    text = render("pixels", "tracking", [small, large])
    assert "2 cameras x 100 frames" in text and "| 500 x 400 |" in text and "The refinement alone" not in text
    figure = Figure()
    scaling_pages.draw("pixels", "tracking", figure, [small, large])
    assert np.asarray(figure.axes[0].lines[0].get_xdata()).tolist() == [0.2, 0.8]


def test_the_refinement_is_split_into_flow_and_rest_and_its_memory_bounded() -> None:
    [cells] = cells_of("frames", refinement_columns("frames"), refined(100))
    assert cells == {
        **{"s": "50.0", "of it flow": "25.0", "the rest": "25.0", "s / flow": "2.00"},
        **{"flow per image": "0.125", "rest per image": "0.125"},
        **{"peak MB": "500", "processes": "3", "all at most MB": "1500", "of 2 GB %": "79"},
    }
    wide = refined(100, width=500, height=400, refinement_seconds={"temporal flow": 10.0})
    [cells] = cells_of("pixels", refinement_columns("pixels"), wide)
    assert (cells["s / flow"], cells["flow per Mpx"], cells["rest per Mpx"]) == ("5.00", "0.250", "1.000")
    [cells] = cells_of("frames", refinement_columns("frames"), refined(100, refinement_seconds={}))
    assert (cells["of it flow"], cells["s / flow"]) == ("0.0", "-")


def test_a_failed_refinement_is_on_its_page_without_figures() -> None:
    failed = entry(200, 0.0, 0.0, 5.0, problem="out of memory", scores=None)
    text = render("frames", "refinement", [refined(100), failed])
    assert text.count("| 2 x 200 (failed) | - |") == 2 and "* 2 x 200: out of memory" in text
    assert "The refinement alone" in text and "the sum is not" in text
    figure = Figure()
    scaling_pages.draw("frames", "refinement", figure, [refined(100), failed])
    assert [line.get_label() for line in figure.axes[0].lines][-1] == "of it flow"
    assert np.asarray(figure.axes[1].lines[-1].get_ydata()).tolist() == [1500.0]


def test_two_stages_add_their_seconds_and_not_their_memory() -> None:
    tracking = ProcessUsage(0, 10.0, 8.0, 700.0, None)
    both = totals({"tracking": tracking, "refinement": ProcessUsage(0, 5.0, 9.0, 300.0, None)})
    assert both == {"problem": None, "seconds": 15.0, "cpu_seconds": 17.0, "peak_mb": 700.0,
                    "stage_peak_mb": {"tracking": 700.0, "refinement": 300.0}}  # fmt: skip
    failed = totals({"tracking": tracking, "refinement": ProcessUsage(1, 5.0, None, None, "disk full")})
    assert failed["problem"] == "disk full" and failed["peak_mb"] == 700.0 and failed["cpu_seconds"] is None


@pytest.mark.parametrize("words", [["--widths", "254"], ["--widths", "256", "32"], ["--frames", "1"]])
def test_sizes_that_cannot_be_made_are_refused_at_once(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        scaling.main([*words, "--results", str(tmp_path)])
    assert words[0] in capsys.readouterr().err.splitlines()[-1] and not list(tmp_path.iterdir())


def test_widths_are_kept_one_by_one_and_each_stage_has_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run: list[tuple[str, int | None]] = []

    def fake(size: scaling.Size, options: argparse.Namespace) -> dict[str, Any]:
        run.append((options.stage, size.width))
        assert size.width is not None and size.source is None and size.cameras == 3
        made = refined(size.frames, cameras=3, width=size.width, height=3 * size.width // 4)
        return {key: value for key, value in made.items() if key != "commit"}

    monkeypatch.setattr(scaling, "measure", fake)
    words = ["--studies", "pixels", "--of", "3", "--results", str(tmp_path), "--widths", "128", "64"]
    assert scaling.main(words) == 0
    before = (tmp_path / "scaling_pixels.md").read_text()
    assert scaling.main([*words, "256", "--stage", "refinement"]) == 0
    assert scaling.main([*words, "256", "--stage", "refinement"]) == 0
    assert run == [("tracking", 64), ("tracking", 128), *(("refinement", width) for width in (64, 128, 256))]
    assert (tmp_path / "scaling_pixels.md").read_text() == before
    text = (tmp_path / "scaling_pixels_refinement.md").read_text()
    assert text.count("| 256 x 192 |") == 2 and "3 cameras x 60 frames" in text
    assert (tmp_path / "scaling_pixels_refinement.png").is_file()


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
