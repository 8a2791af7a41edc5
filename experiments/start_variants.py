"""The wide-baseline start on altered rendered captures, and on generated ones.

Pieces of their videos in time, pairs of cameras, crops that leave a fifth of the view in common or none,
reversed and shifted time, half the resolution, fewer frames, worse images, cameras of different scenes put
together. How much two cameras share is measured with the true depth. Verdicts, worst pair first:

  WRONG   placed, and off by more than 2 degrees or 10 % of the median depth, or placed with nothing in common
  rough   placed, and beyond the goal of 0.5 degrees or 3 %
  apart   left apart, though the two share at least a fifth of their view
  right   all of the others

--only takes words; a variant is run when its name holds one of them. --random makes captures of whole length
instead, with what they show drawn at random, and starts on those.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.altered_captures import Alteration, AlteredCapture, Part, alter_capture
from experiments.records import (
    RENDERED,
    ExperimentError,
    Page,
    Run,
    experiment_parser,
    figure,
    key_of,
    parse,
    run_experiment,
    table,
)
from experiments.start_errors import StartScore, score_start
from experiments.wide_baseline import GOAL_DEG, GOAL_SHARE, run_classical
from mvdyn_gtsam.config import load_config, to_dict
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.scenes import SceneSettings, make_scene

NAME = "start_variants"
WRONG_DEG, WRONG_SHARE = 2.0, 0.1
"""Beyond these, flow guided by the poses finds nothing: tracking does not recover."""
ENOUGH_SHARED = 0.2
"""Common view from which cameras ought to be connected; the project's goal is a fifth."""
NOTHING_SHARED = 0.005
ORDER = ("WRONG", "failed", "rough", "apart", "right")


@dataclass(frozen=True)
class CaptureVariant:
    """One capture to start on."""

    name: str
    parts: tuple[Part, ...]


WORSE = (
    Alteration(noise=8.0, gain=(0.75, 1.0), jpeg=40, blur_px=3),
    Alteration(noise=8.0, gain=(1.15, 0.85), jpeg=40, blur_px=3),
)
"""Dim light and cheap phones: noise of 3 %, exposures 1.5 times apart, blocks, shake of 3 px."""

SCENES = {
    "room_3": SceneSettings(seed=3, overlap=0.4, frames=40, exposure=0.1, every=5, camera_motion=0.5),
    "room_7": SceneSettings(seed=7, overlap=0.3, frames=40, exposure=0.1, every=5, texture=0.5),
    "room_11": SceneSettings(seed=11, overlap=0.35, frames=40, repeat=0.4, motion=0.8, every=5),
    "yard_5": SceneSettings(seed=5, overlap=0.35, frames=40, place="yard", every=5, camera_motion=0.6),
    "yard_9": SceneSettings(seed=9, overlap=0.3, frames=40, place="yard", repeat=0.3, every=5),
    "room_13": SceneSettings(seed=13, overlap=0.0, frames=40, repeat=0.4, every=5),
}
"""Generated where a variant asks for them."""


def random_scene(seed: int) -> SceneSettings:
    """Two or three cameras, 60 frames; overlap, texture, repetition, motion, noise and place are drawn."""
    random = np.random.default_rng(1000 + seed)
    return SceneSettings(
        seed=seed,
        frames=60,
        every=12,
        cameras=int(random.choice([2, 2, 3])),
        overlap=float(random.uniform(0.25, 0.45)),
        texture=float(random.uniform(0.3, 0.9)),
        repeat=float(random.choice([0.0, 0.2, 0.5])),
        motion=float(random.uniform(0.3, 1.0)),
        noise=float(random.choice([0.005, 0.02])),
        exposure=float(random.choice([0.0, 0.1])),
        camera_motion=float(random.uniform(0.25, 0.6)),
        place="yard" if random.choice(["room", "room", "yard"]) == "yard" else "room",
        meet=float(random.uniform(0.6, 1.5)),
    )


def random_variants(first: int, last: int) -> tuple[CaptureVariant, ...]:
    """All cameras of the random scenes of these seeds."""
    variants = []
    for seed in range(first, last + 1):
        name = f"random_{seed}"
        cameras = range(random_scene(seed).cameras)
        variants.append(CaptureVariant(name, tuple(Part(name, f"cam{camera}") for camera in cameras)))
    return tuple(variants)


