"""The factor graph of a bundle adjustment: sightings, gauge, mounts, and focal lengths that are yet to be
found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import F, X
from factors.priors import pose_prior
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.rig import Pair, add_mounts
from mvdyn_gtsam.frontend.start.model import FoundIntrinsics

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Label = tuple[int, int]
"""Camera and row of one of its map's frames."""

ROBUST_PX = 1.0
"""Cauchy scale of reprojection errors; SIFT is good to about half a pixel."""
SQUARE_SIGMA = 0.05
"""Difference of both focal lengths that is left to square pixels, and the skew, px: none to speak of, and not
so little that the system becomes singular."""
LEAST_FRAMES = 3
"""Of a camera, for its images to be asked for its focal length: those of a still one are a single image."""
HELD = 1e-4
"""For ``centre_sigma``: known principal points stay."""
SQUARE = 0.002
"""Share by which the two focal lengths of square pixels differ at most; calibrations find them that alike."""
FOCAL_EFFORT = 100, 1e-5
"""Iterations at most, and the share by which the cost falls in the last: a focal length that is let go
follows a narrow valley. Source: from 5 and 15 % off, three iterations went at most half the way, in a trial
that is not kept."""


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


@dataclass(frozen=True)
class Bundle:
    """The graph of some sightings and the values that it begins with."""

    sightings: gtsam.NonlinearFactorGraph
    """Reprojection factors alone: what the images say."""
    graph: gtsam.NonlinearFactorGraph
    """With what holds the gauge."""
    values: gtsam.Values
    landmarks: list[int]
    """Keys."""


