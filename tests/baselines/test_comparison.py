from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from mvdyn_gtsam.baselines import comparison as comparison_module
from mvdyn_gtsam.baselines.comparison import MethodResult, compare, our_command
from mvdyn_gtsam.baselines.process import ProcessUsage
from mvdyn_gtsam.baselines.settings import Request
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter
from tests.evaluation.fakes import random_poses, random_similarity, write_groundtruth

FRAMES = 10
CAMERAS = ("cam0", "cam1")


@pytest.fixture
def truth(tmp_path: Path) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    poses = {camera: random_poses(rng, FRAMES) for camera in CAMERAS}
    write_groundtruth(tmp_path / "capture", poses)
    return poses


def write_result(folder: Path, poses: dict[str, np.ndarray]) -> None:
    cameras = tuple(Camera(name, 8, 6, 5.0, 5.0, 3.5, 2.5) for name in CAMERAS)
    with ReconstructionWriter.create(folder, CaptureInfo("capture", 10.0, FRAMES, cameras), {}) as writer:
        for camera, wTc in poses.items():
            writer.write_trajectory(camera, np.arange(FRAMES) / 10.0, wTc)
        writer.set_groups([list(CAMERAS)])


def usage(problem: str | None = None) -> ProcessUsage:
    return ProcessUsage(0 if problem is None else 1, 12.5, 11.0, 640.0, problem)


@pytest.fixture
def finished(
    truth: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Path, list[MethodResult]]:
    """A comparison where ours is exact, COLMAP fails and GLOMAP misses three frames."""

    def ours(capture: Path, folder: Path, *_: object) -> ProcessUsage:
        write_result(
            folder,
            {c: random_similarity(np.random.default_rng(1)).transform_poses(p) for c, p in truth.items()},
        )
        return usage()

    def worker(request: Request, *_: object) -> ProcessUsage:
        folder = request.out
        if request.method == "colmap":
            return usage("colmap found no model (exit code 1)")
        partial = {c: p.copy() for c, p in truth.items()}
        partial["cam1"][:3] = np.nan
        write_result(folder, partial)
        (folder / "baseline.json").write_text('{"phases": {}, "reused": {"matching": 30.0}, "points": 5}')
        return usage()

    monkeypatch.setattr(comparison_module, "_run_ours", ours)
    monkeypatch.setattr(comparison_module, "run_worker", worker)
    seen: list[MethodResult] = []
    compare(
        tmp_path / "capture",
        tmp_path / "capture" / "groundtruth",
        ["ours", "colmap", "glomap"],
        tmp_path / "out",
        on_finished=seen.append,
    )
    return tmp_path / "out", seen


def test_every_method_is_a_row(finished: tuple[Path, list[MethodResult]]) -> None:
    out, seen = finished
    content = json.loads((out / "compare.json").read_text())
    ours, colmap, glomap = content["methods"]
    assert (
        [row["method"] for row in content["methods"]]
        == [r.method for r in seen]
        == ["ours", "colmap", "glomap"]
    )
    assert ours["scores"]["ate_m"] == pytest.approx(0.0, abs=1e-6) and ours["registered"] == 1.0
    assert colmap["problem"].startswith("colmap found no model")
    assert colmap["scores"] is None and colmap["registered"] == 0.0 and colmap["seconds"] == 12.5
    assert glomap["registered"] == pytest.approx(17 / 20) and glomap["peak_mb"] == 640.0


def test_time_taken_over_from_another_method_is_counted(finished: tuple[Path, list[MethodResult]]) -> None:
    ours, _, glomap = finished[1]
    assert ours.seconds == 12.5
    assert glomap.seconds == pytest.approx(42.5)


def test_the_tables_say_what_failed_and_what_is_incomplete(finished: tuple[Path, list[MethodResult]]) -> None:
    text = (finished[0] / "compare.md").read_text()
    assert "| colmap (failed) | 0.0 | - | - | - | - | - | 12.5 | 640 |" in text
    assert "* colmap failed: colmap found no model" in text
    assert "* glomap: incomplete" in text
    table = comparison_module.Comparison("capture", tuple(finished[1])).to_table()
    console = Console(width=80)
    with console.capture() as capture:
        console.print(table)
    shown = capture.get()
    assert "…" not in shown
    assert "colmap (failed)" in shown and "glomap: incomplete" in shown and "640" in shown


def test_without_ground_truth_registration_is_still_compared(
    truth: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ours(capture: Path, folder: Path, *_: object) -> ProcessUsage:
        write_result(folder, truth)
        return usage()

    monkeypatch.setattr(comparison_module, "_run_ours", ours)
    (result,) = compare(tmp_path / "capture", None, ["ours"], tmp_path / "out").results
    assert result.problem is None and result.scores is None and result.registered == 1.0


def test_a_result_that_cannot_be_scored_is_a_failure(
    truth: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison_module, "_run_ours", lambda *_: usage())
    groundtruth = tmp_path / "capture" / "groundtruth"
    (result,) = compare(tmp_path / "capture", groundtruth, ["ours"], tmp_path / "out").results
    assert result.problem is not None and "no such folder" in result.problem


@pytest.mark.parametrize("methods", [["ours", "bundler"], []])
def test_unknown_or_no_methods_are_refused_before_anything_runs(methods: list[str], tmp_path: Path) -> None:
    with pytest.raises(BaselineError):
        compare(tmp_path, None, methods, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_our_command_is_the_one_a_user_would_give() -> None:
    command = our_command(Path("capture"), Path("out"), "tracking", ["--set", "a=1"])
    assert command[0] == sys.executable
    assert command[1:] == [
        *("-m", "mvdyn_gtsam.cli.main", "reconstruct", "capture", "--out", "out"),
        *("--stage", "tracking", "--overwrite", "--set", "a=1"),
    ]


def test_a_camera_without_any_pose_is_incomplete_and_not_an_error(
    truth: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ours(capture: Path, folder: Path, *_: object) -> ProcessUsage:
        write_result(folder, {"cam0": truth["cam0"], "cam1": np.full_like(truth["cam1"], np.nan)})
        return usage()

    monkeypatch.setattr(comparison_module, "_run_ours", ours)
    groundtruth = tmp_path / "capture" / "groundtruth"
    (result,) = compare(tmp_path / "capture", groundtruth, ["ours"], tmp_path / "out").results
    assert result.problem is None and result.registered == 0.5
