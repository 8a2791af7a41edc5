"""The page beside the paper: figures as printed, signs told right, and nothing taken for run that was not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from experiments import paper, summary
from experiments.ablations.studies import STUDIES
from experiments.against_paper import Kept, direction, effects, method_rows
from experiments.records import RESULTS, Records
from mvdyn_gtsam.config import load_config

SCORES = {"registered": 1.0, "ate_m": 0.002, "rte_m": 0.001, "rre_deg": 0.01, "groups": []}
SCORES |= {"abs_rel": 0.05, "delta_1_25": 0.95, "m_d": 0.04, "m_d_scale_only": 0.03}


def add_method(folder: Path, capture: str, method: str, stage: str | None = None, **scores: Any) -> None:
    entry: dict[str, Any] = {"capture": capture, "method": method, "stage": stage, "overrides": []}
    entry |= {"problem": None, "registered": 1.0, "seconds": 10.0, "scores": {**SCORES, **scores}}
    Records(folder / "accuracy.json").add(f"{capture} {method} {stage}", entry)


def add_variant(folder: Path, study: str, name: str, problem: str | None = None, **scores: Any) -> None:
    variant = next(variant for variant in STUDIES[study].variants if variant.name == name)
    entry = {"capture": "dynamic_human", "settings": list(variant.settings), "problem": problem,
             "start": variant.start.describe(), "seconds": 10.0, "peak_mb": 500.0,
             "scores": None if problem else {**SCORES, **scores}}  # fmt: skip
    Records(folder / "ablations.json").add(f"{study} {name}", entry)


def effect_rows(folder: Path, start: str) -> dict[tuple[str, str], Any]:
    """(capture, figure) -> row of the only effect whose name starts so."""
    [item] = [item for item in effects(Kept.read(folder)) if item.name.startswith(start)]
    return {(row.capture, row.figure): row for row in item.rows}


@pytest.mark.parametrize(
    ("changes", "tables", "keys"),
    [
        (paper.WITHOUT_START, paper.TRAJECTORIES, paper.TRAJECTORY_KEYS),
        (paper.WITHOUT_ST_GRAPH, paper.TRAJECTORIES, paper.TRAJECTORY_KEYS),
        (paper.WITHOUT_PHASES, paper.DEPTH, paper.DEPTH_KEYS),
        (paper.WITHOUT_PHASE_2, paper.DEPTH, paper.DEPTH_KEYS),
    ],
)
def test_the_papers_tables_agree_with_each_other(changes: Any, tables: Any, keys: Sequence[str]) -> None:
    for scene, figures in changes.items():
        assert tuple(figures[key][0] for key in keys) == tables[scene][paper.OURS]


@pytest.mark.parametrize(
    ("key", "full", "change", "expected"),
    [
        ("ate_m", 0.02, 0.002, "worse"),
        ("ate_m", 0.02, -0.002, "better"),
        ("ate_m", 0.02, 0.0009, "same"),
        ("delta_1_25", 0.9, -0.1, "worse"),
        ("delta_1_25", 0.8, 0.1, "better"),
        ("ate_m", 0.0, 0.0, "same"),
    ],
)
def test_direction(key: str, full: float, change: float, expected: str) -> None:
    assert direction(key, full, change) == expected


def test_signs_are_set_against_the_papers(tmp_path: Path) -> None:
    add_variant(tmp_path, "without_init", "full method")
    add_variant(tmp_path, "without_init", "own maps", ate_m=0.3, rre_deg=0.005)
    rows = effect_rows(tmp_path, "Without the wide-baseline start: own maps")
    ate, rte = rows["dynamic_human", "ate_m"], rows["dynamic_human", "rte_m"]
    assert ate.paper == (0.013, 0.130) and ate.here == (0.002, pytest.approx(0.298)) and ate.agrees is True
    # 0.001 of 0.009 is more than the share that counts as none: the paper's got worse, ours did not change.
    assert rte.agrees is False
    assert rows["dynamic_human", "rre_deg"].agrees is False
    assert rows["roboarm", "ate_m"].here == "not run" and rows["roboarm", "ate_m"].agrees is None


def test_a_variant_that_fails_is_worse_and_a_failing_reference_says_nothing(tmp_path: Path) -> None:
    add_variant(tmp_path, "without_init", "full method")
    add_variant(tmp_path, "without_init", "nothing", problem="lost")
    row = effect_rows(tmp_path, "Without the wide-baseline start: nothing")["dynamic_human", "ate_m"]
    assert row.here == "fails" and row.agrees is True
    add_variant(tmp_path, "without_init", "full method", problem="lost")
    row = effect_rows(tmp_path, "Without the wide-baseline start: nothing")["dynamic_human", "ate_m"]
    assert row.agrees is None


def test_a_run_is_found_under_whatever_name_it_was_made(tmp_path: Path) -> None:
    """A setting at its default is the full method; one that no longer exists is nobody's."""
    default = f"graph.st_per_frame={load_config(None, []).graph.st_per_frame}"
    start = STUDIES["without_init"].variants[0].start.describe()
    for key, setting, error in (("a", default, 0.007), ("b", "graph.gone=1", 0.5)):
        entry = {"capture": "roboarm", "settings": [setting], "problem": None, "start": start}
        Records(tmp_path / "ablations.json").add(key, {**entry, "scores": {**SCORES, "ate_m": error}})
    found = Kept.read(tmp_path).variant("roboarm", STUDIES["without_init"].variants[0])
    assert found is not None and found["scores"]["ate_m"] == 0.007


