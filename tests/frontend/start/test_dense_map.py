"""Dense depth from flow within one camera's map, on rendered planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig
from mvdyn_gtsam.frontend.start.dense_map import (
    DenseMap,
    DenseMapConfig,
    densify_map,
    move_map,
    neighbours_of,
)
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.geometry import Similarity, backproject, invert_pose, project, transform_points
from tests.tracking.synthetic_scene import HEIGHT, WIDTH, Scene, two_cameras

FULL = FlowConfig(finest_scale=0)
CONFIG = DenseMapConfig(frames=3, neighbours=8)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(moving=(True,))


def exact_map(scene: Scene) -> CameraMap:
    """True poses, and 200 points of the middle frame wherever they fall in the others."""
    camera, truth = scene.cameras[0], scene.wTc[0]
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, WIDTH, 200), rng.integers(0, HEIGHT, 200)
    pixels = np.column_stack([x, y]).astype(float)
    points = transform_points(truth[4], backproject(pixels, scene.depths[0][4][y, x], camera.intrinsics))
    features, rows = [], []
    for wTc in truth:
        seen, _ = project(transform_points(invert_pose(wTc), points), camera.intrinsics)
        inside = np.flatnonzero((seen >= 0).all(1) & (seen <= [WIDTH - 1, HEIGHT - 1]).all(1))
        features.append(Features(seen[inside], np.zeros((len(inside), 128), np.float32)))
        rows.append(inside)
    return CameraMap(0, np.arange(9), truth.copy(), tuple(features), tuple(rows), points)


@pytest.fixture(scope="module")
def dense(scene: Scene) -> DenseMap:
    return densify_map(scene.capture(), exact_map(scene), DisFlow(FULL), CONFIG)


def test_views_are_spread_over_the_video(dense: DenseMap, scene: Scene) -> None:
    assert [view.time for view in dense.views] == [0, 4, 8]
    for view in dense.views:
        np.testing.assert_array_equal(view.mTc, scene.wTc[0, view.time])
        assert view.image.shape == (HEIGHT, WIDTH)
        assert len(view.depth) == len(view.grid)


def test_depth_is_right_where_it_is_given(dense: DenseMap, scene: Scene) -> None:
    for view in dense.views:
        truth = view.grid.sample(scene.depths[0][view.time])
        sure = np.isfinite(view.depth)
        assert sure.mean() > 0.5
        error = np.abs(np.log(view.depth[sure] / truth[sure]))
        assert np.median(error) < 0.02
        assert np.quantile(error, 0.9) < 0.1


def test_known_is_the_share_with_depth(dense: DenseMap) -> None:
    shares = [np.isfinite(view.depth).mean() for view in dense.views]
    assert dense.known == pytest.approx(np.mean(shares))
    none = [replace(view, depth=np.full_like(view.depth, np.nan)) for view in dense.views]
    assert replace(dense, views=(dense.views[0], *none[1:])).known == pytest.approx(shares[0] / 3)


def test_a_true_map_is_rigid_and_a_wrong_one_is_not(dense: DenseMap, scene: Scene) -> None:
    assert dense.rigidity > 0.95
    true = exact_map(scene)
    wrong = true.mTc.copy()
    wrong[:, 1, 3] += 0.15 * np.array([0, 1, 0, -1, 0, 1, 0, -1, 0])  # jumps up and down, which it did not
    bad = densify_map(scene.capture(), replace(true, mTc=wrong), DisFlow(FULL), CONFIG)
    assert bad.rigidity < 0.6
    given = [np.isfinite(view.depth).mean() for view in bad.views]
    assert np.mean(given) < 0.7 * np.mean([np.isfinite(view.depth).mean() for view in dense.views])


def test_a_map_moved_as_a_whole_has_the_same_depth_in_its_new_scale(dense: DenseMap, scene: Scene) -> None:
    wSm = Similarity(2.5, Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    moved = move_map(scene.cameras[0], dense, wSm.transform_poses(dense.sparse.mTc), CONFIG)
    assert moved.rigidity == pytest.approx(dense.rigidity, abs=1e-3)
    for before, after in zip(dense.views, moved.views, strict=True):
        both = np.isfinite(before.depth) & np.isfinite(after.depth)
        assert both.sum() > 0.98 * np.isfinite(before.depth).sum()
        # a few points are torn between two depths
        off = np.abs(after.depth[both] / (2.5 * before.depth[both]) - 1.0)
        assert np.quantile(off, 0.99) < 1e-3
        assert after.time == before.time and after.image is before.image


def test_neighbours_reach_further_where_frames_are_closer() -> None:
    assert neighbours_of(5, 20, 2, 2) == [3, 4, 5, 6, 7]
    assert neighbours_of(5, 20, 2, 6) == [0, 3, 5, 8, 11]
    assert neighbours_of(0, 3, 4, 8) == [0, 1, 2]


def test_without_parallax_no_depth_is_sure() -> None:
    still = two_cameras(count=9, moving=(False,))
    view = densify_map(still.capture(), exact_map(still), DisFlow(FULL), CONFIG).views[0]
    assert np.isnan(view.depth).all()


def test_nonsense_is_refused() -> None:
    for values in ({"frames": 0}, {"stride": 0}, {"depth_sigma": 0.0}):
        with pytest.raises(ConfigError, match="dense_map"):
            DenseMapConfig(**values)
