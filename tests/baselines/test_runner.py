from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.baselines import BaselineSettings, run_baseline, runner
from mvdyn_gtsam.baselines.process import ProcessUsage
from mvdyn_gtsam.baselines.settings import ALL_FOCALS_REFINED, Request
from mvdyn_gtsam.baselines.shared import SharedCost
from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.evaluation import evaluate
from mvdyn_gtsam.reconstruction import Reconstruction
from tests.baselines.scenes import FOCAL, HEIGHT, WIDTH, write_capture
from tests.baselines.test_retrieval import write_model

SETTINGS = BaselineSettings(num_threads=1)


def test_a_capture_that_cannot_be_read_fails_in_one_line_from_the_loader(tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match="colmap: .*nowhere.*exit code 1") as caught:
        run_baseline(tmp_path / "nowhere", "colmap", tmp_path / "out")
    assert "Traceback" not in (tmp_path / "out.log").read_text()
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_both_methods_place_the_cameras_of_a_tiny_scene(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_capture(capture, frames=6)
    matches = tmp_path / "matches"
    results = {}
    for method in ("glomap", "colmap"):
        results[method] = run_baseline(
            capture, method, tmp_path / method, settings=SETTINGS, database=matches
        )
        result = results[method]
        assert result.registered == 1.0
        assert set(result.phases) == {"frames", "features", "matching", "mapping"}
        assert result.seconds > sum(result.phases.values()) > 0.0
        assert result.peak_mb > 50.0 and result.points > 50
        assert [np.isfinite(wTc).all() for wTc in result.trajectories.values()] == [True, True]
        reconstruction = Reconstruction.load(tmp_path / method)
        scores = evaluate(reconstruction, capture / "groundtruth")
        # Known intrinsics and the shift of half a pixel are right only if rotations come out this well.
        assert scores.ate_m < 0.02 and scores.inter_camera_rot_deg is not None
        assert scores.inter_camera_rot_deg < 0.3
        assert reconstruction.groups == [["cam0", "cam1"]]
    first, second = results["glomap"], results["colmap"]
    assert second.phases["matching"] == first.phases["matching"]  # shared, and counted for both
    (work,) = matches.iterdir()
    taken_over = SharedCost.from_json(json.loads((work / "phases.json").read_text()))
    assert second.seconds > sum(taken_over.seconds.values()) + second.phases["mapping"]
    assert second.cpu_seconds > taken_over.cpu_seconds > 0.1
    assert second.peak_mb >= taken_over.peak_mb > 50.0
    other = run_baseline(
        capture, "glomap", tmp_path / "other", settings=BaselineSettings(inter_window=1), database=matches
    )
    assert other.phases["matching"] != first.phases["matching"]  # of other settings, never shared
    assert len(list(matches.iterdir())) == 2


@pytest.mark.slow
def test_a_focal_length_that_is_not_known_is_found(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_capture(capture, frames=6)
    content = json.loads((capture / "capture.json").read_text())
    content["cameras"][0].update(fx=100.0, fy=100.0, estimate_focal=True)
    (capture / "capture.json").write_text(json.dumps(content))
    for method in ("glomap", "colmap"):
        out = tmp_path / method
        result = run_baseline(capture, method, out, settings=SETTINGS, database=tmp_path / "matches")
        assert result.registered == 1.0
        reconstruction = Reconstruction.load(out)
        unknown, known = (reconstruction.camera(name) for name in ("cam0", "cam1"))
        assert unknown.fx == unknown.fy == pytest.approx(FOCAL, rel=0.01) and not unknown.focal_known
        assert known.fx == pytest.approx(FOCAL, rel=0.01)
        assert (known.fx == FOCAL) == (method == "colmap")
        assert (ALL_FOCALS_REFINED in reconstruction.manifest["notes"]) == (method == "glomap")
        assert evaluate(reconstruction, capture / "groundtruth").ate_m < 0.02
    run_baseline(capture, "glomap", tmp_path / "none", settings=SETTINGS, estimate_focal=True)
    reconstruction = Reconstruction.load(tmp_path / "none")
    assert not any(reconstruction.camera(name).focal_known for name in reconstruction.cameras)
    assert reconstruction.camera("cam1").fx == pytest.approx(FOCAL, rel=0.01)
    assert reconstruction.manifest["notes"] == []


@pytest.mark.slow
def test_retrieval_and_masks_reach_the_matcher(tmp_path: Path) -> None:
    capture, masks = tmp_path / "capture", tmp_path / "moving"
    write_capture(capture, frames=4)
    for path in (masks / f"cam{c}" / f"{t:06d}.png" for c in range(2) for t in range(4)):
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, :40] = 255
        assert cv2.imwrite(str(path), mask)
    model = write_model(tmp_path / "mean.onnx", [1, 3, "h", "w"], "mean")
    settings = BaselineSettings(
        intra_window=1, inter_window=0, pairing="retrieval", descriptor=model, retrieval_pairs=2, masks=masks,
        num_threads=1,
    )  # fmt: skip
    database = tmp_path / "matches"
    result = run_baseline(capture, "glomap", tmp_path / "out", settings=settings, database=database)
    assert result.registered == 1.0
    assert set(result.phases) == {"frames", "masks", "retrieval", "features", "matching", "mapping"}
    (work,) = database.iterdir()
    lines = (work / "database.pairs.txt").read_text().splitlines()
    assert len(set(lines)) == len(lines)
    windows = 2 * 3 + 4
    assert windows + 8 * 2 // 2 <= len(lines) <= windows + 8 * 2
    with sqlite3.connect(work / "database.db") as connection:
        stored = connection.execute("SELECT rows, cols, data FROM keypoints").fetchall()
    for rows, columns, data in stored:
        assert (np.frombuffer(data, np.float32).reshape(rows, columns)[:, 0] >= 39).all()


def test_what_was_taken_over_counts_even_for_a_method_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "colmap"
    out.mkdir()
    (out / "baseline.json").write_text("of an earlier run")

    def measured(*_: object, **__: object) -> ProcessUsage:
        assert not (out / "baseline.json").exists()
        cost = SharedCost({"matching": 30.0, "features": 4.0}, cpu_seconds=60.0, peak_mb=900.0)
        (out / "baseline.json").write_text(
            json.dumps({"phases": {}, "reused": cost.to_json(), "points": None})
        )
        return ProcessUsage(1, 12.5, 11.0, 640.0, "colmap found no model (exit code 1)")

    monkeypatch.setattr(runner, "run_measured", measured)
    usage = runner.run_worker(Request(tmp_path, "colmap", out, SETTINGS))
    assert (usage.seconds, usage.cpu_seconds, usage.peak_mb) == (46.5, 71.0, 900.0)
    assert usage.problem is not None


@pytest.mark.slow
def test_no_model_is_a_failure_that_says_so_and_leaves_no_work_behind(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    # COLMAP's default wants ten images in a model; these are two.
    write_capture(capture, frames=1)
    with pytest.raises(BaselineError, match="colmap found no model"):
        run_baseline(capture, "colmap", tmp_path / "out", settings=SETTINGS)
    assert not (tmp_path / "out" / "work").exists()
    assert Reconstruction.load(tmp_path / "out").status == "failed"