def bundle_of(
    cameras: Sequence[Camera],
    wTc: Mapping[Label, Array],
    observations: Observations,
    centres: Sequence[tuple[float, float]],
    centre_sigma: float,
) -> Bundle:
    """One reprojection factor per sighting; the focal lengths of cameras that do not tell them are free, and
    so are their principal points, about ``centres`` of all cameras, with that standard deviation in lengths
    of the longer side."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for (camera, frame), pose in wTc.items():
        values.insert(X(camera, frame), gtsam.Pose3(pose))
    landmark_key = [gtsam.symbol("l", index) for index in range(len(observations.points))]
    for key, point in zip(landmark_key, observations.points, strict=True):
        values.insert(key, point)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST_PX), gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    )
    calibrations = [gtsam.Cal3_S2(c.fx, c.fy, 0.0, c.cx, c.cy) for c in cameras]
    for free in free_cameras(cameras, wTc):
        values.insert(F(free), calibrations[free])
    for landmark, camera, frame, pixel in zip(
        observations.landmark.tolist(),
        observations.camera.tolist(),
        observations.frame.tolist(),
        observations.pixel,
        strict=True,
    ):
        keys = X(camera, frame), landmark_key[landmark]
        if cameras[camera].focal_known:
            known = calibrations[camera]
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, *keys, known, False, False))
        else:
            graph.add(gtsam.GeneralSFMFactor2Cal3_S2(pixel, noise, *keys, F(camera)))
    gauged = gtsam.NonlinearFactorGraph(graph)
    _fix_gauge(gauged, wTc, observations, landmark_key)
    for free in free_cameras(cameras, wTc):
        sigma = centre_sigma * max(cameras[free].width, cameras[free].height)
        gauged.add(_lens_prior(F(free), cameras[free].fx, centres[free], sigma))
    return Bundle(graph, gauged, values, landmark_key)


def _lens_prior(
    key: int, focal: float, centre: tuple[float, float], sigma: float
) -> gtsam.PriorFactorCal3_S2:
    """Square pixels, no skew, and a principal point near ``centre``, px; nothing of the focal length but
    what a first linearisation needs."""
    information = np.zeros((5, 5))
    information[:2, :2] = SQUARE_SIGMA**-2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    information[:2, :2] += (10.0 * focal) ** -2 * np.eye(2)
    information[2, 2] = SQUARE_SIGMA**-2
    information[3, 3] = information[4, 4] = sigma**-2
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.PriorFactorCal3_S2(key, gtsam.Cal3_S2(focal, focal, 0.0, *centre), noise)


def centres_of(cameras: Sequence[Camera]) -> list[tuple[float, float]]:
    """Principal points, px."""
    return [(camera.cx, camera.cy) for camera in cameras]


def free_cameras(cameras: Sequence[Camera], wTc: Mapping[Label, Array]) -> list[int]:
    """Those with frames ``wTc`` whose focal lengths are solved for."""
    return [camera for camera in sorted({label[0] for label in wTc}) if not cameras[camera].focal_known]


def solved_cameras(
    cameras: Sequence[Camera], wTc: Mapping[Label, Array], solution: gtsam.Values
) -> tuple[Camera, ...]:
    """The cameras with the focal lengths and principal points of a solution."""
    result = list(cameras)
    for camera in free_cameras(cameras, wTc):
        found = solution.atCal3_S2(F(camera))
        focal = 0.5 * (found.fx() + found.fy())
        result[camera] = replace(cameras[camera], fx=focal, fy=focal, cx=found.px(), cy=found.py())
    return tuple(result)


def focal_deviations(bundle: Bundle, solution: gtsam.Values, cameras: Sequence[int]) -> dict[int, float]:
    """Standard deviations of the focal lengths of free ``cameras``, px, for sightings good to ``ROBUST_PX``;
    infinite where the images leave one open."""
    if not cameras:
        return {}
    try:
        marginals = gtsam.Marginals(bundle.graph, solution)
        return {camera: float(np.sqrt(marginals.marginalCovariance(F(camera))[0, 0])) for camera in cameras}
    except RuntimeError:  # gtsam: an indeterminate system
        return dict.fromkeys(cameras, np.inf)


def told_intrinsics(
    cameras: Sequence[Camera],
    times: Mapping[Label, int],
    wTc: Mapping[Label, Array],
    observations: Observations,
    mounts: Mapping[Pair, Array],
) -> dict[int, FoundIntrinsics]:
    """What the images say of known focal lengths, all let go at once; of cameras with several frames and
    square pixels."""
    counts = Counter(camera for camera, _ in wTc)
    asked = [
        index
        for index, count in counts.items()
        if (camera := cameras[index]).focal_known
        and count >= LEAST_FRAMES
        and abs(camera.fy / camera.fx - 1.0) < SQUARE
    ]
    if not asked:
        return {}
    freed = [
        replace(camera, focal_known=camera.focal_known and index not in asked)
        for index, camera in enumerate(cameras)
    ]
    bundle = bundle_of(freed, wTc, observations, centres_of(freed), HELD)
    solution = solve_bundle(bundle.graph, bundle.values, times, mounts, *FOCAL_EFFORT)
    told = solved_cameras(freed, wTc, solution)
    deviations = focal_deviations(bundle, solution, asked)
    return {
        index: FoundIntrinsics(told[index].fx, told[index].cx, told[index].cy, deviations[index])
        for index in asked
    }


def solve_bundle(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    times: Mapping[Label, int],
    mounts: Mapping[Pair, Array],
    iterations: int,
    tolerance: float,
) -> gtsam.Values:
    """At most so many ``iterations`` of Levenberg-Marquardt, until the cost falls by a share less than
    ``tolerance``, with ``mounts`` held; ``graph`` and ``values`` stay as they are."""
    if mounts:
        graph, values = gtsam.NonlinearFactorGraph(graph), gtsam.Values(values)
        add_mounts(graph, values, mounts, [((label[0], time), X(*label)) for label, time in times.items()])
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def _fix_gauge(
    graph: gtsam.NonlinearFactorGraph,
    wTc: Mapping[Label, Array],
    observations: Observations,
    landmark_key: list[int],
) -> None:
    """Hold one pose, and the scale by its distance to the farthest; a breath of a prior on every point."""
    anchor = min(wTc)
    graph.add(pose_prior(X(*anchor), wTc[anchor], 1e-5, 1e-5))
    origin = wTc[anchor][:3, 3]
    far = max(wTc, key=lambda label: float(np.linalg.norm(wTc[label][:3, 3] - origin)))
    # Their distance alone: a held position would keep a badly placed camera where it is.
    distance = float(np.linalg.norm(wTc[far][:3, 3] - origin))
    if distance > 0.0:
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3 * distance)
        graph.add(gtsam.RangeFactorPose3(X(*anchor), X(*far), distance, noise))
    # Median depth is 1: this only matters for points that hardly anything constrains.
    loose = gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
    for key, point in zip(landmark_key, observations.points, strict=True):
        graph.add(gtsam.PriorFactorPoint3(key, point, loose))
