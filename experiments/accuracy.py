"""Our accuracy, time and memory against COLMAP, GLOMAP and others, over many captures, as one table.

The paper's tables of trajectories. Every method runs as `mvdyn compare` runs it: in a process of its own, on
the same frames, one by one. Each (capture, method) is kept as soon as it is done, so an interrupted run goes
on where it stopped, and a change of ours does not cost the hours of the baselines: --again ours runs ours
anew. Times are fair only between rows made under the same load; the JSON keeps the load of the machine with
every row.

--method NAME=DIR adds the results of another method made elsewhere: DIR holds one per capture, in a file or
folder of the capture's name.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.plots import Entries, bars, scores_value
from experiments.records import (
    ExperimentError,
    Page,
    Run,
    captures_of,
    experiment_parser,
    figure,
    finite,
    key_of,
    parse,
    run_experiment,
    settings_arguments,
    table,
)
from mvdyn_gtsam.baselines.settings import BASELINES, BaselineSettings
from mvdyn_gtsam.config import load_config, to_dict
from mvdyn_gtsam.errors import MvdynError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "accuracy"
OURS = "ours"
METHODS = (OURS, "colmap", "glomap")
"""Run where nothing else is asked for."""

COLUMNS = (
    "capture",
    "method",
    "registered %",
    "ATE mm",
    "RTE mm",
    "RRE deg",
    "between cameras mm",
    "between cameras deg",
    "Abs.Rel",
    "M_d mm",
    "s",
    "CPU s",
    "peak MB",
)


def run_key(capture: Path, method: str, stage: str, overrides: Sequence[str]) -> str:
    """What decides a row's figures; the baselines do not depend on our settings, nor tracking on those of the
    refinement."""
    name = capture.resolve().name
    if method != OURS:
        return key_of(capture=name, method=method)
    settings = to_dict(load_config(None, overrides))
    if stage == "tracking":
        del settings["refinement"]
    return key_of(capture=name, method=method, stage=stage, settings=settings)


def measure(
    capture: Path, method: str, options: argparse.Namespace, made_elsewhere: Path | None = None
) -> dict[str, Any]:
    """Run one method on one capture through ``compare``, or read its result; a failure is an entry, too."""
    from mvdyn_gtsam.baselines import compare

    groundtruth = capture / "groundtruth"
    entry = {
        "capture": capture.resolve().name,
        "method": method,
        "stage": options.stage if method == OURS else None,
        "overrides": list(options.overrides) if method == OURS else [],
    }
    try:
        comparison = compare(
            capture,
            groundtruth if groundtruth.is_dir() else None,
            [] if made_elsewhere else [method],
            options.work / capture.resolve().name / method,
            imported={method: made_elsewhere} if made_elsewhere else None,
            stage=options.stage,
            settings=BaselineSettings(descriptor=options.descriptor),
            # COLMAP and GLOMAP match once; what it took counts for both.
            database=matches_folder(options.work, capture),
            timeout_s=options.timeout,
            our_arguments=settings_arguments(options.overrides),
        )
    except MvdynError as error:
        # No masks with this capture, a result that cannot be read: the other captures still have theirs.
        nothing = {"registered": 0.0, "seconds": None, "cpu_seconds": None, "peak_mb": None, "scores": None}
        return {**entry, "problem": str(error), **nothing}
    result = comparison.results[0]
    return {
        **entry,
        "problem": result.problem,
        "registered": result.registered,
        "seconds": finite(result.seconds),
        "cpu_seconds": finite(result.cpu_seconds),
        "peak_mb": finite(result.peak_mb),
        "scores": None if result.scores is None else result.scores.to_json(),
    }


def matches_folder(work: Path, capture: Path) -> Path:
    """Where the baselines of one capture keep frames, features and matches."""
    return work / capture.resolve().name / "matches"


def row(entry: Mapping[str, Any]) -> list[str]:
    """Cells of one run, in the order of ``COLUMNS``."""
    scores = entry["scores"] or {}
    return [
        entry["capture"],
        entry["method"] if entry["problem"] is None else f"{entry['method']} (failed)",
        figure(entry["registered"], 1, 100.0),
        figure(scores.get("ate_m"), 1, 1e3),
        figure(scores.get("rte_m"), 2, 1e3),
        figure(scores.get("rre_deg"), 3),
        figure(scores.get("inter_camera_trans_m"), 1, 1e3),
        figure(scores.get("inter_camera_rot_deg"), 3),
        figure(scores.get("abs_rel"), 4),
        figure(scores.get("m_d"), 1, 1e3),
        figure(entry["seconds"], 0),
        figure(entry["cpu_seconds"], 0),
        figure(entry["peak_mb"], 0),
    ]


def against_best(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Per capture: our ATE over the better baseline's, our CPU seconds over those of the one with fewer.

    CPU seconds, since rows kept from different days were made under different loads. A baseline that failed
    has no ATE and no time to beat; one that left frames out is marked ``*``, since its error leaves out the
    frames it failed on.
    """
    rows = []
    for capture in dict.fromkeys(entry["capture"] for entry in entries):
        own = [e for e in entries if e["capture"] == capture and e["method"] == OURS]
        others = [e for e in entries if e["capture"] == capture and e["method"] != OURS]
        if not own or not others:
            continue
        ours, finished = own[0], [e for e in others if e["problem"] is None]
        scored = [e for e in finished if e["scores"] and e["scores"]["ate_m"] is not None]
        best = min(scored, key=lambda e: float(e["scores"]["ate_m"]), default=None)
        timed = [e for e in finished if e["cpu_seconds"] is not None]
        fastest = min(timed, key=lambda e: float(e["cpu_seconds"]), default=None)
        our_ate = ours["scores"]["ate_m"] if ours["scores"] else None
        best_ate = best["scores"]["ate_m"] if best else None
        our_seconds = ours["cpu_seconds"] if ours["problem"] is None else None
        rows.append(
            [
                capture,
                figure(our_ate, 1, 1e3),
                "none finished" if best is None else _named(best, figure(best_ate, 1, 1e3)),
                figure(_ratio(our_ate, best_ate), 2),
                figure(our_seconds, 0),
                "none finished" if fastest is None else _named(fastest, figure(fastest["cpu_seconds"], 0)),
                figure(_ratio(our_seconds, fastest["cpu_seconds"] if fastest else None), 2),
            ]
        )
    return rows