def scene_of(name: str) -> SceneSettings | None:
    """Settings of a generated capture; None for a rendered one."""
    if name.startswith("random_"):
        return random_scene(int(name.removeprefix("random_")))
    return SCENES.get(name)


def _both(capture: str, first: str, second: str, *alterations: Alteration, **frames: Any) -> tuple[Part, ...]:
    """Two cameras of one capture, the same frames of both."""
    left, right = alterations or (Alteration(), Alteration())
    return (
        Part(capture, first, alteration=left, **frames),
        Part(capture, second, alteration=right, **frames),
    )


def _cut(first: str, second: str) -> tuple[Alteration, Alteration]:
    """Crops written as "L0.4": so much of the width cut away on the left."""

    def one(word: str) -> Alteration:
        share = float(word[1:] or 0.0)
        return Alteration(left=share) if word.startswith("L") else Alteration(right=share)

    return one(first), one(second)


VARIANTS = (
    # pieces of time
    CaptureVariant("robodog first 30", _both("robodog_overlap", "cam0", "cam1", stop=30)),
    CaptureVariant("robodog last 30", _both("robodog_overlap", "cam0", "cam1", start=30)),
    CaptureVariant("robodog middle 20", _both("robodog_overlap", "cam0", "cam1", start=20, stop=40)),
    CaptureVariant("human first 30", _both("dynamic_human", "cam0", "cam1", stop=30)),
    CaptureVariant("human last 30", _both("dynamic_human", "cam0", "cam1", start=30)),
    CaptureVariant("human middle 20", _both("dynamic_human", "cam0", "cam1", start=20, stop=40)),
    CaptureVariant("roboarm first 20", _both("roboarm", "cam0", "cam1", stop=20)),
    CaptureVariant("roboarm last 20", _both("roboarm", "cam0", "cam1", start=40)),
    # pairs of cameras
    CaptureVariant("three 0-1 last 30", _both("three_cameras", "cam0", "cam1", start=30)),
    CaptureVariant("three 0-2", _both("three_cameras", "cam0", "cam2")),
    CaptureVariant("three 1-2", _both("three_cameras", "cam1", "cam2")),
    CaptureVariant("three 1-2 first 30", _both("three_cameras", "cam1", "cam2", stop=30)),
    CaptureVariant("courtyard 0-1", _both("multicamvideo", "cam0", "cam1")),
    CaptureVariant("courtyard 0-3", _both("multicamvideo", "cam0", "cam3")),
    CaptureVariant("courtyard 1-3 last 30", _both("multicamvideo", "cam1", "cam3", start=51)),
    CaptureVariant("courtyard 0-2 middle 20", _both("multicamvideo", "cam0", "cam2", start=30, stop=50)),
    # less of the view in common
    CaptureVariant("robodog a fifth", _both("robodog_overlap", "cam0", "cam1", *_cut("L0.3", "R0.3"))),
    CaptureVariant("human a fifth", _both("dynamic_human", "cam0", "cam1", *_cut("R0.3", "L0.3"))),
    CaptureVariant("roboarm a quarter", _both("roboarm", "cam0", "cam1", *_cut("L0.35", "R0.35"))),
    CaptureVariant("three 0-1 a fifth", _both("three_cameras", "cam0", "cam1", *_cut("R0.3", "L0.3"))),
    CaptureVariant("three 0-2 a quarter", _both("three_cameras", "cam0", "cam2", *_cut("L0.4", ""))),
    CaptureVariant("courtyard 0-1 a fifth", _both("multicamvideo", "cam0", "cam1", *_cut("L0.5", "R0.5"))),
    CaptureVariant("courtyard 1-3 a fifth", _both("multicamvideo", "cam1", "cam3", *_cut("L0.5", "R0.5"))),
    CaptureVariant("courtyard 2-3 a fifth", _both("multicamvideo", "cam2", "cam3", *_cut("L0.5", "R0.5"))),
    CaptureVariant("courtyard 0-2 a quarter", _both("multicamvideo", "cam0", "cam2", *_cut("L0.5", "R0.5"))),
    # time
    CaptureVariant(
        "human reversed, 20 frames apart",
        (
            Part("dynamic_human", "cam0", stop=40, reverse=True),
            Part("dynamic_human", "cam1", start=20, reverse=True),
        ),
    ),
    CaptureVariant(
        "three 0-2, second half with first",
        (Part("three_cameras", "cam0", start=30), Part("three_cameras", "cam2", stop=30)),
    ),
    CaptureVariant(
        "courtyard 3, twice",
        (Part("multicamvideo", "cam3", stop=30), Part("multicamvideo", "cam3", start=51)),
    ),
    CaptureVariant("roboarm every third", _both("roboarm", "cam0", "cam1", step=3)),
    CaptureVariant("courtyard 1-2 every third", _both("multicamvideo", "cam1", "cam2", step=3)),
    # images
    CaptureVariant(
        "robodog half size", _both("robodog_overlap", "cam0", "cam1", *[Alteration(scale=0.5)] * 2)
    ),
    CaptureVariant(
        "courtyard 0-1 half size", _both("multicamvideo", "cam0", "cam1", *[Alteration(scale=0.5)] * 2)
    ),
    CaptureVariant(
        "three 0-1, one half size",
        _both("three_cameras", "cam0", "cam1", Alteration(), Alteration(scale=0.5)),
    ),
    CaptureVariant("robodog worse images", _both("robodog_overlap", "cam0", "cam1", *WORSE)),
    CaptureVariant("human worse images", _both("dynamic_human", "cam0", "cam1", *WORSE)),
    CaptureVariant("courtyard 2-3 worse images", _both("multicamvideo", "cam2", "cam3", *WORSE, stop=40)),
    # generated
    *(
        CaptureVariant(f"generated {name}", _both(name, "cam0", "cam1"))
        for name in SCENES
        if name != "room_13"
    ),
    # nothing in common
    CaptureVariant("none: robodog apart, last 30", _both("robodog_nonoverlap", "cam0", "cam1", start=30)),
    CaptureVariant("little: generated room_13", _both("room_13", "cam0", "cam1")),
    CaptureVariant(
        "none: courtyard 1-2", _both("multicamvideo", "cam1", "cam2", *_cut("L0.66", "R0.66"), stop=30)
    ),
    CaptureVariant(
        "little: three 1-2", _both("three_cameras", "cam1", "cam2", *_cut("L0.5", "R0.5"), stop=30)
    ),
    CaptureVariant(
        "none: two robodog rooms",
        (Part("robodog_overlap", "cam0", stop=40), Part("robodog_nonoverlap", "cam0", stop=40)),
    ),
    CaptureVariant(
        "none: human, robodog",
        (Part("dynamic_human", "cam0", stop=40), Part("robodog_overlap", "cam1", stop=40)),
    ),
    CaptureVariant(
        "none: roboarm, courtyard",
        (Part("roboarm", "cam1", stop=40), Part("multicamvideo", "cam2", stop=40)),
    ),
    CaptureVariant(
        "none: two generated rooms",
        (Part("room_11", "cam0"), Part("room_13", "cam1")),
    ),
)


