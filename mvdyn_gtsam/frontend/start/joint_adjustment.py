"""Bundle adjustment of all placed maps together: what one camera's map leaves uncertain, the others fix."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from factors.keys import X
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.rig import Pair, RigConfig, likely_mounts, solved_mounts
from mvdyn_gtsam.frontend.start.bundle import (
    Bundle,
    Label,
    Observations,
    bundle_of,
    centres_of,
    focal_deviations,
    free_cameras,
    solve_bundle,
    solved_cameras,
    told_intrinsics,
)
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.model import FoundIntrinsics, StartFrame
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.frontend.threads import in_order
from mvdyn_gtsam.geometry import Similarity, invert_pose, project, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
logger = logging.getLogger(__name__)

MISFIT_PX = 4.0
"""Reprojection error beyond which a sighting is dropped; COLMAP's filter_max_reproj_error."""


@dataclass(frozen=True)
class AdjustmentConfig:
    """Joint bundle adjustment of the start."""

    points_per_camera: int = 800
    """Points of one camera alone that enter. Source: choice, time."""
    search_px: tuple[float, ...] = (40.0, 12.0, 4.0)
    """Radius of each round of looking for points in frames that should see them. Source: choice."""
    similarity: float = 0.88
    """Cosine of two descriptors from which they may be one point. Source: experiments/wide_baseline.py."""
    maximum_iterations: int = 25
    """Levenberg-Marquardt iterations per round. Source: choice, time."""
    relative_tolerance: float = 1e-3
    """Relative decrease of the cost at which a round ends. Source: choice, time."""
    centre_sigma: float = 0.005
    """Standard deviation of a principal point that is not known from what is given, or from the image's
    centre, in lengths of the longer side. Source: experiments/focal.py, next to nothing and this; twice as
    much was alike in a trial that is not kept."""
    rig: RigConfig = field(default_factory=RigConfig)

    def __post_init__(self) -> None:
        if self.maximum_iterations < 1 or self.relative_tolerance <= 0.0:
            raise ConfigError("frontend.wide_baseline.adjustment: at least 1 iteration, tolerance above 0")
        if self.points_per_camera < 50 or any(radius <= 0.0 for radius in self.search_px):
            raise ConfigError("frontend.wide_baseline.adjustment: points_per_camera >= 50, search_px above 0")
        if not self.centre_sigma > 0.0:
            raise ConfigError("frontend.wide_baseline.adjustment: centre_sigma above 0")


@dataclass(frozen=True)
class Adjusted:
    """The maps of some cameras in one world."""

    frames: dict[int, tuple[StartFrame, ...]]
    """By camera, sparse depths included."""
    cameras: tuple[Camera, ...]
    """With the intrinsics that were yet to be found."""
    focal_deviation: dict[int, float]
    """Of these cameras, px."""
    told_focal: dict[int, FoundIntrinsics]
    """What the images say of those that are known, by camera, where that was asked."""


@dataclass(frozen=True)
class _State:
    """Between two rounds."""

    cameras: tuple[Camera, ...]
    wTc: dict[Label, Array]
    observations: Observations
    mounts: Mapping[Pair, Array]
    bundle: Bundle
    solution: gtsam.Values


def adjust_maps(
    cameras: Sequence[Camera],
    maps: Sequence[CameraMap],
    wSm: Mapping[int, Similarity],
    same_point: Sequence[tuple[int, int, Index]],
    config: AdjustmentConfig,
    ask_focal: bool = False,
) -> Adjusted:
    """Every placed camera in the common world, and the focal lengths that are not known.

    With ``ask_focal`` also what the images say of those that are known.

    ``same_point`` holds ``(camera a, camera b, (M, 2) rows of map points that are one)``. After a first
    solution every point is looked for in every other frame, near where it should be: that closes loops
    between cameras and within one, and the second solution has far more to go by.
    """
    observations = _gather(maps, wSm, same_point, config.points_per_camera)
    wTc = {
        (camera, frame): pose
        for camera, similarity in wSm.items()
        for frame, pose in enumerate(similarity.transform_poses(maps[camera].mTc))
    }
    times = {(camera, frame): int(maps[camera].times[frame]) for camera, frame in wTc}
    centres = centres_of(cameras)
    state = _optimise(tuple(cameras), centres, times, wTc, observations, {}, config)
    for radius in config.search_px:
        found = _search(state.cameras, maps, state.wTc, state.observations, radius, config.similarity)
        state = _optimise(state.cameras, centres, times, state.wTc, found, state.mounts, config)
    for a, b in state.mounts:
        logger.info("%s and %s are mounted on one another", cameras[a].name, cameras[b].name)
    frames = {
        camera: tuple(
            _start_frame(camera, frame, maps[camera], state.wTc[camera, frame], state.observations)
            for frame in range(len(maps[camera].times))
        )
        for camera in wSm
    }
    free = free_cameras(cameras, wTc)
    deviations = focal_deviations(state.bundle, state.solution, free)
    told = (
        told_intrinsics(state.cameras, times, state.wTc, state.observations, state.mounts)
        if ask_focal
        else {}
    )
    return Adjusted(frames, state.cameras, deviations, told)


