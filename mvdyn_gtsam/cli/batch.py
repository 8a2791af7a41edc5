"""``mvdyn batch``."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from rich.console import Console

from mvdyn_gtsam.cli.arguments import add_config_arguments, add_depth_model_argument, read_settings
from mvdyn_gtsam.cli.progress import ConsoleProgress
from mvdyn_gtsam.cli.reconstruct import STAGES

SUMMARY = "reconstruct every capture of a folder, several at once"
DESCRIPTION = """\
Reconstruct every capture below FOLDER (any layout that reconstruct takes, up to four levels down), several at
once on Dask distributed: on worker processes of this machine, or on those of a running scheduler. OUT gets
one result folder and one log per clip, and batch.json and batch.md with a table of all.
A clip that fails stops no other. The same command again keeps what is finished, goes on with what was
interrupted, and tries again what failed; remove OUT/<clip> to have it made anew. A clip that was begun keeps
its settings, as with reconstruct --resume: it fails where --set or --config ask for others than a finished
stage was made with.
Needs the extra: pip install 'mvdyn_gtsam[batch]', and 'mvdyn_gtsam[eval]' to score what has ground truth."""
EPILOG = """\
examples:
  mvdyn batch clips --out results
  mvdyn batch MultiCamVideo-Dataset/val --out results --workers 8 --timeout 3600
  mvdyn batch clips --out results --skip-failed             # the rest, without what failed before
  mvdyn batch clips --out results --depth-prior moge-2-vits-normal.onnx   # one network for all clips
  mvdyn batch clips --out results --scheduler tcp://10.0.0.1:8786   # FOLDER and OUT seen by all machines

Workers of a scheduler (dask worker ADDRESS --nthreads 2) run one clip per thread; started with --no-nanny
they are not replaced when they die. How many may die under one clip is the scheduler's own setting there
(distributed.scheduler.allowed-failures)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of captures")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT", help="folder of the results")
    parser.add_argument(
        "--stage", choices=STAGES, default=STAGES[-1], help="last stage to run (default: %(default)s)"
    )
    parser.add_argument(
        "--depth-prior",
        type=Path,
        metavar="FOLDER|MODEL.onnx",
        help="z-depth of single images as for reconstruct: FOLDER/<clip>/<camera>/000012.npy, <clip> as its"
        " result is named; clips without a folder have none. Or one network for all clips",
    )
    add_depth_model_argument(parser)
    add_config_arguments(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=_count, metavar="N", help="clips at once here (default: one per processor)"
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="a running Dask scheduler, in place of here")
    parser.add_argument(
        "--threads-per-worker",
        type=_count,
        metavar="N",
        help="threads of each clip (default: the processors of its machine, shared out)",
    )
    parser.add_argument(
        "--retries",
        type=int,
        default=3,
        choices=range(0, 101),
        metavar="K",
        help="run a clip again this often when its process or worker is killed (default: %(default)s)",
    )
    parser.add_argument("--timeout", type=_seconds, metavar="SECONDS", help="a clip fails after this long")
    parser.add_argument(
        "--evaluate",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="score clips that have ground truth (default: yes)",
    )
    parser.add_argument("--skip-failed", action="store_true", help="do not try again what failed before")


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    asked = read_settings(arguments)
    from mvdyn_gtsam.batch import BatchError, BatchSettings, Row, run_batch

    def tell(row: Row) -> None:
        seconds = "" if row.seconds is None else f", {row.seconds:.0f} s"
        messages.print(f"{row.clip}: {row.state}{seconds}{f': {row.problem}' if row.problem else ''}")

    settings = BatchSettings(
        stage=arguments.stage,
        workers=arguments.workers,
        threads=arguments.threads_per_worker,
        scheduler=arguments.scheduler,
        retries=arguments.retries,
        timeout_s=arguments.timeout,
        evaluate=arguments.evaluate,
        skip_failed=arguments.skip_failed,
        depth_priors=arguments.depth_prior,
        depth_model=arguments.depth_model,
    )
    try:
        with ConsoleProgress(messages) as progress:
            report = run_batch(
                arguments.folder, arguments.out, asked, settings, progress=progress, on_row=tell
            )
    except KeyboardInterrupt:
        messages.print("stopped; what is finished is kept, and the same command goes on")
        raise
    Console(highlight=False).print(report.to_table())
    messages.print(f"table: {arguments.out / 'batch.md'}")
    if report.failed:
        raise BatchError(
            f"{len(report.failed)} of {len(report.rows)} clips failed; see {arguments.out / 'batch.md'};"
            " the same command tries them again, --skip-failed does not"
        )
    return 0


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return seconds
