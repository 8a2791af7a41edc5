"""Results survive from run to run; tables say what they hold."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from experiments.records import (
    QUICK,
    RESULTS,
    ROOT,
    ExperimentError,
    Page,
    Records,
    Run,
    captures_of,
    experiment_parser,
    figure,
    key_of,
    page,
    parse,
    run_experiment,
    table,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def test_an_entry_is_found_again_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "inner" / "runs.json"
    Records(path).add("a", {"value": 1})
    Records(path).add("b", {"value": 2})
    Records(path).add("a", {"value": 3})
    records = Records(path)
    assert [entry["key"] for entry in records.entries()] == ["b", "a"]
    found = records.find("a")
    assert found is not None and found["value"] == 3
    assert records.find("c") is None
    assert {"commit", "machine"} <= set(found)


def test_records_see_what_another_process_added(tmp_path: Path) -> None:
    ours, theirs = Records(tmp_path / "runs.json"), Records(tmp_path / "runs.json")
    theirs.add("theirs", {})
    ours.add("ours", {})
    assert {entry["key"] for entry in theirs.entries()} == {"theirs", "ours"}


@pytest.mark.parametrize("content", ["{", "[]", '{"runs": [{}]}', '{"runs": 3}'])
def test_a_foreign_file_is_refused_and_kept(tmp_path: Path, content: str) -> None:
    path = tmp_path / "runs.json"
    path.write_text(content)
    with pytest.raises(ExperimentError, match="runs.json"):
        Records(path)
    assert path.read_text() == content


def test_key_depends_on_every_part_and_not_on_the_order_of_settings() -> None:
    key = key_of(capture="a", settings={"x": 1, "y": {"z": 2}})
    assert key == key_of(capture="a", settings={"y": {"z": 2}, "x": 1})
    assert key != key_of(capture="a", settings={"x": 1, "y": {"z": 3}})
    assert key != key_of(capture="b", settings={"x": 1, "y": {"z": 2}})


def test_table_is_markdown() -> None:
    text = table(("name", "value"), [["a", "1"], ["b", "2"]])
    assert text == "| name | value |\n| --- | ---: |\n| a | 1 |\n| b | 2 |\n"


@pytest.mark.parametrize(
    ("value", "cell"), [(0.01234, "12.3"), (None, "-"), (float("nan"), "-"), (float("inf"), "-")]
)
def test_figure(value: float | None, cell: str) -> None:
    assert figure(value, 1, 1000.0) == cell


def test_page_holds_a_command_that_can_be_pasted() -> None:
    text = page("T", "accuracy", ["a folder", "--set", "x=[1, 2]"], "body\n")
    assert "    python -m experiments.accuracy 'a folder' --set 'x=[1, 2]'\n" in text


def small_run(words: list[str], results: Path, measure: Callable[[], dict[str, Any]]) -> int:
    """An experiment of one run, its page with a plot."""

    def plot(figure: Figure, entries: Sequence[Mapping[str, Any]]) -> None:
        figure.subplots().plot([entry["value"] for entry in entries], "o")

    pages = [Page(results / "small.md", "Small", lambda entries: f"{len(entries)} run\n", plot)]
    return run_experiment(
        "small",
        words,
        results / "small.json",
        pages,
        lambda: [Run("one", "one", measure, "--again" in words)],
    )


def test_a_page_shows_its_plot(tmp_path: Path) -> None:
    assert small_run([], tmp_path, lambda: {"value": 1}) == 0
    assert "![Small](small.png)" in (tmp_path / "small.md").read_text()
    assert (tmp_path / "small.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small.json", "small.md", "small.png"]


def test_without_matplotlib_the_page_is_written_and_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert small_run([], tmp_path, lambda: {"value": 1}) == 0
    assert "small.png" not in (tmp_path / "small.md").read_text() and not (tmp_path / "small.png").exists()
    lines = [line for line in capsys.readouterr().err.splitlines() if "pip install" in line]
    assert len(lines) == 1 and lines[0].endswith("pip install mvdyn_gtsam[view]")


def test_a_plot_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "small.png").mkdir()
    assert small_run([], tmp_path, lambda: {"value": 1}) == 1
    assert "--results" in capsys.readouterr().err.splitlines()[-1]
    assert Records(tmp_path / "small.json").find("one") is not None


def test_results_and_work_follow_quick(tmp_path: Path) -> None:
    parser = experiment_parser("name", "What it does.")
    full, quick = parse(parser, []), parse(parser, ["--quick"])
    assert (full.results, full.work) == (RESULTS, ROOT / "out" / "name")
    assert (quick.results, quick.work) == (QUICK, QUICK / "work" / "name")
    own = parse(parser, ["--quick", "--results", str(tmp_path), "--set", "a=1", "--set", "b=2"])
    assert own.work == tmp_path / "work" / "name" and own.overrides == ["a=1", "b=2"]


@pytest.mark.parametrize("words", [["--quick", "somewhere"], ["--quick", "--results", str(RESULTS)]])
def test_quick_never_touches_the_kept_results(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        parse(experiment_parser("name", "What it does."), words)
    assert stopped.value.code == 2 and "--quick" in capsys.readouterr().err.splitlines()[-1]


def test_quick_runs_on_a_generated_scene_below_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "experiments.quick.quick_capture", lambda folder, *size: folder / "x".join(map(str, size))
    )
    options = parse(experiment_parser("name", None), ["--quick", "--results", str(tmp_path)])
    assert captures_of(options) == [tmp_path / "scenes" / "2x14"]
    named = parse(experiment_parser("name", None), [str(tmp_path)])
    assert captures_of(named) == [tmp_path]
