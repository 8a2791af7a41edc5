"""Depth error, pose error and time of the refinement over values of its settings, each varied alone.

    python -m experiments.refinement_sweep --vary refinement.smoothness=0.5,2 [--vary ...] [CAPTURE...]

How the settings that name it as their source were chosen, and how to choose them for other scenes. Each
capture is tracked once, or taken from where --kept says; every value refines a copy of that. Runs that the
results already hold are kept. Lists are written with semicolons: refinement.temporal_offsets=2;4;8.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.plots import Entries
from experiments.records import (
    Page,
    Run,
    add_vary,
    captures_of,
    experiment_parser,
    figure,
    key_of,
    parse,
    run_experiment,
    table,
    varied_settings,
)
from experiments.refinement_phases import COLUMNS, FULL, add_kept, measure, row
from mvdyn_gtsam.config import load_config

NAME = "refinement_sweep"
DEFAULTS = "defaults"
QUICK = ("refinement.smoothness=2",)
COMPARED = (
    ("Abs.Rel", "abs_rel"),
    ("static", "abs_rel_static"),
    ("moving", "abs_rel_moving"),
    ("M_d", "m_d"),
    ("ATE", "ate_m"),
)
"""Heading and key of the scores."""


def setting_of(entry: Mapping[str, Any]) -> str:
    """What was varied in a run."""
    return " ".join(entry["varied"]) or DEFAULTS


def against_defaults(entries: Entries) -> list[list[str]]:
    """A row per setting: geometric means, over the captures, of each figure over that of the defaults."""
    plain = {entry["capture"]: entry for entry in entries if not entry["varied"]}
    rows = []
    for setting in dict.fromkeys(setting_of(entry) for entry in entries if entry["varied"]):
        pairs = [
            (entry, plain[entry["capture"]])
            for entry in entries
            if setting_of(entry) == setting and entry["capture"] in plain
        ]
        cells = [figure(_mean_ratio(pairs, key), 3) for _, key in COMPARED]
        rows.append([setting, str(len(pairs)), *cells])
    return rows


def _mean_ratio(pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]], key: str) -> float | None:
    """Over the captures that have the figure; None without any."""
    found = [(one["scores"].get(key), other["scores"].get(key)) for one, other in pairs]
    ratios = [one / other for one, other in found if one and other]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else None


def render(entries: Entries) -> str:
    """Every setting against the defaults, then one row per run, as Markdown."""
    commits = ", ".join(sorted({str(entry["commit"]) for entry in entries}))
    headings = ["setting", "captures", *(heading for heading, _ in COMPARED)]
    columns = [column if column != "variant" else "setting" for column in COLUMNS]
    shown = [{**entry, "variant": setting_of(entry)} for entry in entries]
    return (
        f"Each setting alone, the others at their defaults. Commit {commits}.\n"
        "Over the defaults, geometric mean over the captures; below 1 is better:\n\n"
        + table(headings, against_defaults(entries))
        + "\nEvery run; seconds are to be compared between runs under the same load only:\n\n"
        + table(columns, [row(entry) for entry in shown], text_columns=2)
    )


def measure_varied(
    capture: Path, varied: Sequence[str], work: Path, kept: Path | None, overrides: Sequence[str]
) -> dict[str, Any]:
    """As ``refinement_phases.measure``, with the setting that is varied."""
    return {**measure(capture, FULL, work, kept, [*overrides, *varied]), "varied": list(varied)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the tables, write them after every run; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = experiment_parser(NAME, __doc__)
    add_vary(parser)
    add_kept(parser)
    options = parse(parser, words)

    def plan() -> list[Run]:
        settings = varied_settings(options.vary or (QUICK if options.quick else ()))
        variants: list[list[str]] = [[], *([setting.replace(";", ",")] for setting in settings)]
        for varied in variants:
            load_config(None, [*options.overrides, *varied])
        return [
            Run(
                label=f"{capture.name}, {' '.join(varied) or DEFAULTS}",
                key=key_of(capture=capture.resolve().name, varied=varied, overrides=options.overrides),
                measure=partial(
                    measure_varied, capture, varied, options.work, options.kept, options.overrides
                ),
                again=options.again,
            )
            for varied, capture in itertools.product(variants, captures_of(options))
        ]

    pages = [Page(options.results / f"{NAME}.md", "The refinement over values of its settings", render)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
