"""The ablations of tracking: what each part is worth, measured by leaving it out or changing it.

    python -m experiments.ablations STUDY [CAPTURE...]

Every variant is tracked in a process of its own from a start made beforehand (kept in --work), and scored
over all cameras together: ATE, RTE, RRE, errors between cameras, seconds, peak memory, registered frames. A
variant that fails is a row that says so. Runs are kept in ablations.json as soon as they are done and shared
by the studies that have them in common; each study has its page, ablation_<study>.md, and a plot.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

from experiments.ablations.run import add_timeout, run_study
from experiments.ablations.studies import STUDIES
from experiments.records import experiment_parser, parse

NAME = "ablations"
ALL = "all"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, f"{__doc__}\n{_studies_help()}", captures=False)
    result.prog = f"python -m experiments.{NAME}"
    result.add_argument("study", choices=[*STUDIES, ALL], metavar="STUDY", help=f"one of the above, or {ALL}")
    result.add_argument("captures", nargs="*", type=Path, help="default: all of ../shared/data/rendered")
    add_timeout(result)
    return result


def _studies_help() -> str:
    blocks = []
    for study in STUDIES.values():
        text = f"{study.title}. {study.about} The paper: {study.stands_for}"
        blocks.append(f"{study.name}\n{textwrap.indent(textwrap.fill(text, 98), '    ')}")
    return "studies:\n\n" + "\n\n".join(blocks)


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
            f"ablation_{study.name}",
            redone,
        )
        for study in chosen
    ]
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
