"""How much a moving thing grows in the image, and what that tells of its depth."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.edges import Edge
from mvdyn_gtsam.refinement.moving.growth import SIGMA, growths_along, vertical_growth
from mvdyn_gtsam.refinement.moving.over_time import smooth_over_time
from mvdyn_gtsam.refinement.moving.region_depth import RegionDepth
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView

CAMERA = Camera("cam0", 160, 120, 140.0, 140.0, 79.5, 59.5)
VIEW = DenseView.of(CAMERA, 0.5)
CONFIG = RefinementConfig()
RNG = np.random.default_rng(3)


def projected(points: np.ndarray) -> Float32:
    return (140.0 * points[:, :2] / points[:, 2:] + [79.5, 59.5]).astype(np.float32)


def thing(degrees: float, away: float, count: int = 800) -> tuple[Float32, Float32]:
    """Pixels of a flat thing 2 m away, and after it turned about the vertical and went away."""
    points = np.column_stack([RNG.uniform(-0.4, 0.4, (count, 2)), np.zeros(count)])
    turn = np.radians(degrees)
    turned = points @ np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    return projected(points + [0.1, 0.0, 2.0]), projected(turned + [-0.2, 0.1, 2.0 + away])


@pytest.mark.parametrize(("degrees", "away"), [(0.0, 0.0), (0.0, 0.5), (0.0, -0.6), (25.0, 0.3)])
def test_growth_is_the_ratio_of_the_depths(degrees: float, away: float) -> None:
    here, there = thing(degrees, away)
    found = vertical_growth(here, there, np.ones(len(here), np.float32), 100.0)
    assert found is not None
    assert found[0] == pytest.approx(np.log(2.0 / (2.0 + away)), abs=0.02 if degrees else 1e-4)
    assert SIGMA <= found[1] < 3.0 * SIGMA


def test_a_swinging_arm_does_not_spoil_it() -> None:
    here, there = thing(0.0, 0.5)
    there[:200] += [9.0, -7.0]
    found = vertical_growth(here, there, np.ones(len(here), np.float32), 100.0)
    assert found is not None and found[0] == pytest.approx(np.log(2.0 / 2.5), abs=0.01)


def test_what_is_no_single_thing_has_no_growth() -> None:
    here, there = thing(0.0, 0.5)
    ones = np.ones(len(here), np.float32)
    assert vertical_growth(here, RNG.permutation(there), ones, 100.0) is None
    line = here.copy()
    line[:, 1] = 50.0
    assert vertical_growth(line, there, ones, 100.0) is None
    assert vertical_growth(here, there * np.array([1.0, -1.0], np.float32), ones, 100.0) is None


def test_a_small_thing_is_measured_less_well() -> None:
    here, there = thing(0.0, 0.5)
    small = np.abs(here - here.mean(axis=0)).max(axis=1) < 5.0
    whole, part = (
        vertical_growth(here[kept], there[kept], np.ones(int(kept.sum()), np.float32), float(kept.sum()) / 8)
        for kept in (np.ones(len(here), bool), small)
    )
    assert whole is not None and part is not None and part[1] > 2.0 * whole[1]


def test_regions_grow_to_those_that_the_flow_finds() -> None:
    labels, labels_there = np.zeros(VIEW.shape, np.int32), np.zeros(VIEW.shape, np.int32)
    labels[10:30, 10:30], labels[40:55, 50:70] = 1, 2
    pixels = np.flatnonzero(labels)
    row, column = np.divmod(pixels, VIEW.shape[1])
    # twice as large about the image's upper left corner; the second region leaves the image
    twice = np.column_stack([2.0 * column, 2.0 * row])
    labels_there[20:60, 20:60] = 7
    inside = (twice[:, 0] < VIEW.shape[1]) & (twice[:, 1] < VIEW.shape[0])
    nearest = np.where(inside, twice[:, 1] * VIEW.shape[1] + twice[:, 0], -1).astype(np.int64)
    target = ((twice + 0.5) * 2.0 - 0.5).astype(np.float32)
    weight = np.ones(len(pixels), np.float32)
    edge = Edge(
        (0, 3), (0, 5), pixels, VIEW.rays[pixels], target, weight, nearest, np.eye(4), CAMERA.intrinsics
    )
    focal = np.array([140.0, 140.0], np.float32)
    found = growths_along(edge, labels.ravel(), labels_there.ravel(), focal, CONFIG)
    assert [(growth.first, growth.second) for growth in found] == [(((0, 3), 1), ((0, 5), 7))]
    assert found[0].log_growth == pytest.approx(np.log(2.0), abs=1e-3)
    # nothing moves where the flow leads
    assert growths_along(edge, labels.ravel(), np.zeros_like(labels_there).ravel(), focal, CONFIG) == []


def test_depth_follows_the_growth_where_no_other_camera_sees() -> None:
    """It comes nearer, stops and goes away again; only the last of 30 frames are observed."""
    true = 0.3 * np.sin(np.arange(30) / 6.0)
    regions = [
        RegionDepth((0, t), 1, true[t] if t >= 24 else 2.0, 1.0 if t >= 24 else 0.0) for t in range(30)
    ]
    links = [(t, t + 1, True) for t in range(29)]
    growths = [(t, t + k, true[t + k] - true[t], SIGMA) for k in (2, 4) for t in range(30 - k)]
    growths[5] = (*growths[5][:2], 0.7, SIGMA)  # one is wrong
    solved, _ = smooth_over_time(regions, links, growths)
    np.testing.assert_allclose(solved, true, atol=0.03)
    assert np.abs(smooth_over_time(regions, links)[0] - true).max() > 0.3
