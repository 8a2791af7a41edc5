"""``mvdyn evaluate``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from mvdyn_gtsam.errors import CaptureError, ResultError

if TYPE_CHECKING:
    from mvdyn_gtsam.evaluation import ReconstructionLike

SUMMARY = "score a reconstruction, or any method's result, against ground truth"
DESCRIPTION = """\
Score poses and depth against ground truth: one Sim(3) aligns all cameras together, so that a camera in
the wrong place counts; frames without a pose count as failures.
Needs the extra: pip install 'mvdyn_gtsam[eval]'

RESULT is a reconstruction of mvdyn or the result of any other method: a folder of <camera>.txt TUM files, a
COLMAP model, a transforms.json or a .npz, with depth/<camera>/<frame>.npy, .npz, .png or .tif beside it.
The conventions are those of `mvdyn compare --help`. Another method's result needs the capture it was made
from, for names, frame rate and size of its cameras: the folder that holds DIR, or --capture."""
EPILOG = """\
examples:
  mvdyn evaluate result --groundtruth clip/groundtruth --json scores.json --plots pictures
  mvdyn evaluate runs/vggt/poses.npz --groundtruth clip/groundtruth"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument(
        "reconstruction", type=Path, metavar="RESULT", help="folder or file of a reconstruction"
    )
    parser.add_argument(
        "--groundtruth",
        type=Path,
        required=True,
        metavar="DIR",
        help="CAPTURE/groundtruth: TUM files, depth, masks",
    )
    parser.add_argument(
        "--capture",
        type=Path,
        metavar="CAPTURE",
        help="of another method's result (default: the folder that holds DIR)",
    )
    parser.add_argument("--truncate", action="store_true", help="cut all cameras of CAPTURE to the shortest")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure as JSON")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write plots of trajectories and errors")


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.evaluation import evaluate, format_table, load_groundtruth, save_plots
    from mvdyn_gtsam.reconstruction.files import write_json

    groundtruth = load_groundtruth(arguments.groundtruth)
    result = read_result(arguments.reconstruction, arguments)
    scores = evaluate(result, groundtruth)
    Console(highlight=False).print(format_table(scores))
    if arguments.json is not None:
        write_json(arguments.json, scores.to_json())
        messages.print(f"figures: {arguments.json}")
    if arguments.plots is not None:
        for path in save_plots(result, groundtruth, arguments.plots):
            messages.print(f"plot: {path}")
    return 0


def read_result(path: Path, arguments: argparse.Namespace) -> ReconstructionLike:
    """Our reconstruction, which knows its capture, or another method's. Raises ResultError."""
    from mvdyn_gtsam.capture import open_capture
    from mvdyn_gtsam.reconstruction import Reconstruction, is_reconstruction
    from mvdyn_gtsam.reconstruction.imports import load_result

    if not path.exists():
        raise ResultError(f"{path}: no such file or folder; make a reconstruction with: mvdyn reconstruct")
    if path.is_dir() and is_reconstruction(path):
        return Reconstruction.load(path)
    folder = arguments.capture or arguments.groundtruth.resolve().parent
    try:
        capture = open_capture(folder, truncate=arguments.truncate)
    except CaptureError as error:
        if arguments.capture is not None:
            raise
        raise ResultError(
            f"{path}: is no reconstruction of mvdyn, and to read it as another method's result its capture is"
            f" needed: name it with --capture ({error})"
        ) from error
    return load_result(path, capture)
