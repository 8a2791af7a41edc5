from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import (
    Similarity,
    backproject,
    interpolate_pose,
    invert_pose,
    pixel_rays,
    project,
    rotation_angle_deg,
    transform_points,
)

Array = npt.NDArray[np.float64]


def _vectors(*shape: int, size: float = 10.0) -> st.SearchStrategy[Array]:
    return arrays(np.float64, shape, elements=st.floats(-size, size))


rotations = _vectors(3, size=1.8).map(lambda rotvec: Rotation.from_rotvec(rotvec).as_matrix())
fractions = st.floats(0.0, 1.0)


@st.composite
def poses(draw: Any) -> Array:
    aTb = np.eye(4)
    aTb[:3, :3] = draw(rotations)
    aTb[:3, 3] = draw(_vectors(3))
    return aTb


@st.composite
def similarities(draw: Any) -> Similarity:
    return Similarity(draw(st.floats(0.1, 10.0)), draw(rotations), draw(_vectors(3)))


@st.composite
def intrinsics(draw: Any) -> Array:
    fx, fy = draw(st.floats(100.0, 2000.0)), draw(st.floats(100.0, 2000.0))
    return np.array([[fx, 0, draw(st.floats(0, 640))], [0, fy, draw(st.floats(0, 480))], [0, 0, 1]])


