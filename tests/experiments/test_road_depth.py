"""The lane before a car."""

from __future__ import annotations

import numpy as np

from experiments.road_depth import FARTHEST, HALF_WIDTH, lane_depth
from mvdyn_gtsam.geometry import backproject

INTRINSICS = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
HEIGHT = 1.65


def test_points_of_the_lane_lie_on_the_road_within_its_bounds() -> None:
    depth = lane_depth(INTRINSICS, (376, 1241), HEIGHT)
    rows, cols = np.nonzero(np.isfinite(depth))
    points = backproject(np.stack([cols, rows], axis=1).astype(float), depth[rows, cols], INTRINSICS)
    np.testing.assert_allclose(points[:, 1], HEIGHT)
    assert np.abs(points[:, 0]).max() <= HALF_WIDTH and points[:, 2].max() <= FARTHEST
    # its edges are in the image, and nothing above the horizon is
    assert np.ptp(points[:, 0]) > 1.9 * HALF_WIDTH and rows.min() > 180


def test_a_camera_under_the_road_sees_no_lane() -> None:
    assert not np.isfinite(lane_depth(INTRINSICS, (376, 1241), 100.0)).any()