def _search(
    cameras: Sequence[Camera],
    maps: Sequence[CameraMap],
    wTc: Mapping[Label, Array],
    observations: Observations,
    radius: float,
    similarity: float,
) -> Observations:
    """Also the keypoints that look like a landmark and lie within ``radius`` of its projection."""
    descriptor = _descriptors(maps, observations)
    known = np.column_stack(
        [observations.landmark, observations.camera, observations.frame, observations.pixel]
    )
    jobs = [
        partial(
            _found_in, label, cameras[label[0]], maps[label[0]], pose, observations, descriptor, radius,
            similarity,
        )
        for label, pose in wTc.items()
    ]  # fmt: skip
    added = [known, *in_order(jobs)]
    table = np.concatenate(added)
    columns = table[:, :3].astype(np.int64)
    return Observations(columns[:, 0], columns[:, 1], columns[:, 2], table[:, 3:5], observations.points)


def _found_in(
    label: Label,
    camera: Camera,
    camera_map: CameraMap,
    wTc: Array,
    observations: Observations,
    descriptor: npt.NDArray[np.float32],
    radius: float,
    similarity: float,
) -> Array:
    """Rows ``(M, 5)`` of landmark, camera, frame and pixel: what ``_search`` finds in one frame."""
    here = (observations.camera == label[0]) & (observations.frame == label[1])
    unseen = np.ones(len(observations.points), bool)
    unseen[observations.landmark[here]] = False
    features = camera_map.features[label[1]]
    # Keypoints that already are a landmark's stay its own.
    free = np.ones(len(features.pixels), bool)
    free[cKDTree(features.pixels).query(observations.pixel[here])[1]] = False
    candidates, pixels = _visible(camera, wTc, observations.points, np.flatnonzero(unseen))
    landmark, keypoint = _look_near(
        descriptor[candidates], pixels, features, np.flatnonzero(free), radius, similarity
    )
    labels = np.broadcast_to(label, (len(landmark), 2))
    return np.column_stack([candidates[landmark], labels, features.pixels[keypoint]])


def _descriptors(maps: Sequence[CameraMap], observations: Observations) -> npt.NDArray[np.float32]:
    """``(P, 128)`` mean descriptor of each landmark's sightings, unit length."""
    found = np.empty((len(observations.landmark), 128), np.float32)
    for camera, frame in np.unique(np.column_stack([observations.camera, observations.frame]), axis=0):
        here = (observations.camera == camera) & (observations.frame == frame)
        features = maps[camera].features[frame]
        found[here] = features.descriptors[cKDTree(features.pixels).query(observations.pixel[here])[1]]
    sightings = np.arange(len(found))
    # numpy's add.at takes ten times as long
    belongs = csr_array(
        (np.ones(len(found), np.float32), (observations.landmark, sightings)),
        shape=(len(observations.points), len(found)),
    )
    total = np.asarray(belongs @ found, np.float32)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)


def _visible(camera: Camera, wTc: Array, points: Array, rows: Index) -> tuple[Index, Array]:
    """Those of ``rows`` whose points fall inside the image, and where."""
    pixels, depth = project(transform_points(invert_pose(wTc), points[rows]), camera.intrinsics)
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
    return rows[inside], pixels[inside]


def _look_near(
    descriptor: npt.NDArray[np.float32],
    pixels: Array,
    features: Features,
    free: Index,
    radius: float,
    similarity: float,
) -> tuple[Index, Index]:
    """Landmark rows and keypoints that are each other's best look within ``radius``."""
    empty = np.zeros(0, np.int64)
    if len(free) == 0 or len(pixels) == 0:
        return empty, empty
    near = cKDTree(pixels).sparse_distance_matrix(
        cKDTree(features.pixels[free]), radius, output_type="coo_matrix"
    )
    row, column = near.row.astype(np.int64), near.col.astype(np.int64)
    look = (descriptor[row] * features.descriptors[free[column]]).sum(1)
    good = look > similarity
    row, column, look = row[good], column[good], look[good]
    order = np.argsort(-look, kind="stable")
    row, column = row[order], column[order]
    best_of_row = np.unique(row, return_index=True)[1]
    best_of_column = np.unique(column, return_index=True)[1]
    mutual = np.intersect1d(best_of_row, best_of_column)
    return row[mutual], free[column[mutual]]


