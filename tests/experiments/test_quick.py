"""Every experiment of ours from end to end on the tiny generated scene, with `--quick`.

The ablations have such tests of their own.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from experiments import (
    accuracy,
    factor_cost,
    flow_accuracy,
    focal,
    refinement_phases,
    refinement_pictures,
    scaling,
    summary,
    wide_baseline,
)

needs_scenes = pytest.mark.skipif(
    importlib.util.find_spec("embreex") is None, reason="needs embreex: pip install mvdyn_gtsam[scenes]"
)
pytestmark = [pytest.mark.slow, needs_scenes]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all, so that the scene is made once."""
    return tmp_path_factory.mktemp("quick")


def runs(results: Path, name: str) -> list[dict[str, Any]]:
    return list(json.loads((results / f"{name}.json").read_text())["runs"])


def is_whole(results: Path, name: str) -> None:
    """A page with figures, and its plot."""
    text = (results / f"{name}.md").read_text()
    assert f"({name}.png)" in text and text.count("\n| ") >= 3
    assert (results / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_refinement_phases_pictures_of_what_they_leave_and_the_summary(results: Path) -> None:
    words = ["--quick", "--results", str(results), "--variants", "tracking", "phases 1, 2"]
    assert refinement_phases.main(words) == 0
    tracked, refined = (entry["scores"] for entry in runs(results, "refinement_phases"))
    assert tracked["registered"] == refined["registered"] == 1.0
    assert refined["abs_rel"] < tracked["abs_rel"] and refined["m_d"] < tracked["m_d"]
    is_whole(results, "refinement_phases")
    is_whole(results, "refinement_on_tracking")

    assert refinement_pictures.main(["--quick", "--out", str(results)]) == 0
    for kind in ("depth", "points"):
        assert (results / f"{kind}_quick_2x14.jpg").read_bytes().startswith(b"\xff\xd8")
    assert summary.main(["--quick", "--results", str(results)]) == 0
    assert "| none, quick_2x14 | ours (refined) | - | - | - | 100.0 |" in (results / "summary.md").read_text()


def test_scaling(results: Path) -> None:
    words = ["--quick", "--results", str(results), "--studies", "frames", "cameras", "--frames", "10"]
    assert scaling.main([*words, "--cameras", "2"]) == 0
    for entry in runs(results, "scaling"):
        assert entry["problem"] is None and entry["scores"]["registered"] == 1.0
        assert entry["peak_mb"] > entry["libraries_mb"] > 0.0
        assert set(entry["phase_seconds"]) == {"start", "tracking"}
    is_whole(results, "scaling_frames")
    is_whole(results, "scaling_cameras")


def test_scaling_of_the_refinement_with_pixels(results: Path) -> None:
    words = ["--quick", "--results", str(results), "--stage", "refinement", "--studies", "pixels"]
    assert scaling.main([*words, "--widths", "192", "256", "--generated-frames", "10"]) == 0
    made = [entry for entry in runs(results, "scaling") if entry["study"] == "pixels"]
    assert [(entry["width"], entry["height"]) for entry in made] == [(192, 144), (256, 192)]
    for entry in made:
        assert entry["problem"] is None and entry["scores"]["registered"] == 1.0
        assert set(entry["phase_seconds"]) == {"start", "tracking", "refinement"}
        steps = entry["refinement_seconds"]
        assert steps["temporal flow"] > 0.0 and steps["wide flow"] > 0.0
        assert sum(steps.values()) <= entry["phase_seconds"]["refinement"] < entry["seconds"]
        assert entry["stage_peak_mb"]["refinement"] > entry["libraries_mb"] / 2
    is_whole(results, "scaling_pixels_refinement")


def test_wide_baseline(results: Path) -> None:
    assert wide_baseline.main(["--quick", "--results", str(results)]) == 0
    [entry] = runs(results, "wide_baseline")
    assert entry["problem"] is None and entry["pairs"]
    is_whole(results, "wide_baseline")


def test_focal(results: Path) -> None:
    # so short a clip leaves its focal lengths open where principal points are free, too
    held = ["--set", "frontend.wide_baseline.adjustment.centre_sigma=1e-4"]
    assert focal.main(["--quick", "--results", str(results), *held]) == 0
    [entry] = runs(results, "focal")
    assert entry["problem"] is None and entry["tracking"] is None
    for camera in entry["cameras"]:
        assert abs(camera["found_px"] / camera["true_px"] - 1.0) < 0.01
    assert (results / "focal.md").read_text().count("| quick_2x14 |") == 4


def test_accuracy_of_ours_and_a_baseline(results: Path) -> None:
    words = ["--quick", "--results", str(results), "--methods", "ours", "glomap-masks"]
    assert accuracy.main(words) == 0
    ours, baseline = runs(results, "accuracy")
    assert ours["problem"] is None and ours["registered"] == 1.0 and ours["scores"]["ate_m"] < 0.02
    assert baseline["method"] == "glomap-masks" and baseline["seconds"] > 0.0
    is_whole(results, "accuracy")


def test_flow_accuracy(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "--quick",
        "--kinds",
        "+1",
        "cross+0",
        "--times",
        "1",
        "--out",
        str(results / "flow_accuracy.md"),
    ]
    assert flow_accuracy.main(words) == 0
    assert "| default | cross+0 |" in capsys.readouterr().out


def test_factor_cost(capsys: pytest.CaptureFixture[str]) -> None:
    assert factor_cost.main(["--quick"]) == 0
    assert "N = 48 points, E = 2 edges" in capsys.readouterr().out
