"""The refinement's sweep: each setting alone, against the defaults of the same capture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from experiments import refinement_sweep
from experiments.refinement_sweep import against_defaults, render


def entry(capture: str, *varied: str, abs_rel: float | None) -> dict[str, Any]:
    return {"capture": capture, "varied": list(varied), "commit": "a", "seconds": 10.0, "peak_mb": None,
            "step_seconds": {}, "scores": {"abs_rel": abs_rel}}  # fmt: skip


def test_a_setting_is_compared_with_the_defaults_of_its_capture() -> None:
    entries = [
        entry("a", abs_rel=0.1),
        entry("b", abs_rel=0.4),
        entry("a", "x=1", abs_rel=0.2),
        entry("b", "x=1", abs_rel=0.2),
        entry("c", "x=1", abs_rel=0.9),
        entry("a", "x=2", abs_rel=None),
    ]
    rows = against_defaults(entries)
    # twice and half of the defaults are 1 in the mean; c has no defaults to be compared with
    assert rows[0] == ["x=1", "2", "1.000", "-", "-", "-", "-"]
    assert rows[1] == ["x=2", "1", "-", "-", "-", "-", "-"]


def test_every_run_is_a_row() -> None:
    text = render([entry("a", abs_rel=0.1), entry("a", "x=1", abs_rel=0.2)])
    assert "| a | defaults | 0.1000 |" in text and "| a | x=1 | 0.2000 |" in text


@pytest.mark.parametrize(
    ("vary", "named"), [([], "--vary"), (["--vary", "refinement.smoothnes=1"], "refinement.smoothness")]
)
def test_what_cannot_be_varied_is_one_line_before_any_work(
    vary: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refinement_sweep.main([str(tmp_path), "--results", str(tmp_path / "results"), *vary]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and named in error


@pytest.mark.slow
def test_quick_varies_one_setting(tmp_path: Path) -> None:
    assert refinement_sweep.main(["--quick", "--results", str(tmp_path)]) == 0
    page = (tmp_path / "refinement_sweep.md").read_text()
    assert "| refinement.smoothness=2 | 1 |" in page
