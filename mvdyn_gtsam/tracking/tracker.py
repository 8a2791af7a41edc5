"""The tracker: one step per instant, usable live, and a polish over everything at the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import perf_counter

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.config import Config
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.dense_flow import DenseFlow
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import GridDepth, PriorAtGrid
from mvdyn_gtsam.frontend.start.model import Start, StartFrame
from mvdyn_gtsam.graph.connections import Edge, EdgeKind, Frame
from mvdyn_gtsam.tracking import finish as end
from mvdyn_gtsam.tracking.depth import sparse_log_depth
from mvdyn_gtsam.tracking.images import Image, Read
from mvdyn_gtsam.tracking.measure import mean_flow
from mvdyn_gtsam.tracking.model import FrameDepth, Keyframe, StepReport, TrackingResult
from mvdyn_gtsam.tracking.motion import predict_pose
from mvdyn_gtsam.tracking.state import TrackState
from mvdyn_gtsam.tracking.window import SlidingWindow

Array = npt.NDArray[np.float64]

NEAR_PX = 2.0
"""Median change of a prediction up to which the flow around it finds the same, px: half of the 62 flows
between successive frames of hololens_office_2seg change less, and the error stayed at 25.4 mm."""


class Tracker:
    """Poses of all cameras, instant by instant, from a wide-baseline start.

    Call ``step`` once per instant, in order and without gaps, then ``finish``. ``read(camera, time)`` hands
    out earlier frames again; without it only frames still held in memory can get new connections.
    ``depth_prior`` is asked once for every frame, in the unit of the start.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        start: Start,
        flow: DenseFlow,
        config: Config,
        read: Read | None = None,
        depth_prior: PriorAtGrid | None = None,
    ) -> None:
        """Raises TrackingError where the start does not fit the cameras."""
        self.state = TrackState(cameras, start, flow, config, read, depth_prior)
        self._window = SlidingWindow(self.state.views, config.tracking, self.state.priors)

    def step(self, time: int, frames: Sequence[Image]) -> StepReport:
        """Take the frames ``(H, W, 3) uint8`` of all cameras at ``time``, the next instant.

        Raises TrackingError for an instant out of order or a missing or wrongly sized frame.
        """
        began = perf_counter()
        self._check_step(time, frames)
        self.state.last_time = time
        new: list[Keyframe] = []
        touched: dict[Frame, Keyframe] = {}
        for camera, image in enumerate(frames):
            self.state.images.put((camera, time), image)
        for candidate in self._candidates(time, frames):
            if self._is_keyframe(candidate):
                new.append(candidate)
            else:
                self.state.others[candidate.camera].append(candidate)
        self._promote(new, touched)
        self.state.count_time("flow", began)
        self._solve_step(new, touched)
        counts = self.state.graph.record(time)
        return StepReport(
            time=time,
            wTc=np.stack([self._latest(camera).wTc for camera in range(len(frames))]),
            keyframes=tuple(any(k.camera == camera for k in new) for camera in range(len(frames))),
            counts=counts,
            seconds=perf_counter() - began,
        )

    # ---- one frame -----------------------------------------------------------------------------------

    def _candidates(self, time: int, frames: Sequence[Image]) -> list[Keyframe]:
        """The new frames with poses and depths, measured against the last keyframes of their cameras."""
        new: list[Keyframe] = []
        followed: list[tuple[Keyframe, Keyframe, list[Array]]] = []
        for camera, track in enumerate(self.state.tracks):
            predictions = self._predictions(camera, time)
            prior = self.state.depth_prior(camera, time, frames[camera])
            if not track:
                sparse = self._nearest_start(camera, time)
                log_depth = sparse_log_depth(sparse.pixels, sparse.depth, self.state.views[camera].grid)
                new.append(self._keyframe(camera, time, predictions[0], log_depth, prior))
                # it is filled in between sparse points
                self.state.believe(new[-1], log_depth, np.zeros(len(log_depth), bool))
                continue
            # the depth is only a stand-in until flow says better
            new.append(self._keyframe(camera, time, predictions[0], track[-1].log_depth, prior))
            followed.append((track[-1], new[-1], predictions))
        self.state.measurer.temporal_all([(last, frame) for last, frame, _ in followed])
        # where the flow is guided, the depth must belong to the new view: measured with that once more where
        # that predicts another flow
        guided = [one for one in followed if one[1].frame in one[0].guides]
        for last, frame, predictions in followed:
            self.state.locate(frame, [last], predictions)
        for last, frame, _ in guided:
            self.state.carry_depth(frame, last)
        guided = [one for one in guided if self.state.measurer.outdated(one[0], one[1], NEAR_PX)]
        self.state.measurer.guided_all([(last, frame) for last, frame, _ in guided])
        for last, frame, predictions in guided:
            self.state.locate(frame, [last], [frame.wTc, *predictions])
        for last, frame, _ in followed:
            self.state.carry_depth(frame, last)
        return new

    def _keyframe(
        self, camera: int, time: int, wTc: Array, log_depth: Array, prior: GridDepth | None
    ) -> Keyframe:
        sigma = np.full(len(log_depth), self.state.tracking.carried_sigma)
        return Keyframe(camera, time, wTc, log_depth, sigma**-2.0, log_depth, sigma, depth_prior=prior)

    def _predictions(self, camera: int, time: int) -> list[Array]:
        """Poses to try, the most trusted first: the start's, and constant velocity corrected by tracking."""
        start = self.state.start.frames[camera]
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
        both = self.state.tracks[camera][-2:] + self.state.others[camera][-2:]
        return sorted(both, key=lambda frame: frame.time)[-2:]

    def _latest(self, camera: int) -> Keyframe:
        return self._recent(camera)[-1]

    def _nearest_start(self, camera: int, time: int) -> StartFrame:
        return min(self.state.start.frames[camera], key=lambda frame: abs(frame.time - time))

    def _is_keyframe(self, frame: Keyframe) -> bool:
        track = self.state.tracks[frame.camera]
        if not track:
            return True
        length = mean_flow(track[-1], frame.frame, self.state.views[frame.camera])
        # nothing measured: the view has changed beyond recognition, so it is new
        return not length < self.state.tracking.keyframe_px

    # ---- keyframes and their connections ---------------------------------------------------------------

    def _promote(self, new: Sequence[Keyframe], touched: dict[Frame, Keyframe]) -> None:
        """Make frames of different cameras keyframes, connected and measured."""
        edges: list[Edge] = []
        unmeasured: list[tuple[Keyframe, Keyframe]] = []
        for frame in new:
            track = self.state.tracks[frame.camera]
            self._forget_candidates(frame)
            touched[frame.frame] = frame
            offsets = [offset for offset in self.state.graph_config.temporal_offsets if offset <= len(track)]
            for offset in offsets:
                other = track[-offset]
                if not self.state.images.available(other.frame) or self._out_of_sight(other, frame, offset):
                    continue
                edges.append(Edge(frame.frame, other.frame, EdgeKind.TEMPORAL))
                if frame.frame not in other.flows:
                    unmeasured.append((other, frame))
                # a renewal takes in all flow since the last: early for depth, late for completeness
                if offset in (offsets[0], self.state.graph_config.temporal_offsets[-1]):
                    touched[other.frame] = other
        for frame in new:
            self.state.tracks[frame.camera].append(frame)
            self.state.frames[frame.frame] = frame
        self.state.add_edges(edges)
        self.state.measurer.measure_all(unmeasured, self._connect_cameras(new))

    def _out_of_sight(self, other: Keyframe, frame: Keyframe, offset: int) -> bool:
        """Whether a fast camera has turned so far since ``other`` that flow would find next to nothing."""
        least = self.state.graph_config.temporal_overlap
        return offset > 1 and self.state.measurer.predicted_overlap(other, frame) < least

    def _forget_candidates(self, frame: Keyframe) -> None:
        """Flow of frames that were no keyframes is measured again at the end, to keyframes on both sides."""
        track = self.state.tracks[frame.camera]
        if track:
            last = track[-1]
            if self.state.images.read is None:  # measured now or never
                return
            for other in [key for key in last.flows if key not in self.state.frames and key != frame.frame]:
                del last.flows[other]

    def _connect_cameras(self, new: Sequence[Keyframe]) -> Iterator[tuple[Keyframe, Keyframe]]:
        """Connect keyframes to those of other cameras; what is yielded is to be measured."""
        unmeasured: list[tuple[Keyframe, Keyframe]] = []
        for frame in new:
            edges = self.state.edges_to_other_cameras(frame, self.state.graph_config.st_per_frame)
            unmeasured += [(frame, self.state.frames[edge.j]) for edge in edges]
            self.state.add_edges(edges)
        yield from unmeasured

    def _solve_step(self, new: list[Keyframe], touched: dict[Frame, Keyframe]) -> None:
        if not new:
            return
        began = perf_counter()
        self._window.update(new, list(touched.values()), self.state.frames)
        window = self.state.tracking.window
        self.state.graph.leave_window(
            {camera: track[-window:][0].time for camera, track in enumerate(self.state.tracks) if track}
        )
        self.state.count_time("isam2", began)

    # ---- the end -----------------------------------------------------------------------------------------

    def finish(self, on_progress: end.OnProgress | None = None) -> TrackingResult:
        """Polish over all keyframes, motion-only solves for the other frames, and the result."""
        if self.state.last_time < 0:
            raise TrackingError("nothing was tracked: step was never called")
        self._finish_last_frames()
        self._window.release()
        return end.finish(self.state, on_progress)

    def frame_depths(self) -> Iterator[FrameDepth]:
        """After ``finish``: grid depth of every frame of every camera, in time order, nothing dense held."""
        return end.frame_depths(self.state)

    def _finish_last_frames(self) -> None:
        """The last frame of every camera becomes a keyframe, so that every other lies between two."""
        new: list[Keyframe] = []
        touched: dict[Frame, Keyframe] = {}
        for others in self.state.others:
            if others and others[-1].time == self.state.last_time:
                new.append(others.pop())
        self._promote(new, touched)
        self._solve_step(new, touched)

    def _check_step(self, time: int, frames: Sequence[Image]) -> None:
        if time != self.state.last_time + 1:
            raise TrackingError(
                f"instant {time} was handed in after {self.state.last_time}; hand in every one in order"
            )
        if len(frames) != len(self.state.views):
            raise TrackingError(f"instant {time}: {len(frames)} frames for {len(self.state.views)} cameras")
        for view, image in zip(self.state.views, frames, strict=True):
            size = (view.camera.height, view.camera.width)
            if image.shape[:2] != size:
                raise TrackingError(
                    f"instant {time}: camera {view.camera.name} handed a frame of "
                    f"{image.shape[1]}x{image.shape[0]}, but its intrinsics are for {size[1]}x{size[0]}"
                )
