"""How well the start finds focal lengths that it is not told, and what decides between the minima it meets.

Every camera is given the same first guess, FIRST_FOCAL times its longer side, and the centre of its image as
principal point. Per camera: the focal length that its own video speaks for, the one that the joint adjustment
of the start ends with, and where bundle adjustment ends from each guess and how many sightings fit there. A
minimum is wrong where it is more than 3 % off the truth; wrong / right compares the best wrong one's fitting
sightings with the right one's. Beside it stands how much of the flow their maps explain, by which the start
chooses.

--crop S1 S2 ... repeats everything on centre crops of S times the width and height, the focal length in px as
it was: a narrower field of view. --track reconstructs with the found and with the given intrinsics as well,
up to the poses of every frame.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from experiments.accuracy import notes
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
from mvdyn_gtsam.capture.focal import first_intrinsics
from mvdyn_gtsam.capture.model import FIRST_FOCAL, Camera, Capture, FrameStream
from mvdyn_gtsam.config import Config, load_config, to_dict
from mvdyn_gtsam.errors import MvdynError, TrackingError
from mvdyn_gtsam.evaluation import GroundTruth
from mvdyn_gtsam.frontend.start.focal import FOCAL_GUESSES, LEAST_FITTING, MOST_DEVIATION, FocalMinima

if TYPE_CHECKING:
    from mvdyn_gtsam.frontend.start.model import Start

NAME = "focal"
WRONG_SHARE = 0.03
"""Error from which on a minimum is another than the true one, as a share of the focal length."""
GUESSES = (FIRST_FOCAL, *FOCAL_GUESSES)
"""Focal lengths that a camera is tried with, in lengths of its longer side."""
FOUND, GIVEN = "found", "given"
CENTRE = "centre"


@dataclass(frozen=True)
class CroppedStream:
    """The part of another stream's frames that begins at ``(left, top)`` px."""

    stream: FrameStream
    left: int
    top: int
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.stream)

    def read(self, time: int) -> npt.NDArray[np.uint8]:
        """Frame ``time``, ``(height, width, 3) uint8`` RGB."""
        image = self.stream.read(time)
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        return np.ascontiguousarray(part)


@dataclass(frozen=True)
class TruePoses(GroundTruth):
    """Trajectories alone: true depth is that of the whole images, not of cropped ones."""

    def depth_frames(self, camera: str) -> list[int]:
        return []


def cropped(capture: Capture, share: float) -> Capture:
    """The middle of every image, ``share`` of its width and height, with intrinsics to match."""
    if share == 1.0:
        return capture
    cameras, streams = [], []
    for camera, stream in zip(capture.cameras, capture.streams, strict=True):
        width, height = round(share * camera.width), round(share * camera.height)
        left, top = (camera.width - width) // 2, (camera.height - height) // 2
        cx, cy = camera.cx - left, camera.cy - top
        cameras.append(replace(camera, width=width, height=height, cx=cx, cy=cy))
        streams.append(CroppedStream(stream, left, top, width, height))
    return replace(capture, cameras=tuple(cameras), streams=tuple(streams))


def guessed(capture: Capture, principal_point: str) -> Capture:
    """The capture as of cameras that nothing is known about, or ``GIVEN`` their principal points."""
    from mvdyn_gtsam.capture import with_unknown_focal

    cameras = []
    for camera in capture.cameras:
        fx, fy, cx, cy = first_intrinsics(camera.width, camera.height)
        if principal_point == GIVEN:
            cx, cy = camera.cx, camera.cy
        cameras.append(replace(camera, fx=fx, fy=fy, cx=cx, cy=cy))
    return with_unknown_focal(replace(capture, cameras=tuple(cameras)))


def minima_of(capture: Capture, config: Config, index: int) -> tuple[FocalMinima, dict[float, float]]:
    """What the guesses of one camera lead to, from the same frames and matches as in the start, and of the
    focal lengths that differ the share of the flow that their maps explain."""
    from mvdyn_gtsam.frontend.dense_flow import DisFlow
    from mvdyn_gtsam.frontend.start.camera_maps import map_of, seen_frames
    from mvdyn_gtsam.frontend.start.dense_map import testimony_flow
    from mvdyn_gtsam.frontend.start.focal import focal_minima
    from mvdyn_gtsam.frontend.start.single_camera import usable_pairs

    start, camera = config.frontend.wide_baseline, capture.cameras[index]
    seen = seen_frames(capture, index, start)
    minima = focal_minima(camera, seen.features, usable_pairs(seen.pairs))
    flow = DisFlow(testimony_flow(config.frontend.flow))
    explained = {
        focal: map_of(capture, index, replace(camera, fx=focal, fy=focal), seen, flow, start).rigidity
        for focal in minima.distinct()
    }
    return minima, explained


