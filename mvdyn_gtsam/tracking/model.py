"""What tracking keeps and hands on: keyframes, step reports and the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import numpy.typing as npt

from factors.measurement import StructurelessMeasurement
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import GridDepth
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.geometry import pixel_rays
from mvdyn_gtsam.graph.connections import EdgeCounts, EdgeKind, Frame
from mvdyn_gtsam.tracking.fixed_shape import FixedShapeMeasurement
from mvdyn_gtsam.tracking.kept_flow import KeptFlow

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """What is fixed about one camera: its grid and rays."""

    camera: Camera
    grid: Grid
    rays: Array
    """``(N, 3)`` with z = 1."""
    intrinsics: Array
    """``(4,)`` fx fy cx cy, px."""
    checkerboard: npt.NDArray[np.int64]
    """Indices of every second grid point."""

    @staticmethod
    def of(camera: Camera, grid_points: int) -> View:
        """The view whose grid has about ``grid_points`` points."""
        stride = max(1, round(float(np.sqrt(camera.width * camera.height / grid_points))))
        grid = Grid.covering(camera.width, camera.height, stride)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        rows, cols = np.indices(grid.shape)
        checkerboard = np.flatnonzero(((rows + cols) % 2 == 0).ravel())
        return View(camera, grid, pixel_rays(grid.pixels, camera.intrinsics), intrinsics, checkerboard)


@dataclass(frozen=True)
class Guide:
    """Depth and relative pose that a guided flow was measured around."""

    log_depth: Array
    """``(N,)`` of frame i."""
    jTi: Array
    """``(4, 4)``"""


@dataclass(eq=False)
class Keyframe:
    """A frame that is a variable of the graph; the tracker updates it in place."""

    camera: int
    time: int
    wTc: Array
    """``(4, 4)``"""
    log_depth: Array
    """``(N,)`` latest solution on the grid."""
    information: Array
    """``(N,)`` inverse variance of ``log_depth``, poses held fixed."""
    prior_log_depth: Array
    """``(N,)`` before the scale: carried over, a depth prior's, or both."""
    prior_sigma: Array
    """``(N,)``"""
    log_scale: float = 0.0
    depth_prior: GridDepth | None = None
    """A depth prior's word on this frame, in the state's unit."""
    flows: dict[Frame, KeptFlow] = field(default_factory=dict)
    """Flow from this frame to others."""
    guides: dict[Frame, Guide] = field(default_factory=dict)
    """What the flow to a neighbour was guided by; neighbours measured without guidance have no entry."""

    noise_ratio: float = 1.0
    """Noise of this keyframe's flow over the configured one, at least 1: estimated from its residuals."""

    @property
    def frame(self) -> Frame:
        return self.camera, self.time


def measurement_of(
    keyframe: Keyframe,
    neighbours: list[Frame],
    views: tuple[View, ...],
    config: TrackingConfig,
    steps: int = 4,
    thin: bool = False,
    robust_px: float | None = None,
    measured: bool = False,
) -> StructurelessMeasurement:
    """The keyframe's flow to ``neighbours`` as the factor wants it.

    ``thin`` takes every second grid point, as on a checkerboard; ``measured`` only those with a weight for
    any neighbour: the others say nothing of poses. ``robust_px`` replaces the configured one.
    Robust scale and noise grow with the keyframe's own noise: blurred or fast frames are measured worse.
    Where ``tracking.depth_model`` fixes the shape of depth, that shape comes along.
    """
    view = views[keyframe.camera]
    flows = [keyframe.flows[frame] for frame in neighbours]
    points = view.checkerboard if thin else np.arange(len(view.rays))
    if measured:
        seen = np.any([flow.weight_steps[points] > 0 for flow in flows], axis=0)
        # a measurement of no points at all would be a special case everywhere
        points = points[seen] if seen.any() else points[:1]
    make: Callable[..., StructurelessMeasurement] = StructurelessMeasurement
    if config.depth_model != "structureless":
        make = partial(FixedShapeMeasurement, log_shape=_log_shape(keyframe, config)[points])
    return make(
        rays=view.rays[points],
        initial_log_depth=keyframe.log_depth[points],
        prior_log_depth=keyframe.prior_log_depth[points],
        prior_sigma=keyframe.prior_sigma[points],
        intrinsics_j=np.stack([views[camera].intrinsics for camera, _ in neighbours]),
        target=np.stack([flow.target[points] for flow in flows]),
        weight=np.stack([flow.weight[points] for flow in flows]),
        robust_px=keyframe.noise_ratio * (config.robust_px if robust_px is None else robust_px),
        noise_px=keyframe.noise_ratio * config.noise_px,
        steps=steps,
    )


def _log_shape(keyframe: Keyframe, config: TrackingConfig) -> Array:
    """``(N,)`` log depth before the scale."""
    if config.depth_model == "carried_shape":
        return keyframe.prior_log_depth
    return keyframe.log_depth - keyframe.log_scale


@dataclass(frozen=True)
class StepReport:
    """What one time step did."""

    time: int
    wTc: Array
    """``(N, 4, 4)`` pose of every camera, as known now."""
    keyframes: tuple[bool, ...]
    """Whether the frame of each camera became a keyframe."""
    counts: EdgeCounts
    seconds: float


@dataclass(frozen=True)
class EdgeRecord:
    """One direction of a connection, and how well it fits at the end."""

    i: Frame
    j: Frame
    kind: EdgeKind
    weight: float
    """Mean measurement weight over the grid."""
    median_px: float
    """Median residual, px."""
    inlier_fraction: float


@dataclass(frozen=True)
class TrackingResult:
    """Poses of every frame of every camera, in the world of its group and the start's unit."""

    groups: tuple[tuple[int, ...], ...]
    wTc: Array
    """``(N, T, 4, 4)``"""
    covariance: Array
    """``(N, T, 6, 6)`` marginal covariance, tangent ``[omega, v]``; for keyframes from the graph, for the
    others with their keyframes held fixed."""
    keyframe_times: tuple[tuple[int, ...], ...]
    """Per camera."""
    grids: tuple[Grid, ...]
    """Per camera: where the grid depths are."""
    log_depth: tuple[npt.NDArray[np.float32], ...]
    """Per camera ``(K, N_grid)`` log z-depth of its keyframes."""
    information: tuple[npt.NDArray[np.float32], ...]
    """Per camera ``(K, N_grid)`` inverse variance of the log depth, poses held fixed."""
    edges: tuple[EdgeRecord, ...]
    counts: tuple[EdgeCounts, ...]
    """Active connections per time step."""
    seconds: Mapping[str, float]
    """Time spent per part."""


@dataclass(frozen=True)
class FrameDepth:
    """Depth of one frame on the grid of its camera."""

    camera: int
    time: int
    log_depth: Array
    """``(N,)`` log z-depth in the unit of the result."""
    information: Array
    """``(N,)`` inverse variance of the log depth, poses held fixed."""
