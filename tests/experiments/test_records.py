"""Results survive from run to run; tables say what they hold."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.records import ExperimentError, Records, figure, key_of, page, table


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