def test_noise_is_the_median_of_its_seeds(tmp_path: Path) -> None:
    for level, errors in (("3 deg, 0.00 m", (0.002, 0.002, 0.5)), ("3 deg, 0.10 m", (0.3, 0.004, 0.004))):
        for seed, error in enumerate(errors):
            add_variant(tmp_path, "noisy_init", f"{level}, seed {seed}", ate_m=error)
    row = effect_rows(tmp_path, "A noisy start: 3 deg and 0.10 m")["dynamic_human", "ate_m"]
    assert row.here == (0.002, pytest.approx(0.002)) and row.agrees is True
    add_variant(tmp_path, "noisy_init", "3 deg, 0.10 m, seed 0", problem="lost")
    add_variant(tmp_path, "noisy_init", "3 deg, 0.10 m, seed 1", problem="lost")
    row = effect_rows(tmp_path, "A noisy start: 3 deg and 0.10 m")["dynamic_human", "ate_m"]
    assert row.here == "fails"


def test_methods_stand_beside_the_papers_and_the_refined_result_is_ours(tmp_path: Path) -> None:
    add_method(tmp_path, "roboarm", "ours", "tracking", ate_m=0.009)
    add_method(tmp_path, "roboarm", "ours", "refinement", ate_m=0.001)
    add_method(tmp_path, "roboarm", "fastvggt", ate_m=0.05)
    add_method(tmp_path, "elsewhere", "colmap", ate_m=0.07)
    found = method_rows(Kept.read(tmp_path), paper.TRAJECTORIES, ("ate_m",))
    rows = {(row.capture, row.method): row for row in found}
    assert rows["roboarm", "ours (refined)"].here == (0.001,)
    assert rows["roboarm", "FastVGGT"].here == (0.05,)
    assert rows["roboarm", "FastVGGT"].paper == (0.006, 0.004, 0.107)
    assert rows["roboarm", "colmap"].here == "not run"
    assert rows["elsewhere", "colmap"].paper is None and rows["elsewhere", "colmap"].scene is None
    assert ("elsewhere", "ours") not in rows


def test_the_page_is_written_with_its_plot_and_data(tmp_path: Path) -> None:
    add_method(tmp_path, "roboarm", "ours", "tracking", ate_m=0.004, groups=[{}, {}])
    add_method(tmp_path, "roboarm", "colmap", ate_m=0.016)
    (tmp_path / "scaling_frames.md").write_text("")
    assert summary.main(["--results", str(tmp_path)]) == 0
    text = (tmp_path / "summary.md").read_text()
    assert "The scenes differ" in text and "ours (tracking only, cameras apart)" in text
    assert "| RoboArm, roboarm | 0.62 | 0.25 | 0.83 | not run |" in text
    assert "[scaling_frames.md](scaling_frames.md)" in text and "scaling_cameras.md" not in text
    assert (tmp_path / "summary.png").is_file()
    content = json.loads((tmp_path / "summary.json").read_text())
    assert {"trajectories", "depth", "effects", "commits"} == content.keys()


def test_without_any_result_all_is_not_run(tmp_path: Path) -> None:
    assert summary.main(["--results", str(tmp_path / "none")]) == 0
    items = effects(Kept.read(tmp_path / "none"))
    assert items and all(row.here == "not run" for item in items for row in item.rows)


def test_the_kept_results_can_be_read() -> None:
    kept = Kept.read(RESULTS)
    assert kept.accuracy and kept.phases and kept.commits


def test_a_foreign_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "accuracy.json").write_text("[]")
    assert summary.main(["--results", str(tmp_path)]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
