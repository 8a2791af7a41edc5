"""Plain regions and the planes that rims agree on, in a room whose planes are known."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.refinement.plain.planes import (
    PlainRegion,
    RimPlanes,
    agreed_plane,
    fill_plain,
    plain_regions,
    planes_in_camera,
    planes_in_world,
    rim_planes,
    surfaces,
)
from mvdyn_gtsam.refinement.settings import PlainConfig
from tests.test_geometry import poses

Array = npt.NDArray[np.float64]
CONFIG = PlainConfig()
HEIGHT, WIDTH, FOCAL = 72, 96, 80.0
COLUMN, ROW = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
RAYS = np.stack([(COLUMN - 47.5) / FOCAL, (ROW - 35.5) / FOCAL, np.ones((HEIGHT, WIDTH))], axis=2).reshape(
    -1, 3
)
BACK = np.array([0.0, 0.0, 0.25])
"""A wall 4 m away."""
CEILING = np.array([0.0, -1.0 / 1.2, 0.0])
"""1.2 m above the camera."""
SIDE = np.array([1.0 / 1.8, 0.0, 0.0])
"""1.8 m to the right."""
NO_AXES = np.zeros((0, 3))


def room() -> tuple[Array, Array]:
    """Log inverse depth ``(h, w)`` of the nearest surface, and which it is: 0 back, 1 side, 2 ceiling."""
    inverse_depth = np.stack([(RAYS @ plane).reshape(HEIGHT, WIDTH) for plane in (BACK, SIDE, CEILING)])
    return np.log(inverse_depth.max(axis=0)), inverse_depth.argmax(axis=0)


def view_of_room() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image of textured walls and a plain ceiling, depth that is wrong on the ceiling, trust, truth."""
    truth, surface = room()
    random = np.random.default_rng(0)
    grey = np.where(surface == 2, 200.0, 100.0 + 40.0 * random.random((HEIGHT, WIDTH))).astype(np.float32)
    # what is seen ends two pixels inside the ceiling, as windows of a matcher reach that far
    seen = (surface != 2) | np.roll(surface != 2, -2, axis=0)
    theta = np.where(seen, truth, np.log(0.25)).astype(np.float32)
    return grey, theta, np.where(seen, 0.9, 0.0).astype(np.float32), truth


def coloured(luminance: np.ndarray, hue: np.ndarray | float = 128.0) -> np.ndarray:
    """``(h, w, 3)``"""
    return np.dstack([luminance, hue + 0.0 * luminance, 128.0 + 0.0 * luminance]).astype(np.float32)


def regions_of(seed: int = 0) -> list[PlainRegion]:
    grey, theta, trust, _ = view_of_room()
    nothing = np.zeros(grey.shape, bool)
    return plain_regions(coloured(grey), theta, trust, nothing, RAYS.astype(np.float32), CONFIG, (seed, 0))


def bank_of(count: int) -> Array:
    """Planes of ``count`` frames of a camera that stands still."""
    return bank([regions_of(time) for time in range(count)], NO_AXES)


def bank(found: list[list[PlainRegion]], axes: Array) -> Array:
    """Planes of the regions ``found`` in the frames of a camera that stands still."""
    rows = []
    for time, regions in enumerate(found):
        rims = [rim_planes(region, axes, CONFIG, (time, number)) for number, region in enumerate(regions)]
        rows.append(np.insert(planes_in_world(rims, np.eye(4)), 0, [[0], [time]], axis=1))
    return np.concatenate(rows)


def test_ceiling_takes_the_plane_through_both_walls_rims() -> None:
    grey, theta, trust, truth = view_of_room()
    filled = fill_plain(theta, trust, regions_of(), bank_of(8), np.eye(4), NO_AXES, CONFIG)
    ceiling = room()[1] == 2
    before, after = np.abs(theta - truth)[ceiling], np.abs(filled - truth)[ceiling]
    assert before.mean() > 0.15
    assert after.mean() < 0.3 * before.mean()
    np.testing.assert_array_equal(filled[~ceiling & (ROW > 40)], theta[~ceiling & (ROW > 40)])


