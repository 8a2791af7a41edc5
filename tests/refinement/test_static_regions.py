"""Regions where flow fails: what looks alike at other times stands still, what moved away does not."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.refinement.patches import Picture
from mvdyn_gtsam.refinement.static_regions import static_regions
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


def test_of_two_regions_the_one_that_looks_alike_at_other_times_stands_still() -> None:
    grey, side = wall_and_side()
    depth = at(WALL).reshape(SHAPE)
    found = static_regions(labels(), moved(grey, 2), depth, VIEW.rays, [side, side], ALIKE)
    assert (found.still == (labels() == 1)).all() and (found.matched == found.still).all()
    assert found.seen[found.matched].mean() > 0.9 and not found.seen[~found.matched].any()


def test_at_a_wrong_depth_nothing_is_alike() -> None:
    grey, side = wall_and_side()
    found = static_regions(labels(), grey, at(2.0 * WALL).reshape(SHAPE), VIEW.rays, [side], ALIKE)
    assert not found.still.any()


def test_most_views_decide() -> None:
    grey, side = wall_and_side()
    other = Picture(side.grey[::-1].copy(), side.intrinsics, side.jTi)
    depth = at(WALL).reshape(SHAPE)
    assert static_regions(labels(), grey, depth, VIEW.rays, [side, side, other], ALIKE).still.any()
    assert not static_regions(labels(), grey, depth, VIEW.rays, [side, other, other], ALIKE).still.any()


def test_a_bare_region_is_no_evidence_of_motion_nor_of_depth() -> None:
    grey, side = wall_and_side()
    grey[:, :45] = 90.0
    found = static_regions(labels(), grey, at(2.0 * WALL).reshape(SHAPE), VIEW.rays, [side], ALIKE)
    assert (found.still == (labels() == 1)).all()
    assert not found.matched.any() and not found.seen.any()


def test_what_no_other_time_sees_is_left_open() -> None:
    grey, side = wall_and_side()
    depth = at(WALL).reshape(SHAPE)
    assert not static_regions(labels(), grey, depth, VIEW.rays, [], ALIKE).still.any()
    away = side.jTi.copy()
    away[0, 3] = 100.0
    elsewhere = [Picture(side.grey, side.intrinsics, away)]
    assert not static_regions(labels(), grey, depth, VIEW.rays, elsewhere, ALIKE).still.any()
