"""What experiments share: results kept from run to run, and Markdown tables that say how they were made."""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mvdyn_gtsam.errors import MvdynError

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments" / "results"
RENDERED = ROOT.parent / "shared" / "data" / "rendered"
"""Captures next to the checkout; too large to keep in it."""


class ExperimentError(MvdynError):
    """An experiment cannot be run as asked."""


class Records:
    """A JSON list on disk, one entry per finished run, so that an interrupted experiment is taken up again.

    An entry is found by its ``key``: everything that decides its figures, but for the code itself, whose
    commit it names.
    """

    def __init__(self, path: Path) -> None:
        """Raises ExperimentError where ``path`` holds something else."""
        self.path = path
        self.entries()

    def entries(self) -> list[dict[str, Any]]:
        """Every entry, oldest first."""
        if not self.path.is_file():
            return []
        try:
            content = json.loads(self.path.read_text())
            return [entry for entry in content["runs"] if isinstance(entry["key"], str)]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ExperimentError(
                f"{self.path}: is no list of runs ({error}); move it away to start anew"
            ) from error

    def find(self, key: str) -> dict[str, Any] | None:
        """The entry with this key, or None."""
        return next((entry for entry in self.entries() if entry["key"] == key), None)

    def add(self, key: str, content: Mapping[str, Any]) -> dict[str, Any]:
        """Put an entry in place of one with the same key; on disk when this returns."""
        entry = {"key": key, "commit": commit(), "machine": machine(), **content}
        # Read anew: another process may have added its own.
        runs = [other for other in self.entries() if other["key"] != key] + [entry]
        write_text(self.path, json.dumps({"runs": runs}, indent=1, allow_nan=False) + "\n")
        return entry


def key_of(**parts: Any) -> str:
    """A short name of everything that decides a run: readable values, and a digest of nested ones."""
    words = []
    for name, value in parts.items():
        if isinstance(value, Mapping):
            text = json.dumps(value, sort_keys=True, default=str)
            value = hashlib.sha256(text.encode()).hexdigest()[:12]
        words.append(f"{name}={value}")
    return " ".join(words)


def commit() -> str:
    """Short hash of the checkout, with ``+`` where its Python files were changed since; "unknown" outside."""
    try:
        head = _git("rev-parse", "--short", "HEAD")
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", "*.py")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+" if changed else "")


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def machine() -> dict[str, Any]:
    """Where a run was made, and how busy that machine was just now."""
    return {
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "load_1_min": round(os.getloadavg()[0], 2),
    }


def write_text(path: Path, text: str) -> None:
    """Write ``path`` whole or not at all. Raises ExperimentError where it cannot be written."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text)
        partial.replace(path)
    except OSError as error:
        raise ExperimentError(
            f"{path}: cannot be written ({error.strerror}); choose another --results"
        ) from error


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> str:
    """A Markdown table; the first ``text_columns`` are aligned left, figures right."""
    alignment = ["---" if number < text_columns else "---:" for number in range(len(columns))]
    lines = [columns, alignment, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def figure(value: float | None, digits: int = 1, factor: float = 1.0) -> str:
    """A number for a table, a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{factor * value:.{digits}f}"


def page(title: str, module: str, arguments: Sequence[str], body: str) -> str:
    """A results page: title, the command that made it, and the tables."""
    command = shlex.join(["python", "-m", f"experiments.{module}", *arguments])
    return f"# {title}\n\n    {command}\n\n{body}"


def finite(value: float | None) -> float | None:
    """None for NaN and infinity, which JSON does not have."""
    return value if value is not None and math.isfinite(value) else None


@dataclass(frozen=True)
class Run:
    """One run of an experiment."""

    label: str
    """What to call it while it runs."""
    key: str
    """Of its entry in the records."""
    measure: Callable[[], Mapping[str, Any]]
    """Does it, where the records have no such entry."""
    again: bool = False
    """Do it even so."""
    shown_as: Mapping[str, Any] = field(default_factory=dict)
    """Put in place of what the entry holds when it is shown."""


@dataclass(frozen=True)
class Page:
    """A results page that grows with every run."""

    path: Path
    title: str
    render: Callable[[Sequence[Mapping[str, Any]]], str]


def run_experiment(
    module: str, words: Sequence[str], records: Path, pages: Sequence[Page], plan: Callable[[], Sequence[Run]]
) -> int:
    """Do the runs of ``plan`` that ``records`` lacks, write the pages after each; returns the exit code."""
    entries: list[dict[str, Any]] = []
    try:
        kept = Records(records)
        for run in plan():
            entry = None if run.again else kept.find(run.key)
            if entry is None:
                sys.stderr.write(f"{run.label}: running\n")
                entry = kept.add(run.key, run.measure())
            else:
                sys.stderr.write(f"{run.label}: kept from commit {entry['commit']}\n")
            entries.append({**entry, **run.shown_as})
            for item in pages:
                write_text(item.path, page(item.title, module, words, item.render(entries)))
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write("\n".join(item.render(entries) for item in pages))
    sys.stderr.write(f"written: {', '.join(str(item.path) for item in pages)}\n")
    return 0


def captures_or_rendered(folders: Sequence[Path]) -> list[Path]:
    """``folders``, or the captures of ``../shared/data/rendered`` where none are given.

    Raises ExperimentError for a folder that is not there: hours later would be too late.
    """
    captures = list(folders) or sorted(path.parent for path in RENDERED.glob("*/capture.json"))
    if not captures:
        raise ExperimentError(f"{RENDERED}: holds no captures; name capture folders on the command line")
    for folder in captures:
        if not folder.is_dir():
            raise ExperimentError(f"{folder}: there is no such capture folder; check the path")
    return captures


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """``--results`` and ``--again``, which every long experiment has."""
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="DIR", help="where JSON and Markdown go"
    )
    parser.add_argument("--again", action="store_true", help="run anew what the results already hold")
