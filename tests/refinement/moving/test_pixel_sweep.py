"""Depth of the pixels of a moving region, on a textured scene seen from aside."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.moving.pixel_sweep import PRIOR_REACH, STEP, swept_region
from mvdyn_gtsam.refinement.moving.region_depth import InstantView
from tests.refinement.moving.test_region_depth import (
    EVERYWHERE,
    INTRINSICS,
    RAYS,
    SHAPE,
    from_the_side,
    textured,
)

REGION = np.zeros(SHAPE, bool)
REGION[10:50, 20:60] = True
LEFT = np.zeros(SHAPE, bool)
LEFT[:, :40] = True
NEAR, FAR = -np.log(2.0), -np.log(3.2)
BASELINE = 8 * 2.0 / 70.0
"""Of a camera to the right that sees what is 2 m away 8 px farther to the left, what is 3.2 m away 5 px."""


def seen_from_aside(grey: Float32, nearer: np.ndarray, moves: np.ndarray = EVERYWHERE) -> InstantView:
    """``nearer (h, w)`` lies at 2 m, all else at 3.2 m; the image shows both where they are seen."""
    jTi = np.eye(4)
    jTi[0, 3] = -BASELINE
    image = np.roll(grey, -5, axis=1)
    front = np.roll(nearer, -8, axis=1)
    image[front] = np.roll(grey, -8, axis=1)[front]
    wall = np.full(SHAPE, np.log(0.1), np.float32)
    return InstantView(image, INTRINSICS, jTi, wall, moves, wall)


def swept(start: float, grey: Float32, *views: InstantView, region: np.ndarray = REGION) -> Float32:
    return swept_region(start, region, grey, INTRINSICS, RAYS, views)


def halves(theta: Float32) -> tuple[float, float]:
    """Of the left and of the right half of the region that lie within a step of the nearer and of the farther
    depth."""
    left = LEFT[REGION]
    return (
        float((np.abs(theta[left] - NEAR) < STEP).mean()),
        float((np.abs(theta[~left] - FAR) < STEP).mean()),
    )


@pytest.mark.parametrize("start", [NEAR, FAR, 0.5 * (NEAR + FAR)])
def test_two_things_in_one_region_get_a_depth_each(start: float) -> None:
    """Whichever of them the region had its depth from."""
    grey = textured()
    near, far = halves(swept(start, edged(grey), seen_from_aside(edged(grey), LEFT)))
    # patches along the edge see both
    assert near > 0.75 and far > 0.75


def edged(grey: Float32) -> Float32:
    """An image whose left half is darker: depth jumps where colour does."""
    return np.where(LEFT, 0.4 * grey, 0.4 * grey + 150.0).astype(np.float32)


def test_a_region_of_one_depth_has_that() -> None:
    grey = textured()
    found = swept(FAR, grey, seen_from_aside(grey, EVERYWHERE))
    assert np.abs(found - NEAR).max() < STEP


def test_a_surface_that_slants_is_found_slanting() -> None:
    """A camera to the right sees what leans away from it: inverse depth is linear over the image."""
    grey, columns = textured(), np.arange(SHAPE[1], dtype=np.float32)
    inverse_depth = 0.5 + 0.003 * (columns - 39.5)
    # where the camera, half a metre to the right, sees each column, and by which columns its own are filled
    there = columns - 70.0 * 0.5 * inverse_depth
    image = np.stack([np.interp(columns, there, row) for row in grey]).astype(np.float32)
    jTi = np.eye(4)
    jTi[0, 3] = -0.5
    wall = np.full(SHAPE, np.log(0.1), np.float32)
    found = swept(np.log(0.5), grey, InstantView(image, INTRINSICS, jTi, wall, EVERYWHERE, wall))
    error = found - np.log(np.broadcast_to(inverse_depth, SHAPE)[REGION])
    assert np.ptp(np.log(inverse_depth[20:60])) > 0.2
    assert np.abs(error).mean() < 0.5 * STEP


def test_of_depths_that_look_alike_one_that_is_denied_is_not_taken() -> None:
    """A pattern that repeats every 3 px looks the same 5 and 8 px to the left. The other camera sees it
    move 8 px to the left: 5 px to the left its last 3 columns would lie beside that."""
    grey = np.tile(textured()[:, :3], 27)[:, : SHAPE[1]]
    np.testing.assert_allclose(swept(FAR, grey, seen_from_aside(grey, EVERYWHERE)), FAR, atol=STEP)
    found = np.full(SHAPE, np.nan, np.float32)
    found[REGION] = swept(FAR, grey, seen_from_aside(grey, EVERYWHERE, np.roll(REGION, -8, axis=1)))
    np.testing.assert_allclose(found[10:50, 20:57], FAR, atol=STEP)
    assert (np.abs(found[10:50, 57:60] - NEAR) < STEP).mean() > 0.85


@pytest.mark.parametrize("contrast", [0.0, 1.0])
def test_without_a_view_or_texture_a_region_lies_at_its_depth(contrast: float) -> None:
    grey = (contrast * textured()).astype(np.float32)
    views = () if contrast else (seen_from_aside(grey, LEFT),)
    np.testing.assert_allclose(swept(NEAR, grey, *views), NEAR, atol=1e-6)


def test_what_looks_too_little_alike_stays_where_it_is() -> None:
    noise = textured(1)
    found = swept(NEAR, textured(), seen_from_aside(noise, EVERYWHERE))
    assert (np.abs(found - NEAR) < PRIOR_REACH).mean() > 0.8


def test_what_the_view_would_not_see_is_not_drawn_into_it() -> None:
    """At its depth it lies left of the other image, in which something else looks a little like it."""
    grey, jTi = textured(), np.eye(4)
    jTi[0, 3] = -2.0
    farther = NEAR - 0.4
    alike = np.roll(grey, -round(70.0 * 2.0 * np.exp(farther)), axis=1)
    image = (0.4 * alike + 0.9 * textured(1)).astype(np.float32)
    wall = np.full(SHAPE, np.log(0.1), np.float32)
    found = swept(NEAR, grey, InstantView(image, INTRINSICS, jTi, wall, EVERYWHERE, wall))
    assert (np.abs(found - NEAR) < 0.1).mean() > 0.95


def test_what_a_view_sees_from_the_side_is_nearer_than_its_middle() -> None:
    """No texture: the region stays at its depth but for half of the way to the front of its hull."""
    pillar = np.zeros(SHAPE, bool)
    pillar[20:40, 38:42] = True
    plain = np.full(SHAPE, 100.0, np.float32)
    found = swept(np.log(0.5), plain, from_the_side(90.0, 0.3), region=pillar)
    np.testing.assert_allclose(found, np.log(0.5) + 0.5 * np.log(2.0 / 1.7), atol=0.03)


def test_a_region_at_the_rim_and_of_one_pixel() -> None:
    grey = textured()
    view = seen_from_aside(grey, EVERYWHERE)
    for rows, columns in ((slice(0, 1), slice(0, 1)), (slice(0, 60), slice(0, 80))):
        region = np.zeros(SHAPE, bool)
        region[rows, columns] = True
        found = swept(NEAR, grey, view, region=region)
        assert found.shape == (int(region.sum()),) and np.isfinite(found).all()
