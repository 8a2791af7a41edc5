"""The whole reconstruction, top to bottom as in the paper's overview figure."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import Config, to_dict
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.frontend.dense_depth import upsample_depth
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, DisFlow, FlowConfig
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import AlignedPrior, align_to_start
from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior, NoDepthPrior
from mvdyn_gtsam.frontend.depth_priors.predictions import Predictions
from mvdyn_gtsam.frontend.start.dense_map import testimony_flow
from mvdyn_gtsam.frontend.start.model import Start, found_cameras, start_from_arrays, start_to_arrays
from mvdyn_gtsam.frontend.start.wide_baseline import ClassicalInitializer, WideBaselineInitializer
from mvdyn_gtsam.frontend.threads import in_order
from mvdyn_gtsam.progress import NullProgress, Progress
from mvdyn_gtsam.reconstruction import CaptureInfo, Reconstruction, ReconstructionWriter
from mvdyn_gtsam.resuming import RunConfig, configure, resumed_prior
from mvdyn_gtsam.tracking.model import FrameDepth, TrackingResult
from mvdyn_gtsam.tracking.tracker import Tracker

if TYPE_CHECKING:
    from mvdyn_gtsam.refinement.stage import Tracked

logger = logging.getLogger(__name__)

STAGES = ("tracking", "refinement")


def reconstruct(
    capture: Capture,
    out: Path | str,
    config: Config | Mapping[str, Any] | None = None,
    *,
    stage: str = "refinement",
    resume: bool = False,
    progress: Progress | None = None,
    flow: DenseFlow | None = None,
    initializer: WideBaselineInitializer | None = None,
    depth_prior: DepthPrior | None = None,
) -> Reconstruction:
    """Recover every camera's pose and depth at every frame and write them to ``out``.

    ``stage`` is the last one to run, one of ``STAGES``. ``flow`` and ``initializer`` replace the classical
    measurements; a flow that cannot be pickled needs ``refinement.workers=1``. ``config`` may be nested
    settings, e.g. ``{"tracking": {"window": 20}}``; the others have their defaults. ``depth_prior`` predicts
    depth from single images, for tracking; it is asked once for every frame.

    With ``resume`` what ``out`` already holds is not computed again, and the run goes on with the settings it
    began with, those of stages to come too. ``config`` may change them for stages that are not finished; of a
    ``Config`` what differs from the defaults counts as asked for. Settings that are new since take their
    defaults. A run that began with a depth prior needs it again until tracking is finished.

    Raises TrackingError when nothing can be reconstructed, DepthPriorError when the prior cannot be used or
    fits no scale of the scene, ResultError when ``out`` cannot be used or a finished stage was made with
    other settings than ``config`` asks for.
    """
    if stage not in STAGES:
        raise ValueError(f"unknown stage {stage!r}; there are {', '.join(STAGES)}")
    out = Path(out)
    run = configure(out, config, resume=resume)
    config = run.config
    if isinstance(depth_prior, NoDepthPrior):
        depth_prior = None
    prior_name = resumed_prior(out, None if depth_prior is None else depth_prior.name, resume=resume)
    progress = progress if progress is not None else NullProgress()
    tracking_flow = flow if flow is not None else DisFlow(config.frontend.flow)
    if initializer is None:
        testimony = DisFlow(testimony_flow(config.frontend.flow))
        initializer = ClassicalInitializer(testimony, config.frontend.wide_baseline)
    writer = ReconstructionWriter.create(
        out, CaptureInfo.from_capture(capture), to_dict(config), resume=resume, depth_prior=prior_name
    )
    run.log()
    with writer:
        if not writer.stage_finished("tracking"):
            start = _start(capture, initializer, writer, progress)
            capture = replace(capture, cameras=found_cameras(capture.cameras, start))
            _note_intrinsics(capture, start, writer)
            writer.set_groups([[capture.cameras[camera].name for camera in group] for group in start.groups])
            _note_groups(capture, start, writer)
            with _aligned(depth_prior, capture, start, writer, progress) as prior:
                _track(capture, start, tracking_flow, prior, config, writer, progress)
        if stage == "refinement" and not writer.stage_finished("refinement"):
            capture = replace(capture, cameras=writer.cameras)
            _warn_of_new_start(run, writer)
            refinement_flow = flow if flow is not None else DisFlow(dense_flow_config(config))
            _refine(capture, refinement_flow, config, writer, progress)
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


def _note_intrinsics(capture: Capture, start: Start, writer: ReconstructionWriter) -> None:
    """Write down what the start found; ``capture`` has it already."""
    found = {capture.cameras[index].name: own for index, own in start.intrinsics.items()}
    cameras = {capture.cameras[index].name: capture.cameras[index] for index in start.intrinsics}
    writer.set_found_intrinsics(cameras, {name: own.deviation for name, own in found.items()})
    for name, own in found.items():
        writer.add_note(
            f"{name}: focal length found in its video, {own.focal:.1f} px, give or take {own.deviation:.1f};"
            f" principal point ({own.cx:.1f}, {own.cy:.1f})"
        )


def _note_groups(capture: Capture, start: Start, writer: ReconstructionWriter) -> None:
    if len(start.groups) == 1:
        return
    groups = "; ".join(", ".join(capture.cameras[camera].name for camera in group) for group in start.groups)
    note = f"no view connects all cameras; each of these groups has its own world frame and scale: {groups}"
    logger.warning(note)
    writer.add_note(note)


@contextmanager
def _aligned(
    depth_prior: DepthPrior | None,
    capture: Capture,
    start: Start,
    writer: ReconstructionWriter,
    progress: Progress,
) -> Iterator[AlignedPrior | None]:
    """The prior in the start's scale; what it predicts is kept on disk in the meantime."""
    if depth_prior is None:
        yield None
        return
    with Predictions(depth_prior, capture.cameras, writer.predictions_folder) as predictions:
        aligned = align_to_start(predictions, start, capture.read, progress)
        writer.set_diagnostics(
            "depth_prior",
            [
                {
                    "cameras": [capture.cameras[camera].name for camera in one.group],
                    "scale": one.scale_offset.scale,
                    "offset": one.scale_offset.offset,
                    "median_error": one.error,
                }
                for one in aligned.alignments
            ],
        )
        yield aligned


