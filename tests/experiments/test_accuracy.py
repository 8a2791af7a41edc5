"""The table of several methods: honest about failures, and the baselines' runs are kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from experiments import accuracy
from experiments.records import Records
from mvdyn_gtsam.errors import BaselineError


def entry(method: str, ate_m: float | None, seconds: float, **changes: Any) -> dict[str, Any]:
    scores = None if ate_m is None else {"ate_m": ate_m, "rte_m": 0.001, "rre_deg": 0.01, "groups": []}
    content = {
        "capture": "clip",
        "method": method,
        "commit": "abc",
        "problem": None,
        "registered": 1.0,
        "seconds": seconds,
        "cpu_seconds": seconds,
        "peak_mb": 500.0,
        "scores": scores,
    }
    return {**content, **changes}


def test_ours_is_set_against_the_better_and_the_faster() -> None:
    entries = [entry("ours", 0.002, 60.0), entry("colmap", 0.024, 50.0), entry("glomap", 0.005, 100.0)]
    assert accuracy.against_best(entries) == [
        ["clip", "2.0", "5.0 (glomap)", "0.40", "60", "50 (colmap)", "1.20"]
    ]


def test_a_failed_baseline_is_not_what_we_are_set_against() -> None:
    failed = entry("colmap", None, 1.0, problem="no model", registered=0.0)
    entries = [entry("ours", 0.002, 60.0), failed, entry("glomap", 0.004, 100.0, registered=0.9)]
    assert accuracy.against_best(entries) == [
        ["clip", "2.0", "4.0 (glomap*)", "0.50", "60", "100 (glomap*)", "0.60"]
    ]
    text = accuracy.render(entries)
    assert "colmap (failed)" in text and "no model" in text
    assert "glomap: incomplete" in text
    assert "incomplete: some frames have no pose" in accuracy.render_best(entries)


def test_our_failure_has_no_ratio() -> None:
    failed = entry("ours", None, 3.0, problem="boom", registered=0.0)
    assert accuracy.against_best([failed, entry("colmap", 0.01, 9.0)]) == [
        ["clip", "-", "10.0 (colmap)", "-", "-", "9 (colmap)", "-"]
    ]


def test_rows_are_in_the_units_of_their_headings() -> None:
    row = dict(zip(accuracy.COLUMNS, accuracy.row(entry("ours", 0.0123, 61.4)), strict=True))
    assert (row["ATE mm"], row["RTE mm"], row["RRE deg"]) == ("12.3", "1.00", "0.010")
    assert (row["registered %"], row["s"], row["peak MB"], row["Abs.Rel"]) == ("100.0", "61", "500", "-")


def test_our_settings_decide_our_runs_alone() -> None:
    clip, setting = Path("clip"), ["tracking.window=20"]
    assert accuracy.run_key(clip, "ours", "tracking", []) != accuracy.run_key(
        clip, "ours", "tracking", setting
    )
    assert accuracy.run_key(clip, "ours", "tracking", []) != accuracy.run_key(clip, "ours", "refinement", [])
    assert accuracy.run_key(clip, "colmap", "tracking", []) == accuracy.run_key(
        clip, "colmap", "refinement", setting
    )
    refining = ["refinement.smoothness=2"]
    assert accuracy.run_key(clip, "ours", "tracking", []) == accuracy.run_key(
        clip, "ours", "tracking", refining
    )
    assert accuracy.run_key(clip, "ours", "refinement", []) != accuracy.run_key(
        clip, "ours", "refinement", refining
    )


def test_finished_runs_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run: list[str] = []

    def fake(capture: Path, method: str, *_: object) -> dict[str, Any]:
        run.append(method)
        if method == "glomap" and run.count("glomap") == 1:
            raise KeyboardInterrupt
        return {key: value for key, value in entry(method, 0.01, 1.0).items() if key != "commit"}

    monkeypatch.setattr(accuracy, "measure", fake)
    (tmp_path / "clip").mkdir()
    arguments = [str(tmp_path / "clip"), "--results", str(tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        accuracy.main(arguments)
    assert accuracy.main(arguments) == 0
    assert run == ["ours", "colmap", "glomap", "glomap"]
    assert accuracy.main([*arguments, "--again", "ours"]) == 0
    assert run == ["ours", "colmap", "glomap", "glomap", "ours"]
    text = (tmp_path / "accuracy.md").read_text()
    assert all(f"| clip | {method} |" in text for method in accuracy.METHODS)
    assert "10.0 (colmap)" in (tmp_path / "accuracy_against_best.md").read_text()


def test_a_baseline_run_anew_matches_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy, "measure", lambda _capture, method, *_: entry(method, 0.01, 1.0))
    clip, work = tmp_path / "clip", tmp_path / "work"
    matches = accuracy.matches_folder(work, clip)
    for folder in (clip, matches):
        folder.mkdir(parents=True)
    words = [str(clip), "--results", str(tmp_path), "--work", str(work)]
    assert accuracy.main([*words, "--again", "ours"]) == 0 and matches.is_dir()
    assert accuracy.main([*words, "--again", "glomap"]) == 0 and not matches.exists()


def test_results_made_elsewhere_are_read_anew_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[tuple[str, Path]] = []

    def fake(capture: Path, method: str, options: object, made: Path) -> dict[str, Any]:
        read.append((method, made))
        untimed = {**entry(method, 0.01, 1.0), "seconds": None, "cpu_seconds": None, "peak_mb": None}
        return {key: value for key, value in untimed.items() if key != "commit"}

    monkeypatch.setattr(accuracy, "measure", fake)
    Records(tmp_path / "accuracy.json").add(
        accuracy.run_key(Path("clip"), "ours", "tracking", []), entry("ours", 0.002, 60.0)
    )
    (tmp_path / "clip").mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "clip.npz").touch()
    (tmp_path / "runs" / "clip2.npz").touch()
    words = [str(tmp_path / "clip"), "--results", str(tmp_path), "--method", f"vggt={tmp_path / 'runs'}"]
    words += ["--methods", "ours"]
    for _ in range(2):
        assert accuracy.main(words) == 0
    assert read == 2 * [("vggt", tmp_path / "runs" / "clip.npz")]
    assert "| clip | vggt | 100.0 | 10.0 |" in (tmp_path / "accuracy.md").read_text()
    assert (tmp_path / "accuracy.png").is_file()
    best = (tmp_path / "accuracy_against_best.md").read_text()
    assert "| clip | 2.0 | 10.0 (vggt) | 0.20 | 60 | none finished | - |" in best


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "vggt"], "NAME=DIR"),
        (["--method", "colmap=runs"], "NAME=DIR"),
        (["--method", "vggt=nowhere"], "0 results called clip"),
        (["--methods", "colmap-retrieval"], "--descriptor"),
    ],
)
def test_what_cannot_be_run_is_said_first(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "clip").mkdir()
    assert accuracy.main([str(tmp_path / "clip"), "--results", str(tmp_path), *words]) == 1
    error = capsys.readouterr().err
    assert said in error and "running" not in error


def test_a_capture_without_masks_is_an_entry_that_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*_: object, **__: object) -> None:
        raise BaselineError("clip: there are no motion masks")

    monkeypatch.setattr("mvdyn_gtsam.baselines.compare", refuses)
    (tmp_path / "clip").mkdir()
    words = [str(tmp_path / "clip"), "--results", str(tmp_path), "--methods", "colmap-masks", "glomap-masks"]
    assert accuracy.main(words) == 0
    text = (tmp_path / "accuracy.md").read_text()
    assert "* clip, colmap-masks failed: clip: there are no motion masks" in text and "glomap-masks" in text