def line_below_a_wall() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image of a plain wall 4 m away over a textured floor, of which only the wall's foot is seen; depth that
    is wrong on the wall, trust, truth."""
    floor = np.array([0.0, 1.0 / 1.2, 0.0])
    inverse_depth = np.stack([(RAYS @ plane).reshape(HEIGHT, WIDTH) for plane in (BACK, floor)])
    random = np.random.default_rng(0)
    wall = inverse_depth.argmax(axis=0) == 0
    grey = np.where(wall, 200.0, 100.0 + 40.0 * random.random((HEIGHT, WIDTH))).astype(np.float32)
    seen = ~np.roll(wall, -2, axis=0) | ~wall
    truth = np.log(inverse_depth.max(axis=0))
    theta = np.where(seen, truth, np.log(0.4)).astype(np.float32)
    return grey, theta, np.where(seen, 0.9, 0.0).astype(np.float32), truth


@pytest.mark.parametrize(("axes", "share"), [(NO_AXES, 1.0), (np.array([[0.0, 1.0, 0.0]]), 0.2)])
def test_a_wall_of_which_only_the_foot_is_seen_stands_upright(axes: Array, share: float) -> None:
    """Through one line there are many planes, but one alone is upright."""
    grey, theta, trust, truth = line_below_a_wall()
    rays, nothing = RAYS.astype(np.float32), np.zeros(grey.shape, bool)
    found = [
        plain_regions(coloured(grey), theta, trust, nothing, rays, CONFIG, (time, 0)) for time in range(8)
    ]
    filled = fill_plain(theta, trust, found[0], bank(found, axes), np.eye(4), axes, CONFIG)
    above = ROW < 30
    left = np.abs(filled - truth)[above].mean() / np.abs(theta - truth)[above].mean()
    assert left <= share + 1e-6
    assert (left < 0.9) == (share < 1.0)


def test_surfaces_that_are_well_seen_are_found_by_their_planes() -> None:
    truth, surface = room()
    trust = np.where(surface == 2, 0.0, 0.9).astype(np.float32)
    found = surfaces(truth.astype(np.float32), trust, RAYS.astype(np.float32), CONFIG, (0, 0))
    assert len(found) > 0
    np.testing.assert_allclose(found[0, :3], BACK, atol=0.02)
    assert found[0, 3] == pytest.approx((surface == 0).sum() / (surface < 2).sum(), abs=0.1)
    nowhere = np.zeros(truth.shape, np.float32)
    assert surfaces(truth.astype(np.float32), nowhere, RAYS.astype(np.float32), CONFIG, (0, 0)).shape == (
        0,
        4,
    )


def test_nothing_is_filled_without_witnesses() -> None:
    _, theta, trust, _ = view_of_room()
    regions = regions_of()
    assert len(regions) > 0
    nobody = np.zeros((0, 7))
    np.testing.assert_array_equal(
        fill_plain(theta, trust, regions, nobody, np.eye(4), NO_AXES, CONFIG), theta
    )


def test_a_plane_alone_against_many_is_not_taken() -> None:
    region = regions_of()[0]
    tilted = CEILING * 1.2
    planes = np.concatenate([np.tile(CEILING, (5, 1)), tilted[None]])
    chosen = agreed_plane(region, planes, np.ones(6), np.arange(6), CONFIG)
    assert chosen is not None
    np.testing.assert_allclose(chosen.plane, CEILING)
    assert chosen.frames == 5


def test_planes_of_one_frame_are_one_witness() -> None:
    region = regions_of()[0]
    planes = np.tile(CEILING, (20, 1))
    frames = np.repeat([0, 1, 2, 3], 5)
    assert agreed_plane(region, planes, np.ones(20), frames, CONFIG) is not None
    config = replace(CONFIG, witnesses=8)
    # twenty frames were asked, four of them agree
    asked = np.concatenate([frames, [19]])
    planes = np.concatenate([planes, SIDE[None]])
    assert agreed_plane(region, planes, np.ones(21), asked, config) is None


def test_of_very_many_planes_some_are_compared() -> None:
    (region,) = regions_of()
    planes = np.concatenate([np.tile(CEILING, (1500, 1)), np.tile(BACK, (500, 1))])
    tracemalloc.start()
    chosen = agreed_plane(region, planes, np.ones(2000), np.arange(2000), CONFIG)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert chosen is not None
    np.testing.assert_allclose(chosen.plane, CEILING)
    assert peak < 50e6


def test_a_plane_counts_less_far_from_its_rim() -> None:
    grey, theta, trust, truth = view_of_room()
    filled = fill_plain(theta, trust, regions_of(), bank_of(2), np.eye(4), NO_AXES, CONFIG)
    ceiling = room()[1] == 2
    share = np.full(theta.shape, np.nan)
    share[ceiling] = (filled - theta)[ceiling] / (truth - theta)[ceiling]
    top, bottom = np.nanmedian(share[:3]), np.nanmedian(share[np.flatnonzero(ceiling.any(axis=1))[-8:-5]])
    assert top < bottom


def test_walls_as_bright_as_each_other_are_told_apart_by_their_hue() -> None:
    """Two plain walls over a textured floor; in grey they are one."""
    _, theta, _, _ = view_of_room()
    random = np.random.default_rng(0)
    grey = np.full((HEIGHT, WIDTH), 150.0)
    grey[-12:] = 100.0 + 40.0 * random.random((12, WIDTH))
    trust = np.zeros((HEIGHT, WIDTH), np.float32)
    trust[-14:] = 0.9
    nothing, rays = np.zeros(grey.shape, bool), RAYS.astype(np.float32)
    hue = np.where(np.arange(WIDTH) < WIDTH // 2, 124.0, 132.0)[None]
    for colour, count in ((coloured(grey), 1), (coloured(grey, hue), 2)):
        assert len(plain_regions(colour, theta, trust, nothing, rays, CONFIG, (0, 0))) == count


def test_excluded_pixels_belong_to_no_region() -> None:
    grey, theta, trust, _ = view_of_room()
    everything = np.ones(grey.shape, bool)
    assert (
        plain_regions(coloured(grey), theta, trust, everything, RAYS.astype(np.float32), CONFIG, (0, 0)) == []
    )


def test_the_draw_is_repeatable() -> None:
    first, second = regions_of(3), regions_of(3)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.rim_rays, other.rim_rays)
        rims = [rim_planes(region, NO_AXES, CONFIG, (3, 0)) for region in (one, other)]
        np.testing.assert_array_equal(rims[0].planes, rims[1].planes)


@given(poses(), st.floats(0.1, 10.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_planes_return_from_the_world(wTc: Array, z: float, x: float, y: float) -> None:
    plane = np.array([x, y, 1.0]) / z
    world = planes_in_world([RimPlanes(plane[None], np.ones(1), 4)], wTc)
    assert np.linalg.norm(world[0, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(planes_in_camera(world[:, :4], wTc)[0], plane, rtol=1e-5, atol=1e-6)
