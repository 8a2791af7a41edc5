"""The outline of what moves, against an image whose background is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.moving.outline import OtherTime, background, depth_behind, grown, outlined
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView

CONFIG = RefinementConfig()
SHAPE = (40, 60)
VIEW = DenseView.of(Camera("cam0", 60, 40, 50.0, 50.0, 29.5, 19.5), 1.0)
INTRINSICS, RAYS = VIEW.intrinsics, VIEW.rays
WALL = (100.0 + 3.0 * np.arange(60, dtype=np.float32) + np.zeros((40, 1), np.float32)).astype(np.float32)
"""A wall 2 m away, brighter to the right; it is plain along a column."""


def coloured(grey: np.ndarray) -> np.ndarray:
    """``(h, w, 3)`` of a grey image."""
    return np.dstack([grey, *np.full((2, *grey.shape), 128.0)]).astype(np.float32)


def other(shift_px: float, moves: np.ndarray | None = None) -> OtherTime:
    """The wall, seen after the camera moved to the right by ``shift_px`` of the wall's image."""
    jTi = np.eye(4)
    jTi[0, 3] = -shift_px * 2.0 / 50.0
    nothing = np.zeros(SHAPE, np.uint8)
    grey, moves = WALL + np.float32(3.0 * shift_px), nothing if moves is None else moves
    return OtherTime(
        coloured(grey), moves, jTi, np.full(SHAPE, -np.log(2.0), np.float32), np.ones(SHAPE, bool)
    )


def half(depth: float = 2.0) -> np.ndarray:
    return np.full(2400, 1.0 / depth, np.float32)


def test_background_is_what_other_times_see_there() -> None:
    seen = background(half(), RAYS, INTRINSICS, [other(4.0), other(-4.0)]).reshape(*SHAPE, 3)
    np.testing.assert_allclose(seen[:, 1:-1], coloured(WALL)[:, 1:-1], atol=1e-2)
    # only one of the two sees the outermost columns, which is enough
    alone = background(half(), RAYS, INTRINSICS, [other(4.0)])
    assert np.isnan(alone).any() and np.isfinite(seen).mean() > np.isfinite(alone).mean()


def test_background_of_a_large_image_whole() -> None:
    # an image of a phone: more pixels than OpenCV takes side by side
    camera = Camera("cam0", 400, 300, 300.0, 300.0, 199.5, 149.5)
    view, grey = (
        DenseView.of(camera, 1.0),
        np.add.outer(np.arange(300.0), np.arange(400.0)).astype(np.float32),
    )
    nothing = np.zeros((300, 400), np.uint8)
    still = OtherTime(coloured(grey), nothing, np.eye(4), np.zeros_like(grey), np.ones(grey.shape, bool))
    seen = background(np.ones(120_000, np.float32), view.rays, view.intrinsics, [still])
    np.testing.assert_allclose(seen[:, 0].reshape(300, 400)[1:-1, 1:-1], grey[1:-1, 1:-1], atol=0.1)


def test_background_at_the_wrong_depth_is_something_else() -> None:
    seen = background(half(1.0), RAYS, INTRINSICS, [other(4.0), other(4.0)])[:, 0].reshape(SHAPE)
    assert np.nanmin(np.abs(seen[:, 12:-12] - WALL[:, 12:-12])) > 5.0


def test_what_moves_at_other_times_is_no_background() -> None:
    moves = np.zeros(SHAPE, np.uint8)
    moves[10:30, 20:40] = 1
    seen = background(half(), RAYS, INTRINSICS, [other(0.0, moves), other(0.0, moves)]).reshape(*SHAPE, 3)
    assert np.isnan(seen[12:28, 22:38]).all()
    assert np.isfinite(seen[:8]).all()


def test_other_times_know_the_depth_behind() -> None:
    # from 1 m nearer the wall is 1 m away; what moves there, or is not settled, says nothing
    nearer, moves = np.eye(4), np.zeros(SHAPE, np.uint8)
    nearer[2, 3], moves[:, :30] = -1.0, 1
    theta, settled = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, bool)
    settled[:, 10:50] = True
    around = np.zeros(SHAPE, bool)
    around[5:-5, :] = True
    one = OtherTime(coloured(WALL), moves, nearer, theta, settled)
    found = depth_behind(around, RAYS, INTRINSICS, [one])
    known = np.isfinite(found)
    np.testing.assert_allclose(found[known], -np.log(2.0), atol=1e-5)
    assert known[around].any() and not known[~around].any()
    # half as large: columns 30 to 49 of it are those from the middle to 39.3 of this one
    columns = np.flatnonzero(known.any(axis=0))
    assert columns[0] == 30 and columns[-1] == 39
    assert not np.isfinite(depth_behind(around, RAYS, INTRINSICS, [])).any()


