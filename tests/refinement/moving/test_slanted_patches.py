"""Planes that patches of another camera's image fit, on surfaces seen from aside."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.moving import slanted_patches
from mvdyn_gtsam.refinement.moving.pixel_sweep import swept_region
from mvdyn_gtsam.refinement.moving.region_depth import InstantView
from mvdyn_gtsam.refinement.moving.slanted_patches import PatchView, Planes, fitted_planes
from mvdyn_gtsam.refinement.views import DenseView

Mask = npt.NDArray[np.bool_]

SHAPE = (60, 80)
VIEW = DenseView.of(Camera("cam0", 80, 60, 70.0, 70.0, 39.5, 29.5), 1.0)
REGION = np.zeros(SHAPE, bool)
REGION[12:48, 15:65] = True
BASELINE = 1.2
EVERYWHERE = np.ones(SHAPE, bool)


def wall(slope: float) -> Float32:
    """Inverse depth ``(h, w)`` of a wall 2 m away that turns away from the camera."""
    columns = np.arange(SHAPE[1], dtype=np.float32) - 39.5
    return np.asarray(np.broadcast_to(0.5 * (1.0 + slope * columns), SHAPE), np.float32)


def seen_from_the_right(image: Float32, slope: float) -> tuple[Float32, npt.NDArray[np.float64]]:
    """What a camera ``BASELINE`` to the right sees of the wall that ``image`` shows, and its ``jTi``.

    Where it has a pixel ``u`` this camera has the ``x`` with ``x - 70 B rho(x) = u``, linear in ``x``.
    """
    jTi = np.eye(4)
    jTi[0, 3] = -BASELINE
    shift = 70.0 * BASELINE * 0.5
    columns = np.arange(SHAPE[1], dtype=np.float32)
    x = (columns + shift * (1.0 - slope * 39.5)) / (1.0 - shift * slope)
    rows = np.repeat(np.arange(SHAPE[0], dtype=np.float32)[:, None], SHAPE[1], axis=1)
    across = np.repeat(x[None].astype(np.float32), SHAPE[0], axis=0)
    return cv2.remap(image, across, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), jTi


def textured(seed: int = 0) -> Float32:
    noise = np.random.default_rng(seed).uniform(0.0, 255.0, (*SHAPE, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.asarray((smooth - smooth.mean()) * 4.0 + 128.0, np.float32)


def fitted(image: Float32, start: float, *views: PatchView, region: Mask = REGION) -> tuple[Float32, Float32]:
    """Log inverse depth and likeness, NaN outside of the region."""
    theta = np.full(SHAPE, start, np.float32)
    fit = fitted_planes(theta, region, image, VIEW.intrinsics, views, (0, 1))
    found, alike = (np.full(SHAPE, np.nan, np.float32) for _ in range(2))
    found[region], alike[region] = fit.theta, fit.likeness
    return found, alike


@pytest.mark.parametrize("slope", [0.0, 0.006, -0.009])
def test_a_wall_that_slants_is_found_from_a_depth_that_is_off(slope: float) -> None:
    image, truth = textured(), np.log(wall(slope))
    other, jTi = seen_from_the_right(image, slope)
    found, alike = fitted(image, np.log(0.5) + 0.12, PatchView(other, VIEW.intrinsics, jTi, 1.0))
    # beyond the left border the other camera sees nothing of it
    seen = REGION & (np.arange(SHAPE[1]) - 70.0 * BASELINE * wall(slope) > 4.0)
    error = np.abs(found - truth)[seen]
    assert seen.sum() > 500
    assert np.median(error) < 0.005 and (error < 0.02).mean() > 0.85
    assert np.median(alike[seen]) > 0.85
    assert np.isfinite(found[REGION]).all()


def test_a_slanting_wall_is_found_better_than_by_a_sweep() -> None:
    slope = -0.018
    image, truth = textured(3), np.log(wall(slope))
    other, jTi = seen_from_the_right(image, slope)
    found, _ = fitted(image, np.log(0.5), PatchView(other, VIEW.intrinsics, jTi, 1.0))
    far = np.full(SHAPE, np.log(0.1), np.float32)
    view = InstantView(other[..., 0], VIEW.intrinsics, jTi, far, EVERYWHERE, far)
    swept = np.full(SHAPE, np.nan, np.float32)
    swept[REGION] = swept_region(np.log(0.5), REGION, image[..., 0], VIEW.intrinsics, VIEW.rays, [view])
    seen = REGION & (np.arange(SHAPE[1]) - 70.0 * BASELINE * wall(slope) > 4.0)
    assert np.abs(found - truth)[seen].mean() < 0.4 * np.abs(swept - truth)[seen].mean()


def test_likeness_is_the_weighted_correlation_of_patches() -> None:
    """Against the definition, point by point, of patches that are shifted by whole pixels."""
    image = textured(5)
    jTi = np.eye(4)
    jTi[0, 3] = -4.0 / 35.0  # 4 px at 2 m
    other = np.roll(textured(6), 2, axis=1) + 0.5 * image
    cells = slanted_patches._Cells(REGION)
    theta = np.full(SHAPE, np.log(0.5), np.float32)
    view = PatchView(other, VIEW.intrinsics, jTi, 0.8)
    search = slanted_patches._Search(cells, theta, REGION, image, VIEW.intrinsics, [view])
    reach = range(-slanted_patches.RADIUS, slanted_patches.RADIUS + 1, slanted_patches.SPACING)
    for cell in (0, 7, 200, len(cells.row) - 1):
        row, column = int(cells.row[cell]), int(cells.column[cell])
        at = [(row + down, column + across) for down in reach for across in reach]
        own = np.array([image[p] for p in at], np.float64)
        seen = np.array([other[y, x - 4] for y, x in at], np.float64)
        outside = np.array([1.0 if REGION[p] else slanted_patches.OUTSIDE for p in at])
        weight = outside * np.exp(-np.abs(own[:, 0] - image[row, column, 0]) / slanted_patches.ALIKE_GREYS)
        weight /= weight.sum()
        own, seen = own - weight @ own, seen - weight @ seen
        floor = slanted_patches.NOISE**2
        variances = [weight @ (part**2).sum(axis=1) + floor for part in (own, seen)]
        expected = 0.8 * (weight @ (own * seen).sum(axis=1)) / np.sqrt(np.prod(variances))
        assert search.likeness[cell] == pytest.approx(max(expected, 0.0), abs=1e-4)


def test_a_plane_is_the_same_seen_from_its_other_pixels() -> None:
    rng = np.random.default_rng(2)
    planes = Planes(
        rng.normal(size=50).astype(np.float32), rng.uniform(-0.02, 0.02, (50, 2)).astype(np.float32)
    )
    first, second = rng.integers(-8, 9, (2, 50, 2)).astype(np.float32)
    there, direct = planes.at(first).at(second), planes.at(first + second)
    np.testing.assert_allclose(there.theta, direct.theta, atol=1e-5)
    np.testing.assert_allclose(there.slope, direct.slope, atol=1e-6)
    back = there.at(-first - second)
    np.testing.assert_allclose(back.theta, planes.theta, atol=1e-5)
    linear = np.exp(planes.theta) * (1.0 + (planes.slope * first).sum(axis=1))
    np.testing.assert_allclose(np.exp(planes.at(first).theta), linear, rtol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (60, 80)])
def test_every_pixel_has_a_cell_and_every_cell_a_pixel_of_the_region(size: tuple[int, int]) -> None:
    region = np.zeros(SHAPE, bool)
    region[: size[0], -size[1] :] = np.random.default_rng(0).uniform(size=size) > 0.3
    region[0, -1] = True
    cells = slanted_patches._Cells(region)
    rows, columns = np.nonzero(region)
    assert region[cells.row, cells.column].all()
    assert len(cells.row) <= 1.3 * slanted_patches.MOST_CELLS
    np.testing.assert_array_equal(cells.column[cells.of_pixel] + cells.offset[:, 0], columns)
    np.testing.assert_array_equal(cells.row[cells.of_pixel] + cells.offset[:, 1], rows)
    own, other, offset = cells.neighbours(1, 0)
    np.testing.assert_array_equal(cells.row[other] + offset[:, 1], cells.row[own])
    assert (cells.row[other] > cells.row[own] - 1).all() and len(np.unique(own)) == len(own)


def test_without_a_view_or_texture_nothing_is_alike() -> None:
    image, plain = textured(), np.full((*SHAPE, 3), 90.0, np.float32)
    other, jTi = seen_from_the_right(plain, 0.0)
    for own, views in ((image, ()), (plain, (PatchView(other, VIEW.intrinsics, jTi, 1.0),))):
        found, alike = fitted(own, np.log(0.5), *views)
        assert np.nanmax(alike) < 0.01
        assert np.isfinite(found[REGION]).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (7, 1)])
def test_a_region_of_few_pixels_at_the_rim(size: tuple[int, int]) -> None:
    region, image = np.zeros(SHAPE, bool), textured()
    region[: size[0], -size[1] :] = True
    other, jTi = seen_from_the_right(image, 0.0)
    found, _ = fitted(image, np.log(0.5), PatchView(other, VIEW.intrinsics, jTi, 1.0), region=region)
    assert np.isfinite(found[region]).all()


def test_the_same_seed_finds_the_same() -> None:
    image = textured()
    other, jTi = seen_from_the_right(image, 0.006)
    view = PatchView(other, VIEW.intrinsics, jTi, 1.0)
    first, second = (fitted(image, np.log(0.5), view) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_a_view_that_has_the_region_behind_it_sees_nothing() -> None:
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    view = PatchView(textured(), VIEW.intrinsics, behind, 1.0)
    found, alike = fitted(textured(), np.log(0.5), view)
    assert np.isfinite(found[REGION]).all() and np.nanmax(alike) <= 0.0