def _gather(
    maps: Sequence[CameraMap],
    wSm: Mapping[int, Similarity],
    same_point: Sequence[tuple[int, int, Index]],
    points_per_camera: int,
) -> Observations:
    first = np.concatenate([[0], np.cumsum([len(camera_map.points) for camera_map in maps])])
    owner = _merge(int(first[-1]), [pairs + [first[a], first[b]] for a, b, pairs in same_point])
    rows = []
    for camera in wSm:
        for frame, point_of_keypoint in enumerate(maps[camera].point_of_keypoint):
            known = np.flatnonzero(point_of_keypoint >= 0)
            landmark = owner[first[camera] + point_of_keypoint[known]]
            pixel = maps[camera].features[frame].pixels[known]
            label = np.broadcast_to([camera, frame], (len(known), 2))
            rows.append(np.column_stack([landmark, label, pixel]))
    table = np.concatenate(rows)
    landmark = table[:, 0].astype(np.int64)
    keep = _choose_points(landmark, table[:, 1].astype(np.int64), int(first[-1]), points_per_camera)
    table = table[keep[landmark]]
    used, compact = np.unique(table[:, 0].astype(np.int64), return_inverse=True)
    world = np.concatenate(
        [
            wSm[camera].transform_points(camera_map.points) if camera in wSm else camera_map.points
            for camera, camera_map in enumerate(maps)
        ]
    )
    return Observations(
        landmark=compact.ravel(),
        camera=table[:, 1].astype(np.int64),
        frame=table[:, 2].astype(np.int64),
        pixel=table[:, 3:5],
        points=world[used],
    )


def _merge(count: int, pairs: Sequence[Index]) -> Index:
    """For each of ``count`` points the lowest-numbered point it is one with."""
    edges = np.concatenate([np.zeros((0, 2), np.int64), *pairs])
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, lowest = np.unique(label, return_index=True)
    return np.asarray(lowest[label], np.int64)


def _choose_points(landmark: Index, camera: Index, count: int, per_camera: int) -> npt.NDArray[np.bool_]:
    seen = np.bincount(landmark, minlength=count)
    lowest, highest = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(lowest, landmark, camera)
    np.maximum.at(highest, landmark, camera)
    keep = highest > lowest
    for one in np.unique(camera):
        own = np.flatnonzero((lowest == one) & (highest == one) & (seen >= 3))
        keep[own[np.argsort(-seen[own], kind="stable")[:per_camera]]] = True
    return keep


def _optimise(
    cameras: tuple[Camera, ...],
    centres: Sequence[tuple[float, float]],
    times: Mapping[Label, int],
    wTc: Mapping[Label, Array],
    observations: Observations,
    mounts: Mapping[Pair, Array],
    config: AdjustmentConfig,
) -> _State:
    """Bundle adjustment with a redescending loss; sightings that do not fit afterwards are dropped.

    ``centres`` are where principal points that are free are expected.
    ``mounts`` are held. Where there are none yet, cameras that move like a rig are tried as one, and their
    mounts returned if the images bear it out.
    """
    bundle = bundle_of(cameras, wTc, observations, centres, config.centre_sigma)
    effort = config.maximum_iterations, config.relative_tolerance
    solution = solve_bundle(bundle.graph, bundle.values, times, mounts, *effort)
    mounts = solved_mounts(solution, mounts)
    if not mounts:
        poses = {(label[0], times[label]): solution.atPose3(X(*label)).matrix() for label in wTc}
        likely = likely_mounts(poses, config.rig)
        if likely:
            held = solve_bundle(bundle.graph, solution, times, likely, *effort)
            increase = bundle.sightings.error(held) / max(bundle.sightings.error(solution), 1e-12) - 1.0
            logger.debug("holding %s as mounted: cost %+.1f %%", list(likely), 100.0 * increase)
            if increase <= config.rig.cost_increase:
                solution, mounts = held, solved_mounts(held, likely)
    solved = {label: solution.atPose3(X(*label)).matrix() for label in wTc}
    points = np.array([solution.atPoint3(key) for key in bundle.landmarks]).reshape(-1, 3)
    cameras = solved_cameras(cameras, wTc, solution)
    fitting = _fitting(cameras, solved, replace(observations, points=points))
    return _State(cameras, solved, fitting, mounts, bundle, solution)


def _fitting(
    cameras: Sequence[Camera], wTc: Mapping[Label, Array], observations: Observations
) -> Observations:
    error = np.full(len(observations.landmark), np.inf)
    for (camera, frame), pose in wTc.items():
        here = (observations.camera == camera) & (observations.frame == frame)
        points = observations.points[observations.landmark[here]]
        pixels, _ = project(transform_points(invert_pose(pose), points), cameras[camera].intrinsics)
        distance = np.linalg.norm(pixels - observations.pixel[here], axis=1)
        error[here] = np.nan_to_num(distance, nan=np.inf)
    fits = error < MISFIT_PX
    fits &= (
        np.bincount(observations.landmark[fits], minlength=len(observations.points))[observations.landmark]
        >= 2
    )
    used, compact = np.unique(observations.landmark[fits], return_inverse=True)
    return Observations(
        compact.ravel(),
        observations.camera[fits],
        observations.frame[fits],
        observations.pixel[fits],
        observations.points[used],
    )


def _start_frame(
    camera: int, frame: int, camera_map: CameraMap, wTc: Array, observations: Observations
) -> StartFrame:
    seen = (observations.camera == camera) & (observations.frame == frame)
    points = observations.points[observations.landmark[seen]]
    depth = transform_points(invert_pose(wTc), points)[:, 2]
    front = depth > 0.0
    return StartFrame(
        time=int(camera_map.times[frame]), wTc=wTc, pixels=observations.pixel[seen][front], depth=depth[front]
    )
