"""Parts of a moving region at depths of their own, on a textured scene seen from aside."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement import parts
from mvdyn_gtsam.refinement.moving_depth import InstantView
from mvdyn_gtsam.refinement.parts import STEP, depth_of_parts
from tests.refinement.test_moving_depth import EVERYWHERE, INTRINSICS, RAYS, SHAPE, textured

REGION = np.zeros(SHAPE, bool)
REGION[10:50, 20:60] = True
LEFT = np.zeros(SHAPE, bool)
LEFT[:, :40] = True
ROWS, COLUMNS = np.nonzero(REGION)
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


def shares(theta: Float32) -> tuple[float, float]:
    """Of the left and of the right half that lie within a step of the nearer and of the farther depth."""
    left = LEFT[REGION]
    return (
        float((np.abs(theta[left] - NEAR) < STEP).mean()),
        float((np.abs(theta[~left] - FAR) < STEP).mean()),
    )


def test_two_things_in_one_region_get_a_depth_each() -> None:
    grey = textured()
    one = np.full(len(ROWS), NEAR, np.float32)
    assert shares(one) == (1.0, 0.0)
    found = depth_of_parts(one, REGION, grey, RAYS, [seen_from_aside(grey, LEFT)])
    near, far = shares(found)
    assert near > 0.95 and far > 0.75
    # the other way round: the region had the depth of the farther
    found = depth_of_parts(np.full_like(one, FAR), REGION, grey, RAYS, [seen_from_aside(grey, LEFT)])
    near, far = shares(found)
    assert near > 0.75 and far > 0.95


def test_a_region_of_one_depth_keeps_its_relief() -> None:
    grey = textured()
    relief = (NEAR + 0.03 * np.sin(COLUMNS / 3.0)).astype(np.float32)
    found = depth_of_parts(relief, REGION, grey, RAYS, [seen_from_aside(grey, EVERYWHERE)])
    np.testing.assert_array_equal(found, relief)


def test_a_depth_that_is_denied_is_not_taken() -> None:
    """The other camera sees nothing move at the farther depth, 5 px to the left."""
    grey = textured()
    one = np.full(len(ROWS), NEAR, np.float32)
    nothing_there = np.roll(REGION & LEFT, -8, axis=1)
    wall_before = seen_from_aside(grey, LEFT, nothing_there)
    wall_before.theta[:] = FAR + 0.01
    assert shares(depth_of_parts(one, REGION, grey, RAYS, [wall_before]))[1] < 0.1


def test_what_looks_too_little_alike_stays_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    grey = textured()
    one = np.full(len(ROWS), NEAR, np.float32)
    view = seen_from_aside((0.5 * (grey + textured(1))).astype(np.float32), LEFT)
    assert shares(depth_of_parts(one, REGION, grey, RAYS, [view]))[1] > 0.5
    monkeypatch.setattr(parts, "LEAST", 0.95)
    np.testing.assert_array_equal(depth_of_parts(one, REGION, grey, RAYS, [view]), one)


@pytest.mark.parametrize("contrast", [0.0, 1.0])
def test_without_a_view_or_texture_nothing_changes(contrast: float) -> None:
    grey = (contrast * textured()).astype(np.float32)
    theta = np.random.default_rng(0).normal(NEAR, 0.05, len(ROWS)).astype(np.float32)
    views = [] if contrast else [seen_from_aside(grey, LEFT)]
    np.testing.assert_array_equal(depth_of_parts(theta, REGION, grey, RAYS, views), theta)


def test_a_region_at_the_rim_and_of_one_pixel() -> None:
    grey = textured()
    views = [seen_from_aside(grey, EVERYWHERE)]
    for rows, columns in ((slice(0, 1), slice(0, 1)), (slice(0, 60), slice(0, 80))):
        region = np.zeros(SHAPE, bool)
        region[rows, columns] = True
        theta = np.full(int(region.sum()), NEAR, np.float32)
        assert depth_of_parts(theta, region, grey, RAYS, views).shape == theta.shape