def _named(entry: Mapping[str, Any], cell: str) -> str:
    return f"{cell} ({entry['method']}{'' if entry['registered'] == 1.0 else '*'})"


def _ratio(ours: float | None, other: float | None) -> float | None:
    return None if ours is None or not other else ours / other


def notes(entries: Sequence[Mapping[str, Any]]) -> str:
    """Failures, incomplete results and cameras left apart, one line each."""
    lines = []
    for entry in entries:
        name = f"{entry['capture']}, {entry['method']}"
        groups = (entry["scores"] or {}).get("groups") or []
        if entry["problem"] is not None:
            lines.append(f"* {name} failed: {entry['problem']}")
        elif entry["registered"] < 1.0:
            lines.append(f"* {name}: incomplete; the errors leave out the frames without a pose")
        if len(groups) > 1:
            parts = "; ".join(
                f"{'+'.join(group['cameras'])} alone: "
                + (group["problem"] or f"ATE {figure(group['ate_m'], 1, 1e3)} mm")
                for group in groups
            )
            lines.append(
                f"* {name}: the cameras are not connected, so errors over all of them mean little; {parts}"
            )
    return "".join(f"{line}\n" for line in lines)


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """One row per run, and below it what went wrong, as Markdown."""
    commits = ", ".join(sorted({str(e["commit"]) for e in entries if e["method"] == OURS})) or "-"
    parts = [
        f"RMSE, one Sim(3) over all cameras together. Ours at commit {commits}.\n",
        table(COLUMNS, [row(entry) for entry in entries], text_columns=2),
    ]
    return "\n".join([*parts, *filter(None, [notes(entries)])])