def folders_of(variant: CaptureVariant, scenes: Path) -> dict[str, Path]:
    """Where the captures of its parts are; generated ones are made below ``scenes``.

    Raises ExperimentError for a rendered one that is not there.
    """
    folders = {}
    for name in dict.fromkeys(part.capture for part in variant.parts):
        scene = scene_of(name)
        if scene is not None:
            folders[name] = make_scene(scene, scenes / name)
        elif (RENDERED / name).is_dir():
            folders[name] = RENDERED / name
        else:
            raise ExperimentError(f"{RENDERED / name}: there is no such capture")
    return folders


def measure(variant: CaptureVariant, overrides: Sequence[str], scenes: Path) -> dict[str, Any]:
    """The start on one variant as an entry of the records; one that fails says so."""
    altered = alter_capture(variant.name, variant.parts, folders_of(variant, scenes))
    names = [camera.name for camera in altered.capture.cameras]
    seconds: float | None = None
    problem: str | None = None
    try:
        groups, frames, seconds = run_classical(altered.capture, load_config(None, overrides))
        score = score_start(groups, frames, altered.truth)
        problem = score.problem
    except TrackingError as error:
        score, problem = score_start([[name] for name in names], {}, altered.truth), str(error)
    return {
        "variant": variant.name,
        "seconds": seconds,
        "length": altered.capture.frame_count,
        "verdict": "failed" if problem else verdict(altered, score),
        "median_depth_m": altered.median_depth,
        "shared": [[*pair, altered.shared_at_once[pair], share] for pair, share in altered.shared.items()],
        **asdict(score),
        "problem": problem,
    }


