"""Where things stand that no other camera sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvdyn_gtsam.refinement.moving.ground import Footing, footing
from mvdyn_gtsam.refinement.moving.over_time import (
    NEARER,
    Link,
    ground_at_border,
    on_the_ground,
    smooth_over_time,
)
from mvdyn_gtsam.refinement.moving.region_depth import RegionDepth


def floor_and_wall() -> np.ndarray:
    """Log inverse depth of a floor that comes nearer downwards from row 20, and a wall above."""
    rows = np.arange(48, dtype=np.float32)[:, None] + np.zeros((1, 64), np.float32)
    return np.log(0.2 + 0.02 * np.maximum(rows - 20.0, 0.0)).astype(np.float32)


def test_a_thing_stands_where_its_feet_are() -> None:
    theta, region = floor_and_wall(), np.zeros((48, 64), bool)
    region[10:36, 30:34] = True
    found = footing(theta, region, ~region)
    assert found is not None and found.feet_seen
    assert found.log_inverse_depth == pytest.approx(theta[36:38, 0].mean(), abs=0.03)


def test_a_thing_whose_feet_are_outside_hides_the_ground_at_the_border() -> None:
    """Behind it the floor is unknown, and a box stands by that must not count."""
    theta, region = floor_and_wall(), np.zeros((48, 64), bool)
    region[10:48, 30:34] = True
    ground = theta[46:48, 0].mean()
    theta[region] = theta[0, 0]
    box = np.zeros_like(region)
    box[30:48, 34:40] = True
    theta[box] += 1.0
    found = footing(theta, region, ~(region | box))
    assert found is not None and not found.feet_seen
    assert found.log_inverse_depth == pytest.approx(ground, abs=0.03)


def test_of_a_thing_that_fills_the_border_nothing_is_known() -> None:
    theta, region = floor_and_wall(), np.zeros((48, 64), bool)
    region[10:48] = True
    assert footing(theta, region, ~region) is None


def walking(
    feet_seen: list[bool],
) -> tuple[list[RegionDepth], list[Link], list[tuple[int, int, float, float]]]:
    """It comes nearer by 2 % a frame; where its feet are outside the border is as far as at first."""
    true = 0.02 * np.arange(len(feet_seen))
    regions = [
        RegionDepth((0, t), 1, 3.0, 0.0, footing=Footing(true[t] if seen else 0.0, seen))
        for t, seen in enumerate(feet_seen)
    ]
    links = [(t, t + 1, True) for t in range(len(true) - 1)]
    growths = [(t, t + k, true[t + k] - true[t], 0.01) for k in (2, 4) for t in range(len(true) - k)]
    return regions, links, growths


def test_where_it_stood_before_tells_where_it_stands_without_feet() -> None:
    found = on_the_ground(*walking([True] * 10 + [False] * 15))
    np.testing.assert_allclose(found, 0.02 * np.arange(25), atol=0.01)


def test_a_thing_without_feet_is_nearer_than_the_border() -> None:
    regions, links, growths = walking([False] * 5)
    assert (on_the_ground(regions, links, growths) >= NEARER).all()


def test_where_images_tell_a_depth_the_border_only_bounds_it() -> None:
    outside, inside = Footing(0.5, False), Footing(0.5, True)
    regions = [
        RegionDepth((0, 0), label, 0.0, evidence, footing=footing)
        for label, (evidence, footing) in enumerate(
            [(1.0, outside), (0.0, outside), (1.0, inside), (0.0, None)]
        )
    ]
    np.testing.assert_allclose(ground_at_border(regions), [0.5, 0.5 + NEARER, -np.inf, -np.inf])


def test_feet_tell_the_depth_that_images_do_not() -> None:
    """Others saw it wrongly, 0.3 too near, before it left their view; its feet are on the ground."""
    wrong = [RegionDepth((0, t), 1, 0.3, 0.5 if t < 3 else 0.0) for t in range(20)]
    standing = [replace(region, footing=Footing(0.0, True)) for region in wrong]
    links = [(t, t + 1, True) for t in range(19)]
    (without, _), (found, belief) = (smooth_over_time(each, links) for each in (wrong, standing))
    assert without[10:] == pytest.approx(0.3, abs=0.02)
    assert found[10:] == pytest.approx(0.0, abs=0.05)
    # that it moves images must say
    assert smooth_over_time([replace(one, evidence=0.0) for one in standing], links)[1].max() == 0.0
    assert belief[0] > 0.0


def test_feet_have_no_say_where_images_tell() -> None:
    """A thing that hovers, or flies."""
    hovering = [RegionDepth((0, t), 1, 0.3, 0.5, footing=Footing(0.0, True)) for t in range(5)]
    solved, _ = smooth_over_time(hovering, [(t, t + 1, True) for t in range(4)])
    np.testing.assert_allclose(solved, 0.3, atol=1e-6)


def test_what_never_touches_the_ground_is_nowhere() -> None:
    regions = [RegionDepth((0, t), 1, 3.0, 0.0) for t in range(4)]
    assert np.isnan(on_the_ground(regions, [(0, 1, True), (1, 2, True), (2, 3, True)], [])).all()
