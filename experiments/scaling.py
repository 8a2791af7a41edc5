"""Time per frame by phase, peak memory and ATE against the video's length and the number of cameras.

The study `frames` plays a short capture forwards and backwards to each length (images are written once and
linked; its true poses follow), cut to --of cameras. The study `cameras` generates a scene for each number of
cameras, every one the same but for that number. Each size runs `mvdyn reconstruct` in a process of its own,
whose peak resident memory is set against that of a process that imports the same libraries and does nothing.
Goal: at most 1.5 GB above the libraries, growing no more than the result; time per frame flat.

Sizes are kept one by one, so a long study can be run in parts: give some sizes now, and all of them at the
end for the whole page.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.plots import Entries, lines, scores_value
from experiments.records import (
    QUICK_FRAMES,
    RENDERED,
    ExperimentError,
    Page,
    Run,
    captures_or_rendered,
    experiment_parser,
    figure,
    finite,
    key_of,
    parse,
    quick_scene,
    run_experiment,
    settings_arguments,
    table,
)
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import load_config, to_dict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mvdyn_gtsam.reconstruction import Reconstruction

NAME = "scaling"
GOAL_MB = 1500.0
PHASES = ("start", "tracking", "refinement")
STUDIES = {
    "frames": "Time, memory and error against length",
    "cameras": "Time, memory and error against the number of cameras",
}

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


def write_long_capture(source: Path, cameras: int, length: int, out: Path) -> None:
    """Write ``source``'s first ``cameras`` cameras played to ``length`` frames to the new folder ``out``.

    With ``groundtruth/`` where the source has true poses; a frame without one has no line.
    """
    from mvdyn_gtsam.capture import load_capture, write_capture

    capture = load_capture(source)
    if len(capture.cameras) < cameras:
        raise ExperimentError(f"{capture.name}: has {len(capture.cameras)} cameras, not {cameras}")
    capture = replace(capture, cameras=capture.cameras[:cameras], streams=capture.streams[:cameras])
    write_capture(capture, out)
    order = forwards_and_backwards(capture.frame_count, length)
    for camera in capture.cameras:
        folder = out / camera.name
        for number in range(capture.frame_count, length):
            os.link(folder / f"{order[number]:06d}.png", folder / f"{number:06d}.png")
        for number in range(length, capture.frame_count):
            (folder / f"{number:06d}.png").unlink()
    content = json.loads((out / "capture.json").read_text())
    content["num_frames"] = length
    (out / "capture.json").write_text(json.dumps(content, indent=1) + "\n")
    if (source / "groundtruth").is_dir():
        _write_long_truth(capture, source / "groundtruth", order, out / "groundtruth")


def _write_long_truth(capture: Capture, source: Path, order: Sequence[int], out: Path) -> None:
    import numpy as np

    from experiments.start_errors import true_frames
    from mvdyn_gtsam.capture.convert import tum_lines
    from mvdyn_gtsam.evaluation import load_groundtruth

    out.mkdir()
    for camera, wTc_of in true_frames(capture, load_groundtruth(source)).items():
        known = [number for number, frame in enumerate(order) if frame in wTc_of]
        if known:
            wTc = np.stack([wTc_of[order[number]] for number in known])
            (out / f"{camera}.txt").write_text(tum_lines(np.array(known) / capture.fps, wTc))


def generate(cameras: int, frames: int, folder: Path) -> Path:
    """The generated scene of that size below ``folder``, made where it is not there yet."""
    from mvdyn_gtsam.scenes import SceneSettings, make_scene

    # Depth, masks and flow of the first frame alone: poses are what is scored.
    settings = SceneSettings(cameras=cameras, frames=frames, every=frames)
    return make_scene(settings, folder / f"generated_{cameras}x{frames}")


@dataclass(frozen=True)
class Size:
    """One size of one study, and how its capture comes about."""

    study: str
    cameras: int
    frames: int
    source: Path | None
    """Capture to play; None: generate the scene."""
    scene_of_quick: bool = False

    @property
    def name(self) -> str:
        return "generated" if self.source is None else self.source.resolve().name

    def prepare(self, options: argparse.Namespace, folder: Path) -> Path:
        """The capture of this size, in the new folder ``folder`` or kept in ``--work``."""
        if self.source is not None:
            write_long_capture(self.source, self.cameras, self.frames, folder)
            return folder
        if self.scene_of_quick:
            return quick_scene(options.results, self.cameras, self.frames)
        return generate(self.cameras, self.frames, options.work / "scenes")


def measure_libraries() -> float:
    """Peak resident memory in MiB of the interpreter with everything imported. Raises ExperimentError."""
    from mvdyn_gtsam.baselines.process import run_measured

    with tempfile.TemporaryDirectory(prefix="mvdyn-libraries-") as folder:
        usage = run_measured([sys.executable, "-c", LIBRARIES], Path(folder) / "log")
    if usage.problem is not None or usage.peak_mb is None:
        raise ExperimentError(f"importing the libraries failed: {usage.problem}")
    return usage.peak_mb


def measure(size: Size, options: argparse.Namespace) -> dict[str, Any]:
    """Reconstruct a capture of that size and say what it took; a run that fails is an entry that says so."""
    from mvdyn_gtsam.baselines.comparison import our_command
    from mvdyn_gtsam.baselines.process import run_measured
    from mvdyn_gtsam.reconstruction import Reconstruction

    # Kept until the next run: what a failed one left can be looked at.
    folder = options.work / f"{size.study}_{size.cameras}x{size.frames}"
    shutil.rmtree(folder, ignore_errors=True)
    capture = size.prepare(options, folder / "capture")
    result = folder / "result"
    command = our_command(capture, result, options.stage, settings_arguments(options.overrides))
    usage = run_measured(command, folder / "log")
    entry = {
        "study": size.study,
        "capture": size.name,
        "cameras": size.cameras,
        "frames": size.frames,
        "stage": options.stage,
        "problem": usage.problem,
        "seconds": usage.seconds,
        "cpu_seconds": finite(usage.cpu_seconds),
        "peak_mb": finite(usage.peak_mb),
        "libraries_mb": measure_libraries(),
    }
    if usage.problem is None:
        entry |= {"result_mb": folder_mb(result), **_what_it_says(Reconstruction.load(result), capture)}
        shutil.rmtree(folder)
    return entry


def _what_it_says(result: Reconstruction, capture: Path) -> dict[str, Any]:
    """Seconds by phase, and scores where there is ground truth."""
    from mvdyn_gtsam.evaluation import evaluate

    truth = capture / "groundtruth"
    return {
        "phase_seconds": {stage["name"]: stage["seconds"] for stage in result.manifest["stages"]},
        "tracking_seconds": result.diagnostics("seconds"),
        "scores": evaluate(result, truth).to_json() if truth.is_dir() else None,
    }


def folder_mb(folder: Path) -> float:
    """Size in MiB of all files below ``folder``."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20


