"""One table of several methods on the same frames of the same capture, one after the other on one machine."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import platform
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.baselines.runner import log_path, read_result, run_worker
from mvdyn_gtsam.baselines.settings import METHODS, BaselineSettings, Method, Request
from mvdyn_gtsam.errors import BaselineError, MvdynError
from mvdyn_gtsam.evaluation import GroundTruth, Scores, evaluate, load_groundtruth
from mvdyn_gtsam.reconstruction import Reconstruction

OURS = "ours"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MethodResult:
    """One row: a method that failed has a ``problem`` and no scores; it is never left out."""

    method: str
    problem: str | None
    scores: Scores | None
    seconds: float | None
    """Whole process, wall clock; with shared matches the time of these is counted for each method."""
    cpu_seconds: float | None
    """Of the method's own process, without what it took over from another."""
    peak_mb: float | None
    folder: Path
    registered: float = 0.0
    """Fraction of frames with a pose; a method that failed registered none."""


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
        lines = ["| " + " | ".join(_COLUMNS) + " |", "|---|" + "---:|" * (len(_COLUMNS) - 1)]
        lines += ["| " + " | ".join(_cells(result)) + " |" for result in self.results]
        notes = [f"* {note}" for note in self._notes()]
        return "\n".join([f"### {self.capture}", "", *lines, *([""] if notes else []), *notes]) + "\n"

    def to_table(self) -> Table:
        """The same for the terminal."""
        # Must fit 80 columns: headings break before their unit, figures never break.
        table = Table(title=self.capture, box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        for name in _COLUMNS:
            heading = "\n".join(name.replace("inter-", "inter- ").split())
            table.add_column(heading, justify="left" if name == "method" else "right", no_wrap=True)
        for result in self.results:
            table.add_row(*_cells(result))
        table.caption = "\n".join(self._notes()) or None
        table.caption_justify = "left"
        return table

    def _notes(self) -> list[str]:
        notes = [f"{r.method} failed: {r.problem}" for r in self.results if r.problem is not None]
        partial = [r.method for r in self.results if r.problem is None and r.registered < 1.0]
        if partial:
            notes.append(f"{', '.join(partial)}: incomplete; the errors leave out the frames without a pose.")
        return notes


_COLUMNS = (
    "method",
    "poses %",
    "ATE m",
    "RTE m",
    "RRE deg",
    "inter-camera m",
    "inter-camera deg",
    "s",
    "peak MB",
)


def compare(
    capture: Path,
    groundtruth: Path | None,
    methods: Sequence[str],
    out: Path,
    *,
    stage: str = "tracking",
    settings: BaselineSettings | None = None,
    share_matches: bool = False,
    truncate: bool = False,
    timeout_s: float | None = None,
    our_arguments: Sequence[str] = (),
    on_finished: Callable[[MethodResult], None] | None = None,
) -> Comparison:
    """Run each method (``ours``, ``colmap``, ``glomap``) in a process of its own and score what it wrote.

    ``out/<method>`` holds each result, ``out/<method>.log`` what it said, ``out/compare.json`` and
    ``compare.md`` the table, written anew after each method so that an interrupted comparison keeps what was
    done. Without ground truth only registration, time and memory are compared. ``our_arguments`` are added to
    our command.
    Raises BaselineError for an unknown method, EvaluationError for unusable ground truth; a method that fails
    becomes a row that says so.
    """
    known = (OURS, *METHODS)
    for method in methods:
        if method not in known:
            raise BaselineError(f"method {method!r} is none of {', '.join(known)}")
    if not methods:
        raise BaselineError(f"no method to compare; choose from {', '.join(known)}")
    truth = None if groundtruth is None else load_groundtruth(groundtruth)
    database = out / "matches" if share_matches else None
    results: list[MethodResult] = []
    for method in dict.fromkeys(methods):
        logger.info("%s: running", method)
        folder = out / method
        if method == OURS:
            extra = [*(["--truncate"] if truncate else []), *our_arguments]
            usage = _run_ours(capture, folder, stage, extra, timeout_s)
            reused = 0.0
        else:
            name: Method = "colmap" if method == "colmap" else "glomap"
            request = Request(capture, name, folder, settings or BaselineSettings(), database, truncate)
            usage = run_worker(request, timeout_s)
            reused = 0.0 if usage.problem else read_result(name, folder, usage).seconds - usage.seconds
        results.append(_result(method, folder, usage, reused, truth))
        if on_finished is not None:
            on_finished(results[-1])
        _write(Comparison(Path(capture).resolve().name, tuple(results)), out)
    if database is not None:
        shutil.rmtree(database, ignore_errors=True)
    return Comparison(Path(capture).resolve().name, tuple(results))


def our_command(capture: Path, folder: Path, stage: str, arguments: Sequence[str] = ()) -> list[str]:
    """The command line of our own method, as a user would give it."""
    return [
        *(sys.executable, "-m", "mvdyn_gtsam.cli.main", "reconstruct", str(capture), "--out", str(folder)),
        *("--stage", stage, "--overwrite", *arguments),
    ]


def _run_ours(
    capture: Path, folder: Path, stage: str, arguments: Sequence[str], timeout_s: float | None
) -> ProcessUsage:
    command = our_command(capture, folder, stage, arguments)
    return run_measured(command, log_path(folder), timeout_s=timeout_s)


def _result(
    method: str, folder: Path, usage: ProcessUsage, reused_seconds: float, truth: GroundTruth | None
) -> MethodResult:
    problem, scores, registered = usage.problem, None, 0.0
    if problem is None:
        try:
            reconstruction = Reconstruction.load(folder)
            registered = _registered(reconstruction)
            scores = None if truth is None else evaluate(reconstruction, truth)
        except MvdynError as error:
            problem = str(error)
    if problem is not None:
        logger.warning("%s failed: %s", method, problem)
    seconds = usage.seconds + reused_seconds
    return MethodResult(
        method, problem, scores, seconds, usage.cpu_seconds, usage.peak_mb, folder, registered
    )


def _registered(reconstruction: Reconstruction) -> float:
    poses = np.concatenate([reconstruction.trajectory(camera)[1] for camera in reconstruction.cameras])
    return float(np.isfinite(poses).all(axis=(1, 2)).mean())


def _write(comparison: Comparison, out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "compare.json").write_text(json.dumps(comparison.to_json(), indent=1) + "\n")
        (out / "compare.md").write_text(comparison.to_markdown())
    except OSError as error:
        raise BaselineError(f"{out}: the comparison cannot be written ({error.strerror})") from error


def _cells(result: MethodResult) -> tuple[str, ...]:
    scores = result.scores
    figures = (
        (None, 4) if scores is None else (scores.ate_m, 4),
        (None, 4) if scores is None else (scores.rte_m, 4),
        (None, 3) if scores is None else (scores.rre_deg, 3),
        (None, 4) if scores is None else (scores.inter_camera_trans_m, 4),
        (None, 3) if scores is None else (scores.inter_camera_rot_deg, 3),
        (result.seconds, 1),
        (result.peak_mb, 0),
    )
    name = result.method if result.problem is None else f"{result.method} (failed)"
    return (name, f"{100 * result.registered:.1f}", *(_cell(value, digits) for value, digits in figures))


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
