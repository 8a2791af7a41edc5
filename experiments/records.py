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
from typing import TYPE_CHECKING, Any

from mvdyn_gtsam.errors import MvdynError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments" / "results"
RENDERED = ROOT.parent / "shared" / "data" / "rendered"
"""Captures next to the checkout; too large to keep in it."""
QUICK = ROOT / "out" / "quick"
"""Results of ``--quick``, apart from the kept ones."""
QUICK_CAMERAS, QUICK_FRAMES = 2, 14


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
    plot: Callable[[Figure, Sequence[Mapping[str, Any]]], None] | None = None
    """Draws the entries into an empty figure, which is kept as PNG next to the page."""

    def write(self, module: str, words: Sequence[str], entries: Sequence[Mapping[str, Any]]) -> str | None:
        """Write page and plot; what the plot lacks, or None. Raises ExperimentError, as does ``render``."""
        body, problem = self.render(entries), None
        if self.plot is not None:
            picture = self.path.with_suffix(".png")
            problem = _draw(picture, self.plot, entries)
            if problem is None:
                body += f"\n![{self.title}]({picture.name})\n"
        write_text(self.path, page(self.title, module, words, body))
        return problem


def _draw(
    path: Path,
    plot: Callable[[Figure, Sequence[Mapping[str, Any]]], None],
    entries: Sequence[Mapping[str, Any]],
) -> str | None:
    try:
        # The figure without pyplot: no window system, no global state.
        from matplotlib.figure import Figure
    except ImportError:
        return f"{path}: not drawn, plots need matplotlib: pip install mvdyn_gtsam[view]"
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    plot(figure, entries)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(partial, dpi=100, format="png")
        partial.replace(path)
    except OSError as error:
        raise ExperimentError(
            f"{path}: cannot be written ({error.strerror}); choose another --results"
        ) from error
    return None


def run_experiment(
    module: str, words: Sequence[str], records: Path, pages: Sequence[Page], plan: Callable[[], Sequence[Run]]
) -> int:
    """Do the runs of ``plan`` that ``records`` lacks, write the pages after each; returns the exit code."""
    entries: list[dict[str, Any]] = []
    problems: dict[str, None] = {}
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
            problems.update({p: None for item in pages if (p := item.write(module, words, entries))})
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write("\n".join(item.render(entries) for item in pages))
    sys.stderr.write("".join(f"{problem}\n" for problem in problems))
    sys.stderr.write(f"written: {', '.join(str(item.path) for item in pages)}\n")
    return 0


def exit_status(work: Callable[[], None]) -> int:
    """0 after ``work``; 1 where it cannot be done, which is the last line on stderr then."""
    try:
        work()
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
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
    """``--results`` and ``--again``, for a parser that is not made by :func:`experiment_parser`."""
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="DIR", help="where JSON and Markdown go"
    )
    _add_again(parser)


def _add_again(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--again", action="store_true", help="run anew what the results already hold")


def experiment_parser(
    name: str, description: str | None, captures: bool = True, again: bool = True
) -> argparse.ArgumentParser:
    """Command line with ``captures``, ``--quick``, ``--results``, ``--work``, ``--again`` and ``--set``.

    ``captures`` and ``again``: False leaves these out, for an experiment that has its own. To be read by
    :func:`parse`.
    """
    result = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if captures:
        result.add_argument("captures", nargs="*", type=Path, help="default: all of ../shared/data/rendered")
    result.add_argument("--quick", action="store_true",
                        help="a tiny generated scene, results in out/quick")  # fmt: skip
    result.add_argument("--results", type=Path, metavar="DIR",
                        help="where JSON, Markdown and plots go (default: experiments/results)")  # fmt: skip
    result.add_argument("--work", type=Path, metavar="DIR",
                        help=f"where reconstructions and logs go (default: out/{name})")  # fmt: skip
    result.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
                        help="change a setting of ours, e.g. tracking.robust_px=0.5")  # fmt: skip
    if again:
        _add_again(result)
    result.set_defaults(experiment=name)
    return result


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Arguments of :func:`experiment_parser` with ``results`` and ``work`` filled in.

    Exits with one line where ``--quick`` is given captures, or would write among the kept results.
    """
    options = parser.parse_args(words)
    if options.quick and getattr(options, "captures", None):
        parser.error("--quick makes its own scene; name captures or give --quick, not both")
    if options.results is None:
        options.results = QUICK if options.quick else RESULTS
    elif options.quick and options.results.resolve() == RESULTS.resolve():
        parser.error(f"--quick would write among the kept results; choose another folder than {RESULTS}")
    if options.work is None:
        folder = options.results / "work" if options.quick else ROOT / "out"
        options.work = folder / options.experiment
    return options


def captures_of(options: argparse.Namespace) -> list[Path]:
    """The captures that :func:`parse` read: those named, the rendered ones, or the scene of ``--quick``.

    Raises ExperimentError for a folder that is not there: hours later would be too late.
    """
    return [quick_scene(options.results)] if options.quick else captures_or_rendered(options.captures)


def quick_scene(results: Path, cameras: int = QUICK_CAMERAS, frames: int = QUICK_FRAMES) -> Path:
    """The scene of ``--quick`` below ``results``, generated where it is not there yet."""
    from experiments.quick import quick_capture

    return quick_capture(results / "scenes", cameras, frames)


def settings_arguments(overrides: Sequence[str]) -> list[str]:
    """``--set KEY=VALUE`` for each, for the command line of `mvdyn reconstruct`."""
    return [word for override in overrides for word in ("--set", override)]


def varied_settings(vary: Sequence[str]) -> list[str]:
    """``key=value`` for every value of ``--vary key=value,value,...``, in their order.

    Raises ExperimentError for a word not of that form, and where nothing is varied.
    """
    settings = []
    for item in vary:
        key, separator, values = item.partition("=")
        if not separator or not all(value.strip() for value in values.split(",")):
            raise ExperimentError(f"--vary {item}: write it as key=value,value,...")
        settings += [f"{key}={value.strip()}" for value in values.split(",")]
    if not settings:
        raise ExperimentError("nothing to vary; give --vary key=value,value,..., `mvdyn config` lists keys")
    return settings


def add_vary(parser: argparse.ArgumentParser) -> None:
    """``--vary``, for :func:`varied_settings`."""
    parser.add_argument("--vary", action="append", default=[], metavar="KEY=V1,V2,...",
                        help="a setting and the values it takes; may be given several times")  # fmt: skip
