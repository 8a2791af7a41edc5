"""Depth of moving regions: what the frames before and after make of it."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.refinement.moving.over_time import (
    FADING_STEPS,
    FARTHEST,
    Link,
    link,
    smooth_over_time,
    standing_still,
    strongest_around,
)
from mvdyn_gtsam.refinement.moving.region_depth import RegionDepth

SHAPE = (60, 80)


def test_regions_that_overlap_are_one_thing() -> None:
    before, now = np.zeros(SHAPE, np.int32), np.zeros(SHAPE, np.int32)
    before[10:20, 10:20], before[40:50, 10:20] = 1, 2
    now[10:20, 14:24], now[40:50, 19:40] = 2, 1
    assert link(before, now) == [(1, 2, True)]
    assert link(before, np.zeros(SHAPE, np.int32)) == []


def walk(count: int, wrong: dict[int, float], evidence: dict[int, float]) -> list[RegionDepth]:
    """A thing that walks away slowly, seen wrongly at some times."""
    return [RegionDepth((0, t), 1, wrong.get(t, -0.01 * t), evidence.get(t, 1.0)) for t in range(count)]


def chain(count: int) -> list[Link]:
    return [(t, t + 1, True) for t in range(count - 1)]


def test_a_wrong_instant_gives_way_to_those_around() -> None:
    regions = walk(20, {9: -1.2}, {})
    solved, belief = smooth_over_time(regions, chain(20))
    np.testing.assert_allclose(solved, -0.01 * np.arange(20), atol=0.03)
    assert (belief > 0.5).all()


def test_frames_without_evidence_take_it_from_the_nearest_with() -> None:
    unseen = {t: 0.0 for t in range(8)}
    regions = walk(20, {t: 1.0 for t in range(8)}, unseen)
    solved, belief = smooth_over_time(regions, chain(20))
    # it walks evenly, also before anybody saw it
    np.testing.assert_allclose(solved, -0.01 * np.arange(20), atol=0.02)
    assert (np.diff(belief[:8]) > 0.0).all()


def test_regions_that_meet_are_no_longer_one_thing() -> None:
    before, now = np.zeros(SHAPE, np.int32), np.zeros(SHAPE, np.int32)
    before[10:20, 10:20], before[10:20, 22:60] = 1, 2
    now[10:20, 10:60] = 1
    assert link(before, now) == [(1, 1, False), (2, 1, True)]


def test_depth_may_jump_where_things_part() -> None:
    """Ten frames of two people as one region, whose depth is that of the farther one; then each alone."""
    together = [RegionDepth((0, t), 1, -1.0, 0.8) for t in range(10)]
    near = [RegionDepth((0, t), 2, -0.4, 1.0) for t in range(10, 20)]
    links: list[Link] = [(t, t + 1, t != 9) for t in range(19)]
    solved, _ = smooth_over_time(together + near, links)
    np.testing.assert_allclose(solved, [-1.0] * 10 + [-0.4] * 10, atol=0.05)


def test_evidence_fades_with_the_frames_in_between() -> None:
    rng = np.random.default_rng(2)
    times = rng.integers(0, 200, 60).astype(np.float64)
    evidence = np.where(rng.random(60) < 0.5, rng.random(60), 0.0)
    plain = (evidence * np.exp(-np.abs(times - times[:, None]) / FADING_STEPS)).max(axis=1)
    np.testing.assert_allclose(strongest_around(evidence, times), plain)
    assert (strongest_around(np.zeros(5), np.arange(5.0)) == 0.0).all()


def test_even_motion_ends_where_the_scene_does() -> None:
    """Seen for ten frames only, it would be 9 times as far off after 100 more."""
    seen = {t: float(t < 10) for t in range(110)}
    regions = [RegionDepth((0, t), 1, -0.02 * t if t < 10 else 0.0, seen[t]) for t in range(110)]
    solved, _ = smooth_over_time(regions, chain(110))
    assert solved.min() >= -0.18 - FARTHEST - 0.05


def test_regions_apart_do_not_touch_each_other() -> None:
    regions = walk(3, {}, {}) + [RegionDepth((1, t), 1, 2.0, 0.0) for t in range(3)]
    solved, belief = smooth_over_time(regions, [(0, 1, True), (1, 2, True), (3, 4, True), (4, 5, True)])
    np.testing.assert_allclose(solved[3:], 2.0)
    assert (belief[3:] == 0.0).all()
    assert (belief[:3] > 0.5).all()


def test_a_single_region_keeps_its_depth() -> None:
    solved, belief = smooth_over_time([RegionDepth((0, 0), 1, -0.7, 0.5)], [])
    np.testing.assert_allclose(solved, [-0.7])
    np.testing.assert_allclose(belief, [0.5])


def still_regions(still: list[bool], start: int = 0) -> list[RegionDepth]:
    """One region in every frame."""
    return [RegionDepth((0, start + time), 1, 0.0, 0.0, 0.0, value) for time, value in enumerate(still)]


def test_a_thing_that_moves_before_and_after_does_not_stand_still_for_a_frame() -> None:
    still = [False] * 10 + [True, False, True] + [False] * 10
    assert not standing_still(still_regions(still), chain(23)).any()


def test_what_mostly_stands_still_does_where_it_is_seen_to() -> None:
    still = [True, True, False, True, True, False, True]
    assert standing_still(still_regions(still), chain(7)).tolist() == still
    # a thing that stops: both halves keep what is said of them
    stops = [False] * 12 + [True] * 12
    assert standing_still(still_regions(stops), chain(24)).tolist() == stops


def test_other_things_have_no_say_in_whether_one_stands_still() -> None:
    regions = still_regions([True]) + still_regions([False] * 4) + still_regions([True], 30)
    assert standing_still(regions, [(1, 2, True), (2, 3, True), (3, 4, True)]).tolist() == [True] + [
        False
    ] * 4 + [True]
    assert standing_still(regions[:1], []).tolist() == [True]
