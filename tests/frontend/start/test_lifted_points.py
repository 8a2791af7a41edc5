"""Keypoints lifted onto dense depth: points and matches where triangulation left none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from factors.structureless import StructurelessMeasurement
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, DepthView, MeasuredView
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.lifted_points import LiftConfig, depth_at, lift_keypoints, match_lifted
from mvdyn_gtsam.frontend.start.placement import (
    PlacementConfig,
    match_maps,
    propose_placements,
    same_placement,
)
from mvdyn_gtsam.geometry import Similarity, invert_pose, pixel_rays, project, transform_points
from tests.frontend.start.synthetic_maps import (
    CAMERA,
    HEIGHT,
    WIDTH,
    Cloud,
    camera_map,
    poses,
    similarity,
    unit_descriptors,
)

K = CAMERA.intrinsics
GRID = Grid.covering(WIDTH, HEIGHT, 4)
WORLD_A = similarity(1.0, (0.0, 0.1, 0.0), (0.1, 0.0, 0.05))
WORLD_B = similarity(1.6, (0.2, -0.3, 0.1), (0.4, -0.2, 0.3))
TRUTH = WORLD_A.compose(WORLD_B.inverse())


def two_walls(count: int) -> Cloud:
    """Points on a wall at z = 1 and, beside it, one at z = 1.3."""
    random = np.random.default_rng(1)
    points = random.uniform([-0.6, -0.4, 1.0], [1.0, 0.4, 1.0], (count, 3))
    points[points[:, 0] > 0.2, 2] = 1.3
    return Cloud(points, unit_descriptors(random, count))


def wall_depth(wTc: npt.NDArray[np.float64], pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Depth of the two walls along the rays of ``(N, 2)`` pixels; the nearer one hides the other."""
    rays = pixel_rays(pixels, K) @ wTc[:3, :3].T
    near, far = ((z - wTc[2, 3]) / rays[:, 2] for z in (1.0, 1.3))
    return np.where(wTc[0, 3] + near * rays[:, 0] <= 0.2, near, far)


def dense_map(
    camera: int, scene: Cloud, wTc: npt.NDArray[np.float64], mSw: Similarity, frames: list[int]
) -> DenseMap:
    """True depth in some frames; no keypoint is triangulated."""
    sparse = camera_map(camera, scene, wTc, mSw)
    unknown = tuple(np.full_like(rows, -1) for rows in sparse.point_of_keypoint)
    empty = StructurelessMeasurement(
        rays=np.zeros((0, 3)),
        initial_log_depth=np.zeros(0),
        prior_log_depth=np.zeros(0),
        prior_sigma=np.zeros(0),
        intrinsics_j=np.zeros((0, 4)),
        target=np.zeros((0, 0, 2)),
        weight=np.zeros((0, 0)),
    )
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    return DenseMap(
        sparse=replace(sparse, point_of_keypoint=unknown, points=np.zeros((0, 3))),
        views=tuple(
            DepthView(
                int(sparse.times[f]),
                sparse.mTc[f],
                K,
                GRID,
                mSw.scale * wall_depth(wTc[f], GRID.pixels),
                image,
            )
            for f in frames
        ),
        rigidity=1.0,
        seen=tuple(MeasuredView(f, (), empty, GRID, image) for f in frames),
    )


def two_maps() -> tuple[DenseMap, DenseMap]:
    scene = two_walls(500)
    return (
        dense_map(0, scene, poses((0.0, 0.0, 0.0), 5), WORLD_A, [0, 2, 4]),
        dense_map(1, scene, poses((0.3, 0.05, -0.05), 5, turn_deg=-12.0), WORLD_B, [0, 2, 4]),
    )


