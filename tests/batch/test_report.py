from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from mvdyn_gtsam.batch.clips import BatchError
from mvdyn_gtsam.batch.report import BatchReport, Row, State, read_rows

REPORT = BatchReport(
    "tracking",
    (
        Row("clip1", State.DONE, 2, 41, 1.0, 33.26, 512.4, 0.00281, 0.0312),
        Row("clip2", State.RESUMED, 3, 60, 0.95, 12.0, 400.0, groups=2),
        Row("clip3", State.FAILED, seconds=1.0, problem="cam0.mp4: the file is empty"),
        Row("clip4", State.UNFINISHED),
    ),
)


def test_the_table_holds_every_clip_and_says_what_is_missing() -> None:
    lines = REPORT.to_markdown().splitlines()
    assert "| clip1 | done | 2 x 41 | 100.0 | 33.3 | 512 | 0.0028 | 0.0312 |" in lines
    assert "| clip2 | resumed | 3 x 60 | 95.0 | 12.0 | 400 | - | - |" in lines
    assert "| clip3 | failed | - | - | 1.0 | - | - | - |" in lines
    assert "| clip4 | unfinished | - | - | - | - | - | - |" in lines
    assert lines[-4:] == [
        "* clip3: cam0.mp4: the file is empty",
        "* resumed: seconds and memory are those of the last process only.",
        "* no view connects all cameras of clip2: no common frame, large ATE.",
        "* poses below 100 %: the errors leave out the frames without a pose.",
    ]
    assert [row.clip for row in REPORT.failed] == ["clip3"]


def test_the_terminal_table_fits_eighty_columns() -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(REPORT.to_table())
    text = console.export_text()
    assert "512" in text and "0.0312" in text and "unfinished" in text and "…" not in text


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "batch.json"
    assert read_rows(path) == {}
    path.write_text(json.dumps(REPORT.to_json()))
    assert tuple(read_rows(path).values()) == REPORT.rows


@pytest.mark.parametrize("content", ["", "[]", '{"clips": [{"clip": "a"}]}', '{"clips": [{"state": "new"}]}'])
def test_another_file_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "batch.json").write_text(content)
    with pytest.raises(BatchError, match="is not the table of a batch .*; move it away"):
        read_rows(tmp_path / "batch.json")
