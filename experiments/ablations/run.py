"""Running a study: what the records lack, then its page."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from experiments.ablations import pages
from experiments.ablations.measure import check_truth, measure, run_key
from experiments.ablations.studies import Study, Variant, ate_changes
from experiments.records import Page, Run, captures_of, run_experiment

RECORDS = "ablations"


def run_study(
    study: Study, options: argparse.Namespace, module: str, words: Sequence[str], page: str, redone: set[str]
) -> int:
    """Do the runs of one study that the records lack, write its ``page``; returns the exit code.

    ``options``: of ``experiments.records.experiment_parser`` and ``timeout``. ``module`` and ``words``: the
    command. ``redone``: keys that ``--again`` has had its turn with; it grows.
    """

    def plan() -> list[Run]:
        captures = captures_of(options)
        for capture in captures:
            check_truth(capture)
        return [
            _run(capture, variant, options, redone)
            for capture, variant in itertools.product(captures, study.variants)
        ]

    drawn = Page(
        options.results / f"{page}.md", study.title, partial(pages.render, study), pages.plot_of(study)
    )
    return run_experiment(module, words, options.results / f"{RECORDS}.json", [drawn], plan)


def _run(capture: Path, variant: Variant, options: argparse.Namespace, redone: set[str]) -> Run:
    key = run_key(capture, variant, options.overrides)
    again = options.again and key not in redone
    redone.add(key)
    return Run(
        label=f"{capture.name}, {variant.name}",
        key=key,
        measure=partial(measure, capture, variant, options.overrides, options.work, options.timeout),
        again=again,
        shown_as={
            "variant": variant.name,
            "reported": None if variant.reported is None else ate_changes(variant.reported),
            "against": variant.against,
            "level": variant.level,
            "noise_m": variant.start.translation_m,
        },
    )


def add_timeout(parser: argparse.ArgumentParser) -> None:
    """``--timeout``, which ``run_study`` reads."""
    parser.add_argument("--timeout", type=float, metavar="SECONDS", help="stop a variant after this long")