def test_what_triangulation_missed_is_matched_once_it_is_lifted() -> None:
    first, second = two_maps()
    config = PlacementConfig(samples=8000)
    assert len(match_maps(first.sparse, second.sparse, config)) == 0
    lifted = lift_keypoints(first, {}), lift_keypoints(second, {})
    matches = match_lifted(*lifted, LiftConfig(), config)
    assert len(matches) > 200
    best = propose_placements(matches, K, K, config)[0]
    assert same_placement(best.aSb, TRUTH)
    # Depth comes from the nearest grid point, up to 2 px away: exact it is not.
    assert best.inliers > 0.9 * len(matches)


def test_lifted_points_are_seen_where_their_keypoints_are() -> None:
    lifted = lift_keypoints(two_maps()[0], {}).sparse
    assert len(lifted.points) > 500
    for frame, rows in enumerate(lifted.point_of_keypoint):
        if frame % 2:
            assert (rows == -1).all()  # no dense depth there
            continue
        pixels, depth = project(transform_points(invert_pose(lifted.mTc[frame]), lifted.points[rows]), K)
        np.testing.assert_allclose(pixels, lifted.features[frame].pixels, atol=1e-9)
        assert (depth > 0).all()
    used = np.concatenate([rows[rows >= 0] for rows in lifted.point_of_keypoint])
    np.testing.assert_array_equal(np.sort(used), np.arange(len(lifted.points)))


def test_triangulated_points_keep_their_rows() -> None:
    dense, _ = two_maps()
    own = camera_map(0, two_walls(500), poses((0.0, 0.0, 0.0), 5), WORLD_A)
    known = tuple(np.where(rows < 100, rows, -1) for rows in own.point_of_keypoint)
    before = replace(dense, sparse=replace(own, point_of_keypoint=known, points=own.points[:100]))
    after = lift_keypoints(before, {}).sparse
    np.testing.assert_array_equal(after.points[:100], own.points[:100])
    for old, new in zip(known, after.point_of_keypoint, strict=True):
        np.testing.assert_array_equal(new[old >= 0], old[old >= 0])
        assert ((new[old < 0] == -1) | (new[old < 0] >= 100)).all()
    assert len(after.points) > 400


def test_no_depth_no_point() -> None:
    dense, _ = two_maps()
    holes = np.where(GRID.pixels[:, 0] < WIDTH / 2, np.nan, dense.views[0].depth)
    dense = replace(dense, views=(replace(dense.views[0], depth=holes), *dense.views[1:]))
    lifted = lift_keypoints(dense, {}).sparse
    left = lifted.features[0].pixels[:, 0] < WIDTH / 2 - 4
    right = lifted.features[0].pixels[:, 0] > WIDTH / 2 + 4
    assert (lifted.point_of_keypoint[0][left] == -1).all()
    assert (lifted.point_of_keypoint[0][right] >= 0).all()


def test_further_keypoints_come_after_those_of_the_frame() -> None:
    dense, _ = two_maps()
    more = Features(np.array([[100.0, 100.0], [300.0, 200.0]]), unit_descriptors(np.random.default_rng(2), 2))
    lifted = lift_keypoints(dense, {2: more}).sparse
    count = len(dense.sparse.features[2].pixels)
    np.testing.assert_array_equal(lifted.features[2].pixels[count:], more.pixels)
    np.testing.assert_array_equal(lifted.features[2].descriptors[count:], more.descriptors)
    assert len(lifted.point_of_keypoint[2]) == count + 2
    assert (lifted.point_of_keypoint[2][count:] >= 0).all()
    assert lifted.features[0] is dense.sparse.features[0]


def test_depth_is_that_of_the_nearest_grid_point() -> None:
    view = two_maps()[0].views[0]
    np.testing.assert_array_equal(depth_at(view, GRID.pixels + 1.4), view.depth)
    np.testing.assert_array_equal(depth_at(view, np.array([[-3.0, -3.0]])), view.depth[:1])


@pytest.mark.parametrize("values", [{"match_ratio": 0.0}, {"tilted_frames": -1}, {"apart_px": -1.0}])
def test_nonsense_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="lift"):
        LiftConfig(**values)  # type: ignore[arg-type]
