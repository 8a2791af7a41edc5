"""Before and after the refinement: changes are against the same capture, and settings are checked first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from experiments import refinement_phases
from experiments.refinement_phases import COLUMNS, on_tracking_rows, row
from mvdyn_gtsam.refinement.settings import RefinementConfig


def entry(capture: str, variant: str, **scores: float | None) -> dict[str, Any]:
    figures = {"ate_m": 0.002, "rte_m": 0.001, "rre_deg": 0.02, "m_d": 0.1, "abs_rel": 0.05, **scores}
    return {"capture": capture, "variant": variant, "commit": "a", "seconds": None, "peak_mb": None,
            "step_seconds": {"wide flow": 3.0}, "scores": figures}  # fmt: skip


def test_every_column_has_a_cell_in_the_units_of_its_heading() -> None:
    cells = dict(zip(COLUMNS, row(entry("a", "phase 1", m_d=0.1234, m_d_scale_only=0.0567)), strict=True))
    assert (cells["M_d mm"], cells["M_d scale only mm"], cells["ATE mm"]) == ("123.4", "56.7", "2.00")
    assert (cells["of it flow"], cells["static"]) == ("3", "-")


def test_changes_are_against_the_tracking_of_the_same_capture() -> None:
    entries = [
        entry("a", "tracking", ate_m=0.004),
        entry("b", "tracking", ate_m=0.010),
        entry("a", "phases 1, 2", ate_m=0.003, m_d=None),
        entry("b", "phases 1, 2", ate_m=0.011),
        entry("c", "phases 1, 2"),
    ]
    rows = on_tracking_rows(entries)
    assert [line[:4] for line in rows] == [
        ["a", "phases 1, 2", "4.00 -> 3.00", "-25 %"],
        ["b", "phases 1, 2", "10.00 -> 11.00", "+10 %"],
    ]
    assert rows[0][-2:] == ["100.0 -> -", "-"]


def test_both_plots_have_a_bar_per_variant() -> None:
    entries = [entry("a", "tracking"), entry("a", "phases 1, 2", abs_rel=None)]
    for draw in (refinement_phases.draw, refinement_phases.draw_on_tracking):
        figure = Figure()
        draw(figure, entries)
        assert all(len(axes.containers) == 2 for axes in figure.axes)


def test_what_was_tracked_earlier_is_refined_with_the_settings_of_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The resumed run must not go on with defaults of the day of the tracking."""
    capture, seen = tmp_path / "clip", []
    tracked = refinement_phases.folder_of(tmp_path, capture, "tracking")
    tracked.mkdir(parents=True)
    old = {"refinement": {"moving_sigma": 7.0}, "tracking": {"window": 9}}
    (tracked / "manifest.json").write_text(json.dumps({"config": old}))

    def run(capture: Path, folder: Path, arguments: list[str]) -> None:
        seen.append(json.loads((folder / "manifest.json").read_text())["config"])
        raise InterruptedError

    monkeypatch.setattr(refinement_phases, "_track", lambda capture, folder: None)
    monkeypatch.setattr(refinement_phases, "_run", run)
    with pytest.raises(InterruptedError):
        refinement_phases.measure(capture, "phases 1, 2", tmp_path, None, [])
    assert seen[0]["refinement"]["moving_sigma"] == RefinementConfig().moving_sigma
    assert seen[0]["tracking"] == {"window": 9}
    assert json.loads((tracked / "manifest.json").read_text())["config"] == old


def test_an_unknown_setting_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(tmp_path), "--results", str(tmp_path / "results"), "--set", "refinement.jiont=true"]
    assert refinement_phases.main(words) == 1
    error = capsys.readouterr().err
    assert "refinement.joint" in error and "running" not in error