def started(capture: Capture, config: Config) -> tuple[Start, float]:
    """The classical start, and the seconds it took. Raises TrackingError."""
    from mvdyn_gtsam.frontend.dense_flow import DisFlow
    from mvdyn_gtsam.frontend.start.dense_map import testimony_flow
    from mvdyn_gtsam.frontend.start.wide_baseline import ClassicalInitializer

    began = time.perf_counter()
    flow = DisFlow(testimony_flow(config.frontend.flow))
    start = ClassicalInitializer(flow, config.frontend.wide_baseline)(capture)
    return start, time.perf_counter() - began


def tracked(
    capture: Capture, config: Config, out: Path, groundtruth: GroundTruth
) -> tuple[Start | None, float | None, dict[str, Any]]:
    """The start of a reconstruction up to tracking, its seconds, and errors of the poses; a failure says so.

    What ``out`` held is removed first.
    """
    from mvdyn_gtsam.evaluation import evaluate
    from mvdyn_gtsam.frontend.start.model import start_from_arrays
    from mvdyn_gtsam.pipeline import reconstruct

    shutil.rmtree(out, ignore_errors=True)
    start, seconds = None, None
    try:
        result = reconstruct(capture, out, config, stage="tracking")
        start = start_from_arrays(result.arrays("start"))
        seconds = {stage["name"]: float(stage["seconds"]) for stage in result.manifest["stages"]}["start"]
        scores = evaluate(result, groundtruth)
    except MvdynError as error:
        return start, seconds, {"problem": str(error), "registered": 0.0, "scores": None}
    return start, seconds, {"problem": None, "registered": scores.registered, "scores": scores.to_json()}


def measure(folder: Path, crop: float, options: argparse.Namespace) -> dict[str, Any]:
    """One capture as an entry of the records; a start that is refused is an entry that says why."""
    from mvdyn_gtsam.capture import load_capture
    from mvdyn_gtsam.evaluation import load_groundtruth
    from mvdyn_gtsam.frontend.threads import flow_threads

    config = load_config(None, options.overrides)
    capture = cropped(load_capture(folder), crop)
    unknown = guessed(capture, options.principal_point)
    with ThreadPoolExecutor(flow_threads()) as pool:
        own = partial(minima_of, unknown, config)
        minima = list(pool.map(own, range(len(unknown.cameras))))
    start: Start | None = None
    seconds: float | None = None
    problem: str | None = None
    tracking: dict[str, Any] | None = None
    if options.track:
        truth = load_groundtruth(folder / "groundtruth")
        truth = TruePoses(truth.folder, truth.trajectories, truth.depth_scale)
        work = options.work / f"{folder.resolve().name}_{options.principal_point}_{crop:g}"
        start, seconds, found = tracked(unknown, config, work / FOUND, truth)
        tracking = {FOUND: found, GIVEN: tracked(capture, config, work / GIVEN, truth)[2]}
        problem = found["problem"]
    else:
        try:
            start, seconds = started(unknown, config)
        except TrackingError as error:
            problem = str(error)
    cameras = [
        camera_entry(camera, *own, start, index)
        for index, (camera, own) in enumerate(zip(capture.cameras, minima, strict=True))
    ]
    return {
        "capture": folder.resolve().name,
        "crop": crop,
        "principal_point": options.principal_point,
        "start_seconds": seconds,
        "problem": problem,
        "cameras": cameras,
        "tracking": tracking,
    }


def camera_entry(
    camera: Camera, minima: FocalMinima, explained: Mapping[float, float], start: Start | None, index: int
) -> dict[str, Any]:
    """What is known and what was found of camera number ``index``; focal lengths in px."""
    found = None if start is None else start.intrinsics[index]
    return {
        "camera": camera.name,
        "width": camera.width,
        "height": camera.height,
        "true_px": 0.5 * (camera.fx + camera.fy),
        "frames": None if start is None else len(start.frames[index]),
        "alone_px": max(explained, key=lambda focal: explained[focal]) if explained else None,
        "found_px": None if found is None else found.focal,
        "centre_off_px": None
        if found is None
        else float(np.hypot(found.cx - camera.cx, found.cy - camera.cy)),
        "deviation_px": None if found is None else finite(found.deviation),
        "minima": [
            {"guess_px": float(guess), "focal_px": finite(float(focal)), "fitting": int(fitting)}
            for guess, focal, fitting in zip(minima.guesses, minima.focal, minima.fitting, strict=True)
        ],
        "explained": [{"focal_px": focal, "share": share} for focal, share in explained.items()],
    }


