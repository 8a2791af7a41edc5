from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from mvdyn_gtsam.baselines import comparison as comparison_module
from mvdyn_gtsam.baselines.comparison import compare, our_command
from mvdyn_gtsam.baselines.process import ProcessUsage
from mvdyn_gtsam.baselines.results import Comparison, MethodResult
from mvdyn_gtsam.baselines.settings import ALL_FOCALS_REFINED, BaselineSettings, Request
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import BaselineError, MvdynError
from mvdyn_gtsam.evaluation import evaluate
from mvdyn_gtsam.evaluation.depth import DepthScores
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter
from tests.baselines.scenes import HEIGHT, WIDTH, write_capture
from tests.evaluation.fakes import FakeReconstruction, random_poses, random_similarity, write_groundtruth

FRAMES = 10
CAMERAS = ("cam0", "cam1")


@pytest.fixture
def truth(tmp_path: Path) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    poses = {camera: random_poses(rng, FRAMES) for camera in CAMERAS}
    write_groundtruth(tmp_path / "capture", poses)
    return poses


def write_result(folder: Path, poses: dict[str, np.ndarray], notes: Sequence[str] = ()) -> None:
    cameras = tuple(Camera(name, 8, 6, 5.0, 5.0, 3.5, 2.5) for name in CAMERAS)
    with ReconstructionWriter.create(folder, CaptureInfo("capture", 10.0, FRAMES, cameras), {}) as writer:
        for camera, wTc in poses.items():
            writer.write_trajectory(camera, np.arange(FRAMES) / 10.0, wTc)
        writer.set_groups([list(CAMERAS)])
        for note in notes:
            writer.add_note(note)


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


def test_the_tables_say_what_failed_and_what_is_incomplete(finished: tuple[Path, list[MethodResult]]) -> None:
    text = (finished[0] / "compare.md").read_text()
    assert "| colmap (failed) | 0.0 | - | - | - | - | - | 12.5 | 640 |" in text
    assert "* colmap failed: colmap found no model" in text
    assert "* glomap: incomplete" in text
    table = Comparison("capture", tuple(finished[1])).to_table()
    console = Console(width=80)
    with console.capture() as capture:
        console.print(table)
    shown = capture.get()
    assert "…" not in shown
    assert "colmap (failed)" in shown and "glomap: incomplete" in shown and "640" in shown