def test_the_nearest_of_what_one_time_sees_there_is_kept() -> None:
    # a box 1 m away before the left of the wall moves twice as far over the image as the wall does
    theta = np.full(SHAPE, -np.log(2.0), np.float32)
    theta[:, :20] = 0.0
    everywhere = np.ones(SHAPE, bool)
    view = replace(other(-20.0), theta=theta)
    found = depth_behind(everywhere, RAYS, INTRINSICS, [view])
    # to the left, out of the image; to the right, over the wall
    assert not (np.abs(found) < 0.1).any()
    found = depth_behind(everywhere, RAYS, INTRINSICS, [replace(other(20.0), theta=theta)])
    np.testing.assert_allclose(found[:, 41:59], 0.0, atol=1e-5)
    # of several times the median counts, which no single error moves
    wrong = replace(other(0.0), theta=np.full(SHAPE, 1.0, np.float32))
    found = depth_behind(everywhere, RAYS, INTRINSICS, [other(0.0), wrong, other(0.0)])
    np.testing.assert_allclose(found, -np.log(2.0), atol=1e-5)


def test_outline_is_where_the_image_differs() -> None:
    true = np.zeros(SHAPE, bool)
    true[10:30, 20:35] = True
    grey = np.where(true, WALL - np.float32(40.0), WALL)
    fat = grown(true, CONFIG.moving_reach)
    around = grown(fat, CONFIG.moving_reach)
    found = outlined(fat, around, coloured(grey), coloured(WALL), CONFIG)
    # at most a pixel of blur all around
    assert np.count_nonzero(found ^ true) < 74
    assert np.count_nonzero(fat ^ true) > 3 * np.count_nonzero(found ^ true)


def test_outline_of_what_differs_in_colour_alone() -> None:
    true = np.zeros(SHAPE, bool)
    true[10:30, 20:35] = True
    colour = coloured(WALL)
    colour[true, 1] += 30.0
    fat = grown(true, CONFIG.moving_reach)
    found = outlined(fat, grown(fat, CONFIG.moving_reach), colour, coloured(WALL), CONFIG)
    assert np.count_nonzero(found ^ true) < 74


def test_unknown_background_leaves_the_mask() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[10:30, 20:35] = True
    unknown = np.full((*SHAPE, 3), np.nan, np.float32)
    found = outlined(mask, grown(mask, CONFIG.moving_reach), coloured(WALL), unknown, CONFIG)
    # no edge of the image holds it: corners are rounded, and it grows by a pixel at most
    assert found[13:27, 23:32].all() and not (found & ~grown(mask, 1.0 / mask.shape[1])).any()


def test_grown_reaches_as_far_as_the_setting() -> None:
    mask = np.zeros((41, 100), bool)
    mask[20, 50] = True
    assert np.count_nonzero(grown(mask, CONFIG.moving_reach)) == (2 * 6 + 1) ** 2


def test_a_gap_is_closed_where_the_image_has_no_outline_of_it() -> None:
    shape = (80, 256)
    thing = np.zeros(shape, bool)
    thing[20:60, 100:160] = True
    grey = np.where(thing, 40.0, 100.0).astype(np.float32)
    around = grown(thing, CONFIG.moving_reach)
    # what stands behind its middle is as dark as itself
    dark = np.full(shape, 100.0, np.float32)
    dark[36:44, 126:134] = 40.0
    assert outlined(thing, around, coloured(grey), coloured(dark), CONFIG)[34:46, 124:136].all()
    # through a gap, the wall
    wall, through = np.full(shape, 100.0, np.float32), grey.copy()
    through[30:50, 124:136] = 100.0
    found = outlined(thing, around, coloured(through), coloured(wall), CONFIG)
    assert not found[32:48, 126:134].any() and found[32:48, 104:120].all()


def test_an_outline_lies_where_half_a_pixel_is_hidden_however_strong_the_contrast() -> None:
    true = np.zeros(SHAPE, bool)
    true[10:30, 20:35] = True
    fat = grown(true, CONFIG.moving_reach)
    for contrast in (30.0, 60.0, 90.0):
        # pixels beside it are hidden by a seventh, which at the stronger contrast is above the limit
        share = np.where(grown(true, 1.0 / true.shape[1]), 0.15, 0.0)
        share[true] = 1.0
        grey = (WALL - contrast * share).astype(np.float32)
        found = outlined(fat, grown(fat, CONFIG.moving_reach), coloured(grey), coloured(WALL), CONFIG)
        assert np.count_nonzero(found & ~true) <= 4 and np.count_nonzero(true & ~found) <= 8