def field_of_view_deg(camera: Mapping[str, Any]) -> float:
    """True angle that the longer side of the image spans."""
    side = max(camera["width"], camera["height"])
    return float(np.degrees(2.0 * np.arctan(0.5 * side / camera["true_px"])))


def error_share(focal_px: float | None, true_px: float) -> float | None:
    """How far a focal length is off, as a share of the true one, with its sign."""
    return None if focal_px is None else focal_px / true_px - 1.0


def is_wrong(focal_px: float, true_px: float) -> bool:
    """Whether a minimum is another than the true one."""
    return abs(focal_px / true_px - 1.0) > WRONG_SHARE


def wrong_over_right(camera: Mapping[str, Any]) -> float | None:
    """Fitting sightings of the best wrong minimum over those of the right one; 0 without a wrong one,
    infinite without a right one, None without any."""
    ends = [(one["focal_px"], one["fitting"]) for one in camera["minima"] if one["focal_px"] is not None]
    if not ends:
        return None
    wrong = max((fit for focal, fit in ends if is_wrong(focal, camera["true_px"])), default=0)
    right = max((fit for focal, fit in ends if not is_wrong(focal, camera["true_px"])), default=0)
    return wrong / right if right else float("inf")


def most_explained(camera: Mapping[str, Any], wrong: bool) -> float | None:
    """Share of the flow that the best map of a wrong, or of the right, focal length explains."""
    shares = [
        one["share"] for one in camera["explained"] if is_wrong(one["focal_px"], camera["true_px"]) == wrong
    ]
    return max(shares, default=None)


def label(entry: Mapping[str, Any]) -> str:
    """The capture and what was done to it."""
    crop = "" if entry["crop"] == 1.0 else f", crop {entry['crop']:g}"
    return entry["capture"] + crop + (", principal point given" if entry["principal_point"] == GIVEN else "")


