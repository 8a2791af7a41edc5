"""Everything a tracker knows, and what both its steps and its end ask of it."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import perf_counter

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import S, X
from factors.priors import pose_prior, scale_prior
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.config import Config
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.dense_flow import DenseFlow
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import GridDepth, PriorAtGrid
from mvdyn_gtsam.frontend.grid_flow import OneWayFlow
from mvdyn_gtsam.frontend.rig import Pair
from mvdyn_gtsam.frontend.start.model import Start
from mvdyn_gtsam.graph.connections import ConnectionGraph, Edge, EdgeKind, Frame
from mvdyn_gtsam.tracking.connect import inter_camera_edges
from mvdyn_gtsam.tracking.depth import carried_log_depth, with_prior
from mvdyn_gtsam.tracking.images import Image, ImageStore, Read
from mvdyn_gtsam.tracking.measure import EdgeMeasurer
from mvdyn_gtsam.tracking.model import Keyframe, View
from mvdyn_gtsam.tracking.motion import Correspondences, PoseFit, locate, world_points
from mvdyn_gtsam.tracking.normalise import normalised_start

Array = npt.NDArray[np.float64]

NOTHING = 0.0025
"""Mean weight below which a connection found nothing at all, not even a little."""
NEAR = 2
"""Keyframes away at which a connection that found nothing speaks for its neighbours. On hololens_office_2seg
93 of 146 connections between cameras found nothing, nearly all of them in one unbroken stretch of time."""


class TrackState:
    """Shared by the steps (``Tracker``) and the end (``finish``); in units of the start's median depth."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        start: Start,
        flow: DenseFlow,
        config: Config,
        read: Read | None,
        depth_prior: PriorAtGrid | None = None,
    ) -> None:
        """Raises TrackingError where the start does not fit the cameras."""
        _check_start(cameras, start)
        self.tracking, self.graph_config = config.tracking, config.graph
        self.rig_config = config.frontend.wide_baseline.adjustment.rig
        self.mounts: Mapping[Pair, Array] = {}
        """Cameras found to be mounted on one another, and their relative poses ``aTb``."""
        self.start, self.units = normalised_start(start)
        self.views = tuple(View.of(camera, config.tracking.grid_points) for camera in cameras)
        self.images = ImageStore(config.tracking.image_cache_mb * 2**20, read, isinstance(flow, OneWayFlow))
        self.measurer = EdgeMeasurer(self.views, flow, config.frontend.flow, self.images, config.tracking)
        self.graph = ConnectionGraph(config.graph.max_active_edges)
        self.tracks: list[list[Keyframe]] = [[] for _ in cameras]
        """Per camera its keyframes."""
        self.frames: dict[Frame, Keyframe] = {}
        """All keyframes."""
        self.others: list[list[Keyframe]] = [[] for _ in cameras]
        """Per camera the frames that are no keyframes, no variables of the graph."""
        self.group_of = {camera: group for group, members in enumerate(start.groups) for camera in members}
        self.kinds: dict[frozenset[Frame], EdgeKind] = {}
        """Of every connection made."""
        self.last_time = -1
        self.seconds: dict[str, float] = {}
        self._depth_prior = depth_prior
        self._skeleton = [{frame.time: frame for frame in frames} for frames in self.start.frames]

    @property
    def keyframes(self) -> list[Keyframe]:
        """All keyframes, camera by camera."""
        return [keyframe for track in self.tracks for keyframe in track]

    def unit(self, camera: int) -> float:
        """Factor from the state's unit back to the start's."""
        return self.units[self.group_of[camera]]

    def locate(self, frame: Keyframe, sources: Sequence[Keyframe], predictions: Sequence[Array]) -> PoseFit:
        """Motion-only pose of ``frame`` from keyframes that have flow to it."""
        seen = Correspondences.join(
            [
                Correspondences(
                    world_points(self.views[source.camera].rays, source.log_depth, source.wTc),
                    source.flows[frame.frame].target.astype(np.float64),
                    source.flows[frame.frame].weight.astype(np.float64),
                )
                for source in sources
            ]
        )
        fit = locate(seen, self.views[frame.camera].intrinsics, predictions, self.tracking.window_robust_px)
        frame.wTc = fit.wTc
        return fit

    def carry_depth(self, frame: Keyframe, source: Keyframe) -> None:
        """Depth of ``frame`` from that of a keyframe it has flow to."""
        view = self.views[frame.camera]
        source_view = self.views[source.camera]
        log_depth, carried = carried_log_depth(
            frame.flows[source.frame],
            view.grid,
            frame.wTc,
            source_view.grid,
            source.log_depth,
            source.wTc,
            source_view.camera.intrinsics,
            minimum_weight=0.1,
        )
        self.believe(frame, log_depth, carried)

    def believe(self, frame: Keyframe, log_depth: Array, carried: npt.NDArray[np.bool_]) -> None:
        """Start ``frame`` from ``log_depth (N,)``, filled in where not ``carried``, and its prior."""
        if frame.depth_prior is None:
            frame.log_depth = frame.prior_log_depth = log_depth
            return
        belief = with_prior(log_depth, carried, frame.depth_prior, self.tracking)
        frame.log_depth, frame.log_scale = belief.log_depth, belief.log_scale
        frame.prior_log_depth, frame.prior_sigma = belief.prior_log_depth, belief.prior_sigma
        frame.information = belief.prior_sigma**-2.0

    def depth_prior(self, camera: int, time: int, image: Image) -> GridDepth | None:
        """The depth prior's word on a frame, in the state's unit; None without a prior."""
        if self._depth_prior is None:
            return None
        depth = self._depth_prior(camera, time, image, self.views[camera].grid)
        return (
            None if depth is None else replace(depth, log_depth=depth.log_depth - np.log(self.unit(camera)))
        )

    def add_edges(self, edges: Sequence[Edge]) -> None:
        """Note connections; measuring them is the caller's."""
        for edge in edges:
            self.kinds.setdefault(edge.frames, edge.kind)
        self.graph.add(edges)

    def edges_to_other_cameras(self, keyframe: Keyframe, per_camera: int) -> list[Edge]:
        """New connections to keyframes of the other cameras of its group whose images can be had.

        Without those whose neighbours in time found nothing.
        """
        edges: list[Edge] = []
        if not self.graph_config.inter_camera:
            return edges
        for camera, track in enumerate(self.tracks):
            if camera == keyframe.camera or self.group_of[camera] != self.group_of[keyframe.camera]:
                continue
            others = [other for other in track if self.images.available(other.frame)]
            edges += inter_camera_edges(
                keyframe, others, self.views, self.graph, self.graph_config, per_camera
            )
        return [edge for edge in edges if not self._in_vain(edge)]

    def _in_vain(self, edge: Edge) -> bool:
        """Whether all that was measured between keyframes next to its own in time found nothing."""
        found = [
            max(i.flows[j.frame].mean_weight, j.flows[i.frame].mean_weight)
            for i in self._around(edge.i)
            for j in self._around(edge.j)
            if j.frame in i.flows
        ]
        return bool(found) and max(found) < NOTHING

    def _around(self, frame: Frame) -> list[Keyframe]:
        track = self.tracks[frame[0]]
        position = bisect_left(track, frame[1], key=lambda keyframe: keyframe.time)
        return track[max(0, position - NEAR) : position + NEAR + 1]

    def priors(self, keyframe: Keyframe) -> list[gtsam.NonlinearFactor]:
        """The start's word on this frame, and the gauge at the first keyframe of each group."""
        pose_key, scale_key = X(*keyframe.frame), S(*keyframe.frame)
        config = self.tracking
        if keyframe is self._anchor(keyframe.camera):
            return [pose_prior(pose_key, keyframe.wTc, 1e-5, 1e-5), scale_prior(scale_key, 0.0, 1e-3)]
        priors: list[gtsam.NonlinearFactor] = [scale_prior(scale_key, 0.0, config.scale_sigma)]
        start = self._skeleton[keyframe.camera].get(keyframe.time)
        if start is not None:
            rotation = np.radians(config.start_rotation_deg)
            priors.append(pose_prior(pose_key, start.wTc, rotation, config.start_translation))
        return priors

    def _anchor(self, camera: int) -> Keyframe | None:
        group = self.start.groups[self.group_of[camera]]
        first = [self.tracks[member][0] for member in group if self.tracks[member]]
        return min(first, key=lambda frame: frame.frame[::-1]) if first else None

    def count_time(self, part: str, began: float) -> None:
        """Add the time since ``began`` (``perf_counter``) to a part's total."""
        self.seconds[part] = self.seconds.get(part, 0.0) + perf_counter() - began


def _check_start(cameras: Sequence[Camera], start: Start) -> None:
    members = sorted(camera for group in start.groups for camera in group)
    if members != list(range(len(cameras))) or len(start.frames) != len(cameras):
        raise TrackingError(
            f"the start's groups {start.groups} do not hold each of {len(cameras)} cameras once"
        )
    for camera, frames in zip(cameras, start.frames, strict=True):
        if not frames or all(len(frame.depth) == 0 for frame in frames):
            raise TrackingError(f"the start has no depths for camera {camera.name}")