def verdict(altered: AlteredCapture, score: StartScore) -> str:
    """The worst that can be said of any pair of cameras."""
    found = ["right"]
    for pair in score.pairs:
        share = pair.translation_m / altered.median_depth
        if (
            altered.shared[pair.cameras] < NOTHING_SHARED
            and len(altered.capture.cameras) == 2
            or pair.rotation_deg > WRONG_DEG
            or share > WRONG_SHARE
        ):
            found.append("WRONG")
        elif pair.rotation_deg > GOAL_DEG or share > GOAL_SHARE:
            found.append("rough")
    if any(altered.shared[pair] >= ENOUGH_SHARED for pair in score.apart):
        found.append("apart")
    return min(found, key=ORDER.index)


def rows(entries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """One row per variant."""
    result = []
    for entry in entries:
        pairs = entry["pairs"]
        deg = max((pair["rotation_deg"] for pair in pairs), default=None)
        metres = max((pair["translation_m"] for pair in pairs), default=None)
        result.append(
            [
                entry["variant"],
                entry["verdict"],
                " ".join(figure(at_once, 2) for *_, at_once, _ in entry["shared"]),
                " ".join(figure(share, 2) for *_, share in entry["shared"]),
                " / ".join("+".join(group) for group in entry["groups"]) or "-",
                str(entry["length"]),
                " ".join(str(count) for count in entry["frames"].values()),
                figure(deg, 2),
                figure(None if metres is None else metres / entry["median_depth_m"], 2, 100.0),
                figure(entry["seconds"], 0),
            ]
        )
    return result


def render(entries: Sequence[Mapping[str, Any]]) -> str:
    """The table, and how many of each verdict."""
    counts = {word: sum(entry["verdict"] == word for entry in entries) for word in ORDER}
    said = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    commits = ", ".join(sorted({str(entry["commit"]) for entry in entries}))
    columns = ("variant", "verdict", "shared at once", "ever", "groups", "length", "frames", "worst pair deg")
    parts = [
        f"{said}. Shared: the part of the view that two cameras have in common, at one instant and with any"
        f" instant of the other, by true depth. Frames: those that the start placed. Commit {commits}.\n",
        table((*columns, "% of depth", "s"), rows(entries), text_columns=2),
    ]
    problems = [f"* {e['variant']}: {e['problem']}\n" for e in entries if e["problem"]]
    return "\n".join([*parts, *(["".join(problems)] if problems else [])])


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__, captures=False)
    result.add_argument("--only", nargs="+", metavar="WORD", help="variants whose name holds one of these")
    result.add_argument(
        "--random", nargs=2, type=int, metavar=("FIRST", "LAST"), help="seeds of captures drawn at random"
    )
    result.add_argument("--name", default=NAME, help="of the Markdown file (default: %(default)s)")
    return result


def variant_runs(
    options: argparse.Namespace,
    variants: Sequence[CaptureVariant],
    measure: Callable[[CaptureVariant, Sequence[str], Path], dict[str, Any]],
    **key: Any,
) -> list[Run]:
    """A run per variant that ``options.only`` leaves; ``key``: what else an entry of the records depends on.

    Raises ExperimentError where it leaves none.
    """
    config = load_config(None, options.overrides)
    chosen = [v for v in variants if options.only is None or any(word in v.name for word in options.only)]
    if not chosen:
        raise ExperimentError(f"--only {' '.join(options.only)}: no variant is called so")
    return [
        Run(
            label=variant.name,
            key=key_of(
                variant=variant.name,
                parts={"parts": [asdict(part) for part in variant.parts]},
                settings=to_dict(config)["frontend"],
                **key,
            ),
            measure=partial(measure, variant, options.overrides, options.work / "scenes"),
            again=options.again,
        )
        for variant in chosen
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print the table, write it."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(parser(), words)

    def plan() -> list[Run]:
        variants = random_variants(*options.random) if options.random else VARIANTS
        return variant_runs(options, variants, measure)

    pages = [Page(options.results / f"{options.name}.md", "The start on altered captures", render)]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
