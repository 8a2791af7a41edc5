"""Dense depth for a few frames of one camera's map, and how well the map explains what is seen.

Structure from motion of one camera can be led astray by a large moving thing. Dense flow between the map's
frames sees every surface: it gives the frames dense depth, and the share of flow that a rigid scene explains
tells a good map from a bad one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from factors.structureless import (
    StructurelessMeasurement,
    edge_residuals,
    solve_log_depths,
)
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_depth import interpolate_sparse_depth
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, FlowConfig, GridFlow, Image, sample_pair, to_grey
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.grid_flow import GridView, OneWayFlow, measure_grid, measure_grid_predicted
from mvdyn_gtsam.frontend.guided_flow import predicted_flow
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.geometry import backproject, invert_pose, pixel_rays, project, transform_points

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Times = npt.NDArray[np.int64]


@dataclass(frozen=True)
class DenseMapConfig:
    """Dense flow within one camera's map."""

    frames: int = 6
    """Frames of each camera that get dense depth. Source: choice, time."""
    neighbours: int = 4
    """Frames of the map before and after that flow is measured to. Source: see ``testimony_flow``."""
    stride: int = 4
    """Pixels between the grid points of the dense depth. Source: choice, time."""
    far_motion: float = 0.06
    """Predicted motion, in image widths, from which flow is seeded by the map. Source: DIS reaches 30 px."""
    depth_sigma: float = 0.05
    """Largest relative uncertainty of a depth that may testify about a placement. Source: choice."""
    flow_sigma_px: float = 0.5
    """Error of a flow vector of full weight, for that uncertainty. Source: experiments/flow_accuracy.py."""

    def __post_init__(self) -> None:
        if min(self.frames, self.neighbours, self.stride) < 1:
            raise ConfigError("frontend.dense_map: frames, neighbours and stride must be at least 1")
        if min(self.far_motion, self.depth_sigma, self.flow_sigma_px) <= 0.0:
            raise ConfigError("frontend.dense_map: far_motion, depth_sigma, flow_sigma_px must be above 0")


@dataclass(frozen=True)
class DepthView:
    """A frame of a map with dense depth on a grid, ready to be warped."""

    time: int
    mTc: Array
    """``(4, 4)`` in its camera's map."""
    intrinsics: Array
    grid: Grid
    depth: Array
    """``(N,)`` in the map's scale; NaN where not trustworthy."""
    image: Float32
    """``(H, W)`` grey, smoothed to the grid's resolution."""


@dataclass(frozen=True)
class MeasuredView:
    """Flow of one frame of a map to others, from which its depth follows wherever the frames are put."""

    frame: int
    """Row in the map."""
    neighbours: tuple[int, ...]
    measurement: StructurelessMeasurement
    grid: Grid
    image: Float32
    """``(H, W)`` grey, smoothed to the grid's resolution."""


@dataclass(frozen=True)
class DenseMap:
    """A map with dense depth in some of its frames."""

    sparse: CameraMap
    views: tuple[DepthView, ...]
    """Frames spread over the video."""
    rigidity: float
    """Share of the measured flow that a rigid scene explains to 1.5 px: what the map is worth."""
    seen: tuple[MeasuredView, ...] = ()
    """What ``views`` were solved from."""

    @property
    def known(self) -> float:
        """Share of the views whose depth is to be trusted."""
        return float(np.mean([np.isfinite(view.depth).mean() for view in self.views]))


def testimony_flow(config: FlowConfig) -> FlowConfig:
    """Flow settings for depth that testifies about placements: smooth, for completeness decides.

    On a wall of repeated posters (multicamvideo) the truth leads a shifted placement by 3.2 to 1.5 with four
    neighbours. It was 2.8 to 2.3 with three, and 3.4 to 2.6 with three and flow of full resolution, which
    takes three times as long; with two the shifted one led. Two iterations of smoothing take 70 % of the time
    of five, and the truth kept its lead: 11.7 for and 1.3 against it, 4.6 and 4.1 for the shifted one, where
    five gave 12.3 and 1.7, 4.7 and 4.4.
    """
    return replace(config, finest_scale=min(config.finest_scale, 1), variational_iterations=2)


Flows = dict[int, GridFlow]
RoughViews = dict[int, tuple[Image, Float32]]
"""Grey image and interpolated depth by frame of the map."""