def focal_rows(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """One row per camera: what was found."""
    rows = []
    for entry in entries:
        for camera in entry["cameras"]:
            true, deviation = camera["true_px"], camera["deviation_px"]
            relative = None if deviation is None else deviation / camera["found_px"]
            refused = camera["found_px"] is None
            rows.append(
                [
                    label(entry),
                    camera["camera"],
                    "-" if camera["frames"] is None else str(camera["frames"]),
                    figure(field_of_view_deg(camera)),
                    figure(true),
                    figure(camera["alone_px"]),
                    figure(error_share(camera["alone_px"], true), 2, 100.0),
                    "refused" if refused else figure(camera["found_px"]),
                    figure(deviation, 2),
                    figure(relative, 2, 100.0),
                    figure(error_share(camera["found_px"], true), 2, 100.0),
                    figure(camera["centre_off_px"]),
                    figure(entry["start_seconds"], 0),
                ]
            )
    return rows


def minima_rows(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """One row per camera: where each guess ended, and how many sightings fit there."""
    rows = []
    for entry in entries:
        for camera in entry["cameras"]:
            ratio = wrong_over_right(camera)
            said = "no right one" if ratio == float("inf") else figure(ratio, 2)
            rows.append(
                [
                    label(entry),
                    camera["camera"],
                    figure(camera["true_px"]),
                    *(_minimum(one, camera["true_px"]) for one in camera["minima"]),
                    "none wrong" if ratio == 0.0 else said,
                    figure(most_explained(camera, wrong=False), 3),
                    figure(most_explained(camera, wrong=True), 3),
                ]
            )
    return rows


def _minimum(one: Mapping[str, Any], true_px: float) -> str:
    if one["focal_px"] is None:
        return "-"
    mark = r" \*" if is_wrong(one["focal_px"], true_px) else ""
    return f"{one['focal_px']:.1f} ({one['fitting']}){mark}"


def tracking_entries(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One per capture and intrinsics, as the pages of accuracy have them."""
    return [
        {**tracking[intrinsics], "capture": label(entry), "method": f"{intrinsics} intrinsics"}
        for entry in entries
        if (tracking := entry["tracking"]) is not None
        for intrinsics in (FOUND, GIVEN)
    ]


def tracking_row(entry: Mapping[str, Any]) -> list[str]:
    """Errors of the poses."""
    scores = entry["scores"] or {}
    return [
        entry["capture"],
        entry["method"] if entry["problem"] is None else f"{entry['method']} (failed)",
        figure(entry["registered"], 1, 100.0),
        figure(scores.get("ate_m"), 1, 1e3),
        figure(scores.get("rte_m"), 2, 1e3),
        figure(scores.get("inter_camera_trans_m"), 1, 1e3),
        figure(scores.get("inter_camera_rot_deg"), 3),
    ]


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """Focal lengths, minima, poses, and what was refused, as Markdown."""
    commits = ", ".join(sorted({str(entry["commit"]) for entry in entries}))
    parts = [
        f"First guess: {FIRST_FOCAL:g} of the longer side. Alone: by the camera's own video, before the joint"
        f" adjustment. Give or take: standard deviation; refused from {100.0 * MOST_DEVIATION:g} % on."
        f" Commit {commits}.\n",
        table(
            (
                "capture", "camera", "frames", "field of view deg", "true px", "alone px", "error %",
                "found px", "give or take px", "%", "error %", "principal point off px", "start s",
            ),
            focal_rows(entries),
            text_columns=2,
        ),
    ]  # fmt: skip
    refused = [f"* {label(e)}: {e['problem']}\n" for e in entries if e["problem"] is not None]
    parts += ["".join(refused)] if refused else []
    parts += [
        "Where bundle adjustment ends in px from each guess, in lengths of the longer side, and in brackets"
        f" how many sightings fit there; \\* more than {100.0 * WRONG_SHARE:g} % off the truth. Wrong /"
        " right: fitting sightings of the best such minimum over the right one's. Explained: share of the"
        " camera's flow by a map of the right one, and by the best of a wrong one, of those with"
        f" {LEAST_FITTING:g} of the most fitting sightings; the start takes what explains most.\n",
        table(
            (
                "capture",
                "camera",
                "true px",
                *(f"from {guess:g}" for guess in GUESSES),
                "wrong / right",
                "explained, right",
                "wrong",
            ),
            minima_rows(entries),
            text_columns=2,
        ),
    ]
    poses = tracking_entries(entries)
    if poses:
        parts += [
            "Poses of every frame, tracked with either intrinsics: RMSE, one Sim(3) over all cameras"
            " together.\n",
            table(
                (
                    "capture", "intrinsics", "registered %", "ATE mm", "RTE mm", "between cameras mm",
                    "between cameras deg",
                ),
                [tracking_row(entry) for entry in poses],
                text_columns=2,
            ),
        ]  # fmt: skip
        # Why a start was refused stands above already.
        said = notes([e for e in poses if e["problem"] is None or not e["method"].startswith(FOUND)])
        parts += [said] if said else []
    return "\n".join(parts)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__)
    result.add_argument("--crop", dest="crops", nargs="+", type=float, default=[1.0], metavar="SHARE",
                        help="of width and height that is kept, 1: all (default: 1)")  # fmt: skip
    result.add_argument("--principal-point", choices=(CENTRE, GIVEN), default=CENTRE,
                        help="that the start is told (default: %(default)s of the image)")  # fmt: skip
    result.add_argument("--track", action="store_true",
                        help="also track with the found and with the given intrinsics")  # fmt: skip
    result.add_argument("--name", default=NAME, help="of the Markdown file (default: %(default)s)")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print the tables, write them."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)

    def plan() -> list[Run]:
        if not all(0.0 < crop <= 1.0 for crop in options.crops):
            raise ExperimentError("--crop: give shares above 0, and 1 for the whole image")
        settings = to_dict(load_config(None, options.overrides))
        del settings["refinement"]
        return [
            Run(
                label=f"{folder.name}, crop {crop:g}",
                key=key_of(
                    capture=folder.resolve().name,
                    crop=crop,
                    principal_point=options.principal_point,
                    guesses=",".join(f"{guess:g}" for guess in GUESSES),
                    tracked=options.track,
                    settings=settings,
                ),
                measure=partial(measure, folder, crop, options),
                again=options.again,
            )
            for folder, crop in itertools.product(captures_of(options), options.crops)
        ]

    pages = [Page(options.results / f"{options.name}.md", "Focal lengths found by the start", render)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