def _track(
    capture: Capture,
    start: Start,
    flow: DenseFlow,
    prior: AlignedPrior | None,
    config: Config,
    writer: ReconstructionWriter,
    progress: Progress,
) -> None:
    """Poses of every frame, then its depth, each written as soon as it is known."""
    began = perf_counter()
    tracker = Tracker(
        capture.cameras, start, flow, config, capture.read, None if prior is None else prior.at_grid
    )
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
    jobs = (_depth_job(capture, depth, prior, result, writer) for depth in tracker.frame_depths())
    for done, name in enumerate(in_order(jobs)):
        progress.update("depth", done + 1, total, name)
    writer.finish_stage("tracking", perf_counter() - began)


def _refine(
    capture: Capture, flow: DenseFlow, config: Config, writer: ReconstructionWriter, progress: Progress
) -> None:
    """Dense depth and poses from flow of every pixel; they replace tracking's when all is done."""
    # here, so that tracking alone does not wait for what it does not use
    from mvdyn_gtsam.refinement.report import SelfCheck
    from mvdyn_gtsam.refinement.stage import Refinement

    began = perf_counter()
    tracked = _tracked(capture, writer)
    refinement = Refinement(
        tracked, _workspace(writer), config.refinement, flow, dense_flow_config(config), progress
    )
    _announce_refinement(tracked, config, writer)
    names = [camera.name for camera in capture.cameras]
    residuals = SelfCheck(names)
    with refinement:
        refined = refinement.run()
        for frame in refinement.frames():
            camera, time = frame.frame
            residuals.add(frame)
            writer.write_motion(names[camera], time, frame.moving)
            writer.write_depth(names[camera], time, frame.depth, frame.confidence, refined=True)
    for camera, name in enumerate(names):
        writer.write_trajectory(name, capture.timestamps, refined.wTc[camera], refined=True)
    writer.publish_refined()
    writer.set_diagnostics("residual_px", residuals.medians())
    writer.set_diagnostics("refinement_seconds", refined.seconds)
    writer.write_arrays("scales", {"scale": refined.scale, "offset": refined.offset})
    writer.finish_stage("refinement", perf_counter() - began)
    refinement.remove()
    shutil.rmtree(writer.refinement_folder, ignore_errors=True)


