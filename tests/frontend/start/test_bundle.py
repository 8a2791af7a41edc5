"""Focal lengths in a bundle adjustment: found where cameras turn, left open where they only slide."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import F
from mvdyn_gtsam.frontend.start.bundle import (
    Observations,
    bundle_of,
    focal_deviations,
    solve_bundle,
    solved_cameras,
)
from mvdyn_gtsam.geometry import invert_pose, project, transform_points
from tests.frontend.start.synthetic_maps import CAMERA, cloud, poses

Array = npt.NDArray[np.float64]
SCENE = cloud(200)
NOISE_PX = 0.3
CENTRES = [(CAMERA.cx, CAMERA.cy)]
UNKNOWN = replace(CAMERA, fx=1.05 * CAMERA.fx, fy=1.05 * CAMERA.fy, focal_known=False)


def sightings(wTc: Array, camera: int = 0) -> Observations:
    """Of every point of the scene by every frame, with noise."""
    random = np.random.default_rng(camera)
    rows = []
    for frame, pose in enumerate(wTc):
        pixels, _ = project(transform_points(invert_pose(pose), SCENE.points), CAMERA.intrinsics)
        inside = ((pixels >= 0) & (pixels < [CAMERA.width, CAMERA.height])).all(1)
        seen = np.flatnonzero(inside)
        noisy = pixels[seen] + NOISE_PX * random.normal(size=(len(seen), 2))
        rows.append(np.column_stack([seen, np.full(len(seen), camera), np.full(len(seen), frame), noisy]))
    table = np.concatenate(rows)
    landmark, owner, frame = table[:, :3].astype(np.int64).T
    return Observations(landmark, owner, frame, table[:, 3:], SCENE.points)


def first_sighting(seen: Observations) -> Observations:
    none = np.zeros(1, np.int64)
    return Observations(none, none, none, seen.pixel[:1], seen.points[seen.landmark[:1]])


def solved(wTc: Array) -> tuple[float, float]:
    """Focal length and its deviation, from 5 % off."""
    labels = {(0, frame): pose for frame, pose in enumerate(wTc)}
    bundle = bundle_of([UNKNOWN], labels, sightings(wTc), CENTRES, 0.005)
    solution = solve_bundle(bundle.graph, bundle.values, {label: label[1] for label in labels}, {}, 100, 1e-6)
    (camera,) = solved_cameras([UNKNOWN], labels, solution)
    assert camera.fx == camera.fy and not camera.focal_known
    return camera.fx, focal_deviations(bundle, solution, [0])[0]


def turning() -> Array:
    wTc = poses((0.0, 0.0, 0.0), 8)
    for frame, pose in enumerate(wTc):
        pose[:3, :3] = gtsam.Rot3.Ypr(0.05 * np.sin(frame), 0.04 * frame, 0.03 * np.cos(2 * frame)).matrix()
    return wTc


def test_the_focal_length_of_a_camera_that_turns_and_moves_is_found() -> None:
    focal, deviation = solved(turning())
    assert abs(focal / CAMERA.fx - 1.0) < 0.005
    assert abs(focal - CAMERA.fx) < 3.0 * deviation < 0.06 * CAMERA.fx


def test_a_principal_point_off_the_centre_is_found_as_far_as_it_is_likely() -> None:
    wTc, true = turning(), (CAMERA.cx + 6.0, CAMERA.cy)
    labels = {(0, frame): pose for frame, pose in enumerate(wTc)}
    seen = sightings(wTc)
    moved = replace(seen, pixel=seen.pixel + [6.0, 0.0])
    left = []
    for sigma in (1e-4, 0.005, 0.05):
        bundle = bundle_of([UNKNOWN], labels, moved, CENTRES, sigma)
        ends = {label: label[1] for label in labels}
        solution = solve_bundle(bundle.graph, bundle.values, ends, {}, 100, 1e-6)
        (camera,) = solved_cameras([UNKNOWN], labels, solution)
        left.append(np.hypot(camera.cx - true[0], camera.cy - true[1]))
    assert abs(left[0] - 6.0) < 0.01 and left[2] < 2.0 and left[2] < left[1] < left[0]


def test_a_camera_that_slides_without_turning_leaves_it_open() -> None:
    # depth and the way along the axis stretch with the focal length
    sliding = poses((0.0, 0.0, 0.0), 8)
    sliding[:, :3, :3] = np.eye(3)
    assert solved(sliding)[1] > 10.0 * solved(turning())[1]


def test_known_focal_lengths_are_held_and_tell_the_others() -> None:
    wTa, wTb = turning(), turning()
    wTb[:, :3, 3] += [0.3, 0.0, 0.0]
    labels = {
        (camera, frame): pose for camera, own in enumerate((wTa, wTb)) for frame, pose in enumerate(own)
    }
    first, second = sightings(wTa), sightings(wTb, camera=1)
    both = Observations(
        np.concatenate([first.landmark, second.landmark]),
        np.concatenate([first.camera, second.camera]),
        np.concatenate([first.frame, second.frame]),
        np.concatenate([first.pixel, second.pixel]),
        SCENE.points,
    )
    bundle = bundle_of([CAMERA, UNKNOWN], labels, both, 2 * CENTRES, 0.005)
    assert not bundle.values.exists(F(0)) and bundle.values.exists(F(1))
    solution = solve_bundle(bundle.graph, bundle.values, {label: label[1] for label in labels}, {}, 100, 1e-6)
    known, found = solved_cameras([CAMERA, UNKNOWN], labels, solution)
    assert known is CAMERA
    assert abs(found.fx / CAMERA.fx - 1.0) < 0.002
    assert focal_deviations(bundle, solution, [1])[1] < solved(wTb)[1]


def test_what_cannot_be_solved_is_left_open() -> None:
    wTc = turning()[2:3]
    one = first_sighting(sightings(wTc))
    bundle = bundle_of([UNKNOWN], {(0, 0): wTc[0]}, one, CENTRES, 0.005)
    # one sighting, and no gauge
    without = replace(bundle, graph=bundle.sightings)
    assert focal_deviations(without, without.values, [0]) == {0: np.inf}
    assert focal_deviations(without, without.values, []) == {}


def test_the_residual_and_its_derivative_by_the_intrinsics() -> None:
    wTc = turning()[2:3]
    one = first_sighting(sightings(wTc))
    bundle = bundle_of([UNKNOWN], {(0, 0): wTc[0]}, one, CENTRES, 0.005)
    x, y, z = transform_points(invert_pose(wTc[0]), one.points)[0]
    wrong = UNKNOWN.fx * np.array([x / z, y / z]) + [UNKNOWN.cx, UNKNOWN.cy] - one.pixel[0]
    # both rows carry the root of Cauchy's weight
    weight = np.sqrt(1.0 / (1.0 + wrong @ wrong))
    factor = bundle.sightings.at(0).linearize(bundle.values)
    jacobian, right = factor.jacobian()
    assert factor.keys()[-1] == F(0)
    # by fx, fy, skew, cx and cy
    by_intrinsics = [[x / z, 0.0, y / z, 1.0, 0.0], [0.0, y / z, 0.0, 0.0, 1.0]]
    np.testing.assert_allclose(right, -weight * wrong, rtol=1e-6)
    np.testing.assert_allclose(jacobian[:, -5:], weight * np.array(by_intrinsics), rtol=1e-6)
