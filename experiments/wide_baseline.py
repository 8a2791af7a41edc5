"""How well the wide-baseline start alone places the cameras, against ground truth.

The start's frames of each group of cameras are brought into metres by one Sim(3) over the group. Then every
frame of a camera is compared with the other camera's frame nearest in time: the error of their relative
rotation in degrees, and of their relative translation in metres and in per cent of the scene's median true
depth. Goal: below 0.5 degrees and 3 %. Cameras that the start leaves apart are listed as such.

--sweep KEY=V1,V2,... repeats everything with one setting changed at a time. --joint-sfm adds what the usual
way gives: one joint reconstruction by COLMAP of a few frames per camera, every image matched with all others.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from experiments.plots import bars
from experiments.records import (
    ExperimentError,
    Page,
    Run,
    captures_of,
    experiment_parser,
    figure,
    finite,
    key_of,
    parse,
    run_experiment,
    table,
)
from experiments.start_errors import Frames, score_start, true_frames
from mvdyn_gtsam.capture.model import Capture, FrameStream
from mvdyn_gtsam.config import Config, load_config, to_dict
from mvdyn_gtsam.errors import BaselineError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mvdyn_gtsam.frontend.start.model import Start

Placed = tuple[list[list[str]], Mapping[str, Frames], float]
"""Groups of cameras, their placed frames, and the seconds it took."""

NAME = "wide_baseline"
JOINT_SFM = "joint SfM"
GOAL_DEG = 0.5
GOAL_SHARE = 0.03


def run_classical(capture: Capture, config: Config) -> Placed:
    """Groups, placed frames and seconds of the classical start."""
    from mvdyn_gtsam.frontend.dense_flow import DisFlow
    from mvdyn_gtsam.frontend.start.dense_map import testimony_flow
    from mvdyn_gtsam.frontend.start.wide_baseline import ClassicalInitializer

    began = time.perf_counter()
    flow = DisFlow(testimony_flow(config.frontend.flow))
    start = ClassicalInitializer(flow, config.frontend.wide_baseline)(capture)
    return _placed(capture, start, time.perf_counter() - began)


def read_kept(capture: Capture, work: Path) -> Placed:
    """The start that experiments.accuracy left in ``work``. Raises TrackingError where it has none."""
    from mvdyn_gtsam.errors import TrackingError
    from mvdyn_gtsam.frontend.start.model import start_from_arrays
    from mvdyn_gtsam.reconstruction import Reconstruction

    folder = work / capture.name / "ours" / "ours"
    result = Reconstruction.load(folder)
    seconds = {stage["name"]: stage["seconds"] for stage in result.manifest["stages"]}
    if "start" not in seconds:
        raise TrackingError(f"{folder}: holds no finished start")
    return _placed(capture, start_from_arrays(result.arrays("start")), seconds["start"])


def _placed(capture: Capture, start: Start, seconds: float) -> Placed:
    names = [camera.name for camera in capture.cameras]
    frames: dict[str, Frames] = {
        name: {frame.time: frame.wTc for frame in own} for name, own in zip(names, start.frames, strict=True)
    }
    return [[names[camera] for camera in group] for group in start.groups], frames, seconds


@dataclass(frozen=True)
class ChosenFrames:
    """Some frames of another stream, numbered from zero."""

    stream: FrameStream
    chosen: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.chosen)

    def read(self, time: int) -> npt.NDArray[np.uint8]:
        """Frame ``chosen[time]`` of the stream, ``(H, W, 3) uint8`` RGB."""
        return self.stream.read(self.chosen[time])


def run_joint_sfm(capture: Capture, count: int) -> Placed:
    """The same from COLMAP on ``count`` frames per camera spread over the video. Raises BaselineError."""
    from mvdyn_gtsam.baselines import BaselineSettings, run_baseline
    from mvdyn_gtsam.capture import write_capture

    chosen = tuple(int(t) for t in np.unique(np.linspace(0, capture.frame_count - 1, count).round()))
    reduced = replace(capture, streams=tuple(ChosenFrames(stream, chosen) for stream in capture.streams))
    with tempfile.TemporaryDirectory(prefix="mvdyn-joint-sfm-") as folder:
        write_capture(reduced, Path(folder) / "capture")
        result = run_baseline(
            Path(folder) / "capture",
            "colmap",
            Path(folder) / "result",
            settings=BaselineSettings(pairing="exhaustive"),
        )
    frames: dict[str, Frames] = {
        camera: {chosen[row]: pose for row, pose in enumerate(wTc) if np.isfinite(pose).all()}
        for camera, wTc in result.trajectories.items()
    }
    placed = [camera for camera, own in frames.items() if own]
    return [placed, *([camera] for camera, own in frames.items() if not own)], frames, result.seconds


@dataclass(frozen=True)
class Variant:
    """One way to start: settings of ours, or the joint SfM."""

    name: str
    config: Config
    joint_frames: int = 0
    """Above zero: joint SfM on so many frames per camera."""

    def key(self, capture: Path) -> str:
        settings = {"joint": self.joint_frames} if self.joint_frames else to_dict(self.config)["frontend"]
        return key_of(capture=capture.resolve().name, settings=settings)


def variants(overrides: Sequence[str], sweeps: Sequence[str], joint_frames: int) -> list[Variant]:
    """The default with ``overrides``, then each value of each sweep alone, then the joint SfM.

    Raises ConfigError for unknown settings, ExperimentError for a sweep not of the form key=v1,v2.
    """
    base = load_config(None, overrides)
    result = [Variant(" ".join(overrides) or "default", base)]
    for sweep in sweeps:
        key, separator, values = sweep.partition("=")
        if not separator or not all(value.strip() for value in values.split(",")):
            raise ExperimentError(f"--sweep {sweep}: write it as key=value,value,...")
        result += [
            Variant(f"{key.rsplit('.', 1)[-1]}={value}", load_config(None, [*overrides, f"{key}={value}"]))
            for value in (word.strip() for word in values.split(","))
        ]
    if joint_frames:
        result.append(Variant(f"{JOINT_SFM}, {joint_frames} frames", base, joint_frames))
    return result


def measure(folder: Path, variant: Variant, work: Path | None = None) -> dict[str, Any]:
    """One run, or the start kept in ``work``, as an entry of the records.

    A start that fails is an entry that says so.
    """
    from mvdyn_gtsam.capture import load_capture
    from mvdyn_gtsam.errors import TrackingError
    from mvdyn_gtsam.evaluation import load_groundtruth
    from mvdyn_gtsam.evaluation.depth import median_true_depth

    capture, groundtruth = load_capture(folder), load_groundtruth(folder / "groundtruth")
    truth = true_frames(capture, groundtruth)
    seconds: float | None = None
    try:
        if variant.joint_frames:
            groups, frames, seconds = run_joint_sfm(capture, variant.joint_frames)
        elif work is not None:
            groups, frames, seconds = read_kept(capture, work)
        else:
            groups, frames, seconds = run_classical(capture, variant.config)
        score = score_start(groups, frames, truth)
    except (TrackingError, BaselineError) as error:
        names = [camera.name for camera in capture.cameras]
        score = replace(score_start([[name] for name in names], {}, truth), problem=str(error))
    return {
        "capture": folder.resolve().name,
        "variant": variant.name,
        "seconds": seconds,
        "median_depth_m": finite(median_true_depth(groundtruth)),
        **asdict(score),
    }


def worst(key: str, entry: Mapping[str, Any]) -> float | None:
    """That error of the worst pair of cameras; None where no pair was placed."""
    return max((float(pair[key]) for pair in entry["pairs"]), default=None)


def summary_rows(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """One row per run: the worst pair of cameras of each."""
    rows = []
    for entry in entries:
        depth = entry["median_depth_m"]
        rotation, translation = worst("rotation_deg", entry), worst("translation_m", entry)
        rows.append(
            [
                entry["capture"],
                entry["variant"],
                " / ".join("+".join(group) for group in entry["groups"]) or "-",
                " ".join(str(count) for count in entry["frames"].values()),
                figure(rotation, 2),
                figure(translation, 0, 1000.0),
                figure(_share(translation, depth), 2, 100.0),
                _verdict(entry),
                figure(entry["seconds"], 0),
            ]
        )
    return rows


def pair_rows(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """One row per pair of cameras of each run."""
    rows = []
    for entry in entries:
        depth = entry["median_depth_m"]
        for pair in entry["pairs"]:
            rows.append(
                [
                    entry["capture"],
                    entry["variant"],
                    " - ".join(pair["cameras"]),
                    str(pair["frame_pairs"]),
                    f"{pair['rotation_deg']:.2f} ({pair['worst_rotation_deg']:.2f})",
                    f"{1000 * pair['translation_m']:.0f} ({1000 * pair['worst_translation_m']:.0f})",
                    figure(_share(pair["translation_m"], depth), 2, 100.0),
                ]
            )
        rows += [
            [entry["capture"], entry["variant"], " - ".join(pair), "0", "apart", "apart", "apart"]
            for pair in entry["apart"]
        ]
    return rows


def _share(translation: float | None, depth: float | None) -> float | None:
    return None if translation is None or not depth else translation / depth


def _verdict(entry: Mapping[str, Any]) -> str:
    """Whether every pair that the start connected meets the goal."""
    if entry["problem"] is not None:
        return "failed"
    if not entry["pairs"]:
        return "apart"
    depth = entry["median_depth_m"]
    shares = [_share(pair["translation_m"], depth) for pair in entry["pairs"]]
    met = all(pair["rotation_deg"] < GOAL_DEG for pair in entry["pairs"]) and all(
        share is None or share < GOAL_SHARE for share in shares
    )
    return ("yes" if met else "no") + (", some apart" if entry["apart"] else "")


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """Summary, pairs and problems as Markdown."""
    columns = ("capture", "start", "groups", "frames", "worst pair deg", "worst pair mm", "% of depth")
    parts = [
        f"Goal: every pair below {GOAL_DEG} degrees and {100 * GOAL_SHARE:.0f} % of the median true depth."
        f" Commit {', '.join(sorted({str(entry['commit']) for entry in entries}))}.\n",
        table((*columns, "goal met", "s"), summary_rows(entries), text_columns=3),
        "Per pair, RMSE over its frame pairs (worst frame pair in brackets):\n",
        table(
            ("capture", "start", "pair", "frame pairs", "deg", "mm", "% of depth"),
            pair_rows(entries),
            text_columns=3,
        ),
    ]
    problems = [f"* {e['capture']}, {e['variant']}: {e['problem']}\n" for e in entries if e["problem"]]
    return "\n".join([*parts, *(["".join(problems)] if problems else [])])


def draw(picture: Figure, entries: Sequence[Mapping[str, Any]]) -> None:
    """Errors of the worst pair of cameras of every start; a cross where none was placed."""
    left, right = picture.subplots(1, 2)
    bars(left, entries, "capture", "variant", partial(worst, "rotation_deg"), "worst pair (deg)")
    bars(right, entries, "capture", "variant", partial(worst, "translation_m"), "worst pair (m)")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__)
    result.add_argument("--sweep", dest="sweeps", action="append", default=[], metavar="KEY=V1,V2,...",
                        help="repeat with each value; several sweeps: one at a time")  # fmt: skip
    result.add_argument("--kept", type=Path, metavar="WORK",
                        help="read the starts that experiments.accuracy left here")  # fmt: skip
    result.add_argument("--joint-sfm", action="store_true", help="also start from joint SfM by COLMAP")
    result.add_argument("--joint-frames", type=int, default=8, metavar="N",
                        help="frames per camera for --joint-sfm (default: %(default)s)")  # fmt: skip
    result.add_argument("--name", help="of the Markdown file (default: wide_baseline, or after the sweep)")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print the tables, write them."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)

    def plan() -> list[Run]:
        captures = captures_of(options)
        wanted = variants(options.overrides, options.sweeps, options.joint_frames if options.joint_sfm else 0)
        return [
            Run(
                label=f"{folder.name}, {variant.name}",
                key=variant.key(folder),
                measure=partial(measure, folder, variant, options.kept),
                again=options.again,
                # A value of a sweep that equals the default was measured under that name.
                shown_as={"variant": variant.name},
            )
            for folder, variant in itertools.product(captures, wanted)
        ]

    swept = "_".join(sweep.partition("=")[0].rsplit(".", 1)[-1] for sweep in options.sweeps)
    path = options.results / f"{options.name or '_'.join(filter(None, [NAME, swept]))}.md"
    pages = [Page(path, "The wide-baseline start alone", render, draw)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
