"""The end of tracking: polish over all keyframes, final poses of the other frames, and the result."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from time import perf_counter

import numpy as np
import numpy.typing as npt

from factors.structureless import edge_residuals
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Edge, Frame
from mvdyn_gtsam.tracking.connect import long_range_edges
from mvdyn_gtsam.tracking.covariance import marginal_covariances
from mvdyn_gtsam.tracking.model import (
    EdgeRecord,
    FrameDepth,
    Keyframe,
    TrackingResult,
    measurement_of,
)
from mvdyn_gtsam.tracking.motion import PoseFit, predict_pose
from mvdyn_gtsam.tracking.polish import estimate_noise, solve_all, total_cost
from mvdyn_gtsam.tracking.rig import hold_mounts
from mvdyn_gtsam.tracking.state import TrackState
from mvdyn_gtsam.tracking.window import MINIMUM_WEIGHT, solve_depth, useful_neighbours

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
OnProgress = Callable[[int, int], None]
"""Called with the number of connections looked at and their total."""


def finish(state: TrackState, on_progress: OnProgress | None = None) -> TrackingResult:
    """Polish and collect; ``state`` holds the polished keyframes afterwards."""
    polish(state, on_progress)
    began = perf_counter()
    covariance = marginal_covariances(
        state.keyframes, state.views, state.tracking, state.priors, state.mounts
    )
    state.count_time("covariance", began)
    return _result(state, covariance)


def polish(state: TrackState, on_progress: OnProgress | None = None) -> None:
    """Solve, connect over long ranges and measure anew what the solve moved, in rounds."""
    keyframes = state.keyframes
    _take_better_start(state)
    for polish_round in range(state.tracking.polish_rounds + 1):
        if polish_round > 0:
            began = perf_counter()
            if polish_round == 1:
                _connect_long_range(state)
            _remeasure(state, on_progress)
            state.count_time("polish measure", began)
        began = perf_counter()
        last = polish_round == state.tracking.polish_rounds
        if last:
            _make_room(state)
        # the first solve starts from the window's poses, with errors that a narrow loss would not see
        robust_px = state.tracking.window_robust_px if polish_round == 0 else state.tracking.robust_px
        solve_all(
            keyframes,
            state.views,
            state.tracking,
            state.priors,
            thin=not last,
            robust_px=robust_px,
            mounts=state.mounts,
        )
        if polish_round == 0:
            state.mounts = hold_mounts(state)
        if not last:
            estimate_noise(keyframes, state.views, state.tracking)
        state.count_time("polish solve", began)


def _take_better_start(state: TrackState) -> None:
    """Begin the polish, from what was tracked or from that bent to the start, whichever costs less.

    The window sees only the past and wanders where parallax is low; the start saw the whole video, but
    may be wrong.
    """
    for group in state.start.groups:
        members = [keyframe for keyframe in state.keyframes if keyframe.camera in group]
        bent = [replace(keyframe, wTc=_bent_pose(state, keyframe)) for keyframe in members]
        costs = []
        for candidates in (members, bent):
            frames = {keyframe.frame: keyframe for keyframe in candidates}
            for keyframe in candidates:
                solve_depth(keyframe, frames, state.views, state.tracking)
            costs.append(total_cost(candidates, state.views, state.tracking))
        logger.debug("group %s: cost as tracked %.4g, bent to the start %.4g", group, *costs)
        if costs[1] < costs[0]:
            for keyframe, other in zip(members, bent, strict=True):
                keyframe.wTc, keyframe.log_depth = other.wTc, other.log_depth
                keyframe.information = other.information


def _bent_pose(state: TrackState, keyframe: Keyframe) -> Array:
    """The tracked pose moved by what separates tracking from the start around that time."""
    start = state.start.frames[keyframe.camera]
    tracked = {k.time: k.wTc for k in state.tracks[keyframe.camera]}
    common = [frame for frame in start if frame.time in tracked]
    if not common:
        return keyframe.wTc
    # nearest outside the common times: a correction must not be extrapolated
    time = min(max(keyframe.time, common[0].time), common[-1].time)
    at_tracked = predict_pose([f.time for f in common], [tracked[f.time] for f in common], time)
    at_start = predict_pose([f.time for f in common], [f.wTc for f in common], time)
    return at_start @ invert_pose(at_tracked) @ keyframe.wTc


def _connect_long_range(state: TrackState) -> None:
    for keyframe in state.keyframes:
        if not state.images.available(keyframe.frame):
            continue
        track = [k for k in state.tracks[keyframe.camera] if state.images.available(k.frame)]
        edges: list[Edge] = long_range_edges(keyframe, track, state.views, state.graph, state.graph_config)
        edges += state.edges_to_other_cameras(keyframe, state.graph_config.polish_per_frame)
        state.add_edges(edges)


def _remeasure(state: TrackState, on_progress: OnProgress | None) -> None:
    """Measure new connections, and guided ones anew where depth and poses predict another flow by now.

    Those that found next to nothing stay as they are: of 78 measured anew on two captures 5 found anything.
    """
    # in time order, so that frames that must be decoded again are read nearly in order
    by_time = [sorted(frames, key=_time_first, reverse=True) for frames in state.kinds]
    ordered = sorted(by_time, key=lambda pair: [_time_first(frame) for frame in pair])

    def due() -> Iterator[tuple[Keyframe, Keyframe]]:
        for done, (i, j) in enumerate(ordered):
            if on_progress is not None:
                on_progress(done, len(ordered))
            first, second = state.frames[i], state.frames[j]
            if j in first.flows and not _due_again(state, first, second):
                continue
            if state.images.available(i) and state.images.available(j):
                yield first, second

    state.measurer.guided_all(due())


def _due_again(state: TrackState, first: Keyframe, second: Keyframe) -> bool:
    if second.frame not in first.guides:
        return False
    found = max(first.flows[second.frame].mean_weight, second.flows[first.frame].mean_weight)
    return found > MINIMUM_WEIGHT and state.measurer.outdated(first, second)


def _make_room(state: TrackState) -> None:
    """Free what only further measuring would need: the last solve and the covariances need the memory."""
    state.images.make_room()
    for keyframe in state.keyframes:
        keyframe.guides.clear()


def _time_first(frame: Frame) -> tuple[int, int]:
    return frame[1], frame[0]


def _result(state: TrackState, covariance: dict[Frame, Array]) -> TrackingResult:
    count = state.last_time + 1
    wTc = np.full((len(state.views), count, 4, 4), np.nan)
    covariances = np.full((len(state.views), count, 6, 6), np.nan)
    depths, informations = [], []
    began = perf_counter()
    for camera, track in enumerate(state.tracks):
        rows, weights = [], []
        for keyframe in track:
            wTc[camera, keyframe.time] = keyframe.wTc
            covariances[camera, keyframe.time] = covariance[keyframe.frame]
            rows.append(keyframe.log_depth)
            weights.append(keyframe.information)
        depths.append(np.stack(rows).astype(np.float32))
        informations.append(np.stack(weights).astype(np.float32))
        for frame in state.others[camera]:
            fit = _settle(state, frame)
            wTc[camera, frame.time] = frame.wTc
            covariances[camera, frame.time] = np.linalg.pinv(fit.information / state.tracking.noise_px**2)
    state.count_time("other frames", began)
    for camera in range(len(state.views)):
        unit = state.unit(camera)
        wTc[camera, :, :3, 3] *= unit
        covariances[camera, :, 3:] *= unit
        covariances[camera, :, :, 3:] *= unit
    units = [state.unit(camera) for camera in range(len(state.views))]
    return TrackingResult(
        groups=state.start.groups,
        wTc=wTc,
        covariance=covariances,
        keyframe_times=tuple(tuple(keyframe.time for keyframe in track) for track in state.tracks),
        grids=tuple(view.grid for view in state.views),
        log_depth=tuple(d + np.float32(np.log(u)) for d, u in zip(depths, units, strict=True)),
        information=tuple(informations),
        edges=_records(state),
        counts=state.graph.counts,
        seconds=dict(state.seconds),
    )


def _settle(state: TrackState, frame: Keyframe) -> PoseFit:
    """Final pose of a frame that is no keyframe, from the keyframes on both sides of it."""
    sources = _around(state, frame)
    if all(state.images.available(k.frame) for k in (frame, *sources)):
        state.measurer.temporal_all([(source, frame) for source in sources])
    usable = [source for source in sources if frame.frame in source.flows]
    last = usable[0]
    times = [source.time for source in sources]
    fit = state.locate(frame, usable, [frame.wTc, predict_pose(times, [s.wTc for s in sources], frame.time)])
    state.carry_depth(frame, last)
    for source in usable:
        del source.flows[frame.frame]
    return fit


def _around(state: TrackState, frame: Keyframe) -> list[Keyframe]:
    track = state.tracks[frame.camera]
    after = int(np.searchsorted([keyframe.time for keyframe in track], frame.time))
    return track[max(0, after - 1) : after + 1]


def frame_depths(state: TrackState) -> Iterator[FrameDepth]:
    """After ``finish``: grid depth of every frame of every camera, in time order, nothing dense held."""
    frames = sorted(
        [frame for lists in (state.tracks, state.others) for track in lists for frame in track],
        key=lambda frame: (frame.time, frame.camera),
    )
    for frame in frames:
        if frame.frame not in state.frames:
            solve_depth(frame, state.frames, state.views, state.tracking)
        unit = state.unit(frame.camera)
        yield FrameDepth(frame.camera, frame.time, frame.log_depth + np.log(unit), frame.information)


def _records(state: TrackState) -> tuple[EdgeRecord, ...]:
    records: list[EdgeRecord] = []
    for keyframe in state.frames.values():
        neighbours = [f for f in useful_neighbours(keyframe) if f in state.frames]
        if not neighbours:
            continue
        measurement = measurement_of(keyframe, neighbours, state.views, state.tracking, steps=1)
        wTj = np.stack([state.frames[frame].wTc for frame in neighbours])
        residuals = edge_residuals(measurement, keyframe.wTc, wTj, keyframe.log_scale)
        for index, frame in enumerate(neighbours):
            records.append(
                EdgeRecord(
                    i=keyframe.frame,
                    j=frame,
                    kind=state.kinds[frozenset((keyframe.frame, frame))],
                    weight=keyframe.flows[frame].mean_weight,
                    median_px=float(residuals.median_px[index]),
                    inlier_fraction=float(residuals.inlier_fraction[index]),
                )
            )
    return tuple(records)
