"""Depth of moving regions: what one instant says."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.moving.region_depth import (
    InstantView,
    RegionDepth,
    commonest,
    confirmed_there,
    contradicted,
    moving_there,
    observed_region,
    region_depth,
    side_seen,
    support,
)
from mvdyn_gtsam.refinement.views import DenseView

Mask = npt.NDArray[np.bool_]

SHAPE = (60, 80)
REGION = np.zeros(SHAPE, bool)
REGION[20:40, 30:50] = True
EVERYWHERE = np.ones(SHAPE, bool)
VIEW = DenseView.of(Camera("cam0", 80, 60, 70.0, 70.0, 39.5, 29.5), 1.0)
INTRINSICS, RAYS = VIEW.intrinsics, VIEW.rays


def test_a_region_takes_its_commonest_depth() -> None:
    rng = np.random.default_rng(1)
    instant = np.full(SHAPE, 0.1, np.float32)
    values = 0.5 * np.exp(rng.normal(0.0, 0.01, 400))
    values[:80] = rng.uniform(0.1, 0.3, 80)
    values[80:140] = rng.uniform(0.7, 2.0, 60)
    instant[REGION] = values
    common = commonest(np.log(instant[REGION]))
    assert np.exp(common) == pytest.approx(0.5, rel=0.02)
    depth = region_depth(instant, REGION, common)
    np.testing.assert_allclose(depth[140:], values[140:], rtol=1e-5)
    np.testing.assert_allclose(depth[:140], 0.5, rtol=0.02)


@pytest.mark.parametrize("value", [0.01, 0.3, 0.5, 1.0, 7.3])
def test_a_region_of_one_depth_has_that(value: float) -> None:
    assert np.exp(commonest(np.full(400, np.log(value), np.float32))) == pytest.approx(value)


def textured(seed: int = 0) -> Float32:
    noise = np.random.default_rng(seed).uniform(0.0, 255.0, SHAPE).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 0.6), np.float32)


def beside(grey: Float32, shift: int, moves: Mask = EVERYWHERE) -> InstantView:
    """A camera that sees what is 2 m away ``shift`` px farther to the left, before a wall 5 m away."""
    jTi = np.eye(4)
    jTi[0, 3] = -shift * 2.0 / 70.0
    wall = np.full(SHAPE, np.log(0.2), np.float32)
    thing = np.full(SHAPE, np.log(0.5), np.float32)
    return InstantView(np.roll(grey, -shift, axis=1), INTRINSICS, jTi, wall, moves, thing)


def test_the_right_depth_is_supported_and_a_wrong_one_is_not() -> None:
    grey = textured()
    views = [beside(grey, 8)]
    right, wrong = (support(grey, REGION, np.log(1.0 / depth), RAYS, views) for depth in (2.0, 4.0))
    assert right == 1.0
    assert wrong < 0.3


def test_what_another_camera_does_not_see_is_not_supported() -> None:
    grey = textured()
    assert support(grey, REGION, np.log(0.5), RAYS, [beside(grey, 70)]) == 0.0
    assert support(grey, REGION, np.log(0.5), RAYS, []) == 0.0


def denied_share(depth: float, view: InstantView) -> float:
    rays = RAYS[REGION.ravel()]
    return float(contradicted(np.full(len(rays), -np.log(depth), np.float32), rays, [view]).mean())


def test_a_moving_thing_moves_in_both_cameras() -> None:
    """At 2 m the other camera sees it 8 px to the left, where it moves; at 1 m 16 px, where nothing does."""
    view = beside(textured(), 8, np.roll(REGION, -8, axis=1))
    assert denied_share(2.0, view) == 0.0
    assert denied_share(1.0, view) == pytest.approx(8.0 / 20.0)
    assert denied_share(0.55, view) == 1.0


def test_what_is_hidden_or_outside_is_not_denied() -> None:
    nothing_moves = beside(textured(), 8, ~EVERYWHERE)
    assert denied_share(4.0, nothing_moves) == 1.0
    assert denied_share(8.0, nothing_moves) == 0.0
    assert denied_share(0.1, nothing_moves) == 0.0


def observed(instant: Float32, grey: Float32, view: InstantView) -> RegionDepth:
    """What one view says of the region, the first of its frame."""
    region = observed_region((0, 3), 1, instant, REGION, grey, RAYS, [view])
    assert (region.frame, region.label) == ((0, 3), 1)
    return region


def test_the_observed_depth_is_one_that_no_camera_denies() -> None:
    """Two thirds of the pixels agree on a depth where the other camera sees nothing move."""
    grey, instant = textured(), np.full(SHAPE, 0.5, np.float32)
    instant[20:33] = 2.5
    view = beside(grey, 8, np.roll(REGION, -8, axis=1))
    found = observed(instant, grey, view)
    assert np.exp(found.log_inverse_depth) == pytest.approx(0.5, rel=0.02)
    assert found.evidence == 1.0
    # most pixels lie where the images do not match
    assert np.isnan(found.matched) and not found.still


def test_a_depth_that_is_denied_is_no_evidence() -> None:
    grey, instant = textured(), np.full(SHAPE, 0.5, np.float32)
    assert observed(instant, grey, beside(grey, 8)).evidence == 1.0
    found = observed(instant, grey, beside(grey, 8, ~EVERYWHERE))
    # but a still thing may well stand there
    assert found.evidence == 0.0 and np.exp(found.matched) == pytest.approx(0.5, rel=0.02) and not found.still


def test_a_depth_at_which_the_other_view_finds_something_else_is_no_evidence() -> None:
    """The thing that moves there is 2 m away to both, or 4 m to the other."""
    grey, instant = textured(), np.full(SHAPE, 0.5, np.float32)
    view = beside(grey, 8)
    theta, rays = np.full(int(REGION.sum()), np.log(0.5), np.float32), RAYS[REGION.ravel()]
    farther = replace(view, instant=view.instant - np.float32(np.log(2.0)))
    assert confirmed_there(theta, rays, [view]) == 1.0 and observed(instant, grey, view).evidence == 1.0
    assert confirmed_there(theta, rays, [farther]) == 0.0 and observed(instant, grey, farther).evidence == 0.0
    assert confirmed_there(theta, rays, [farther, view]) == 1.0
    assert confirmed_there(theta, rays, []) == 0.0


def test_what_another_view_sees_stand_still_there_does_not_move() -> None:
    """The wall 5 m away, which another camera sees 3 px to the left."""
    grey, instant = textured(), np.full(SHAPE, 0.2, np.float32)
    jTi = np.eye(4)
    jTi[0, 3] = -3.0 * 5.0 / 70.0
    wall = np.full(SHAPE, np.log(0.2), np.float32)
    view = InstantView(np.roll(grey, -3, axis=1), INTRINSICS, jTi, wall, ~EVERYWHERE, wall)
    found = observed(instant, grey, view)
    assert found.still and found.evidence == 0.0
    assert found.log_inverse_depth == found.matched == pytest.approx(np.log(0.2), abs=0.02)


def test_a_thing_that_no_view_sees_move_is_not_believed() -> None:
    theta = np.full(int(REGION.sum()), np.log(0.5), np.float32)
    half = np.roll(REGION, -8, axis=1)
    half[30:] = False
    rays = RAYS[REGION.ravel()]
    assert moving_there(theta, rays, [beside(textured(), 8, ~EVERYWHERE)]) == 0.0
    assert moving_there(theta, rays, [beside(textured(), 8, half)]) == pytest.approx(0.5)
    assert moving_there(theta, rays, [beside(textured(), 80, EVERYWHERE)]) == 0.0
    assert moving_there(theta, rays, []) == 0.0


def from_the_side(degrees: float, radius: float) -> InstantView:
    """A camera that looks at what is 2 m away, from 2 m, and sees a pillar of that radius move there."""
    jTi, turn = np.eye(4), np.radians(degrees)
    jTi[:3, :3] = [[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]]
    jTi[:3, 3] = [0.0, 0.0, 2.0] - jTi[:3, :3] @ [0.0, 0.0, 2.0]
    moves = np.abs(np.arange(SHAPE[1]) - 39.5) <= 70.0 * radius / 2.0
    wall = np.full(SHAPE, np.log(0.2), np.float32)
    return InstantView(textured(), INTRINSICS, jTi, wall, np.broadcast_to(moves, SHAPE), wall)


def way_to_the_front(degrees: float, radius: float = 0.3) -> Float32:
    middle = np.zeros(SHAPE, bool)
    middle[25:35, 38:42] = True
    theta = np.full(int(middle.sum()), np.log(0.5), np.float32)
    return side_seen(theta, RAYS[middle.ravel()], [from_the_side(degrees, radius)])


def test_what_is_seen_from_the_side_is_nearer_than_its_middle() -> None:
    """Seen at a right angle the hull begins one radius before the middle: half of that."""
    np.testing.assert_allclose(way_to_the_front(90.0), 0.5 * np.log(2.0 / 1.7), atol=0.03)
    assert way_to_the_front(90.0, 0.5).mean() > way_to_the_front(90.0).mean() + 0.03


def test_what_is_seen_from_about_the_same_side_is_where_it_is_matched() -> None:
    assert (way_to_the_front(25.0) == 0.0).all()
    assert 0.0 < way_to_the_front(45.0).mean()


def test_a_view_that_looks_away_has_no_say_in_how_far_it_comes_forward() -> None:
    """At our place it would see the same side of the thing, but it looks at something else."""
    middle = np.zeros(SHAPE, bool)
    middle[25:35, 38:42] = True
    theta, rays = np.full(int(middle.sum()), np.log(0.5), np.float32), RAYS[middle.ravel()]
    aside = from_the_side(90.0, 0.3)
    away = replace(aside, jTi=aside.jTi.copy())
    away.jTi[:3, 3] = 0.0
    way = side_seen(theta, rays, [aside])
    assert way.mean() > 0.05
    np.testing.assert_array_equal(side_seen(theta, rays, [aside, away]), way)


def test_a_hull_that_no_view_ends_says_nothing() -> None:
    """The other camera sees nothing but what moves, or not the front of it."""
    assert (way_to_the_front(90.0, radius=5.0) == 0.0).all()


def test_a_side_that_nobody_sees_moves_nothing() -> None:
    theta = np.full(1, np.log(0.5), np.float32)
    assert (side_seen(theta, RAYS[:1], []) == 0.0).all()
    assert (side_seen(theta, RAYS[:1], [beside(textured(), 400)]) == 0.0).all()