def images(entry: Mapping[str, Any]) -> int:
    """Frames of all cameras."""
    return int(entry["cameras"]) * int(entry["frames"])


COLUMNS = (
    *("cameras x frames", "registered %", "ATE mm", "s", "s per image"),
    *PHASES,
    *("s per added image", "peak MB", "above libraries MB", "growth MB", "result MB", "growth MB"),
)


def rows(entries: Entries) -> list[list[str]]:
    """One row per size; growth is against the last size above that was finished."""
    result: list[list[str]] = []
    before: Mapping[str, Any] | None = None
    for entry in entries:
        size = f"{entry['cameras']} x {entry['frames']}"
        if entry["problem"] is not None:
            result.append([f"{size} (failed)", *["-"] * (len(COLUMNS) - 1)])
            continue
        added = _added(before, entry, "seconds")
        more = None if before is None else images(entry) - images(before)
        scores = entry["scores"] or {}
        result.append(
            [
                size,
                figure(scores.get("registered"), 1, 100.0),
                figure(scores.get("ate_m"), 1, 1e3),
                figure(entry["seconds"], 0),
                figure(entry["seconds"] / images(entry), 3),
                *(figure(per_image(phase, entry), 3) for phase in PHASES),
                figure(None if added is None or not more else added / more, 3),
                figure(entry["peak_mb"], 0),
                figure(entry["peak_mb"] - entry["libraries_mb"], 0),
                figure(_added(before, entry, "peak_mb"), 0),
                figure(entry["result_mb"], 0),
                figure(_added(before, entry, "result_mb"), 0),
            ]
        )
        before = entry
    return result


def _added(before: Mapping[str, Any] | None, entry: Mapping[str, Any], key: str) -> float | None:
    return None if before is None else float(entry[key]) - float(before[key])


def per_image(phase: str, entry: Mapping[str, Any]) -> float | None:
    """Seconds per image of one phase, None where it did not run."""
    seconds = entry["phase_seconds"].get(phase)
    return None if seconds is None else float(seconds) / images(entry)


def render(study: str, entries: Entries) -> str:
    """Table, goal and failures of one study as Markdown."""
    names = ", ".join(dict.fromkeys(entry["capture"] for entry in entries))
    what = (
        f"{names} played forwards and backwards" if study == "frames" else f"{names}: the scene of each row"
    )
    return (
        f"{what}; interpreter and libraries alone take {figure(entries[-1]['libraries_mb'], 0)} MB. Goal:"
        f" at most {GOAL_MB:.0f} MB above them, growing no more than the result. Phases in seconds per image,"
        " MB are MiB; commit "
        f"{', '.join(sorted({str(entry['commit']) for entry in entries}))}.\n\n"
        + table(COLUMNS, rows(entries))
        + _notes(entries)
    )


