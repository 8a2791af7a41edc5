"""Regions where flow fails: what looks alike at other times stands still, what moved away does not."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.refinement.medians import known_median
from mvdyn_gtsam.refinement.other_times import (
    AROUND,
    LIKELIER,
    PATCH,
    TEXTURE,
    StaticRegions,
    better_swept,
    likelier_around,
    likenesses,
    plain_inside,
    static_regions,
    unlike_regions,
)
from mvdyn_gtsam.refinement.patches import Picture, contrast
from mvdyn_gtsam.refinement.settings import RefinementConfig
from tests.refinement.test_patches import SHAPE, VIEW, WALL, at, wall_and_side

ALIKE = 0.7


def labels() -> np.ndarray:
    """Two regions of the size of a thing."""
    found = np.zeros(SHAPE, np.int32)
    found[15:45, 15:35] = 1
    found[15:45, 50:70] = 2
    return found


def moved(grey: np.ndarray, label: int) -> np.ndarray:
    """The image with another thing in one region."""
    image = grey.copy()
    region = labels() == label
    image[region] = np.random.default_rng(5).permutation(image[region])
    return image


def likeness_at(grey: np.ndarray, depth: float, others: list[Picture]) -> np.ndarray:
    return known_median(likenesses(grey, at(depth).reshape(SHAPE), VIEW.rays, others))


def found_in(grey: np.ndarray, depth: float, others: list[Picture]) -> StaticRegions:
    alike = likeness_at(grey, depth, others)
    return static_regions(labels(), alike, contrast(grey, PATCH) > TEXTURE, ALIKE)


def test_of_two_regions_the_one_that_looks_alike_at_other_times_stands_still() -> None:
    grey, side = wall_and_side()
    found = found_in(moved(grey, 2), WALL, [side, side])
    assert (found.still == (labels() == 1)).all() and (found.matched == found.still).all()


def test_at_a_wrong_depth_nothing_is_alike() -> None:
    grey, side = wall_and_side()
    assert not found_in(grey, 2.0 * WALL, [side]).still.any()


def test_most_views_decide() -> None:
    grey, side = wall_and_side()
    other = Picture(np.roll(side.grey, 23, axis=0), side.intrinsics, side.jTi)
    assert found_in(grey, WALL, [side, side, other]).still.any()
    assert not found_in(grey, WALL, [side, other, other]).still.any()


def test_a_bare_region_is_no_evidence_of_motion_nor_of_depth() -> None:
    grey, side = wall_and_side()
    grey[:, :45] = 90.0
    found = found_in(grey, 2.0 * WALL, [side])
    assert (found.still == (labels() == 1)).all() and not found.matched.any()


def test_what_no_other_time_sees_is_left_open() -> None:
    grey, side = wall_and_side()
    assert not found_in(grey, WALL, []).still.any()
    away = side.jTi.copy()
    away[0, 3] = 100.0
    assert not found_in(grey, WALL, [Picture(side.grey, side.intrinsics, away)]).still.any()


def test_what_is_alike_at_no_depth_moves_unless_flow_explains_it() -> None:
    grey, side = wall_and_side()
    image = moved(grey, 2)
    alike = likeness_at(image, WALL, [side])
    assert np.isfinite(alike[30, 40]) and np.isnan(alike[30, 0])
    # patches of single pixels of noise are alike by chance here and there
    config = RefinementConfig(unlike_likeness=0.5)
    found = unlike_regions(alike, np.ones(SHAPE, bool), config)
    inner = np.zeros(SHAPE, bool)
    inner[18:42, 53:67] = True
    assert found[inner].mean() > 0.9 and not found[:, :45].any()
    explained = ~(labels() == 2)
    assert not unlike_regions(alike, explained, config)[inner].any()
    assert not unlike_regions(np.full(SHAPE, np.nan, np.float32), np.ones(SHAPE, bool), config).any()


def test_the_swept_depth_is_taken_where_it_looks_clearly_better_and_only_there() -> None:
    grey, side = wall_and_side()
    config, everywhere = RefinementConfig(), np.ones(SHAPE, bool)
    right, wrong = (likeness_at(grey, depth, [side]) for depth in (WALL, 2.0 * WALL))
    seen = np.isfinite(right) & np.isfinite(wrong)
    assert better_swept(right, wrong, everywhere, config)[seen].mean() > 0.8
    for none in (
        better_swept(wrong, right, everywhere, config),
        better_swept(right, right, everywhere, config),
        better_swept(right, wrong, ~everywhere, config),
        better_swept(np.full_like(right, np.nan), right, everywhere, config),
    ):
        assert not none.any()


def test_plain_pixels_judge_together_what_each_alone_cannot() -> None:
    noise = np.random.default_rng(0).standard_normal((2, *SHAPE)).astype(np.float32)
    left = np.zeros(SHAPE, bool)
    left[:, :45] = True
    # of a single pixel the noise is five times the difference
    gain = (np.where(left, 2.0, 0.0) * LIKELIER + 10.0 * LIKELIER * noise).astype(np.float32)
    found = likelier_around(gain, np.ones(SHAPE, bool))
    inner = slice(AROUND // 2, -AROUND // 2)
    assert found[inner, : 45 - AROUND].mean() > 0.7 and found[inner, 45 + AROUND :].mean() < 0.3
    assert not likelier_around(gain, ~left)[left].any()
    assert not likelier_around(np.full_like(gain, np.nan), np.ones(SHAPE, bool)).any()


def test_a_plain_region_follows_most_of_its_rim() -> None:
    better, worse = (np.zeros(SHAPE, bool) for _ in range(2))
    better[13:15, 15:35] = True
    worse[45:47, 15:25] = True
    # what lies far from a region's outline has no say in it
    better[5:55, 0:5] = True
    worse[13:15, 50:70] = True
    assert (plain_inside(labels(), better, worse) == (labels() == 1)).all()
    none = np.zeros(SHAPE, bool)
    assert not plain_inside(labels(), none, none).any()
