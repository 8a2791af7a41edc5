"""What became of each clip, as JSON, Markdown and a table for the terminal."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from mvdyn_gtsam.batch.clips import BatchError


class State(StrEnum):
    """How far a clip is."""

    DONE = "done"
    RESUMED = "resumed"
    """Done, by going on where an earlier attempt was cut off."""
    KEPT = "kept"
    """Finished by an earlier run."""
    FAILED = "failed"
    UNFINISHED = "unfinished"
    """Not begun, or cut off when the batch was stopped."""


FINISHED = (State.DONE, State.RESUMED, State.KEPT)


@dataclass(frozen=True)
class Row:
    """One clip; None where there is nothing to say."""

    clip: str
    state: State
    cameras: int | None = None
    frames: int | None = None
    registered: float | None = None
    """Fraction of frames with a pose."""
    seconds: float | None = None
    """Wall clock of the process that finished (or gave up); of a resumed clip, of the last one only."""
    peak_mb: float | None = None
    """Peak resident memory of the largest single process, MiB."""
    ate_m: float | None = None
    abs_rel: float | None = None
    groups: int | None = None
    """World frames; more than one where no view connects all cameras."""
    problem: str | None = None
    """One line: why it failed, or why it has no scores."""


@dataclass(frozen=True)
class BatchReport:
    """All clips of a batch."""

    stage: str
    rows: tuple[Row, ...]

    @property
    def failed(self) -> list[Row]:
        """Clips without a result."""
        return [row for row in self.rows if row.state is State.FAILED]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"stage": self.stage, "clips": [dataclasses.asdict(row) for row in self.rows]}

    def to_markdown(self) -> str:
        """A table, and below it one line per problem."""
        lines = ["| " + " | ".join(_COLUMNS) + " |", "|---|---|" + "---:|" * (len(_COLUMNS) - 2)]
        lines += ["| " + " | ".join(_cells(row)) + " |" for row in self.rows]
        notes = [f"* {note}" for note in self._notes()]
        return "\n".join([f"### batch, {self.stage}", "", *lines, *([""] if notes else []), *notes]) + "\n"

    def to_table(self) -> Table:
        """The same for the terminal."""
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        for number, name in enumerate(_COLUMNS):
            heading = "\n".join(name.split(" ", 1))
            table.add_column(
                heading, justify="left" if number < 2 else "right", no_wrap=number > 0, overflow="fold"
            )
        for row in self.rows:
            table.add_row(*_cells(row))
        table.caption = "\n".join(self._notes()) or None
        table.caption_justify = "left"
        return table

    def _notes(self) -> list[str]:
        notes = [f"{row.clip}: {row.problem}" for row in self.rows if row.problem is not None]
        if any(row.state is State.RESUMED for row in self.rows):
            notes.append("resumed: seconds and memory are those of the last process only.")
        apart = [row.clip for row in self.rows if row.groups is not None and row.groups > 1]
        if apart:
            notes.append(f"no view connects all cameras of {', '.join(apart)}: no common frame, large ATE.")
        if any(row.registered is not None and row.registered < 1.0 for row in self.rows):
            notes.append("poses below 100 %: the errors leave out the frames without a pose.")
        return notes


_COLUMNS = ("clip", "state", "cameras x frames", "poses %", "s", "peak MB", "ATE m", "Abs.Rel")


def read_rows(path: Path) -> dict[str, Row]:
    """Rows of an earlier run by clip; none where there was none. Raises BatchError for another file."""
    if not path.is_file():
        return {}
    try:
        rows = [Row(**{**row, "state": State(row["state"])}) for row in json.loads(path.read_text())["clips"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BatchError(f"{path}: is not the table of a batch ({error}); move it away") from error
    return {row.clip: row for row in rows}


def _cells(row: Row) -> tuple[str, ...]:
    size = "-" if row.cameras is None else f"{row.cameras} x {row.frames}"
    registered = None if row.registered is None else 100 * row.registered
    figures = ((registered, 1), (row.seconds, 1), (row.peak_mb, 0), (row.ate_m, 4), (row.abs_rel, 4))
    return (row.clip, row.state.value, size, *(_cell(value, digits) for value, digits in figures))


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
