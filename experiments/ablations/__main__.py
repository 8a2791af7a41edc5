"""The ablations of tracking: what each part is worth, measured by leaving it out or changing it.

    python -m experiments.ablations STUDY [CAPTURE...]

Every variant is tracked in a process of its own from a start made beforehand (kept in --work), and scored
over all cameras together: ATE, RTE, RRE, errors between cameras, seconds, peak memory, registered frames. A
variant that fails is a row that says so. Runs are kept in ablations.json as soon as they are done and shared
by the studies that have them in common; each study has its page, ablation_<study>.md, and a plot.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from experiments.ablations import pages
from experiments.ablations.measure import check_truth, measure, run_key
from experiments.ablations.studies import STUDIES, Study, Variant, ate_changes
from experiments.records import Page, Run, captures_of, experiment_parser, parse, run_experiment

NAME = "ablations"
ALL = "all"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, f"{__doc__}\n{_studies_help()}", captures=False)
    result.prog = f"python -m experiments.{NAME}"
    result.add_argument("study", choices=[*STUDIES, ALL], metavar="STUDY", help=f"one of the above, or {ALL}")
    result.add_argument("captures", nargs="*", type=Path, help="default: all of ../shared/data/rendered")
    result.add_argument("--timeout", type=float, metavar="SECONDS", help="stop a variant after this long")
    return result


def _studies_help() -> str:
    blocks = []
    for study in STUDIES.values():
        text = f"{study.title}. {study.about} The paper: {study.stands_for}"
        blocks.append(f"{study.name}\n{textwrap.indent(textwrap.fill(text, 98), '    ')}")
    return "studies:\n\n" + "\n\n".join(blocks)


def run_study(
    study: Study, options: argparse.Namespace, module: str, words: Sequence[str], redone: set[str]
) -> int:
    """Do the runs of one study that the records lack, write its page; returns the exit code.

    ``options``: as ``parser`` reads them. ``redone``: keys that ``--again`` has had its turn with.
    """

    def plan() -> list[Run]:
        captures = captures_of(options)
        for capture in captures:
            check_truth(capture)
        return [
            _run(capture, variant, options, redone)
            for capture, variant in itertools.product(captures, study.variants)
        ]

    page = Page(
        options.results / f"ablation_{study.name}.md",
        study.title,
        partial(pages.render, study),
        pages.plot_of(study),
    )
    return run_experiment(module, words, options.results / f"{NAME}.json", [page], plan)


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the tables, write them after every run; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)
    chosen = list(STUDIES.values()) if options.study == ALL else [STUDIES[options.study]]
    redone: set[str] = set()
    codes = [
        run_study(
            study.shortened() if options.quick else study,
            options,
            NAME,
            [study.name if word == ALL else word for word in words],
            redone,
        )
        for study in chosen
    ]
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