def _warn_of_new_start(run: RunConfig, writer: ReconstructionWriter) -> None:
    """A refinement keeps its steps only as long as its settings stay (``Workspace.prepare``)."""
    keys = [key for key in run.changed if key.startswith(("refinement.", "frontend.flow."))]
    if keys and _workspace(writer).is_dir():
        logger.warning("the refinement begins anew, its settings are others: %s", ", ".join(keys))


def dense_flow_config(config: Config) -> FlowConfig:
    """Flow settings of the refinement: tracking's, but for how fine it is measured."""
    return replace(config.frontend.flow, finest_scale=config.refinement.flow_finest_scale)


def _workspace(writer: ReconstructionWriter) -> Path:
    return writer.refinement_folder / "work"


def _announce_refinement(tracked: Tracked, config: Config, writer: ReconstructionWriter) -> None:
    """Say what it takes, and refuse what the disk cannot hold."""
    from mvdyn_gtsam.refinement.stage import required

    disk, seconds = required(tracked, config.refinement)
    free = shutil.disk_usage(writer.folder).free
    logger.info("refinement: %.0f MB of disk while it works, flow takes about %.0f s", disk / 1e6, seconds)
    if free < disk:
        raise ResultError(
            f"{writer.folder}: the refinement works on {disk / 1e6:.0f} MB and the disk has"
            f" {free / 1e6:.0f} MB left; free space and continue with --resume, or stay with --stage tracking"
        )


def _tracked(capture: Capture, writer: ReconstructionWriter) -> Tracked:
    """The tracking result as it lies on disk."""
    from mvdyn_gtsam.refinement.stage import Tracked

    result = Reconstruction.load(writer.tracked())
    names = [camera.name for camera in capture.cameras]
    connections = writer.read_arrays("connections")["frames"]
    return Tracked(
        cameras=capture.cameras,
        groups=tuple(tuple(names.index(name) for name in group) for group in result.groups),
        wTc=np.stack([result.trajectory(name)[1] for name in names]),
        covariance=writer.read_arrays("covariance")["covariance"],
        omega=tuple(((int(a), int(b)), (int(c), int(d))) for a, b, c, d in connections),
        read=capture.read,
        depth=lambda camera, time: (
            result.depth(names[camera], time),
            result.confidence(names[camera], time),
        ),
    )


def _depth_job(
    capture: Capture,
    depth: FrameDepth,
    prior: AlignedPrior | None,
    result: TrackingResult,
    writer: ReconstructionWriter,
) -> Callable[[], str]:
    """Brings one frame's depth to the input's resolution, writes it and returns its camera's name.

    The image is read here and now: cameras are read by one thread at a time.
    """
    name = capture.cameras[depth.camera].name
    if writer.has_depth(name, depth.time):
        return lambda: name
    image = capture.read(depth.camera, depth.time)
    log_prior = None if prior is None else prior.dense(depth.camera, depth.time, image)

    def write() -> str:
        # Information of a point's log depth is the inverse variance: confidence falls to a half at 5 % error.
        weight = depth.information / (depth.information + 0.05**-2)
        dense, confidence = upsample_depth(
            image,
            result.grids[depth.camera],
            np.exp(depth.log_depth),
            np.maximum(weight, 1e-6),
            log_prior=log_prior,
        )
        writer.write_depth(name, depth.time, dense, confidence)
        return name

    return write


def _write_diagnostics(capture: Capture, result: TrackingResult, writer: ReconstructionWriter) -> None:
    names = [camera.name for camera in capture.cameras]
    writer.write_arrays("covariance", {"covariance": result.covariance})
    writer.write_arrays(
        "connections", {"frames": np.array([(*edge.i, *edge.j) for edge in result.edges]).reshape(-1, 4)}
    )
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