def _notes(entries: Entries) -> str:
    """Failures and cameras left apart, below the table."""
    lines = []
    for entry in entries:
        size = f"* {entry['cameras']} x {entry['frames']}"
        groups = ((entry.get("scores") or {}).get("groups")) or []
        if entry["problem"] is not None:
            lines.append(f"{size}: {entry['problem']}")
        elif len(groups) > 1:
            names = " / ".join("+".join(group["cameras"]) for group in groups)
            lines.append(f"{size}: the start leaves cameras apart ({names}); ATE over all means little")
    return "".join(f"\n{line}" for line in lines) + ("\n" if lines else "")


def draw(study: str, picture: Figure, entries: Entries) -> None:
    """Seconds per image by phase, memory, and ATE over the size."""
    done = [entry for entry in entries if entry["problem"] is None]
    seconds, memory, error = picture.subplots(1, 3)

    def over(entry: Mapping[str, Any]) -> float:
        return float(entry[study])

    phases = {phase: partial(per_image, phase) for phase in PHASES}
    lines(seconds, done, over, phases, study, "seconds per image")
    megabytes = {
        "peak, above the libraries": lambda entry: entry["peak_mb"] - entry["libraries_mb"],
        "result on disk": lambda entry: entry["result_mb"],
    }
    lines(memory, done, over, megabytes, study, "MB")
    lines(error, done, over, {"ATE": scores_value("ate_m", 1e3)}, study, "ATE (mm)")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__, captures=False)
    result.add_argument("capture", nargs="?", type=Path,
                        help="short capture to play (default: rendered/robodog_overlap)")  # fmt: skip
    result.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    result.add_argument("--frames", nargs="+", type=int, metavar="N",
                        help="lengths per camera (default: 100 200 400 700 1000)")  # fmt: skip
    result.add_argument("--of", type=int, default=2, metavar="CAMERAS",
                        help="cameras of the study `frames` (default: %(default)s)")  # fmt: skip
    result.add_argument("--cameras", nargs="+", type=int, metavar="N",
                        help="numbers of cameras (default: 2 3 4 6 8)")  # fmt: skip
    result.add_argument("--generated-frames", type=int, metavar="N",
                        help="length of the study `cameras` (default: 60)")  # fmt: skip
    result.add_argument("--stage", choices=("tracking", "refinement"), default="tracking",
                        help="last stage to run (default: %(default)s)")  # fmt: skip
    return result


def sizes(options: argparse.Namespace, study: str) -> list[Size]:
    """What to run, smallest first. Raises ExperimentError where the capture to play is not there."""
    quick = options.quick
    if study == "frames":
        [source] = (
            [quick_scene(options.results)]
            if quick
            else captures_or_rendered([options.capture or RENDERED / "robodog_overlap"])
        )
        wanted = options.frames or ([10, 20] if quick else [100, 200, 400, 700, 1000])
        return [Size(study, options.of, length, source) for length in sorted(set(wanted))]
    frames = options.generated_frames or (QUICK_FRAMES if quick else 60)
    wanted = options.cameras or ([2, 3] if quick else [2, 3, 4, 6, 8])
    return [Size(study, cameras, frames, None, quick) for cameras in sorted(set(wanted))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the tables, write each after every size."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    command_line = parser()
    options = parse(command_line, words)
    if options.quick and options.capture:
        command_line.error("--quick makes its own scene; name a capture or give --quick, not both")
    if min([*(options.frames or [2]), options.generated_frames or 2]) < 2:
        command_line.error("--frames and --generated-frames must be at least 2")
    if min([*(options.cameras or [1]), options.of]) < 1:
        command_line.error("--cameras and --of must be at least 1")
    # In that order, whatever was said: only the first can lack its capture, which hours later is too late.
    for study in STUDIES:
        if study in options.studies and (code := _run_study(study, options, words)):
            return code
    return 0


def _run_study(study: str, options: argparse.Namespace, words: Sequence[str]) -> int:
    def plan() -> list[Run]:
        settings = to_dict(load_config(None, options.overrides))
        return [
            Run(
                label=f"{size.name}, {size.cameras} cameras, {size.frames} frames",
                key=key_of(
                    **{"study": study, "capture": size.name, "cameras": size.cameras},
                    **{"frames": size.frames, "stage": options.stage, "settings": settings},
                ),
                measure=partial(measure, size, options),
                again=options.again,
            )
            for size in sizes(options, study)
        ]

    path = options.results / f"{NAME}_{study}.md"
    pages = [Page(path, STUDIES[study], partial(render, study), partial(draw, study))]
    return run_experiment(NAME, words, options.results / f"{NAME}.json", pages, plan)


if __name__ == "__main__":
    sys.exit(main())
