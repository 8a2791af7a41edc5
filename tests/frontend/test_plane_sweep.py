"""Plane sweep on a rendered room whose depth is known: a slanted wall and a board in front of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import pixel_raster
from mvdyn_gtsam.frontend.plane_sweep import (
    SweepConfig,
    SweepView,
    compared_levels,
    ladder_of,
    lowest,
    patch_likeness,
    semi_global,
    sweep,
    sweep_instant,
)
from mvdyn_gtsam.geometry import invert_pose, pixel_rays, project, transform_points
from tests.frontend.textures import to_image, values

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

SHAPE = (72, 96)
INTRINSICS = np.array([[80.0, 0.0, 47.5], [0.0, 80.0, 35.5], [0.0, 0.0, 1.0]])
LADDER = np.linspace(1.0 / 8.0, 1.0 / 1.5, 48, dtype=np.float32)
STEP = float(LADDER[1] - LADDER[0])
BOARD_DEPTH = 2.0
NOTHING_KNOWN = (np.full(SHAPE, 1.0, np.float32), np.zeros(SHAPE, np.float32))
CONFIG = SweepConfig()


def pose(x: float, y: float = 0.0, z: float = 0.0, turn_deg: float = 0.0) -> Array:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    wTc[:3, 3] = [x, y, z]
    return wTc


def render(wTc: Array, moved: float = 0.0) -> tuple[npt.NDArray[np.uint8], Array, npt.NDArray[np.bool_]]:
    """Image, true inverse depth and where the board is, when it has moved along x."""
    rays = pixel_rays(pixel_raster(SHAPE).reshape(-1, 2).astype(np.float64), INTRINSICS) @ wTc[:3, :3].T
    # the wall: z = 4 + 0.3 x
    wall = (4.0 + 0.3 * wTc[0, 3] - wTc[2, 3]) / (rays[:, 2] - 0.3 * rays[:, 0])
    board = (BOARD_DEPTH - wTc[2, 3]) / rays[:, 2]
    on_wall, on_board = (wTc[:3, 3] + rays * length[:, None] for length in (wall, board))
    x, y = on_board[:, 0] - moved, on_board[:, 1]
    hit = (np.abs(x) < 0.4) & (np.abs(y) < 0.35)
    grey = np.where(hit, values(40.0 * x, 40.0 * y, 5), values(20.0 * on_wall[:, 0], 20.0 * on_wall[:, 1], 6))
    inverse_depth = 1.0 / np.where(hit, board, wall)
    return to_image(grey).reshape(SHAPE), inverse_depth.reshape(SHAPE), hit.reshape(SHAPE)


def seen(wTc: Array, same_instant: bool = True, moved: float = 0.0) -> SweepView:
    """What another camera sees of it; the image swept is that of the camera at the origin."""
    return SweepView(render(wTc, moved)[0], INTRINSICS, invert_pose(wTc), same_instant)


def swept(views: list[SweepView], config: SweepConfig = CONFIG) -> Float32:
    return sweep(render(pose(0.0))[0], INTRINSICS, views, LADDER, *NOTHING_KNOWN, config)


def swept_alone(views: list[SweepView]) -> Float32:
    return sweep_instant(render(pose(0.0))[0], INTRINSICS, views, LADDER, CONFIG)


def inner(mask: npt.NDArray[np.bool_], margin: int = 3) -> npt.NDArray[np.bool_]:
    """Pixels all of whose surroundings are in ``mask``."""
    height, width = mask.shape
    result = np.zeros_like(mask)
    for row in range(margin, height - margin):
        for col in range(margin, width - margin):
            around = mask[row - margin : row + margin + 1, col - margin : col + margin + 1]
            result[row, col] = around.all()
    return result


TRUTH, BOARD = render(pose(0.0))[1:]
INTERIOR = inner(BOARD) | inner(~BOARD)
# at the image's borders some views see nothing of a point and patches reach outside
INTERIOR[:8] = INTERIOR[-8:] = False
INTERIOR[:, :8] = INTERIOR[:, -8:] = False
AROUND = [pose(0.3), pose(-0.25, 0.1), pose(0.05, -0.3, 0.1, -2.0), pose(-0.1, 0.2, 0.2, 3.0)]


def wrong_share(inverse_depth: npt.NDArray[np.floating], where: npt.NDArray[np.bool_]) -> float:
    """Share of the pixels farther than a level from the truth."""
    return float((np.abs(inverse_depth - TRUTH)[where] > STEP).mean())


def test_the_depth_of_a_still_scene_is_found_to_a_level() -> None:
    views = [seen(wTc, same_instant=k < 2) for k, wTc in enumerate(AROUND)]
    found = swept(views)
    assert wrong_share(found, INTERIOR) < 0.01
    assert wrong_share(swept_alone(views[:2]), INTERIOR) < 0.03
    # between the levels, not at them
    assert np.median(np.abs(found - TRUTH)[INTERIOR]) < 0.15 * STEP


def test_what_moves_gets_its_depth_from_the_views_of_its_instant() -> None:
    """The board moves 0.4 of the way the camera does: to it alone the board is 1 / 0.3 away."""
    temporal = [seen(pose(x), same_instant=False, moved=0.4 * x) for x in (-0.3, -0.15, 0.15, 0.3)]
    instant = [seen(pose(0.05, 0.3)), seen(pose(0.1, -0.3))]
    found = swept([*temporal, *instant])
    on_board = inner(BOARD)
    assert wrong_share(swept_alone(instant), on_board) < 0.02
    assert np.median(found[on_board]) == pytest.approx(0.3, abs=STEP)
    assert wrong_share(found, inner(~BOARD)) < 0.05


def test_views_of_other_times_alone_tell_a_still_scene() -> None:
    assert wrong_share(swept([seen(wTc, same_instant=False) for wTc in AROUND]), INTERIOR) < 0.01


def test_a_part_of_an_image_is_swept_like_the_whole() -> None:
    rows, columns = slice(10, 60), slice(20, 80)
    intrinsics = INTRINSICS.copy()
    intrinsics[:2, 2] -= 20, 10
    grey = np.ascontiguousarray(render(pose(0.0))[0][rows, columns])
    views = [seen(wTc) for wTc in AROUND[:2]]
    part = sweep_instant(grey, intrinsics, views, LADDER, CONFIG)
    whole = swept_alone(views)[rows, columns]
    assert (np.abs(part - whole)[4:-4, 4:-4] < 0.2 * STEP).mean() > 0.95


def test_a_view_that_sees_nothing_changes_nothing() -> None:
    away = seen(pose(0.0, turn_deg=180.0))
    grey = render(pose(0.0))[0]
    likeness = patch_likeness(grey, INTRINSICS, away, LADDER, CONFIG)
    np.testing.assert_array_equal(likeness, np.float32(CONFIG.unseen))
    views = [seen(wTc) for wTc in AROUND[:2]]
    before, after = swept(views), swept([*views, away])
    np.testing.assert_allclose(after, before, atol=0.05 * STEP)


def test_what_would_be_behind_a_view_is_unseen_by_it() -> None:
    """From 3 before the camera what is nearer than that is behind."""
    grey = render(pose(0.0))[0]
    likeness = patch_likeness(grey, INTRINSICS, seen(pose(0.0, z=3.0)), LADDER, CONFIG)
    np.testing.assert_array_equal(likeness[LADDER > 1.0 / 3.0], np.float32(CONFIG.unseen))
    assert (likeness[LADDER < 0.2] != np.float32(CONFIG.unseen)).any()


def test_a_view_that_sees_a_part_does_not_hurt_the_rest() -> None:
    """Turned aside by 40 degrees, it sees a third of the image at most, and at some depths only."""
    views = [seen(wTc) for wTc in AROUND[:2]]
    aside = seen(pose(0.4, turn_deg=40.0))
    before, after = swept(views), swept([*views, aside])
    assert wrong_share(after, INTERIOR) < wrong_share(before, INTERIOR) + 0.02


def test_likeness_is_highest_at_the_truth_and_bounded() -> None:
    likeness = patch_likeness(render(pose(0.0))[0], INTRINSICS, seen(pose(0.2)), LADDER, CONFIG)
    assert likeness.min() >= 0.0 and likeness.max() <= 1.0 + 1e-4
    level = np.abs(LADDER[:, None, None] - TRUTH).argmin(axis=0)
    there = np.take_along_axis(likeness, level[None], axis=0)[0][inner(BOARD)]
    assert np.median(there) > 0.95 > 0.7 > np.median(likeness[:, inner(BOARD)])


def test_the_known_depth_decides_where_the_image_is_plain() -> None:
    plain = np.full(SHAPE, 120, np.uint8)
    known = np.full(SHAPE, 0.4, np.float32)
    view = SweepView(plain, INTRINSICS, invert_pose(pose(0.02)), True)
    found = sweep(plain, INTRINSICS, [view], LADDER, known, np.ones(SHAPE, np.float32), CONFIG)
    inside = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(found[inside], 0.4, atol=STEP)


def test_the_known_depth_without_confidence_says_nothing() -> None:
    views = [seen(wTc) for wTc in AROUND]
    grey, nothing = render(pose(0.0))[0], np.zeros(SHAPE, np.float32)
    found = [
        sweep(grey, INTRINSICS, views, LADDER, np.full(SHAPE, rho, np.float32), nothing, CONFIG)
        for rho in (0.15, 0.6)
    ]
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.parametrize(
    "ladder", [[0.1, 0.2], [0.0, 0.1, 0.2], [-0.1, 0.1, 0.3], [0.1, 0.3, 0.2], [0.1, 0.1, 0.2]]
)
def test_a_ladder_must_ascend_from_above_zero(ladder: list[float]) -> None:
    with pytest.raises(ValueError, match="positive and ascending"):
        sweep(np.zeros(SHAPE, np.uint8), INTRINSICS, [], np.array(ladder, np.float32), *NOTHING_KNOWN, CONFIG)


def slow_semi_global(cost: Array, grey: npt.NDArray[np.uint8], config: SweepConfig) -> Array:
    """The four directions of the paper, pixel by pixel."""
    height, width, levels = cost.shape
    total = np.zeros(cost.shape)
    for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros(cost.shape)
        for row in range(height)[:: dy or 1]:
            for col in range(width)[:: dx or 1]:
                y, x = row - dy, col - dx
                if not (0 <= y < height and 0 <= x < width):
                    path[row, col] = cost[row, col]
                    continue
                contrast = abs(float(grey[row, col]) - float(grey[y, x]))
                flat = np.exp(-contrast / config.edge_contrast)
                jump = config.small_step + (config.large_step - config.small_step) * flat
                before = path[y, x]
                for level in range(levels):
                    ways = [before[level], before.min() + jump]
                    if level > 0:
                        ways.append(before[level - 1] + config.small_step)
                    if level < levels - 1:
                        ways.append(before[level + 1] + config.small_step)
                    path[row, col, level] = cost[row, col, level] + min(ways) - before.min()
        total += path
    return total


@pytest.mark.parametrize("seed", range(3))
def test_aggregation_against_a_slow_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(-3.0, 3.0, (5, 7, 6)).astype(np.float32)
    grey = rng.integers(0, 60, (5, 7)).astype(np.uint8)
    found = semi_global(cost, grey, CONFIG)
    np.testing.assert_allclose(found, slow_semi_global(cost.astype(np.float64), grey, CONFIG), atol=1e-4)


def test_aggregation_carries_depth_over_plain_image_and_not_over_edges() -> None:
    """Ten pixels of a row; only the first says something."""
    cost = np.zeros((1, 10, 8), np.float32)
    cost[0, 0, 5] = -3.0
    flat, edge = np.full((1, 10), 100, np.uint8), np.full((1, 10), 100, np.uint8)
    edge[0, 4:] = 220
    level = semi_global(cost, flat, CONFIG).argmin(axis=2)
    assert (level == 5).all()
    beyond = semi_global(cost, edge, CONFIG)[0, 4:]
    assert np.ptp(beyond, axis=1).max() < 2.0 * CONFIG.small_step
    # 5 levels away at a small step each
    assert np.ptp(semi_global(cost, flat, CONFIG)[0, 4:], axis=1).min() >= 5.0 * CONFIG.small_step


@given(st.floats(0.6, 7.4), st.floats(0.1, 50.0), st.floats(-10.0, 10.0))
def test_the_lowest_of_a_parabola_is_exact(place: float, curvature: float, height: float) -> None:
    levels = np.arange(9)
    cost = (curvature * (levels - place) ** 2 + height).astype(np.float32)
    level, fraction = lowest(cost[None, None])
    assert level[0, 0] + fraction[0, 0] == pytest.approx(place, abs=2e-3)
    assert abs(fraction[0, 0]) <= 0.5


def test_the_lowest_at_an_end_is_that_level() -> None:
    rising = np.arange(5, dtype=np.float32)
    level, fraction = lowest(np.stack([rising, -rising])[None])
    assert level.tolist() == [[0, 4]] and fraction.tolist() == [[0.0, 0.0]]


def test_the_ladder_covers_what_is_known_and_more() -> None:
    known = np.random.default_rng(0).uniform(0.2, 1.0, 5000)
    # tracked points at a wrong infinity must not stretch it
    known[:20] = 1e-6
    ladder = ladder_of(known, 64)
    assert len(ladder) == 64 and ladder.dtype == np.float32
    assert 0.05 < ladder[0] < 0.15 and 1.4 < ladder[-1] < 2.0
    np.testing.assert_allclose(np.diff(ladder), np.diff(ladder)[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("scale", 0.0),
        ("scale", 1.5),
        ("levels", 2),
        ("window", 4),
        ("window", 1),
        ("temporal_offsets", (0, 8)),
        ("least_shared", 1.5),
        ("noise", 0.0),
        ("prior_tolerance", 0.0),
        ("edge_contrast", 0.0),
    ],
)
def test_values_out_of_range_are_named(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"refinement.sweep.{key} "):
        replace(CONFIG, **{key: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("baseline", [0.01, 0.03])
def test_a_view_near_by_is_compared_at_fewer_levels_and_says_the_same(baseline: float) -> None:
    grey, near = render(pose(0.0))[0], seen(pose(baseline))
    levels = compared_levels(grey.shape, INTRINSICS, near, LADDER, CONFIG.step_px)
    assert levels[0] == 0 and levels[-1] == len(LADDER) - 1
    assert len(levels) < 0.6 * len(LADDER)
    plain = patch_likeness(grey, INTRINSICS, near, LADDER, replace(CONFIG, step_px=1e-9))
    found = patch_likeness(grey, INTRINSICS, near, LADDER, CONFIG)
    np.testing.assert_array_equal(found[levels], plain[levels])
    both = (found != np.float32(CONFIG.unseen)) & (plain != np.float32(CONFIG.unseen))
    np.testing.assert_allclose(found[:, :, 4:-4], plain[:, :, 4:-4], atol=0.05)
    assert np.abs(found - plain)[both].mean() < 0.003


def test_no_pixel_moves_farther_between_the_levels_compared() -> None:
    wTc = pose(0.1, turn_deg=3.0, z=-0.2)
    levels = compared_levels(TRUTH.shape, INTRINSICS, seen(wTc), LADDER, 1.0)
    rays = pixel_rays(np.array([[0.0, 0.0], [20.0, 30.0], [40.0, 11.0]]), INTRINSICS)
    seen_at = [
        project(transform_points(invert_pose(wTc), rays / rho), INTRINSICS)[0] for rho in LADDER[levels]
    ]
    assert np.linalg.norm(np.diff(seen_at, axis=0), axis=2).max() < 1.05
    every = compared_levels(TRUTH.shape, INTRINSICS, seen(pose(0.0, turn_deg=180.0)), LADDER, 1.0)
    np.testing.assert_array_equal(every, np.arange(len(LADDER)))
