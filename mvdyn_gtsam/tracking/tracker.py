"""The tracker: one step per instant, usable live, and a polish over everything at the end."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from time import perf_counter

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import S, X
from factors.priors import pose_prior, scale_prior
from factors.structureless import edge_residuals
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.config import Config
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, FlowConfig
from mvdyn_gtsam.frontend.start import Start, StartFrame
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import ConnectionGraph, Edge, EdgeKind, Frame
from mvdyn_gtsam.tracking.connect import inter_camera_edges, long_range_edges
from mvdyn_gtsam.tracking.depth import carried_log_depth, sparse_log_depth
from mvdyn_gtsam.tracking.images import Image, ImageStore, Read
from mvdyn_gtsam.tracking.measure import EdgeMeasurer, mean_flow
from mvdyn_gtsam.tracking.model import (
    EdgeRecord,
    FrameDepth,
    Keyframe,
    StepReport,
    TrackingResult,
    View,
    measurement_of,
)
from mvdyn_gtsam.tracking.motion import Correspondences, PoseFit, locate, predict_pose, world_points
from mvdyn_gtsam.tracking.normalise import normalised_start
from mvdyn_gtsam.tracking.polish import estimate_noise, marginal_covariances, solve_all, total_cost
from mvdyn_gtsam.tracking.window import SlidingWindow, solve_depth, useful_neighbours

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]


class Tracker:
    """Poses of all cameras, instant by instant, from a wide-baseline start.

    Call ``step`` once per instant, in order and without gaps, then ``finish``. ``read(camera, time)`` hands
    out earlier frames again; without it only frames still held in memory can get new connections.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        start: Start,
        flow: DenseFlow,
        config: Config,
        read: Read | None = None,
    ) -> None:
        """Raises TrackingError where the start does not fit the cameras."""
        _check_start(cameras, start)
        self._config, self._tracking, self._graph_config = config, config.tracking, config.graph
        self._start, self._units = normalised_start(start)
        self._views = tuple(View.of(camera, config.tracking.grid_points) for camera in cameras)
        self._images = ImageStore(config.tracking.image_cache_mb * 2**20, read)
        flow_config = getattr(config.frontend, "flow", None) or FlowConfig()
        self._measurer = EdgeMeasurer(self._views, flow, flow_config, self._images, config.tracking)
        self._graph = ConnectionGraph(config.graph.max_active_edges)
        self._window = SlidingWindow(self._views, config.tracking, self._priors)
        self._tracks: list[list[Keyframe]] = [[] for _ in cameras]
        self._frames: dict[Frame, Keyframe] = {}
        self._others: list[list[Keyframe]] = [[] for _ in cameras]
        """Per camera the frames that are no keyframes: pose and flow from and to keyframes, no variables."""
        self._group_of = {camera: group for group, members in enumerate(start.groups) for camera in members}
        self._skeleton = [{frame.time: frame for frame in frames} for frames in self._start.frames]
        self._last_time = -1
        self._seconds: dict[str, float] = {}
        self._edge_records: dict[frozenset[Frame], EdgeKind] = {}

    def step(self, time: int, frames: Sequence[Image]) -> StepReport:
        """Take the frames ``(H, W, 3) uint8`` of all cameras at ``time``, the next instant.

        Raises TrackingError for an instant out of order or a missing or wrongly sized frame.
        """
        began = perf_counter()
        self._check_step(time, frames)
        self._last_time = time
        new: list[Keyframe] = []
        touched: dict[Frame, Keyframe] = {}
        for camera, image in enumerate(frames):
            self._images.put((camera, time), image)
            candidate = self._candidate(camera, time)
            if self._is_keyframe(candidate):
                self._promote(candidate, touched)
                new.append(candidate)
            else:
                self._others[camera].append(candidate)
        self._time("temporal", began)
        self._solve_step(new, touched)
        counts = self._graph.record(time)
        return StepReport(
            time=time,
            wTc=np.stack([self._latest(camera).wTc for camera in range(len(frames))]),
            keyframes=tuple(any(k.camera == camera for k in new) for camera in range(len(frames))),
            counts=counts,
            seconds=perf_counter() - began,
        )

    # ---- one frame -----------------------------------------------------------------------------------

    def _candidate(self, camera: int, time: int) -> Keyframe:
        """The new frame with a pose and depths, measured against the last keyframe of its camera."""
        view = self._views[camera]
        track = self._tracks[camera]
        predictions = self._predictions(camera, time)
        sparse = self._nearest_start(camera, time)
        if not track:
            log_depth = sparse_log_depth(sparse.pixels, sparse.depth, view.grid)
            return self._keyframe(camera, time, predictions[0], log_depth)
        last = track[-1]
        frame = self._keyframe(camera, time, predictions[0], last.log_depth)
        # only a stand-in until flow says better: where the flow is guided, the depth must belong to this view
        self._measurer.temporal(last, frame)
        self._locate(frame, [last], predictions)
        if frame.frame in last.guides:
            self._carry_depth(frame, last)
            self._measurer.guided(last, frame)
            self._locate(frame, [last], [frame.wTc, *predictions])
        self._carry_depth(frame, last)
        return frame

    def _keyframe(self, camera: int, time: int, wTc: Array, log_depth: Array) -> Keyframe:
        sigma = np.full(len(log_depth), self._tracking.carried_sigma)
        return Keyframe(camera, time, wTc, log_depth, sigma**-2.0, log_depth, sigma)

    def _predictions(self, camera: int, time: int) -> list[Array]:
        """Poses to try, the most trusted first: the start's, and constant velocity corrected by tracking."""
        start = self._start.frames[camera]
        from_start = predict_pose([f.time for f in start], [f.wTc for f in start], time)
        recent = self._recent(camera)
        if not recent:
            return [from_start]
        last = recent[-1]
        moved = predict_pose([f.time for f in start], [f.wTc for f in start], last.time)
        # the start's motion since the last frame, applied where tracking has put that frame
        predictions = [last.wTc @ np.linalg.inv(moved) @ from_start]
        inside = start[0].time <= time <= start[-1].time
        if len(recent) >= 2:
            velocity = predict_pose([f.time for f in recent[-2:]], [f.wTc for f in recent[-2:]], time)
            predictions.insert(len(predictions) if inside else 0, velocity)
        return predictions

    def _recent(self, camera: int) -> list[Keyframe]:
        both = self._tracks[camera][-2:] + self._others[camera][-2:]
        return sorted(both, key=lambda frame: frame.time)[-2:]

    def _latest(self, camera: int) -> Keyframe:
        return self._recent(camera)[-1]

    def _nearest_start(self, camera: int, time: int) -> StartFrame:
        return min(self._start.frames[camera], key=lambda frame: abs(frame.time - time))

    def _locate(self, frame: Keyframe, sources: Sequence[Keyframe], predictions: Sequence[Array]) -> PoseFit:
        """Motion-only pose of ``frame`` from keyframes that have flow to it."""
        seen = Correspondences.join(
            [
                Correspondences(
                    world_points(self._views[source.camera].rays, source.log_depth, source.wTc),
                    source.flows[frame.frame].target.astype(np.float64),
                    source.flows[frame.frame].weight.astype(np.float64),
                )
                for source in sources
            ]
        )
        fit = locate(seen, self._views[frame.camera].intrinsics, predictions, self._tracking.window_robust_px)
        frame.wTc = fit.wTc
        return fit

    def _carry_depth(self, frame: Keyframe, source: Keyframe) -> None:
        view = self._views[frame.camera]
        source_view = self._views[source.camera]
        log_depth, _ = carried_log_depth(
            frame.flows[source.frame],
            view.grid,
            frame.wTc,
            source_view.grid,
            source.log_depth,
            source.wTc,
            source_view.camera.intrinsics,
            minimum_weight=0.1,
        )
        frame.log_depth = frame.prior_log_depth = log_depth

    def _is_keyframe(self, frame: Keyframe) -> bool:
        track = self._tracks[frame.camera]
        if not track:
            return True
        length = mean_flow(track[-1], frame.frame, self._views[frame.camera])
        # nothing measured: the view has changed beyond recognition, so it is new
        return not length < self._tracking.keyframe_px

    # ---- keyframes and their connections ---------------------------------------------------------------

    def _promote(self, frame: Keyframe, touched: dict[Frame, Keyframe]) -> None:
        """Make a frame a keyframe: temporal and inter-camera connections, measured."""
        track = self._tracks[frame.camera]
        self._forget_candidates(frame)
        touched[frame.frame] = frame
        edges: list[Edge] = []
        offsets = [offset for offset in self._graph_config.temporal_offsets if offset <= len(track)]
        for offset in offsets:
            other = track[-offset]
            if not self._images.available(other.frame):
                continue
            edges.append(Edge(frame.frame, other.frame, EdgeKind.TEMPORAL))
            if frame.frame not in other.flows:
                self._measurer.temporal(other, frame)
            # each renewal takes in all flow gathered since the last: early for depth, late for completeness
            if offset in (offsets[0], self._graph_config.temporal_offsets[-1]):
                touched[other.frame] = other
        track.append(frame)
        self._frames[frame.frame] = frame
        self._add_edges(edges)

    def _forget_candidates(self, frame: Keyframe) -> None:
        """Flow of frames that were no keyframes is measured again at the end, to keyframes on both sides."""
        track = self._tracks[frame.camera]
        if track:
            last = track[-1]
            for other in [key for key in last.flows if key not in self._frames and key != frame.frame]:
                del last.flows[other]

    def _connect_cameras(self, new: Sequence[Keyframe]) -> None:
        for frame in new:
            for camera, track in enumerate(self._tracks):
                if camera == frame.camera or self._group_of[camera] != self._group_of[frame.camera]:
                    continue
                others = [other for other in track if self._images.available(other.frame)]
                edges = inter_camera_edges(
                    frame,
                    others,
                    self._views,
                    self._graph,
                    self._graph_config,
                    self._graph_config.st_per_frame,
                )
                for edge in edges:
                    other = self._frames[edge.j]
                    self._measurer.guided(frame, other)
                self._add_edges(edges)

    def _add_edges(self, edges: Sequence[Edge]) -> None:
        for edge in edges:
            self._edge_records.setdefault(edge.frames, edge.kind)
        self._graph.add(edges)

    def _solve_step(self, new: list[Keyframe], touched: dict[Frame, Keyframe]) -> None:
        if not new:
            return
        began = perf_counter()
        self._connect_cameras(new)
        self._time("inter-camera", began)
        began = perf_counter()
        self._window.update(new, list(touched.values()), self._frames)
        window = self._tracking.window
        self._graph.leave_window(
            {camera: track[-window:][0].time for camera, track in enumerate(self._tracks) if track}
        )
        self._time("isam2", began)

    def _priors(self, keyframe: Keyframe) -> list[gtsam.NonlinearFactor]:
        """The start's word on this frame, and the gauge at the first keyframe of each group."""
        pose_key, scale_key = X(*keyframe.frame), S(*keyframe.frame)
        config = self._tracking
        if keyframe is self._anchor(keyframe.camera):
            return [pose_prior(pose_key, keyframe.wTc, 1e-5, 1e-5), scale_prior(scale_key, 0.0, 1e-3)]
        priors: list[gtsam.NonlinearFactor] = [scale_prior(scale_key, 0.0, config.scale_sigma)]
        start = self._skeleton[keyframe.camera].get(keyframe.time)
        if start is not None:
            rotation = np.radians(config.start_rotation_deg)
            priors.append(pose_prior(pose_key, start.wTc, rotation, config.start_translation))
        return priors

    def _anchor(self, camera: int) -> Keyframe | None:
        group = self._start.groups[self._group_of[camera]]
        first = [self._tracks[member][0] for member in group if self._tracks[member]]
        return min(first, key=lambda frame: frame.frame[::-1]) if first else None

    # ---- the end -----------------------------------------------------------------------------------------

    def finish(self) -> TrackingResult:
        """Polish over all keyframes, motion-only solves for the other frames, and the result."""
        if self._last_time < 0:
            raise TrackingError("nothing was tracked: step was never called")
        self._finish_last_frames()
        keyframes = [keyframe for track in self._tracks for keyframe in track]
        self._polish(keyframes)
        began = perf_counter()
        covariance = marginal_covariances(keyframes, self._views, self._tracking, self._priors)
        self._time("covariance", began)
        return self._result(covariance)

    def _polish(self, keyframes: list[Keyframe]) -> None:
        self._take_better_start(keyframes)
        for polish_round in range(self._tracking.polish_rounds + 1):
            if polish_round > 0:
                began = perf_counter()
                self._remeasure(add=polish_round == 1)
                self._time("polish measure", began)
            began = perf_counter()
            last = polish_round == self._tracking.polish_rounds
            # the first solve starts from the window's poses, with errors that a narrow loss would not see
            robust_px = self._tracking.window_robust_px if polish_round == 0 else self._tracking.robust_px
            solve_all(
                keyframes, self._views, self._tracking, self._priors, thin=not last, robust_px=robust_px
            )
            if not last:
                estimate_noise(keyframes, self._views, self._tracking)
            self._time("polish solve", began)

    def _take_better_start(self, keyframes: list[Keyframe]) -> None:
        """Begin the polish, from what was tracked or from that bent to the start, whichever costs less.

        The window sees only the past and wanders where parallax is low; the start saw the whole video, but
        may be wrong.
        """
        for group in self._start.groups:
            members = [keyframe for keyframe in keyframes if keyframe.camera in group]
            bent = [replace(keyframe, wTc=self._bent_pose(keyframe)) for keyframe in members]
            costs = []
            for candidates in (members, bent):
                frames = {keyframe.frame: keyframe for keyframe in candidates}
                for keyframe in candidates:
                    solve_depth(keyframe, frames, self._views, self._tracking)
                costs.append(total_cost(candidates, self._views, self._tracking))
            logger.debug("group %s: cost as tracked %.4g, bent to the start %.4g", group, *costs)
            if costs[1] < costs[0]:
                for keyframe, other in zip(members, bent, strict=True):
                    keyframe.wTc, keyframe.log_depth = other.wTc, other.log_depth
                    keyframe.information = other.information

    def _bent_pose(self, keyframe: Keyframe) -> Array:
        """The tracked pose moved by what separates tracking from the start around that time."""
        start = self._start.frames[keyframe.camera]
        tracked = {k.time: k.wTc for k in self._tracks[keyframe.camera]}
        common = [frame for frame in start if frame.time in tracked]
        if not common:
            return keyframe.wTc
        # nearest outside the common times: a correction must not be extrapolated
        time = min(max(keyframe.time, common[0].time), common[-1].time)
        at_tracked = predict_pose([f.time for f in common], [tracked[f.time] for f in common], time)
        at_start = predict_pose([f.time for f in common], [f.wTc for f in common], time)
        return at_start @ invert_pose(at_tracked) @ keyframe.wTc

    def _remeasure(self, add: bool) -> None:
        """Measure guided edges anew with today's depth and poses; with ``add`` choose long-range ones."""
        if add:
            for track in self._tracks:
                for keyframe in track:
                    self._add_edges(self._polish_edges(keyframe))
        ordered = sorted(self._edge_records, key=lambda frames: sorted(frames, key=lambda f: f[::-1])[::-1])
        for frames in ordered:
            j, i = sorted(frames, key=lambda frame: frame[::-1])
            first, second = self._frames[i], self._frames[j]
            if j in first.flows and (j not in first.guides or not self._measurer.outdated(first, second)):
                continue
            if self._images.available(i) and self._images.available(j):
                self._measurer.guided(first, second)

    def _polish_edges(self, keyframe: Keyframe) -> list[Edge]:
        config = self._graph_config
        track = [k for k in self._tracks[keyframe.camera] if self._images.available(k.frame)]
        if not self._images.available(keyframe.frame):
            return []
        edges = long_range_edges(keyframe, track, self._views, self._graph, config)
        for camera, others in enumerate(self._tracks):
            if camera != keyframe.camera and self._group_of[camera] == self._group_of[keyframe.camera]:
                available = [k for k in others if self._images.available(k.frame)]
                edges += inter_camera_edges(
                    keyframe, available, self._views, self._graph, config, config.polish_per_frame
                )
        return edges

    def _finish_last_frames(self) -> None:
        """The last frame of every camera becomes a keyframe, so that every other lies between two."""
        new: list[Keyframe] = []
        touched: dict[Frame, Keyframe] = {}
        for others in self._others:
            if others and others[-1].time == self._last_time:
                frame = others.pop()
                self._promote(frame, touched)
                new.append(frame)
        self._solve_step(new, touched)

    def _result(self, covariance: dict[Frame, Array]) -> TrackingResult:
        count = self._last_time + 1
        wTc = np.full((len(self._views), count, 4, 4), np.nan)
        covariances = np.full((len(self._views), count, 6, 6), np.nan)
        depths, informations = [], []
        began = perf_counter()
        for camera, track in enumerate(self._tracks):
            rows, weights = [], []
            for keyframe in track:
                wTc[camera, keyframe.time] = keyframe.wTc
                covariances[camera, keyframe.time] = covariance[keyframe.frame]
                rows.append(keyframe.log_depth)
                weights.append(keyframe.information)
            depths.append(np.stack(rows).astype(np.float32))
            informations.append(np.stack(weights).astype(np.float32))
            for frame in self._others[camera]:
                fit = self._settle(frame)
                wTc[camera, frame.time] = frame.wTc
                covariances[camera, frame.time] = np.linalg.pinv(fit.information / self._tracking.noise_px**2)
        self._time("other frames", began)
        for camera in range(len(self._views)):
            unit = self._units[self._group_of[camera]]
            wTc[camera, :, :3, 3] *= unit
            covariances[camera, :, 3:] *= unit
            covariances[camera, :, :, 3:] *= unit
        units = [self._units[self._group_of[camera]] for camera in range(len(self._views))]
        return TrackingResult(
            groups=self._start.groups,
            wTc=wTc,
            covariance=covariances,
            keyframe_times=tuple(tuple(keyframe.time for keyframe in track) for track in self._tracks),
            grids=tuple(view.grid for view in self._views),
            log_depth=tuple(d + np.float32(np.log(u)) for d, u in zip(depths, units, strict=True)),
            information=tuple(informations),
            edges=self._records(),
            counts=self._graph.counts,
            seconds=dict(self._seconds),
        )

    def _settle(self, frame: Keyframe) -> PoseFit:
        """Final pose of a frame that is no keyframe, from the keyframes on both sides of it."""
        sources = self._around(frame)
        if all(self._images.available(k.frame) for k in (frame, *sources)):
            for source in sources:
                self._measurer.temporal(source, frame)
        usable = [source for source in sources if frame.frame in source.flows]
        last = usable[0]
        times = [source.time for source in sources]
        fit = self._locate(
            frame, usable, [frame.wTc, predict_pose(times, [s.wTc for s in sources], frame.time)]
        )
        self._carry_depth(frame, last)
        for source in usable:
            del source.flows[frame.frame]
        return fit

    def _around(self, frame: Keyframe) -> list[Keyframe]:
        track = self._tracks[frame.camera]
        after = int(np.searchsorted([keyframe.time for keyframe in track], frame.time))
        return track[max(0, after - 1) : after + 1]

    def frame_depths(self) -> Iterator[FrameDepth]:
        """After ``finish``: grid depth of every frame of every camera, in time order, nothing dense held."""
        frames = sorted(
            [frame for lists in (self._tracks, self._others) for track in lists for frame in track],
            key=lambda frame: (frame.time, frame.camera),
        )
        for frame in frames:
            if frame.frame not in self._frames:
                solve_depth(frame, self._frames, self._views, self._tracking)
            unit = self._units[self._group_of[frame.camera]]
            yield FrameDepth(frame.camera, frame.time, frame.log_depth + np.log(unit), frame.information)

    def _records(self) -> tuple[EdgeRecord, ...]:
        records: list[EdgeRecord] = []
        for keyframe in self._frames.values():
            neighbours = [f for f in useful_neighbours(keyframe) if f in self._frames]
            if not neighbours:
                continue
            measurement = measurement_of(keyframe, neighbours, self._views, self._tracking, steps=1)
            wTj = np.stack([self._frames[frame].wTc for frame in neighbours])
            residuals = edge_residuals(measurement, keyframe.wTc, wTj, keyframe.log_scale)
            for index, frame in enumerate(neighbours):
                records.append(
                    EdgeRecord(
                        i=keyframe.frame,
                        j=frame,
                        kind=self._edge_records[frozenset((keyframe.frame, frame))],
                        weight=float(keyframe.flows[frame].weight.mean()),
                        median_px=float(residuals.median_px[index]),
                        inlier_fraction=float(residuals.inlier_fraction[index]),
                    )
                )
        return tuple(records)

    def _time(self, part: str, began: float) -> None:
        self._seconds[part] = self._seconds.get(part, 0.0) + perf_counter() - began

    def _check_step(self, time: int, frames: Sequence[Image]) -> None:
        if time != self._last_time + 1:
            raise TrackingError(
                f"instant {time} was handed in after {self._last_time}; hand in every one in order"
            )
        if len(frames) != len(self._views):
            raise TrackingError(f"instant {time}: {len(frames)} frames for {len(self._views)} cameras")
        for view, image in zip(self._views, frames, strict=True):
            size = (view.camera.height, view.camera.width)
            if image.shape[:2] != size:
                raise TrackingError(
                    f"instant {time}: camera {view.camera.name} handed a frame of "
                    f"{image.shape[1]}x{image.shape[0]}, but its intrinsics are for {size[1]}x{size[0]}"
                )


def _check_start(cameras: Sequence[Camera], start: Start) -> None:
    members = sorted(camera for group in start.groups for camera in group)
    if members != list(range(len(cameras))) or len(start.frames) != len(cameras):
        raise TrackingError(
            f"the start's groups {start.groups} do not hold each of {len(cameras)} cameras once"
        )
    for camera, frames in zip(cameras, start.frames, strict=True):
        if not frames or all(len(frame.depth) == 0 for frame in frames):
            raise TrackingError(f"the start has no depths for camera {camera.name}")
