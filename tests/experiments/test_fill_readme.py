"""Tables reach the README without touching what stands around them."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.fill_readme import PAGES, fill, main
from experiments.records import ROOT, ExperimentError

TEXT = "before\n<!-- table: time -->\nold\n<!-- end: time -->\nafter\n"


def test_a_page_replaces_the_old_one_and_its_title_is_left_out() -> None:
    once = fill(TEXT, {"time": "# Title\n\n    command\n\n| a\\1 |\n"})
    assert once == "before\n<!-- table: time -->\n\n    command\n\n| a\\1 |\n\n<!-- end: time -->\nafter\n"
    assert fill(once, {"time": "# Other\n\nnew\n"}).count("new") == 1
    assert "command" not in fill(once, {"time": "# Other\n\nnew\n"})


def test_plots_of_a_page_stay_where_they_are() -> None:
    filled = fill(TEXT, {"time": "# Title\n\n| a |\n\n![Title](time.png)\n"})
    assert filled == "before\n<!-- table: time -->\n\n| a |\n\n<!-- end: time -->\nafter\n"


def test_a_missing_slot_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ExperimentError, match="start"):
        fill(TEXT, {"start": "page"})
    readme = tmp_path / "README.md"
    readme.write_text(TEXT)
    (tmp_path / PAGES["start"]).write_text("page")
    assert main(["--readme", str(readme), "--results", str(tmp_path)]) == 1
    assert readme.read_text() == TEXT
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_the_readme_has_every_slot() -> None:
    text = (ROOT / "README.md").read_text()
    assert all(f"page of {name}" in fill(text, {name: f"page of {name}"}) for name in PAGES)
