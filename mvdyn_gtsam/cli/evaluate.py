"""``mvdyn evaluate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

SUMMARY = "score a reconstruction against ground truth"
DESCRIPTION = """\
Score poses and depth against ground truth: one Sim(3) aligns all cameras together, so that a camera in
the wrong place counts; frames without a pose count as failures.
Needs the extra: pip install 'mvdyn_gtsam[eval]'"""
EPILOG = """\
example:
  mvdyn evaluate result --groundtruth clip/groundtruth --json scores.json --plots pictures"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("reconstruction", type=Path, metavar="OUT", help="folder of a reconstruction")
    parser.add_argument(
        "--groundtruth",
        type=Path,
        required=True,
        metavar="DIR",
        help="CAPTURE/groundtruth: TUM files, depth, masks",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure as JSON")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write plots of trajectories and errors")


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.evaluation import evaluate, format_table, load_groundtruth, save_plots
    from mvdyn_gtsam.reconstruction import Reconstruction
    from mvdyn_gtsam.reconstruction.files import write_json

    result = Reconstruction.load(arguments.reconstruction)
    groundtruth = load_groundtruth(arguments.groundtruth)
    scores = evaluate(result, groundtruth)
    Console(highlight=False).print(format_table(scores))
    if arguments.json is not None:
        write_json(arguments.json, scores.to_json())
        messages.print(f"figures: {arguments.json}")
    if arguments.plots is not None:
        for path in save_plots(result, groundtruth, arguments.plots):
            messages.print(f"plot: {path}")
    return 0
