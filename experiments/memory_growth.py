"""Peak memory and time of `mvdyn reconstruct` (by default `--stage tracking`) against the video's length.

A long capture is made by playing a short one forwards and backwards (its images are written once and linked),
cut to two cameras. Each length runs in a process of its own. Its peak resident memory is set against that of
a process that imports the same libraries and does nothing, and the growth between lengths against the growth
of the result on disk. Goal: at most 1.5 GB above the libraries, growing no more than the result.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from experiments.records import (
    RENDERED,
    ExperimentError,
    Page,
    Run,
    add_common_arguments,
    figure,
    key_of,
    run_experiment,
    table,
)
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import load_config, to_dict

NAME = "memory_growth"
GOAL_MB = 1500.0

LIBRARIES = (
    "import mvdyn_gtsam.cli.main, mvdyn_gtsam.cli.reconstruct, mvdyn_gtsam.cli.progress, mvdyn_gtsam.pipeline"
)
"""What the run itself loads; COLMAP runs in processes of its own and is left out on purpose."""


def forwards_and_backwards(available: int, length: int) -> list[int]:
    """Frame numbers 0, 1, ..., available-1, available-2, ..., 1, 0, 1, ... of the given length."""
    if available < 2:
        raise ExperimentError(f"{available} frames cannot be played forwards and backwards")
    period = 2 * (available - 1)
    return [min(k % period, period - k % period) for k in range(length)]


def write_long_capture(capture: Capture, cameras: int, length: int, out: Path) -> None:
    """Write ``capture``'s first ``cameras`` cameras played to ``length`` frames to the new folder ``out``."""
    from mvdyn_gtsam.capture import write_capture

    if len(capture.cameras) < cameras:
        raise ExperimentError(f"{capture.name}: has {len(capture.cameras)} cameras, not {cameras}")
    write_capture(replace(capture, cameras=capture.cameras[:cameras], streams=capture.streams[:cameras]), out)
    order = forwards_and_backwards(capture.frame_count, length)
    for camera in capture.cameras[:cameras]:
        folder = out / camera.name
        for number in range(capture.frame_count, length):
            os.link(folder / f"{order[number]:06d}.png", folder / f"{number:06d}.png")
        for number in range(length, capture.frame_count):
            (folder / f"{number:06d}.png").unlink()
    content = json.loads((out / "capture.json").read_text())
    content["num_frames"] = length
    (out / "capture.json").write_text(json.dumps(content, indent=1) + "\n")


def folder_mb(folder: Path) -> float:
    """Size in MiB of all files below ``folder``."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20


def measure_libraries() -> float:
    """Peak resident memory in MiB of the interpreter with everything imported. Raises ExperimentError."""
    from mvdyn_gtsam.baselines.process import run_measured

    with tempfile.TemporaryDirectory(prefix="mvdyn-libraries-") as folder:
        usage = run_measured([sys.executable, "-c", LIBRARIES], Path(folder) / "log")
    if usage.problem is not None or usage.peak_mb is None:
        raise ExperimentError(f"importing the libraries failed: {usage.problem}")
    return usage.peak_mb


def measure(
    source: Path, cameras: int, length: int, stage: str, overrides: Sequence[str], scratch: Path | None
) -> dict[str, Any]:
    """Reconstruct a capture of ``length`` frames and say what it took. Raises ExperimentError if it fails."""
    from mvdyn_gtsam.baselines.comparison import our_command
    from mvdyn_gtsam.baselines.process import run_measured
    from mvdyn_gtsam.capture import load_capture

    arguments = [word for override in overrides for word in ("--set", override)]
    with tempfile.TemporaryDirectory(prefix="mvdyn-memory-", dir=scratch) as folder:
        capture, result, log = (Path(folder) / name for name in ("capture", "result", "log"))
        write_long_capture(load_capture(source), cameras, length, capture)
        usage = run_measured(our_command(capture, result, stage, arguments), log)
        if usage.problem is not None:
            raise ExperimentError(f"{source.name}, {length} frames: {usage.problem}")
        return {
            "capture": source.resolve().name,
            "cameras": cameras,
            "frames": length,
            "stage": stage,
            "seconds": usage.seconds,
            "cpu_seconds": usage.cpu_seconds,
            "peak_mb": usage.peak_mb,
            "libraries_mb": measure_libraries(),
            "result_mb": folder_mb(result),
        }


def rows(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """One row per length; growth is against the row above."""
    result = []
    for before, entry in zip([None, *entries[:-1]], entries, strict=True):
        grown = None if before is None else entry["peak_mb"] - before["peak_mb"]
        result_grown = None if before is None else entry["result_mb"] - before["result_mb"]
        added = None if before is None else (entry["seconds"] - before["seconds"]) / max(
            1, entry["cameras"] * (entry["frames"] - before["frames"])
        )  # fmt: skip
        result.append(
            [
                f"{entry['cameras']} x {entry['frames']}",
                figure(entry["peak_mb"], 0),
                figure(entry["peak_mb"] - entry["libraries_mb"], 0),
                figure(grown, 0),
                figure(entry["result_mb"], 0),
                figure(result_grown, 0),
                figure(entry["seconds"], 0),
                figure(entry["seconds"] / (entry["cameras"] * entry["frames"]), 3),
                figure(added, 3),
            ]
        )
    return result


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """Table and goal as Markdown."""
    columns = (
        *("frames", "peak MB", "above libraries MB", "growth MB", "result MB", "growth MB", "s"),
        *("s per image", "s per added image"),
    )
    names = ", ".join(dict.fromkeys(entry["capture"] for entry in entries))
    libraries = figure(entries[-1]["libraries_mb"], 0) if entries else "-"
    return (
        f"{names} played forwards and backwards; interpreter and libraries alone take {libraries} MB. Goal:"
        f" at most {GOAL_MB:.0f} MB above them, growing no more than the result. MB are MiB; commit "
        f"{', '.join(sorted({str(entry['commit']) for entry in entries}))}.\n\n"
        + table(columns, rows(entries))
    )


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("capture", nargs="?", type=Path, default=RENDERED / "robodog_overlap",
                        help="short capture to play (default: rendered/robodog_overlap)")  # fmt: skip
    result.add_argument("--frames", nargs="+", type=int, default=[150, 300],
                        help="lengths per camera (default: 150 300)")  # fmt: skip
    result.add_argument("--cameras", type=int, default=2, help="default: %(default)s")
    result.add_argument("--stage", choices=("tracking", "refinement"), default="tracking",
                        help="last stage to run (default: %(default)s)")  # fmt: skip
    result.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
                        help="change a setting")  # fmt: skip
    result.add_argument("--scratch", type=Path, metavar="DIR", help="for the long capture and its result")
    result.add_argument("--name", default=NAME, help="of the Markdown file (default: %(default)s)")
    add_common_arguments(result)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, write it after every length."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    command_line = parser()
    options = command_line.parse_args(words)
    if min(options.frames) < 2 or options.cameras < 1:
        command_line.error("--frames must be at least 2 and --cameras at least 1")
    name, cameras, stage = options.capture.resolve().name, options.cameras, options.stage

    def plan() -> list[Run]:
        settings = to_dict(load_config(None, options.overrides))
        return [
            Run(
                label=f"{name}, {length} frames",
                key=key_of(capture=name, cameras=cameras, frames=length, stage=stage, settings=settings),
                measure=partial(
                    measure, options.capture, cameras, length, stage, options.overrides, options.scratch
                ),
                again=options.again,
            )
            for length in sorted(set(options.frames))
        ]

    pages = [Page(options.results / f"{options.name}.md", "Memory and time against length", render)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
