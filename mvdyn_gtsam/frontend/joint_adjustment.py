"""Bundle adjustment of all placed maps together: what each camera's own map left uncertain, the others fix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from factors.keys import X
from factors.priors import pose_prior
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.single_camera import CameraMap
from mvdyn_gtsam.frontend.start import StartFrame
from mvdyn_gtsam.geometry import Similarity, invert_pose, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

ROBUST_PX = 1.0
"""Cauchy scale of reprojection errors; SIFT is good to about half a pixel."""


@dataclass(frozen=True)
class Observations:
    """Every sighting of every landmark; rows belong together."""

    landmark: Index
    """``(M,)`` row in ``points``."""
    camera: Index
    """``(M,)``"""
    frame: Index
    """``(M,)`` row in that camera's map."""
    pixel: Array
    """``(M, 2)`` px"""
    points: Array
    """``(P, 3)`` in the world."""


def adjust_maps(
    cameras: Sequence[Camera],
    maps: Sequence[CameraMap],
    wSm: Mapping[int, Similarity],
    same_point: Sequence[tuple[int, int, Index]],
    points_per_camera: int,
) -> dict[int, tuple[StartFrame, ...]]:
    """Frames of every placed camera in the common world, sparse depths included.

    ``same_point`` holds ``(camera a, camera b, (M, 2) rows of map points that are one)``. Points seen by
    several cameras are all used; of the rest, the longest observed ``points_per_camera``.
    """
    observations = _gather(maps, wSm, same_point, points_per_camera)
    wTc, points = _optimise(cameras, maps, wSm, observations)
    return {
        camera: tuple(
            _start_frame(camera, frame, maps[camera], wTc[camera, frame], observations, points)
            for frame in range(len(maps[camera].times))
        )
        for camera in wSm
    }


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
    cameras: Sequence[Camera],
    maps: Sequence[CameraMap],
    wSm: Mapping[int, Similarity],
    observations: Observations,
) -> tuple[dict[tuple[int, int], Array], Array]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for camera, similarity in wSm.items():
        for frame, wTc in enumerate(similarity.transform_poses(maps[camera].mTc)):
            values.insert(X(camera, frame), gtsam.Pose3(wTc))
    landmark_key = [gtsam.symbol("l", index) for index in range(len(observations.points))]
    for key, point in zip(landmark_key, observations.points, strict=True):
        values.insert(key, point)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST_PX), gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    )
    calibrations = [gtsam.Cal3_S2(c.fx, c.fy, 0.0, c.cx, c.cy) for c in cameras]
    for landmark, camera, frame, pixel in zip(
        observations.landmark.tolist(), observations.camera.tolist(), observations.frame.tolist(),
        observations.pixel, strict=True,
    ):  # fmt: skip
        graph.add(
            gtsam.GenericProjectionFactorCal3_S2(
                pixel, noise, X(camera, frame), landmark_key[landmark], calibrations[camera], False, False
            )
        )
    _fix_gauge(graph, values, maps, wSm, observations, landmark_key)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(25)
    parameters.setRelativeErrorTol(1e-4)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    wTc = {
        (camera, frame): solution.atPose3(X(camera, frame)).matrix()
        for camera in wSm
        for frame in range(len(maps[camera].times))
    }
    return wTc, np.array([solution.atPoint3(key) for key in landmark_key]).reshape(-1, 3)


def _fix_gauge(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    maps: Sequence[CameraMap],
    wSm: Mapping[int, Similarity],
    observations: Observations,
    landmark_key: list[int],
) -> None:
    """Hold one pose, and the scale by the pose farthest from it; a breath of a prior on every point."""
    anchor = min(wSm)
    wTc = wSm[anchor].transform_poses(maps[anchor].mTc)
    graph.add(pose_prior(X(anchor, 0), wTc[0], 1e-5, 1e-5))
    ends = [
        (float(np.linalg.norm(values.atPose3(X(camera, frame)).translation() - wTc[0, :3, 3])), camera, frame)
        for camera in wSm
        for frame in range(len(maps[camera].times))
    ]
    _, camera, frame = max(ends)
    far = values.atPose3(X(camera, frame)).matrix()
    graph.add(pose_prior(X(camera, frame), far, 1e3, 1e-3))
    # Median depth is 1: this only matters for points that hardly anything constrains.
    loose = gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
    for key, point in zip(landmark_key, observations.points, strict=True):
        graph.add(gtsam.PriorFactorPoint3(key, point, loose))


def _start_frame(
    camera: int, frame: int, camera_map: CameraMap, wTc: Array, observations: Observations, points: Array
) -> StartFrame:
    seen = (observations.camera == camera) & (observations.frame == frame)
    depth = transform_points(invert_pose(wTc), points[observations.landmark[seen]])[:, 2]
    front = depth > 0.0
    return StartFrame(
        time=int(camera_map.times[frame]), wTc=wTc, pixels=observations.pixel[seen][front], depth=depth[front]
    )
