"""Depth, scene consistency and poses before the refinement, after phase 1, and after both phases.

The runs of the paper's tables of depth and scene consistency, of the phases, of the refinement's effect on
tracking, and (with --variants ... joint) of alternating against joint optimization. Each capture is tracked
once; every variant refines a copy of that. Runs that the results already hold are kept. Writes
refinement_phases.md and, from the same runs, refinement_on_tracking.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
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
    key_of,
    parse,
    run_experiment,
    settings_arguments,
    table,
)
from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.config import load_config
from mvdyn_gtsam.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "refinement_phases"
TRACKING, FULL = "tracking", "phases 1, 2"
VARIANTS: dict[str, tuple[str, ...]] = {
    TRACKING: (),
    "phase 1": ("refinement.phase2=false",),
    FULL: (),
    "joint": ("refinement.joint=true",),
}
"""Settings of each; the first is not refined at all."""
ON_TRACKING = "refinement_on_tracking"
FLOW_STEPS = ("temporal flow", "wide flow")
COLUMNS = (
    "capture",
    "variant",
    "Abs.Rel",
    "static",
    "moving",
    "delta<1.25",
    "M_d mm",
    "M_d scale only mm",
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
    tracked = folder_of(work, capture, TRACKING)
    if kept is not None and not tracked.exists():
        shutil.copytree(kept / capture.resolve().name / "ours" / "ours", tracked)
    usage = _track(capture, tracked)
    folder, seconds = tracked, {}
    if variant != TRACKING:
        folder = folder_of(work, capture, variant)
        if folder.exists():
            shutil.rmtree(folder)
        shutil.copytree(tracked, folder)
        _take_present_settings(folder)
        settings = [*VARIANTS[variant], *overrides]
        usage = _run(capture, folder, ["--resume", *settings_arguments(settings)])
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


def _take_present_settings(folder: Path) -> None:
    """Let a tracked folder be refined with the settings that hold now: ``--resume`` goes on with those that
    were the defaults when it was tracked."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["config"]["refinement"] = asdict(load_config(None, []).refinement)
    path.write_text(json.dumps(manifest))


def folder_of(work: Path, capture: Path, variant: str) -> Path:
    """Where ``measure`` leaves the reconstruction of a variant."""
    return work / capture.resolve().name / variant.replace(" ", "_").replace(",", "")


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
        figure(scores.get("m_d_scale_only"), 1, 1e3),
        figure(scores.get("ate_m"), 2, 1e3),
        figure(scores.get("rte_m"), 2, 1e3),
        figure(entry["seconds"], 0),
        figure(flow if flow > 0.0 else None, 0),
        figure(entry["peak_mb"], 0),
    ]


def render(entries: Entries) -> str:
    """One row per run, as Markdown."""
    return (
        "Abs.Rel and delta after one scale and offset per frame; M_d: after the trajectory's full Sim(3), and"
        f" in the cameras' own frames after its scale alone. Commit {_commits(entries)}.\n"
        "Seconds of a refined row are those of the refinement alone, all processes together.\n\n"
        + table(COLUMNS, [row(entry) for entry in entries], text_columns=2)
    )


def _commits(entries: Entries) -> str:
    return ", ".join(sorted({str(entry["commit"]) for entry in entries}))


def draw(picture: Figure, entries: Entries) -> None:
    """Abs.Rel and M_d of every variant."""
    left, right = picture.subplots(1, 2)
    bars(left, entries, "capture", "variant", scores_value("abs_rel"), "Abs.Rel")
    bars(right, entries, "capture", "variant", scores_value("m_d", 1e3), "M_d (mm)")


ON_TRACKING_FIGURES = (
    ("ATE mm", "ate_m", 1e3, 2),
    ("RTE mm", "rte_m", 1e3, 2),
    ("RRE deg", "rre_deg", 1.0, 4),
    ("M_d mm", "m_d", 1e3, 1),
)
"""Heading, key of the scores, factor and digits."""


def on_tracking_rows(entries: Entries) -> list[list[str]]:
    """Per capture and refined variant: each figure before, after, and the change."""
    tracked = {entry["capture"]: entry["scores"] for entry in entries if entry["variant"] == TRACKING}
    rows = []
    for entry in entries:
        if entry["variant"] == TRACKING or entry["capture"] not in tracked:
            continue
        cells = [entry["capture"], entry["variant"]]
        for _, key, factor, digits in ON_TRACKING_FIGURES:
            before, after = tracked[entry["capture"]].get(key), entry["scores"].get(key)
            share = None if not before or after is None else after / before - 1.0
            cells += [
                f"{figure(before, digits, factor)} -> {figure(after, digits, factor)}",
                "-" if share is None else f"{100.0 * share:+.0f} %",
            ]
        rows.append(cells)
    return rows


def render_on_tracking(entries: Entries) -> str:
    """Poses and scene consistency before and after the refinement, as Markdown."""
    columns = ["capture", "refinement"]
    for heading, *_ in ON_TRACKING_FIGURES:
        columns += [heading, "change"]
    return f"Before the refinement -> after it. Commit {_commits(entries)}.\n\n" + table(
        columns, on_tracking_rows(entries), text_columns=2
    )


def draw_on_tracking(picture: Figure, entries: Entries) -> None:
    """ATE and RRE of every variant."""
    left, right = picture.subplots(1, 2)
    bars(left, entries, "capture", "variant", scores_value("ate_m", 1e3), "ATE (mm)")
    bars(right, entries, "capture", "variant", scores_value("rre_deg"), "RRE (deg)")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__)
    result.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS)[:3])
    add_kept(result)
    return result


def add_kept(parser: argparse.ArgumentParser) -> None:
    """``--kept``, for ``measure``."""
    parser.add_argument("--kept", type=Path, metavar="WORK",
                        help="take the tracking that experiments.accuracy left here")  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the tables, write them after every run."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)

    def plan() -> list[Run]:
        load_config(None, options.overrides)
        return [
            Run(
                label=f"{capture.name}, {variant}",
                key=key_of(capture=capture.resolve().name, variant=variant, overrides=options.overrides),
                measure=partial(measure, capture, variant, options.work, options.kept, options.overrides),
                again=options.again,
            )
            for capture, variant in itertools.product(captures_of(options), options.variants)
        ]

    pages = [
        Page(options.results / f"{NAME}.md", "What the refinement brings", render, draw),
        Page(
            options.results / f"{ON_TRACKING}.md",
            "What the refinement does to tracking",
            render_on_tracking,
            draw_on_tracking,
        ),
    ]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