def densify_map(
    capture: Capture, camera_map: CameraMap, flow: DenseFlow, config: DenseMapConfig, reach: int = 0
) -> DenseMap:
    """Depth of a few frames, spread over the video, from flow to their neighbours in the map.

    Neighbours are up to ``reach`` frames of the map away, at least as many as there are of them.
    """
    camera = capture.cameras[camera_map.camera]
    grid = Grid.covering(camera.width, camera.height, config.stride)
    count = len(camera_map.times)
    chosen = np.unique(np.linspace(0, count - 1, min(count, config.frames)).round().astype(int))
    views, seen, explained, measured = [], [], 0.0, 0.0
    rough: RoughViews = {}
    for frame in chosen:
        flows = _measure_flows(
            capture, camera_map, int(frame), grid, flow, config, rough, max(reach, config.neighbours)
        )
        seen.append(_measured(camera, int(frame), grid, flows, rough[frame], config.stride))
        view, fitting, total = _depth_view(camera, camera_map.times, camera_map.mTc, 0.0, seen[-1], config)
        views.append(view)
        explained += fitting
        measured += total
    return DenseMap(camera_map, tuple(views), explained / max(measured, 1e-12), tuple(seen))


def neighbours_of(frame: int, count: int, neighbours: int, reach: int) -> list[int]:
    """The frame and up to ``neighbours`` on either side of it, evenly up to ``reach`` away."""
    found = {frame}
    for side, left in ((-1, frame), (1, count - 1 - frame)):
        farthest = min(reach, left)
        found |= {
            frame + side * int(step)
            for step in np.linspace(0, farthest, min(neighbours, farthest) + 1).round().astype(int)
        }
    return sorted(found)


def _measure_flows(
    capture: Capture,
    camera_map: CameraMap,
    frame: int,
    grid: Grid,
    flow: DenseFlow,
    config: DenseMapConfig,
    rough: RoughViews,
    reach: int,
) -> Flows:
    """Flow of one frame to the map's frames before and after it; ``rough`` holds those views afterwards."""
    camera = capture.cameras[camera_map.camera]
    span = neighbours_of(frame, len(camera_map.times), config.neighbours, reach)
    for passed in set(rough) - set(span):
        del rough[passed]
    for index in span:
        if index not in rough:
            image = to_grey(capture.read(camera_map.camera, int(camera_map.times[index])))
            rough[index] = image, _sparse_depth(camera_map, index, camera)
    others = [other for other in span if other != frame]

    def measure(other: int) -> GridFlow:
        jTi = invert_pose(camera_map.mTc[other]) @ camera_map.mTc[frame]
        return _measure(rough[frame], rough[other], jTi, camera, grid, flow, config)

    return {other: measure(other) for other in others}


def _measure(
    first: tuple[Image, Float32],
    second: tuple[Image, Float32],
    jTi: Array,
    camera: Camera,
    grid: Grid,
    flow: DenseFlow,
    config: DenseMapConfig,
) -> GridFlow:
    """Flow at the grid between two frames of one camera, given as image and rough depth."""
    (image_i, depth_i), (image_j, depth_j) = first, second
    intrinsics = camera.intrinsics
    coarse = Grid.covering(camera.width, camera.height, 2 * config.stride)
    view_i, view_j = (
        GridView(coarse, (camera.width, camera.height), intrinsics, coarse.sample(depth).astype(np.float64))
        for depth in (depth_i, depth_j)
    )
    near = _predicted_motion(view_i, jTi) < config.far_motion * camera.width
    if isinstance(flow, OneWayFlow):
        if near:
            return measure_grid(flow, image_i, image_j, grid, grid)[0]
        return measure_grid_predicted(flow, image_i, image_j, grid, grid, view_i, view_j, jTi)[0]
    if near:
        return sample_pair(flow.measure(image_i, image_j), grid, grid)[0]
    seed = predicted_flow(depth_i, intrinsics, intrinsics, jTi, image_j.shape)
    seed_back = predicted_flow(depth_j, intrinsics, intrinsics, invert_pose(jTi), image_i.shape)
    return sample_pair(flow.measure(image_i, image_j, seed, seed_back), grid, grid)[0]