def test_the_tables_say_that_known_focal_lengths_were_refined(
    truth: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def worker(request: Request, *_: object) -> ProcessUsage:
        write_result(request.out, truth, [ALL_FOCALS_REFINED] if request.method == "glomap" else ["another"])
        return usage()

    monkeypatch.setattr(comparison_module, "run_worker", worker)
    compare(tmp_path / "capture", None, ["colmap", "glomap"], tmp_path / "out")
    text = (tmp_path / "out" / "compare.md").read_text()
    assert text.splitlines()[-1] == f"* glomap: {ALL_FOCALS_REFINED}"
    assert "another" not in text


def test_estimate_focal_reaches_every_method_and_needs_cameras_without_distortion(
    clip: tuple[Path, dict[str, np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = clip[0]
    asked: list[bool] = []

    def ours(_: Path, folder: Path, stage: str, arguments: list[str], *__: object) -> ProcessUsage:
        asked.append(arguments == ["--set", "a=1", "--estimate-focal"])
        return usage("no pose (exit code 1)")

    def worker(request: Request, *_: object) -> ProcessUsage:
        asked.append(request.estimate_focal)
        return usage("no model (exit code 1)")

    monkeypatch.setattr(comparison_module, "_run_ours", ours)
    monkeypatch.setattr(comparison_module, "run_worker", worker)
    words = ["--set", "a=1"]
    compare(capture, None, ["ours", "glomap"], tmp_path / "out", our_arguments=words, estimate_focal=True)
    assert asked == [True, True]
    content = json.loads((capture / "capture.json").read_text())
    content["cameras"][1]["distortion"] = [0.1, 0, 0, 0, 0]
    (capture / "capture.json").write_text(json.dumps(content))
    with pytest.raises(MvdynError, match="camera cam1: has distortion"):
        compare(capture, None, ["ours"], tmp_path / "other", estimate_focal=True)
    assert not (tmp_path / "other").exists() and len(asked) == 2


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


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("rendered") / "clip"
    return folder, write_capture(folder, frames=6)


@pytest.fixture
def clip(rendered: tuple[Path, dict[str, np.ndarray]], tmp_path: Path) -> tuple[Path, dict[str, np.ndarray]]:
    """A capture that can be opened, of six frames, with true poses."""
    return shutil.copytree(rendered[0], tmp_path / "clip"), rendered[1]


def never(*_: object) -> ProcessUsage:
    raise AssertionError("a method was run")


def write_foreign(folder: Path, poses: dict[str, np.ndarray], **more: np.ndarray) -> Path:
    folder.mkdir(parents=True)
    np.savez(folder / "poses.npz", allow_pickle=False, **{**poses, **more})
    return folder


def test_a_result_made_elsewhere_is_a_row_without_time(
    clip: tuple[Path, dict[str, np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison_module, "run_worker", never)
    capture, truth = clip
    moved = {c: random_similarity(np.random.default_rng(1)).transform_poses(p) for c, p in truth.items()}
    moved["cam1"][:3] = np.nan
    foreign = write_foreign(tmp_path / "vggt", moved)
    depth = np.full((HEIGHT // 2, WIDTH // 2), 2.0, np.float32)
    (foreign / "depth" / "cam0").mkdir(parents=True)
    np.save(foreign / "depth" / "cam0" / "000001.npy", depth)
    units = np.full((HEIGHT, WIDTH), 3000, np.uint16)
    units[:, ::2] = 3500
    for time in (1, 4):
        path = capture / "groundtruth" / "depth" / "cam0" / f"{time:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), units)
    out = tmp_path / "out"
    (row,) = compare(capture, capture / "groundtruth", [], out, imported={"vggt": foreign}).results
    assert row.method == "vggt" and row.problem is None and row.folder == foreign
    assert (row.seconds, row.cpu_seconds, row.peak_mb) == (None, None, None)
    assert row.registered == pytest.approx(9 / 12)
    assert row.scores is not None and row.scores.ate_m == pytest.approx(0.0, abs=1e-6)
    assert row.scores.depth is not None and row.scores.depth.abs_rel is not None
    text = (out / "compare.md").read_text()
    assert "Abs.Rel" in text and text.splitlines()[4].endswith("| - | - |")
    assert "* vggt: incomplete" in text and "* vggt: no depth for 1 of 2 frames with true depth" in text
    pytest.importorskip("matplotlib", reason="matplotlib, the eval extra, is not installed")
    for name in ("trajectories.png", "error.png"):
        assert cv2.imread(str(out / name)) is not None


def test_a_bad_result_made_elsewhere_is_refused_before_anything_runs(
    clip: tuple[Path, dict[str, np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison_module, "_run_ours", never)
    capture, truth = clip
    foreign = write_foreign(tmp_path / "vggt", {c: p[:4] for c, p in truth.items()})
    with pytest.raises(MvdynError, match="cam0 has 4 poses, the capture 6 frames"):
        compare(capture, None, ["ours"], tmp_path / "out", imported={"vggt": foreign})
    with pytest.raises(BaselineError, match="ours is a method of its own; rename it"):
        compare(capture, None, [], tmp_path / "out", imported={"ours": foreign})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("glomap-retrieval", "needs a global descriptor: .*--descriptor, or compare with glomap-exhaustive"),
        ("colmap-masks", "there are no motion masks .*--masks DIR"),
    ],
)
def test_what_a_baseline_lacks_is_told_before_anything_runs(
    clip: tuple[Path, dict[str, np.ndarray]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    message: str,
) -> None:
    monkeypatch.setattr(comparison_module, "run_worker", never)
    capture = clip[0]
    with pytest.raises(BaselineError, match=message):
        compare(capture, capture / "groundtruth", ["glomap", method], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_each_baseline_gets_its_own_settings(
    clip: tuple[Path, dict[str, np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = clip[0]
    masks, model = tmp_path / "masks", tmp_path / "netvlad.onnx"
    model.touch()
    for path in (masks / f"cam{c}" / f"{t:06d}.png" for c in range(2) for t in range(6)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    asked: dict[str, Request] = {}

    def worker(request: Request, *_: object) -> ProcessUsage:
        asked[request.out.name] = request
        return usage("no model (exit code 1)")

    monkeypatch.setattr(comparison_module, "run_worker", worker)
    methods = ["colmap", "glomap", "colmap-masks", "glomap-retrieval", "glomap-exhaustive"]
    given = BaselineSettings(masks=masks, descriptor=model, retrieval_pairs=7, num_threads=1)
    compare(capture, None, methods, tmp_path / "out", settings=given, database=tmp_path / "db")
    plain = BaselineSettings(num_threads=1)
    assert asked["colmap"].settings == asked["glomap"].settings == plain  # so that they can share
    assert [asked[name].method for name in methods] == ["colmap", "glomap", "colmap", "glomap", "glomap"]
    assert asked["colmap-masks"].settings == BaselineSettings(masks=masks, num_threads=1)
    assert asked["glomap-retrieval"].settings == BaselineSettings(
        pairing="retrieval", descriptor=model, retrieval_pairs=7, num_threads=1
    )
    assert asked["glomap-exhaustive"].settings == BaselineSettings(pairing="exhaustive", num_threads=1)
    assert {request.database for request in asked.values()} == {tmp_path / "db"}


def test_long_names_and_depth_fit_a_terminal(clip: tuple[Path, dict[str, np.ndarray]]) -> None:
    capture, truth = clip
    scores = evaluate(FakeReconstruction(truth), capture / "groundtruth")
    figures: dict[str, Any] = {field.name: 0.0123 for field in dataclasses.fields(DepthScores)}
    depth = DepthScores(**figures)
    row = MethodResult(
        "colmap-exhaustive",
        None,
        dataclasses.replace(scores, depth=depth),
        1234.5,
        1.0,
        12345.0,
        Path("x"),
        1.0,
    )
    console = Console(width=80)
    with console.capture() as shown:
        console.print(Comparison("clip", (row,)).to_table())
    words = shown.get().split()
    assert {"colmap-", "exhaustive", "12345", "1234.5", "0.012"} <= set(words), shown.get()
