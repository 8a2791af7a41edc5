"""The outline of what moves, against an image whose background is known."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.outline import OtherTime, background, grown, outlined
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView

CONFIG = RefinementConfig()
SHAPE = (40, 60)
VIEW = DenseView.of(Camera("cam0", 60, 40, 50.0, 50.0, 29.5, 19.5), 1.0)
INTRINSICS, RAYS = VIEW.intrinsics, VIEW.rays
WALL = (100.0 + 3.0 * np.arange(60, dtype=np.float32) + np.zeros((40, 1), np.float32)).astype(np.float32)
"""A wall 2 m away, brighter to the right; it is plain along a column."""


def other(shift_px: float, moves: np.ndarray | None = None) -> OtherTime:
    """The wall, seen after the camera moved to the right by ``shift_px`` of the wall's image."""
    jTi = np.eye(4)
    jTi[0, 3] = -shift_px * 2.0 / 50.0
    nothing = np.zeros(SHAPE, np.uint8)
    return OtherTime(WALL + np.float32(3.0 * shift_px), nothing if moves is None else moves, jTi)


def half(depth: float = 2.0) -> np.ndarray:
    return np.full(2400, 1.0 / depth, np.float32)


def test_background_is_what_other_times_see_there() -> None:
    seen = background(half(), RAYS, INTRINSICS, [other(4.0), other(-4.0)]).reshape(SHAPE)
    np.testing.assert_allclose(seen[:, 1:-1], WALL[:, 1:-1], atol=1e-2)
    # only one of the two sees the outermost columns, which is enough
    alone = background(half(), RAYS, INTRINSICS, [other(4.0)]).reshape(SHAPE)
    assert np.isnan(alone).any() and np.isfinite(seen).mean() > np.isfinite(alone).mean()


def test_background_of_a_large_image_whole() -> None:
    # an image of a phone: more pixels than OpenCV takes side by side
    camera = Camera("cam0", 400, 300, 300.0, 300.0, 199.5, 149.5)
    view, grey = (
        DenseView.of(camera, 1.0),
        np.add.outer(np.arange(300.0), np.arange(400.0)).astype(np.float32),
    )
    still = OtherTime(grey, np.zeros((300, 400), np.uint8), np.eye(4))
    seen = background(np.ones(120_000, np.float32), view.rays, view.intrinsics, [still])
    np.testing.assert_allclose(seen.reshape(300, 400)[1:-1, 1:-1], grey[1:-1, 1:-1], atol=0.1)


def test_background_at_the_wrong_depth_is_something_else() -> None:
    seen = background(half(1.0), RAYS, INTRINSICS, [other(4.0), other(4.0)]).reshape(SHAPE)
    assert np.nanmin(np.abs(seen[:, 12:-12] - WALL[:, 12:-12])) > 5.0


def test_what_moves_at_other_times_is_no_background() -> None:
    moves = np.zeros(SHAPE, np.uint8)
    moves[10:30, 20:40] = 1
    seen = background(half(), RAYS, INTRINSICS, [other(0.0, moves), other(0.0, moves)]).reshape(SHAPE)
    assert np.isnan(seen[12:28, 22:38]).all()
    assert np.isfinite(seen[:8]).all()


def test_outline_is_where_the_image_differs() -> None:
    true = np.zeros(SHAPE, bool)
    true[10:30, 20:35] = True
    grey = np.where(true, WALL - np.float32(40.0), WALL)
    fat = grown(true, CONFIG.moving_reach)
    around = grown(fat, CONFIG.moving_reach)
    found = outlined(fat, around, grey, WALL, CONFIG)
    # at most a pixel of blur all around
    assert np.count_nonzero(found ^ true) < 74
    assert np.count_nonzero(fat ^ true) > 3 * np.count_nonzero(found ^ true)


def test_unknown_background_leaves_the_mask() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[10:30, 20:35] = True
    unknown = np.full(SHAPE, np.nan, np.float32)
    found = outlined(mask, grown(mask, CONFIG.moving_reach), WALL, unknown, CONFIG)
    assert np.count_nonzero(found ^ mask) < 0.05 * np.count_nonzero(mask)


def test_grown_reaches_as_far_as_the_setting() -> None:
    mask = np.zeros((41, 100), bool)
    mask[20, 50] = True
    assert np.count_nonzero(grown(mask, CONFIG.moving_reach)) == (2 * 6 + 1) ** 2


def test_a_gap_that_looks_like_the_background_is_closed_where_it_moves() -> None:
    shape = (80, 256)
    thing = np.zeros(shape, bool)
    thing[20:60, 100:160] = True
    wall = np.full(shape, 100.0, np.float32)
    grey = np.where(thing, 40.0, wall).astype(np.float32)
    grey[30:50, 124:136] = 100.0
    around = grown(thing, CONFIG.moving_reach)
    assert outlined(thing, around, grey, wall, CONFIG)[32:48, 126:134].all()
    beside = thing.copy()
    beside[25:55, 119:141] = False
    assert not outlined(beside, around, grey, wall, CONFIG)[34:46, 128:132].any()