def _predicted_motion(view: GridView, jTi: Array) -> float:
    """Median length of the flow to another frame of the camera, px; inf where nothing stays in view."""
    points = transform_points(jTi, backproject(view.grid.pixels, view.depth, view.intrinsics))
    pixels, depth = project(points, view.intrinsics)
    with np.errstate(invalid="ignore"):
        stays = (depth > 0.0) & ((pixels >= 0.0) & (pixels <= np.array(view.size) - 1)).all(axis=1)
    length = np.linalg.norm((pixels - view.grid.pixels)[stays], axis=1)
    return float(np.median(length)) if len(length) else np.inf


def _sparse_depth(camera_map: CameraMap, frame: int, camera: Camera) -> Float32:
    rows = camera_map.point_of_keypoint[frame]
    known = rows >= 0
    depth = transform_points(invert_pose(camera_map.mTc[frame]), camera_map.points[rows[known]])[:, 2]
    front = depth > 0.0
    pixels = camera_map.features[frame].pixels[known][front]
    if len(pixels) < 4:
        return np.ones((camera.height, camera.width), np.float32)
    return interpolate_sparse_depth(pixels, depth[front], camera.width, camera.height)


def _measured(
    camera: Camera, frame: int, grid: Grid, flows: Flows, rough: tuple[Image, Float32], stride: int
) -> MeasuredView:
    """What is seen from one frame of the map: its flow to others, and a rough depth to begin from."""
    grey, rough_depth = rough
    neighbours = list(flows)
    start = np.log(np.maximum(grid.sample(rough_depth), 1e-6)).astype(np.float64)
    measurement = StructurelessMeasurement(
        rays=pixel_rays(grid.pixels, camera.intrinsics),
        initial_log_depth=start,
        prior_log_depth=start,
        # A factor of e either way: keeps points without parallax from running off, says nothing else.
        prior_sigma=np.ones(len(grid)),
        intrinsics_j=np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (len(neighbours), 1)),
        target=np.stack([flows[other].target for other in neighbours]),
        weight=np.stack([flows[other].weight for other in neighbours]),
        steps=8,
    )
    image = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.35 * stride)
    return MeasuredView(frame, tuple(neighbours), measurement, grid, image)


def _depth_view(
    camera: Camera, times: Times, mTc: Array, log_scale: float, seen: MeasuredView, config: DenseMapConfig
) -> tuple[DepthView, float, float]:
    """Dense depth of one frame; also the weight of its flow that fits, and of all of it."""
    measurement = seen.measurement
    mTi, mTj = mTc[seen.frame], mTc[list(seen.neighbours)]
    log_depth, information = solve_log_depths(measurement, mTi, mTj, log_scale)
    norms = edge_residuals(measurement, mTi, mTj, log_scale).norms_px
    weight = measurement.weight
    fitting = np.where(np.nan_to_num(norms, nan=np.inf) < 1.5, weight, 0.0).sum(0)
    measured = weight.sum(0)
    sigma = config.flow_sigma_px / np.sqrt(np.maximum(information, 1e-12))
    sure = (sigma < config.depth_sigma) & (fitting > 0.5 * measured) & (measured > 0.5)
    view = DepthView(
        time=int(times[seen.frame]),
        mTc=mTi,
        intrinsics=camera.intrinsics,
        grid=seen.grid,
        depth=np.where(sure, np.exp(log_depth), np.nan),
        image=seen.image,
    )
    return view, float(fitting.sum()), float(measured.sum())


def move_map(camera: Camera, dense: DenseMap, mTc: Array, config: DenseMapConfig) -> DenseMap:
    """The map with its frames at other poses ``(K, 4, 4)``, in whatever scale, and the depth they imply."""
    before, after = _spread(dense.sparse.mTc), _spread(mTc)
    log_scale = float(np.log(after / before))
    solved = [_depth_view(camera, dense.sparse.times, mTc, log_scale, seen, config) for seen in dense.seen]
    return replace(
        dense,
        sparse=replace(dense.sparse, mTc=mTc, points=np.full_like(dense.sparse.points, np.nan)),
        views=tuple(view for view, _, _ in solved),
        rigidity=sum(fits for _, fits, _ in solved) / max(sum(total for _, _, total in solved), 1e-12),
    )


def _spread(mTc: Array) -> float:
    """How far the frames' centres lie from their mean: what scale is told by."""
    centres = mTc[:, :3, 3]
    return max(float(np.linalg.norm(centres - centres.mean(0))), 1e-12)
