"""Depth and poses before the refinement, after phase 1, and after both phases (the paper's Table "ablation
depth").

Each capture is tracked once; every variant refines a copy of that. Runs that the results already hold are
kept.
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
    ROOT,
    ExperimentError,
    Page,
    Run,
    add_common_arguments,
    captures_or_rendered,
    figure,
    key_of,
    run_experiment,
    table,
)
from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.reconstruction import Reconstruction

NAME = "refinement_phases"
VARIANTS: dict[str, tuple[str, ...]] = {
    "tracking": (),
    "phase 1": ("refinement.phase2=false",),
    "phases 1, 2": (),
    "joint": ("refinement.joint=true",),
}
"""Settings of each; the first is not refined at all."""
FLOW_STEPS = ("temporal flow", "wide flow")
COLUMNS = (
    "capture",
    "variant",
    "Abs.Rel",
    "static",
    "moving",
    "delta<1.25",
    "M_d mm",
    "ATE mm",
    "RTE mm",
    "s",
    "of it flow",
    "peak MB",
)


def measure(
    capture: Path, variant: str, work: Path, kept: Path | None, overrides: Sequence[str]
) -> dict[str, Any]:
    """Track where that was not done yet, refine a copy, score it."""
    tracked = work / capture.resolve().name / "tracking"
    if kept is not None and not tracked.exists():
        shutil.copytree(kept / capture.resolve().name / "ours" / "ours", tracked)
    usage = _track(capture, tracked)
    folder, seconds = tracked, {}
    if variant != "tracking":
        folder = work / capture.resolve().name / variant.replace(" ", "_").replace(",", "")
        if folder.exists():
            shutil.rmtree(folder)
        shutil.copytree(tracked, folder)
        settings = [*VARIANTS[variant], *overrides]
        usage = _run(capture, folder, ["--resume", *(w for s in settings for w in ("--set", s))])
        seconds = Reconstruction.load(folder).diagnostics("refinement_seconds")
    from mvdyn_gtsam.evaluation import evaluate

    scores = evaluate(Reconstruction.load(folder), capture / "groundtruth").to_json()
    return {
        "capture": capture.resolve().name,
        "variant": variant,
        "overrides": list(overrides),
        "seconds": None if usage is None else usage.seconds,
        "peak_mb": None if usage is None else usage.peak_mb,
        "step_seconds": seconds,
        "scores": scores,
    }


def _track(capture: Path, folder: Path) -> ProcessUsage | None:
    if folder.is_dir() and "tracking" in Reconstruction.load(folder).stages:
        return None
    return _run(capture, folder, ["--stage", "tracking", *(["--resume"] if folder.is_dir() else [])])


def _run(capture: Path, folder: Path, arguments: Sequence[str]) -> ProcessUsage:
    command = [sys.executable, "-m", "mvdyn_gtsam", "reconstruct", str(capture), "--out", str(folder)]
    usage = run_measured([*command, *arguments], folder.with_suffix(".log"))
    if usage.problem is not None:
        raise ExperimentError(f"{capture}: {usage.problem}; log: {folder.with_suffix('.log')}")
    return usage


def row(entry: Mapping[str, Any]) -> list[str]:
    """Cells of one run, in the order of ``COLUMNS``."""
    scores = entry["scores"]
    flow = sum(entry["step_seconds"].get(step, 0.0) for step in FLOW_STEPS)
    return [
        entry["capture"],
        entry["variant"],
        *(figure(scores.get(key), 4) for key in ("abs_rel", "abs_rel_static", "abs_rel_moving")),
        figure(scores.get("delta_1_25"), 3),
        figure(scores.get("m_d"), 1, 1e3),
        figure(scores.get("ate_m"), 2, 1e3),
        figure(scores.get("rte_m"), 2, 1e3),
        figure(entry["seconds"], 0),
        figure(flow if flow > 0.0 else None, 0),
        figure(entry["peak_mb"], 0),
    ]


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """One row per run, as Markdown."""
    commits = ", ".join(sorted({str(entry["commit"]) for entry in entries}))
    return (
        "Abs.Rel after one scale and offset per frame, M_d after the trajectory's Sim(3)."
        f" Commit {commits}.\n"
        "Seconds of a refined row are those of the refinement alone, all processes together.\n\n"
        + table(COLUMNS, [row(entry) for entry in entries], text_columns=2)
    )


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("captures", nargs="*", type=Path, help="default: all of ../shared/data/rendered")
    result.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS)[:3])
    result.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
                        help="change a setting of the refinement")  # fmt: skip
    result.add_argument("--work", type=Path, default=ROOT / "out" / NAME, metavar="DIR",
                        help="where reconstructions go (default: out/refinement_phases)")  # fmt: skip
    result.add_argument("--kept", type=Path, metavar="WORK",
                        help="take the tracking that experiments.accuracy left here")  # fmt: skip
    add_common_arguments(result)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, write it after every run."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser().parse_args(words)

    def plan() -> list[Run]:
        return [
            Run(
                label=f"{capture.name}, {variant}",
                key=key_of(capture=capture.resolve().name, variant=variant, overrides=options.overrides),
                measure=partial(measure, capture, variant, options.work, options.kept, options.overrides),
                again=options.again,
            )
            for capture, variant in itertools.product(
                captures_or_rendered(options.captures), options.variants
            )
        ]

    pages = [Page(options.results / f"{NAME}.md", "What the refinement brings", render)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