def render_best(entries: Sequence[Mapping[str, Any]]) -> str:
    """Ours against the better and the faster baseline of each capture, as Markdown."""
    rows = against_best(entries)
    columns = (
        "capture",
        "ATE mm, ours",
        "better baseline",
        "ratio",
        "CPU s, ours",
        "faster baseline",
        "ratio",
    )
    text = "CPU seconds of whole processes. Ratio: ours over theirs.\n\n" + table(columns, rows)
    if any(cell.endswith("*)") for cells in rows for cell in cells):
        text += "\n\\* incomplete: some frames have no pose.\n"
    return text


def draw(picture: Figure, entries: Entries) -> None:
    """ATE and time of every method; a cross where one failed."""
    left, right = picture.subplots(1, 2)
    bars(left, entries, "capture", "method", scores_value("ate_m", 1e3), "ATE (mm)")
    timed = [entry for entry in entries if entry["seconds"] is not None]
    bars(right, timed, "capture", "method", lambda entry: entry["seconds"], "s")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__, again=False)
    result.add_argument("--methods", nargs="+", choices=(OURS, *BASELINES), default=list(METHODS))
    result.add_argument("--method", dest="made_elsewhere", action="append", default=[], metavar="NAME=DIR",
                        help="results of another method, DIR/<capture>; repeatable")  # fmt: skip
    result.add_argument("--stage", choices=("tracking", "refinement"), default="tracking")
    result.add_argument("--descriptor", type=Path, metavar="ONNX",
                        help="global descriptor of the retrieval methods")  # fmt: skip
    result.add_argument("--timeout", type=float, metavar="SECONDS", help="stop a method after this long")
    result.add_argument("--name", default=NAME, help="of the Markdown file (default: %(default)s)")
    result.add_argument("--again", nargs="+", choices=(OURS, *BASELINES), default=[],
                        help="run these anew even where the results hold them")  # fmt: skip
    return result


def made_elsewhere(words: Sequence[str], captures: Sequence[Path]) -> list[tuple[Path, str, Path]]:
    """(capture, method, result) of every ``--method``. Raises ExperimentError where one is not there."""
    found = []
    for word in words:
        name, separator, folder = word.partition("=")
        if not (name and separator and folder) or name in (OURS, *BASELINES):
            raise ExperimentError(f"--method {word}: write NAME=DIR, with a name that no method here has")
        for capture in captures:
            own = capture.resolve().name
            there = sorted(Path(folder).iterdir()) if Path(folder).is_dir() else []
            paths = [path for path in there if own in (path.name, path.stem)]
            if len(paths) != 1:
                raise ExperimentError(
                    f"--method {word}: {folder} has {len(paths)} results called {own}, with or without a"
                    " suffix; one is wanted"
                )
            found.append((capture, name, paths[0]))
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, write it after every run."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)

    def plan() -> list[Run]:
        captures = captures_of(options)
        others = made_elsewhere(options.made_elsewhere, captures)
        if any(BASELINES[m].pairing == "retrieval" for m in options.methods if m != OURS):
            if options.descriptor is None or not options.descriptor.is_file():
                raise ExperimentError("the retrieval methods need the ONNX model of --descriptor")
        if set(options.again) - {OURS}:
            for capture in captures:  # anew means the matches, too
                shutil.rmtree(matches_folder(options.work, capture), ignore_errors=True)
        runs = [
            Run(
                label=f"{capture.name}, {method}",
                key=run_key(capture, method, options.stage, options.overrides),
                measure=partial(measure, capture, method, options),
                again=method in options.again,
            )
            for capture, method in itertools.product(captures, options.methods)
        ]
        return runs + [
            Run(
                label=f"{capture.name}, {method}",
                key=key_of(capture=capture.resolve().name, method=method),
                measure=partial(measure, capture, method, options, path),
                # Reading takes seconds, and what was made elsewhere may be another by now.
                again=True,
            )
            for capture, method, path in others
        ]

    path = options.results / f"{options.name}.md"
    pages = [
        Page(path, "Accuracy, time and memory", render, draw),
        Page(path.with_stem(f"{path.stem}_against_best"), "Ours against the better baseline", render_best),
    ]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
