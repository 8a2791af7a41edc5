"""The whole reconstruction, top to bottom as in the paper's overview figure."""

from __future__ import annotations

import logging
from pathlib import Path
from time import perf_counter

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import Config, to_dict
from mvdyn_gtsam.frontend.dense_depth import upsample_depth
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, DisFlow
from mvdyn_gtsam.frontend.dense_map import testimony_flow
from mvdyn_gtsam.frontend.start import Start, start_from_arrays, start_to_arrays
from mvdyn_gtsam.frontend.wide_baseline import ClassicalInitializer, WideBaselineInitializer
from mvdyn_gtsam.progress import NullProgress, Progress
from mvdyn_gtsam.reconstruction import CaptureInfo, Reconstruction, ReconstructionWriter
from mvdyn_gtsam.tracking.model import FrameDepth, TrackingResult
from mvdyn_gtsam.tracking.tracker import Tracker

logger = logging.getLogger(__name__)


def reconstruct(
    capture: Capture,
    out: Path | str,
    config: Config | None = None,
    *,
    stage: str = "tracking",
    resume: bool = False,
    progress: Progress | None = None,
    flow: DenseFlow | None = None,
    initializer: WideBaselineInitializer | None = None,
) -> Reconstruction:
    """Recover every camera's pose and depth at every frame and write them to ``out``.

    ``stage`` is the last one to run; "tracking" is the only one so far. ``flow`` and ``initializer`` replace
    the classical measurements. With ``resume`` what ``out`` already holds is not computed again. Raises
    TrackingError when nothing can be reconstructed, ResultError when ``out`` cannot be used.
    """
    if stage != "tracking":
        raise ValueError(f"unknown stage {stage!r}; this version has tracking")
    config = config if config is not None else Config()
    progress = progress if progress is not None else NullProgress()
    flow = flow if flow is not None else DisFlow(config.frontend.flow)
    if initializer is None:
        testimony = DisFlow(testimony_flow(config.frontend.flow))
        initializer = ClassicalInitializer(testimony, config.frontend.wide_baseline)
    out = Path(out)
    writer = ReconstructionWriter.create(
        out, CaptureInfo.from_capture(capture), to_dict(config), resume=resume
    )
    with writer:
        if not writer.stage_finished("tracking"):
            start = _start(capture, initializer, writer, progress)
            writer.set_groups([[capture.cameras[camera].name for camera in group] for group in start.groups])
            _note_groups(capture, start, writer)
            _track(capture, start, flow, config, writer, progress)
    return Reconstruction.load(out)


def _start(
    capture: Capture, initializer: WideBaselineInitializer, writer: ReconstructionWriter, progress: Progress
) -> Start:
    """The wide-baseline start, taken from an earlier run where there is one."""
    if writer.stage_finished("start"):
        return start_from_arrays(writer.read_arrays("start"))
    began = perf_counter()
    start = initializer(capture, progress)
    for note in start.notes:
        writer.add_note(note)
    writer.write_arrays("start", start_to_arrays(start))
    writer.finish_stage("start", perf_counter() - began)
    return start


def _note_groups(capture: Capture, start: Start, writer: ReconstructionWriter) -> None:
    if len(start.groups) == 1:
        return
    groups = "; ".join(", ".join(capture.cameras[camera].name for camera in group) for group in start.groups)
    note = f"no view connects all cameras; each of these groups has its own world frame and scale: {groups}"
    logger.warning(note)
    writer.add_note(note)


def _track(
    capture: Capture,
    start: Start,
    flow: DenseFlow,
    config: Config,
    writer: ReconstructionWriter,
    progress: Progress,
) -> None:
    """Poses of every frame, then its depth, each written as soon as it is known."""
    began = perf_counter()
    tracker = Tracker(capture.cameras, start, flow, config, read=capture.read)
    cameras = range(len(capture.cameras))
    wTc = np.full((len(capture.cameras), capture.frame_count, 4, 4), np.nan)
    try:
        for time in range(capture.frame_count):
            report = tracker.step(time, [capture.read(camera, time) for camera in cameras])
            wTc[:, time] = report.wTc
            note = f"{sum(report.keyframes)} new keyframes"
            progress.update("tracking", time + 1, capture.frame_count, note)
        result = tracker.finish(lambda done, total: progress.update("polish", done, total, "long-range flow"))
        wTc = result.wTc
    finally:
        # Also when stopped half-way: what is known by then can be read and looked at.
        for camera in cameras:
            writer.write_trajectory(capture.cameras[camera].name, capture.timestamps, wTc[camera])
    _write_diagnostics(capture, result, writer)
    total = capture.frame_count * len(capture.cameras)
    for done, depth in enumerate(tracker.frame_depths()):
        _write_depth(capture, depth, result, writer)
        progress.update("depth", done + 1, total, capture.cameras[depth.camera].name)
    writer.finish_stage("tracking", perf_counter() - began)


def _write_depth(
    capture: Capture, depth: FrameDepth, result: TrackingResult, writer: ReconstructionWriter
) -> None:
    name = capture.cameras[depth.camera].name
    if writer.has_depth(name, depth.time):
        return
    image = capture.read(depth.camera, depth.time)
    # Information of a point's log depth is the inverse variance: confidence falls to a half at 5 % error.
    weight = depth.information / (depth.information + 0.05**-2)
    dense, confidence = upsample_depth(
        image, result.grids[depth.camera], np.exp(depth.log_depth), np.maximum(weight, 1e-6)
    )
    writer.write_depth(name, depth.time, dense, confidence)


def _write_diagnostics(capture: Capture, result: TrackingResult, writer: ReconstructionWriter) -> None:
    names = [camera.name for camera in capture.cameras]
    writer.write_arrays("covariance", {"covariance": result.covariance})
    writer.set_diagnostics("seconds", dict(result.seconds))
    writer.set_diagnostics(
        "keyframes", {name: list(times) for name, times in zip(names, result.keyframe_times, strict=True)}
    )
    writer.set_diagnostics(
        "edges_per_step",
        {
            kind: [getattr(counts, kind) for counts in result.counts]
            for kind in ("temporal", "spatial", "spatio_temporal")
        },
    )
