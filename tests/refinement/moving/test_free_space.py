"""What other views see through: a board that seems to stand before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.moving.free_space import DepthView, depth_beyond, sight, without_outlines
from mvdyn_gtsam.refinement.views import DenseView

SHAPE = (60, 80)
VIEW = DenseView.of(Camera("cam0", 80, 60, 70.0, 70.0, 39.5, 29.5), 1.0)
WALL, BOARD = 4.0, 2.0
SURE = np.ones(SHAPE, np.float32)
INNER = np.zeros(SHAPE, bool)
INNER[20:40, 30:50] = True


def seen(depth: float, x: float = 0.0, trust: np.ndarray = SURE) -> DepthView:
    """A view ``x`` m to the right that sees one depth everywhere."""
    jTi = np.eye(4)
    jTi[0, 3] = -x
    return DepthView(np.full(SHAPE, -np.log(depth), np.float32), trust, VIEW.intrinsics, jTi)


def through(depth: float, views: list[DepthView]) -> float:
    """Share of the inner points at ``depth`` that are seen through."""
    theta = np.full(int(INNER.sum()), -np.log(depth), np.float32)
    return float(sight(theta, VIEW.rays[INNER.ravel()], views).seen_through.mean())


def test_a_surface_that_two_views_see_stands_there() -> None:
    theta = np.full(len(VIEW.rays), -np.log(WALL), np.float32)
    assert sight(theta, VIEW.rays, [seen(WALL), seen(WALL)]).seen_there.all()
    assert not sight(theta, VIEW.rays, [seen(WALL)]).seen_there.any()
    assert not sight(
        theta, VIEW.rays, [seen(WALL), seen(WALL), seen(2 * WALL), seen(2 * WALL)]
    ).seen_there.any()
    # a thing before it hides it: that is no word against it, nor for it
    assert not sight(theta, VIEW.rays, [seen(BOARD), seen(BOARD)]).seen_there.any()


def test_what_two_views_see_the_wall_behind_is_not_there() -> None:
    assert through(BOARD, [seen(WALL, 0.1), seen(WALL, -0.1)]) == 1.0
    assert through(WALL, [seen(WALL, 0.1), seen(WALL, -0.1)]) == 0.0


def test_one_view_is_not_enough_and_twice_as_many_must_deny_as_agree() -> None:
    assert through(BOARD, [seen(WALL, 0.1)]) == 0.0
    denying, agreeing = [seen(WALL, 0.1), seen(WALL, -0.1)], [seen(BOARD, 0.05), seen(BOARD, 0.15)]
    assert through(BOARD, [*denying, agreeing[0]]) == 1.0
    assert through(BOARD, [*denying, *agreeing]) == 0.0


def test_views_that_see_something_nearer_or_are_unsure_say_nothing() -> None:
    assert through(BOARD, [seen(1.0, 0.1), seen(1.0, -0.1)]) == 0.0
    unsure = np.full(SHAPE, 0.3, np.float32)
    assert through(BOARD, [seen(WALL, 0.1, unsure), seen(WALL, -0.1, unsure)]) == 0.0


def test_a_view_that_looks_elsewhere_says_nothing() -> None:
    assert through(BOARD, [seen(WALL, 5.0), seen(WALL, -5.0)]) == 0.0
    behind = seen(WALL)
    behind.jTi[2, 3] = -3.0
    farther, _ = depth_beyond(np.full(4, -np.log(BOARD), np.float32), VIEW.rays[:4], behind)
    assert np.isnan(farther).all()


def test_the_depth_there_is_measured_from_the_view() -> None:
    """A view 1 m ahead sees the point at 2 m from 1 m, and the wall from 3 m."""
    ahead = seen(WALL - 1.0)
    ahead.jTi[2, 3] = -1.0
    farther, _ = depth_beyond(
        np.full(1, -np.log(BOARD), np.float32), np.array([[0.0, 0.0, 1.0]], np.float32), ahead
    )
    assert farther[0] == pytest.approx(np.log(3.0), abs=1e-5)


def test_outlines_are_left_out_and_things_are_not() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[10:12, 5:70] = mask[20:40, 60:62] = True
    mask[20:40, 20:40] = True
    kept = without_outlines(mask)
    assert not kept[:15].any() and not kept[:, 50:].any()
    assert kept[22:38, 22:38].all()
