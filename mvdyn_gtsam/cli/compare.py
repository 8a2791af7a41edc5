"""``mvdyn compare``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from mvdyn_gtsam.errors import BaselineError, CaptureError

SUMMARY = "run COLMAP and GLOMAP on the same frames, one table"
DESCRIPTION = """\
Run several methods on the same frames of the same capture, one after the other, each in a process of its
own, and score them alike: poses registered, errors, seconds, peak memory. DIR gets compare.json, compare.md
and every method's result. Baselines get the known intrinsics and match frames +-10 within a camera and
+-5 between cameras. A method that fails is a row that says so."""
EPILOG = """\
example:
  mvdyn compare clip --methods ours,colmap,glomap --out comparison"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder of a capture")
    parser.add_argument(
        "--methods",
        default="ours,colmap,glomap",
        metavar="LIST",
        help="comma-separated (default: %(default)s)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the comparison")
    parser.add_argument(
        "--groundtruth", type=Path, metavar="DIR", help="default: CAPTURE/groundtruth, where there is one"
    )
    parser.add_argument("--truncate", action="store_true", help="cut all cameras to the shortest")
    parser.add_argument(
        "--share-matches",
        action="store_true",
        help="match once for both baselines; its time is counted for each",
    )
    parser.add_argument(
        "--exhaustive", action="store_true", help="baselines match every image with every other"
    )
    parser.add_argument("--masks", type=Path, metavar="DIR", help="baselines: motion masks, 255 where moving")
    parser.add_argument("--timeout", type=float, metavar="SECONDS", help="stop a method after this long")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting of our own method; repeatable",
    )


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.baselines import BaselineSettings, compare
    from mvdyn_gtsam.config import load_config

    load_config(None, arguments.overrides)  # a mistake here must not cost a run
    if not arguments.capture.exists():
        raise CaptureError(f"{arguments.capture}: there is no such file or folder; check the path")
    groundtruth = arguments.groundtruth
    if groundtruth is None and (arguments.capture / "groundtruth").is_dir():
        groundtruth = arguments.capture / "groundtruth"
    if groundtruth is None:
        messages.print("no ground truth: only registration, time and memory are compared")
    comparison = compare(
        arguments.capture,
        groundtruth,
        [method.strip() for method in arguments.methods.split(",") if method.strip()],
        arguments.out,
        settings=BaselineSettings(
            pairing="exhaustive" if arguments.exhaustive else "window", masks=arguments.masks
        ),
        share_matches=arguments.share_matches,
        truncate=arguments.truncate,
        timeout_s=arguments.timeout,
        our_arguments=[word for override in arguments.overrides for word in ("--set", override)],
    )
    Console(highlight=False).print(comparison.to_table())
    messages.print(f"table: {arguments.out / 'compare.md'}")
    failed = {result.method: result.problem for result in comparison.results if result.problem is not None}
    if "ours" in failed or len(failed) == len(comparison.results):
        method = "ours" if "ours" in failed else next(iter(failed))
        raise BaselineError(f"{method} failed: {failed[method]}; see {arguments.out / f'{method}.log'}")
    return 0
