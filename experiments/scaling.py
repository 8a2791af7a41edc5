"""Time per image by phase, peak memory and ATE against length, number of cameras, and pixels.

The study `frames` plays a short capture forwards and backwards to each length (images are written once and
linked; its true poses follow), cut to --of cameras. The study `cameras` generates a scene for each number of
cameras, every one the same but for that number; the study `pixels` one for each width, in the ratio 4:3. Each
size runs `mvdyn reconstruct` in a process of its own, whose peak resident memory is set against that of a
process that imports the same libraries and does nothing.
Goal: at most 1.5 GB above the libraries, growing no more than the result; time per frame flat.

With --stage refinement, tracking and refinement run one after the other in processes of their own, so that
each has its own peak, and the pages (scaling_STUDY_refinement.md) show the refinement apart: its seconds in
flow and in all the rest (goal: all of it at most twice the flow), its memory (goal: 2 GB).

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

from experiments.records import (
    QUICK_FRAMES,
    RENDERED,
    ExperimentError,
    Page,
    Run,
    captures_or_rendered,
    experiment_parser,
    finite,
    key_of,
    parse,
    quick_scene,
    run_experiment,
    settings_arguments,
)
from experiments.scaling_pages import draw, render
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import load_config, to_dict

if TYPE_CHECKING:
    from mvdyn_gtsam.baselines.process import ProcessUsage
    from mvdyn_gtsam.reconstruction import Reconstruction

NAME = "scaling"
STUDIES = {
    "frames": "Time, memory and error against length",
    "cameras": "Time, memory and error against the number of cameras",
    "pixels": "Time, memory and error against the size of the images",
}
STAGES = ("tracking", "refinement")
MIN_WIDTH = 64
"""px; below that there is nothing to match."""

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


@dataclass(frozen=True)
class Size:
    """One size of one study, and how its capture comes about."""

    study: str
    cameras: int
    frames: int
    source: Path | None
    """Capture to play; None: generate the scene."""
    width: int | None = None
    """Of the generated scene, px; None: what that has by itself."""

    @property
    def name(self) -> str:
        return "generated" if self.source is None else self.source.resolve().name

    @property
    def label(self) -> str:
        wide = "" if self.width is None else f", {self.width} px wide"
        return f"{self.name}, {self.cameras} cameras, {self.frames} frames{wide}"

    def folder(self, stage: str) -> str:
        """Name of the folder it works in, another for each stage."""
        parts = [self.study, f"{self.cameras}x{self.frames}"]
        parts += [] if self.width is None else [f"{self.width}px"]
        return "_".join(parts if stage == STAGES[0] else [*parts, stage])

    def prepare(self, options: argparse.Namespace, folder: Path) -> Path:
        """The capture of this size, in the new folder ``folder`` or kept in ``--work``."""
        if self.source is None:
            return generate(self, options)
        write_long_capture(self.source, self.cameras, self.frames, folder)
        return folder


def generate(size: Size, options: argparse.Namespace) -> Path:
    """The generated scene of that size, or that of ``--quick``, made where it is not there yet."""
    from mvdyn_gtsam.scenes import SceneSettings, make_scene

    if options.quick:
        from experiments.quick import quick_settings

        settings, folder = quick_settings(size.cameras, size.frames), options.results / "scenes" / "quick"
    else:
        # Depth, masks and flow of the first frame alone: poses are what is scored.
        settings = SceneSettings(cameras=size.cameras, frames=size.frames, every=size.frames)
        folder = options.work / "scenes" / "generated"
    name = f"{folder.name}_{size.cameras}x{size.frames}"
    if size.width is not None and size.width != settings.width:
        settings = replace(settings, width=size.width, height=3 * size.width // 4)
        name += f"_{size.width}px"
    return make_scene(settings, folder.with_name(name))


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
    from mvdyn_gtsam.capture import load_capture
    from mvdyn_gtsam.reconstruction import Reconstruction

    # Kept until the next run: what a failed one left can be looked at.
    folder = options.work / size.folder(options.stage)
    shutil.rmtree(folder, ignore_errors=True)
    capture = size.prepare(options, folder / "capture")
    result = folder / "result"
    usages = run_stages(capture, result, options)
    camera = load_capture(capture).cameras[0]
    entry = {
        "study": size.study,
        "capture": size.name,
        "cameras": size.cameras,
        "frames": size.frames,
        "width": camera.width,
        "height": camera.height,
        "stage": options.stage,
        **totals(usages),
        "libraries_mb": measure_libraries(),
    }
    if entry["problem"] is None:
        entry |= {"result_mb": folder_mb(result), **_what_it_says(Reconstruction.load(result), capture)}
        if options.stage == "refinement":
            entry |= _what_refinement_says(Reconstruction.load(result), options.overrides)
        shutil.rmtree(folder)
    return entry


def run_stages(capture: Path, result: Path, options: argparse.Namespace) -> dict[str, ProcessUsage]:
    """Usage of each stage up to ``--stage``, each a process of its own; none after one that failed."""
    from mvdyn_gtsam.baselines.comparison import our_command
    from mvdyn_gtsam.baselines.process import run_measured

    settings = settings_arguments(options.overrides)
    command = our_command(capture, result, "tracking", settings)
    usages = {"tracking": run_measured(command, result.with_name("log"))}
    if options.stage == "refinement" and usages["tracking"].problem is None:
        command = [sys.executable, "-m", "mvdyn_gtsam.cli.main", "reconstruct", str(capture)]
        command += ["--out", str(result), "--stage", "refinement", "--resume", *settings]
        usages["refinement"] = run_measured(command, result.with_name("refinement.log"))
    return usages


def totals(usages: Mapping[str, ProcessUsage]) -> dict[str, Any]:
    """Seconds of all stages, the largest process of any, and the peak of each."""
    peaks = {stage: finite(usage.peak_mb) for stage, usage in usages.items()}
    cpu = [usage.cpu_seconds for usage in usages.values()]
    return {
        "problem": next((usage.problem for usage in usages.values() if usage.problem is not None), None),
        "seconds": sum(usage.seconds for usage in usages.values()),
        "cpu_seconds": None if None in cpu else finite(sum(value for value in cpu if value is not None)),
        "peak_mb": max((peak for peak in peaks.values() if peak is not None), default=None),
        "stage_peak_mb": peaks,
    }


def _what_it_says(result: Reconstruction, capture: Path) -> dict[str, Any]:
    """Seconds by phase, and scores where there is ground truth."""
    from mvdyn_gtsam.evaluation import evaluate

    truth = capture / "groundtruth"
    return {
        "phase_seconds": {stage["name"]: stage["seconds"] for stage in result.manifest["stages"]},
        "tracking_seconds": result.diagnostics("seconds"),
        "scores": evaluate(result, truth).to_json() if truth.is_dir() else None,
    }


def _what_refinement_says(result: Reconstruction, overrides: Sequence[str]) -> dict[str, Any]:
    """Seconds by step, and how many processes held memory at once."""
    from mvdyn_gtsam.refinement.pool import worker_count

    # Counted here: a child may run on the same processors.
    workers = worker_count(load_config(None, overrides).refinement.workers)
    # A single worker is the main process itself.
    processes = 1 if workers == 1 else workers + 1
    return {
        "refinement_seconds": result.diagnostics("refinement_seconds"),
        "refinement_processes": processes,
    }


def folder_mb(folder: Path) -> float:
    """Size in MiB of all files below ``folder``."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = experiment_parser(NAME, __doc__, captures=False)
    result.add_argument("capture", nargs="?", type=Path,
                        help="short capture to play (default: rendered/robodog_overlap)")  # fmt: skip
    result.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    result.add_argument("--frames", nargs="+", type=int, metavar="N",
                        help="lengths per camera (default: 100 200 400 700 1000)")  # fmt: skip
    result.add_argument("--of", type=int, default=2, metavar="CAMERAS",
                        help="cameras of `frames` and `pixels` (default: %(default)s)")  # fmt: skip
    result.add_argument("--cameras", nargs="+", type=int, metavar="N",
                        help="numbers of cameras (default: 2 3 4 6 8)")  # fmt: skip
    result.add_argument("--widths", nargs="+", type=int, metavar="N",
                        help="px, heights are three quarters of them (default: 256 384 512 768)")  # fmt: skip
    result.add_argument("--generated-frames", type=int, metavar="N",
                        help="length of the studies `cameras` and `pixels` (default: 60)")  # fmt: skip
    result.add_argument("--stage", choices=STAGES, default=STAGES[0],
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
    if study == "cameras":
        wanted = options.cameras or ([2, 3] if quick else [2, 3, 4, 6, 8])
        return [Size(study, cameras, frames, None) for cameras in sorted(set(wanted))]
    wanted = options.widths or ([192, 256] if quick else [256, 384, 512, 768])
    return [Size(study, options.of, frames, None, width) for width in sorted(set(wanted))]


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
    if any(width < MIN_WIDTH or width % 4 for width in options.widths or []):
        command_line.error(f"--widths must be multiples of 4, for whole heights, from {MIN_WIDTH} px on")
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
                label=size.label,
                key=key_of(
                    **{"study": study, "capture": size.name, "cameras": size.cameras},
                    **{"frames": size.frames, "stage": options.stage, "settings": settings},
                    **({} if size.width is None else {"width": size.width}),
                ),
                measure=partial(measure, size, options),
                again=options.again,
            )
            for size in sizes(options, study)
        ]

    # Of a stage each: a run with the refinement must not take the place of one without.
    refined = options.stage == "refinement"
    path = options.results / f"{NAME}_{study}{'_refinement' if refined else ''}.md"
    title = STUDIES[study] + (", with the refinement" if refined else "")
    page = Page(path, title, partial(render, study, options.stage), partial(draw, study, options.stage))
    return run_experiment(NAME, words, options.results / f"{NAME}.json", [page], plan)


if __name__ == "__main__":
    sys.exit(main())
