"""``mvdyn demo``."""

from __future__ import annotations

import argparse
import importlib.util
import time
from pathlib import Path

from rich.console import Console

from mvdyn_gtsam.cli.reconstruct import STAGES, reconstruct_with_progress, summary
from mvdyn_gtsam.errors import EvaluationError, ResultError

SUMMARY = "reconstruct the bundled clip, score it, and say where to look"
DESCRIPTION = """\
Reconstruct the bundled clip (two hand-held cameras around a walking robot dog, 41 frames each), score it
against its exact ground truth and write pictures. Needs the extra: pip install 'mvdyn_gtsam[eval]'"""
EPILOG = """\
example:
  mvdyn demo --out somewhere"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder of the result (default: %(default)s)"
    )


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    for module in ("evo", "matplotlib"):  # before minutes of work, not after
        if importlib.util.find_spec(module) is None:
            raise EvaluationError(f"the demo needs {module} to score: pip install 'mvdyn_gtsam[eval]'")
    from mvdyn_gtsam.capture import load_capture
    from mvdyn_gtsam.cli.pictures import save_depth_sheet
    from mvdyn_gtsam.config import Config
    from mvdyn_gtsam.demo import demo_capture
    from mvdyn_gtsam.evaluation import evaluate, format_table, load_groundtruth, save_plots
    from mvdyn_gtsam.reconstruction.files import write_json

    folder = demo_capture()
    capture = load_capture(folder)
    _refuse_other_results(arguments.out, capture.name)
    started = time.monotonic()
    result = reconstruct_with_progress(
        capture,
        arguments.out,
        Config(),
        stage=STAGES[-1],
        resume=False,
        overwrite=True,
        messages=messages,
    )
    seconds = time.monotonic() - started
    groundtruth = load_groundtruth(folder / "groundtruth")
    scores = evaluate(result, groundtruth)
    pictures = arguments.out / "pictures"
    times = [round(index * (capture.frame_count - 1) / 4) for index in range(5)]
    plots = save_plots(result, groundtruth, pictures)
    sheet = save_depth_sheet(result, capture, times, pictures / "depth.png")
    write_json(pictures / "scores.json", scores.to_json())

    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(format_table(scores))
    for line in summary(result, seconds):
        console.print(line)
    console.print("look at:")
    for path in (*plots, sheet, pictures / "scores.json"):
        console.print(f"  {path}")
    return 0


def _refuse_other_results(out: Path, name: str) -> None:
    """The demo runs again over its own result, never over another's."""
    from mvdyn_gtsam.reconstruction import Reconstruction, is_reconstruction, refuse_unusable

    refuse_unusable(out, resume=False, overwrite=True)
    if is_reconstruction(out) and Reconstruction.load(out).name != name:
        raise ResultError(f"{out}: holds the reconstruction of another capture; choose another --out")
