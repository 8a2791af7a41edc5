"""Small views: they see what the camera sees."""

from __future__ import annotations

import pickle

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.geometry import pixel_rays, project
from mvdyn_gtsam.refinement.views import DenseView, pixels_seen, scaled_intrinsics

Array = npt.NDArray[np.float64]


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.integers(16, 200)), draw(st.integers(16, 200))
    fx, fy = draw(st.floats(20.0, 300.0)), draw(st.floats(20.0, 300.0))
    cx, cy = draw(st.floats(0.3, 0.7)) * width, draw(st.floats(0.3, 0.7)) * height
    return Camera("c", width, height, fx, fy, cx, cy)


@given(cameras(), st.floats(0.1, 1.0))
def test_a_view_travels_light_and_arrives_whole(camera: Camera, scale: float) -> None:
    view = DenseView.of(camera, scale)
    sent = pickle.dumps(view)
    received = pickle.loads(sent)
    assert len(sent) < 1000
    assert (received.camera, received.shape) == (view.camera, view.shape)
    np.testing.assert_array_equal(received.intrinsics, view.intrinsics)
    np.testing.assert_array_equal(received.rays, view.rays)


@given(cameras(), st.floats(0.1, 1.0), st.integers(0, 10**6))
def test_a_small_view_sees_points_where_the_camera_does(camera: Camera, scale: float, seed: int) -> None:
    """In shares of the image, whose borders lie half a pixel outside the outermost centres."""
    view = DenseView.of(camera, scale)
    points = np.random.default_rng(seed).uniform([-2.0, -2.0, 1.0], [2.0, 2.0, 9.0], (30, 3))
    full, _ = project(points, camera.intrinsics)
    small, _ = project(points, view.intrinsics)
    share_full = (full + 0.5) / [camera.width, camera.height]
    share_small = (small + 0.5) / [view.shape[1], view.shape[0]]
    np.testing.assert_allclose(share_small, share_full, atol=1e-9)


@given(cameras(), st.floats(0.1, 1.0))
def test_rays_go_through_the_pixels_of_the_small_view(camera: Camera, scale: float) -> None:
    view = DenseView.of(camera, scale)
    pixels, _ = project(view.rays.astype(np.float64), view.intrinsics)
    y, x = np.mgrid[: view.shape[0], : view.shape[1]]
    np.testing.assert_allclose(pixels, np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-3)
    assert (view.rays[:, 2] == 1.0).all() and view.rays.dtype == np.float32


def test_at_half_size_a_pixel_looks_between_four_of_the_input() -> None:
    camera = Camera("c", 8, 6, 10.0, 12.0, 3.5, 2.5)
    view = DenseView.of(camera, 0.5)
    between = np.array([[0.5, 0.5], [2.5, 0.5]])
    np.testing.assert_allclose(view.rays[:2], pixel_rays(between, camera.intrinsics), rtol=1e-6)
    image = np.arange(48, dtype=np.float32).reshape(6, 8)
    assert view.shrink(image)[0, 0] == image[:2, :2].mean()


def test_a_view_of_the_cameras_size_is_the_camera() -> None:
    camera = Camera("c", 8, 6, 10.0, 12.0, 3.1, 2.7)
    view, image = DenseView.of(camera, 1.0), np.random.default_rng(0).random((6, 8)).astype(np.float32)
    np.testing.assert_allclose(view.intrinsics, camera.intrinsics, atol=1e-12)
    np.testing.assert_array_equal(view.shrink(image), image)
    np.testing.assert_array_equal(view.grow(image), image)


def test_scaling_does_not_change_what_it_is_given() -> None:
    intrinsics = np.array([[10.0, 0.0, 3.5], [0.0, 12.0, 2.5], [0.0, 0.0, 1.0]])
    kept = intrinsics.copy()
    back = scaled_intrinsics(scaled_intrinsics(intrinsics, 0.5, 0.25), 2.0, 4.0)
    np.testing.assert_array_equal(intrinsics, kept)
    np.testing.assert_allclose(back, intrinsics, atol=1e-12)


@pytest.mark.parametrize("scale", [0.5, 0.25])
def test_growing_and_shrinking_keep_a_ramp_where_it_is(scale: float) -> None:
    """A shift by half a pixel would show."""
    view = DenseView.of(Camera("c", 64, 48, 50.0, 50.0, 31.5, 23.5), scale)
    y, x = np.mgrid[:48, :64]
    ramp = (3.0 * x + 2.0 * y).astype(np.float32)
    small = np.asarray(view.shrink(ramp), np.float32)
    margin = round(1.0 / scale)
    inside = np.s_[margin:-margin, margin:-margin]
    np.testing.assert_allclose(view.grow(small)[inside], ramp[inside], atol=1e-3)


def test_pixels_seen_are_those_of_the_points() -> None:
    rng = np.random.default_rng(0)
    view = DenseView.of(Camera("cam0", 64, 48, 50.0, 55.0, 31.5, 23.5), 0.5)
    rays = view.rays[rng.integers(0, len(view.rays), 20)]
    depth = rng.uniform(1.0, 5.0, 20).astype(np.float32)
    jTi = np.eye(4)
    jTi[:3, :3] = Rotation.from_rotvec([0.05, -0.1, 0.02]).as_matrix()
    jTi[:3, 3] = [0.3, -0.1, 0.2]
    pixels, front = pixels_seen(1.0 / depth, rays, jTi, view.intrinsics)
    points = (rays * depth[:, None]) @ jTi[:3, :3].T + jTi[:3, 3]
    expected = points @ view.intrinsics.T
    np.testing.assert_allclose(pixels, expected[:, :2] / expected[:, 2:], rtol=1e-4, atol=1e-3)
    assert front.all()
    jTi[2, 3] = -10.0
    assert not pixels_seen(1.0 / depth, rays, jTi, view.intrinsics)[1].any()
