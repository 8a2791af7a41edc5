"""Our accuracy, time and memory against COLMAP and GLOMAP, over many captures, as one table.

Every method runs as `mvdyn compare` runs it: in a process of its own, on the same frames, one by one.
Each (capture, method) is kept as soon as it is done, so an interrupted experiment goes on where it stopped,
and a change of ours does not cost the hours of the baselines: --again ours runs ours anew. Times are fair
only between rows made under the same load; the JSON keeps the load of the machine with every row.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from experiments.records import (
    RESULTS,
    ROOT,
    Page,
    Run,
    captures_or_rendered,
    figure,
    finite,
    key_of,
    run_experiment,
    table,
)
from mvdyn_gtsam.config import load_config, to_dict

NAME = "accuracy"
OURS = "ours"
METHODS = (OURS, "colmap", "glomap")

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
    """What decides a row's figures; the baselines do not depend on our settings."""
    name = capture.resolve().name
    if method != OURS:
        return key_of(capture=name, method=method)
    return key_of(capture=name, method=method, stage=stage, settings=to_dict(load_config(None, overrides)))


def measure(
    capture: Path,
    method: str,
    stage: str,
    overrides: Sequence[str],
    work: Path,
    timeout_s: float | None,
) -> dict[str, Any]:
    """Run one method on one capture through ``compare``; a failure is an entry that says so."""
    from mvdyn_gtsam.baselines import compare

    groundtruth = capture / "groundtruth"
    comparison = compare(
        capture,
        groundtruth if groundtruth.is_dir() else None,
        [method],
        work / capture.resolve().name / method,
        stage=stage,
        # COLMAP and GLOMAP match once; what it took counts for both.
        database=matches_folder(work, capture),
        timeout_s=timeout_s,
        our_arguments=[word for override in overrides for word in ("--set", override)],
    )
    result = comparison.results[0]
    return {
        "capture": capture.resolve().name,
        "method": method,
        "stage": stage if method == OURS else None,
        "overrides": list(overrides) if method == OURS else [],
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
    """Per capture: our ATE over the better baseline's, our time over the faster one's.

    A baseline that failed has no ATE and no time to beat; one that left frames out is marked ``*``, since its
    error leaves out the frames it failed on.
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
        fastest = min(finished, key=lambda e: float(e["seconds"]), default=None)
        our_ate = ours["scores"]["ate_m"] if ours["scores"] else None
        best_ate = best["scores"]["ate_m"] if best else None
        our_seconds = ours["seconds"] if ours["problem"] is None else None
        rows.append(
            [
                capture,
                figure(our_ate, 1, 1e3),
                "none finished" if best is None else _named(best, figure(best_ate, 1, 1e3)),
                figure(_ratio(our_ate, best_ate), 2),
                figure(our_seconds, 0),
                "none finished" if fastest is None else _named(fastest, figure(fastest["seconds"], 0)),
                figure(_ratio(our_seconds, fastest["seconds"] if fastest else None), 2),
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
    columns = ("capture", "ATE mm, ours", "better baseline", "ratio", "s, ours", "faster baseline", "ratio")
    text = "Whole process against whole process. Ratio: ours over theirs.\n\n" + table(columns, rows)
    if any(cell.endswith("*)") for cells in rows for cell in cells):
        text += "\n\\* incomplete: some frames have no pose.\n"
    return text


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("captures", nargs="*", type=Path, help="default: all of ../shared/data/rendered")
    result.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    result.add_argument("--stage", choices=("tracking", "refinement"), default="tracking")
    result.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
                        help="change a setting of ours")  # fmt: skip
    result.add_argument("--timeout", type=float, metavar="SECONDS", help="stop a method after this long")
    result.add_argument("--work", type=Path, default=ROOT / "out" / NAME, metavar="DIR",
                        help="where reconstructions and logs go (default: out/accuracy)")  # fmt: skip
    result.add_argument("--results", type=Path, default=RESULTS, metavar="DIR",
                        help="where JSON and Markdown go")  # fmt: skip
    result.add_argument("--name", default=NAME, help="of the Markdown file (default: %(default)s)")
    result.add_argument("--again", nargs="+", choices=METHODS, default=[],
                        help="run these anew even where the results hold them")  # fmt: skip
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, write it after every run."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser().parse_args(words)
    stage, overrides = options.stage, options.overrides

    def plan() -> list[Run]:
        captures = captures_or_rendered(options.captures)
        if set(options.again) - {OURS}:
            for capture in captures:  # anew means the matches, too
                shutil.rmtree(matches_folder(options.work, capture), ignore_errors=True)
        return [
            Run(
                label=f"{capture.name}, {method}",
                key=run_key(capture, method, stage, overrides),
                measure=partial(measure, capture, method, stage, overrides, options.work, options.timeout),
                again=method in options.again,
            )
            for capture, method in itertools.product(captures, options.methods)
        ]

    path = options.results / f"{options.name}.md"
    pages = [
        Page(path, "Accuracy, time and memory", render),
        Page(path.with_stem(f"{path.stem}_against_best"), "Ours against the better baseline", render_best),
    ]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
