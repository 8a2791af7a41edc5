"""Small views: they see what the camera sees; and depth brought back up along the edges of the image."""

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
from mvdyn_gtsam.refinement.tasks import upsample
from mvdyn_gtsam.refinement.views import DenseView, pixels_seen, scaled_intrinsics

Array = npt.NDArray[np.float64]

CONTRAST = 5.0


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


def textured(shape: tuple[int, int]) -> npt.NDArray[np.uint8]:
    return np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)


@pytest.mark.parametrize("small", [(24, 32), (12, 16), (19, 27)])
def test_constant_depth_stays_constant_whatever_the_image(small: tuple[int, int]) -> None:
    found = upsample(np.full(small, 0.37, np.float32), textured((48, 64)), CONTRAST)
    assert found.shape == (48, 64)
    np.testing.assert_allclose(found, 0.37, rtol=1e-5)


def test_at_the_size_of_the_input_nothing_changes() -> None:
    inverse_depth = np.random.default_rng(4).uniform(0.1, 1.0, (20, 30)).astype(np.float32)
    np.testing.assert_array_equal(upsample(inverse_depth, textured((20, 30)), CONTRAST), inverse_depth)


@pytest.mark.parametrize("small", [(24, 32), (12, 16)])
def test_on_a_plain_image_it_is_linear_in_the_logarithm(small: tuple[int, int]) -> None:
    view = DenseView.of(Camera("c", 64, 48, 50.0, 50.0, 31.5, 23.5), small[0] / 48)
    y, x = np.mgrid[:48, :64]
    theta = (-1.0 + 0.01 * x - 0.02 * y).astype(np.float32)
    shrunk = np.asarray(view.shrink(theta), np.float32)
    found = np.log(upsample(np.exp(shrunk), np.full((48, 64), 90, np.uint8), CONTRAST))
    np.testing.assert_allclose(found[4:-4, 4:-4], theta[4:-4, 4:-4], atol=1e-4)


@pytest.mark.parametrize("column", [30, 31, 32, 33])
def test_depth_changes_where_the_image_does(column: int) -> None:
    """The image's edge lies anywhere within the pixels of the small view, and the depth's with it."""
    stride = 4
    grey = np.full((48, 64), 60, np.uint8)
    grey[:, column:] = 160
    truth = np.where(np.arange(64) < column, 0.2, 0.5)
    # a pixel of the small view takes the depth of most of it
    centres = np.arange(16) * stride + 1.5
    small = np.tile(np.where(centres < column - 0.5, 0.2, 0.5), (12, 1)).astype(np.float32)
    found = upsample(small, grey, CONTRAST)
    linear = np.exp(
        np.interp((np.arange(64) + 0.5) / stride - 0.5, np.arange(16), np.log(small[0].astype(np.float64)))
    )
    wrong = np.abs(np.log(found / truth)) > 0.1
    wrong_linear = np.abs(np.log(linear / truth)) > 0.1
    # one on each side, whose luminance is itself between the two
    assert wrong[24].sum() <= 2 < wrong_linear.sum()
    assert found.min() >= 0.2 * (1.0 - 1e-5) and found.max() <= 0.5 * (1.0 + 1e-5)


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
