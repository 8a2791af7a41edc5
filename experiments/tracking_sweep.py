"""Trajectory error, time and memory of tracking over values of its settings, each varied alone.

    python -m experiments.tracking_sweep --vary tracking.robust_px=0.2,0.5,1.0 [--vary ...] [CAPTURE...]

How the settings that name it as their source were chosen, and how to choose them for other scenes. Runs as
experiments.ablations does, from a start that is made once per capture, and shares its records; --name keeps
the pages of several sweeps apart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from experiments.ablations.run import add_timeout, run_study
from experiments.ablations.studies import FULL, Study, Variant
from experiments.records import ExperimentError, add_vary, experiment_parser, parse, varied_settings

NAME = "tracking_sweep"
QUICK = ("tracking.grid_points=192",)
"""A run that the ablation of the grid has, too."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__)
    add_vary(result)
    result.add_argument("--name", default=NAME, help="of the page (default: %(default)s)")
    add_timeout(result)
    return result


def study_of(vary: Sequence[str]) -> Study:
    """The defaults, then every value of every setting alone.

    Raises ExperimentError for a sweep not of the form key=v1,v2.
    """
    settings = varied_settings(vary)
    return Study(
        NAME,
        "Tracking over values of its settings",
        "no table of the paper.",
        "Each setting is varied alone, the others at their defaults or as --set says.",
        (FULL, *(Variant(setting, (setting,)) for setting in settings)),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, write it after every run; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)
    try:
        study = study_of(options.vary or (QUICK if options.quick else ()))
    except ExperimentError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return run_study(study, options, NAME, words, options.name, set())


if __name__ == "__main__":
    sys.exit(main())