def _close(actual: Any, expected: Any, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(actual, expected, atol=atol)


@given(aTb=poses())
def test_inverse_undoes_and_is_an_involution(aTb: Array) -> None:
    _close(invert_pose(aTb) @ aTb, np.eye(4))
    _close(aTb @ invert_pose(aTb), np.eye(4))
    _close(invert_pose(invert_pose(aTb)), aTb)


@given(aTb=poses(), bTc=poses())
def test_inverse_reverses_a_composition(aTb: Array, bTc: Array) -> None:
    _close(invert_pose(aTb @ bTc), invert_pose(bTc) @ invert_pose(aTb), 1e-8)


@given(aTb=poses(), bTc=poses())
def test_inverse_works_on_stacks(aTb: Array, bTc: Array) -> None:
    stack = np.stack([np.stack([aTb, bTc])] * 3)
    inverted = invert_pose(stack)
    assert inverted.shape == (3, 2, 4, 4)
    _close(inverted[2, 1], invert_pose(bTc))


@given(aTb=poses(), bTc=poses(), c_points=_vectors(5, 3))
def test_points_move_through_compositions(aTb: Array, bTc: Array, c_points: Array) -> None:
    _close(
        transform_points(aTb @ bTc, c_points), transform_points(aTb, transform_points(bTc, c_points)), 1e-8
    )
    _close(transform_points(invert_pose(bTc), transform_points(bTc, c_points)), c_points, 1e-8)


@given(aTb=poses(), b_points=_vectors(2, 3))
def test_rigid_motion_keeps_distances(aTb: Array, b_points: Array) -> None:
    a_points = transform_points(aTb, b_points)
    _close(np.linalg.norm(a_points[0] - a_points[1]), np.linalg.norm(b_points[0] - b_points[1]), 1e-8)


@given(axis=_vectors(3), angle=st.floats(0.0, 179.0))
def test_rotation_angle_is_the_angle_turned(axis: Array, angle: float) -> None:
    if np.linalg.norm(axis) < 1e-3:
        axis = np.array([0.0, 0.0, 1.0])
    rotvec = np.radians(angle) * axis / np.linalg.norm(axis)
    _close(rotation_angle_deg(Rotation.from_rotvec(rotvec).as_matrix()), angle, 1e-5)


@given(aTb=poses(), aTc=poses(), fraction=fractions)
def test_interpolation_meets_its_ends_and_is_even(aTb: Array, aTc: Array, fraction: float) -> None:
    _close(interpolate_pose(aTb, aTc, 0.0), aTb)
    _close(interpolate_pose(aTb, aTc, 1.0), aTc, 1e-7)
    between = interpolate_pose(aTb, aTc, fraction)
    whole = rotation_angle_deg(aTb[:3, :3].T @ aTc[:3, :3])
    _close(rotation_angle_deg(aTb[:3, :3].T @ between[:3, :3]), fraction * whole, 1e-4)
    _close(between[:3, 3], (1 - fraction) * aTb[:3, 3] + fraction * aTc[:3, 3])


@given(aTb=poses(), bTc=poses(), fraction=st.floats(-2.0, 2.0))
def test_interpolation_does_not_depend_on_the_frame(aTb: Array, bTc: Array, fraction: float) -> None:
    from_b = interpolate_pose(np.eye(4), bTc, fraction)
    _close(interpolate_pose(aTb, aTb @ bTc, fraction), aTb @ from_b, 1e-6)


@given(
    camera=intrinsics(),
    pixels=_vectors(6, 2, size=1000.0),
    depth=arrays(np.float64, 6, elements=st.floats(0.05, 100.0)),
)
def test_projection_undoes_backprojection(camera: Array, pixels: Array, depth: Array) -> None:
    projected, z = project(backproject(pixels, depth, camera), camera)
    _close(projected, pixels, 1e-6)
    _close(z, depth)


@given(camera=intrinsics(), points=_vectors(6, 3).map(lambda points: points.round(6)))
def test_backprojection_undoes_projection_in_front(camera: Array, points: Array) -> None:
    pixels, z = project(points, camera)
    front = points[:, 2] > 1e-3
    assert np.isnan(pixels[points[:, 2] <= 0]).all()
    np.testing.assert_array_equal(z, points[:, 2])
    _close(backproject(pixels[front], z[front], camera), points[front], 1e-8)


@given(camera=intrinsics(), pixels=_vectors(4, 2, size=1000.0))
def test_rays_are_the_inverse_intrinsics(camera: Array, pixels: Array) -> None:
    homogeneous = np.c_[pixels, np.ones(4)]
    _close(pixel_rays(pixels, camera), homogeneous @ np.linalg.inv(camera).T, 1e-8)


@given(aSb=similarities(), b_points=_vectors(4, 3))
def test_similarity_round_trip(aSb: Similarity, b_points: Array) -> None:
    _close(aSb.inverse().transform_points(aSb.transform_points(b_points)), b_points, 1e-8)
    _close(aSb.compose(aSb.inverse()).matrix(), np.eye(4), 1e-8)
    _close(aSb.inverse().matrix(), np.linalg.inv(aSb.matrix()), 1e-7)
    _close(aSb.compose(Similarity.identity()).matrix(), aSb.matrix())


@given(aSb=similarities(), bSc=similarities(), c_points=_vectors(4, 3))
def test_similarity_composition(aSb: Similarity, bSc: Similarity, c_points: Array) -> None:
    aSc = aSb.compose(bSc)
    _close(aSc.matrix(), aSb.matrix() @ bSc.matrix(), 1e-8)
    _close(aSc.transform_points(c_points), aSb.transform_points(bSc.transform_points(c_points)), 1e-7)
    _close(transform_points(aSc.matrix(), c_points), aSc.transform_points(c_points), 1e-7)


@given(aSb=similarities(), bTc=poses(), c_points=_vectors(4, 3))
def test_similarity_moves_poses_with_their_points(aSb: Similarity, bTc: Array, c_points: Array) -> None:
    # What a camera sees grows with the world's scale and keeps its direction.
    aTc = aSb.transform_poses(bTc)
    moved = aSb.transform_points(transform_points(bTc, c_points))
    _close(transform_points(invert_pose(aTc), moved), aSb.scale * c_points, 1e-6)
    _close(aTc[:3, :3] @ aTc[:3, :3].T, np.eye(3))
    _close(np.linalg.det(aTc[:3, :3]), 1.0)


@given(aSb=similarities(), bTc=poses(), bTd=poses())
def test_similarity_moves_stacks_and_leaves_its_input(aSb: Similarity, bTc: Array, bTd: Array) -> None:
    stack = np.stack([bTc, bTd])
    before = stack.copy()
    moved = aSb.transform_poses(stack)
    np.testing.assert_array_equal(stack, before)
    _close(moved[1], aSb.transform_poses(bTd))
    _close(aSb.inverse().transform_poses(moved), stack, 1e-7)
