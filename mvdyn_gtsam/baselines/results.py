"""The table of a comparison: JSON, Markdown, and for the terminal."""

from __future__ import annotations

import dataclasses
import math
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from mvdyn_gtsam.evaluation import Scores


@dataclass(frozen=True)
class MethodResult:
    """One row: a method that failed has a ``problem`` and no scores; it is never left out."""

    method: str
    problem: str | None
    scores: Scores | None
    seconds: float | None
    """Whole process, wall clock, and what it took over from another; None for a result made elsewhere."""
    cpu_seconds: float | None
    """The same in user and system time."""
    peak_mb: float | None
    """The largest process of the method, or of what it took over."""
    folder: Path
    """Where its result lies."""
    registered: float = 0.0
    """Fraction of frames with a pose; a method that failed registered none."""
    note: str | None = None
    """What a reader of its row must know of how it was made."""


@dataclass(frozen=True)
class Comparison:
    """All methods on one capture."""

    capture: str
    results: tuple[MethodResult, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; per method the contract's figures under ``scores``."""
        return {
            "capture": self.capture,
            "machine": {"platform": platform.platform(), "cpu_count": os.cpu_count()},
            "methods": [
                {
                    **{
                        field.name: getattr(result, field.name)
                        for field in dataclasses.fields(MethodResult)
                        if field.name not in ("scores", "folder")
                    },
                    "folder": str(result.folder),
                    "scores": None if result.scores is None else result.scores.to_json(),
                }
                for result in self.results
            ],
        }

    def to_markdown(self) -> str:
        """A table, and below it which methods failed or are incomplete."""
        columns = self._columns()
        lines = ["| " + " | ".join(columns) + " |", "|---|" + "---:|" * (len(columns) - 1)]
        lines += ["| " + " | ".join(row) + " |" for row in self._rows(columns)]
        notes = [f"* {note}" for note in self._notes()]
        return "\n".join([f"### {self.capture}", "", *lines, *([""] if notes else []), *notes]) + "\n"

    def to_table(self) -> Table:
        """The same for the terminal."""
        # Must fit 80 columns: headings break before their unit, figures never break, long names may.
        table = Table(title=self.capture, box=box.SIMPLE_HEAD, pad_edge=False, padding=0)
        columns = self._columns()
        for name in columns:
            heading = "\n".join(name.replace("inter-", "inter- ").split())
            first = name == "method"
            table.add_column(
                heading, justify="left" if first else "right", no_wrap=not first, overflow="fold"
            )
        for name, *figures in self._rows(columns):
            long = len(name) > _NAME_WIDTH
            table.add_row(name.replace("-", "-\n") if long else name, *figures)
        table.caption = "\n".join(self._notes()) or None
        table.caption_justify = "left"
        return table

    def _columns(self) -> list[str]:
        """Those of depth only where some method has depth and the truth is known."""
        depth = any(r.scores is not None and _has_depth(r.scores) for r in self.results)
        return [name for name in ("method", *_FIGURES) if depth or name not in _DEPTH_FIGURES]

    def _rows(self, columns: list[str]) -> list[list[str]]:
        return [[_name(result), *(_cell(result, name) for name in columns[1:])] for result in self.results]

    def _notes(self) -> list[str]:
        notes = [f"{r.method} failed: {r.problem}" for r in self.results if r.problem is not None]
        partial = [r.method for r in self.results if r.problem is None and r.registered < 1.0]
        if partial:
            notes.append(f"{', '.join(partial)}: incomplete; the errors leave out the frames without a pose.")
        notes += [f"{r.method}: {r.note}" for r in self.results if r.note is not None]
        for result in self.results:
            depth = None if result.scores is None else result.scores.depth
            if depth is not None and 0 < depth.frames_without_estimate < depth.frames:
                missing = f"{depth.frames_without_estimate} of {depth.frames} frames with true depth"
                notes.append(f"{result.method}: no depth for {missing}.")
        return notes


_NAME_WIDTH = 13
"""What 80 columns leave for the name beside all figures."""

_Figure = Callable[[MethodResult], float | None]


def _pose_figure(name: str) -> _Figure:
    return lambda result: None if result.scores is None else getattr(result.scores, name)


def _depth_figure(name: str) -> _Figure:
    def figure(result: MethodResult) -> float | None:
        depth = None if result.scores is None else result.scores.depth
        return None if depth is None else getattr(depth, name)

    return figure


_FIGURES: dict[str, tuple[_Figure, int]] = {
    "poses %": (lambda result: 100 * result.registered, 1),
    "ATE m": (_pose_figure("ate_m"), 4),
    "RTE m": (_pose_figure("rte_m"), 4),
    "RRE deg": (_pose_figure("rre_deg"), 3),
    "inter-camera m": (_pose_figure("inter_camera_trans_m"), 4),
    "inter-camera deg": (_pose_figure("inter_camera_rot_deg"), 3),
    "Abs.Rel": (_depth_figure("abs_rel"), 3),
    "M_d m": (_depth_figure("m_d"), 3),
    "s": (lambda result: result.seconds, 1),
    "peak MB": (lambda result: result.peak_mb, 0),
}
"""Column -> its figure and digits."""
_DEPTH_FIGURES = ("Abs.Rel", "M_d m")


def _has_depth(scores: Scores) -> bool:
    return scores.depth is not None and scores.depth.abs_rel is not None


def _name(result: MethodResult) -> str:
    return result.method if result.problem is None else f"{result.method} (failed)"


def _cell(result: MethodResult, column: str) -> str:
    figure, digits = _FIGURES[column]
    value = figure(result)
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
