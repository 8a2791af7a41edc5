"""Placements tried out: a bent map and a rough placement are mended, a false placement is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, DenseMapConfig, densify_map, move_map
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.joint_adjustment import AdjustmentConfig
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.frontend.start.trial import TrialConfig, mend_placement, similarity_of
from mvdyn_gtsam.frontend.start.verification import VerificationConfig, verify_placement
from mvdyn_gtsam.geometry import (
    Similarity,
    backproject,
    invert_pose,
    project,
    rotation_angle_deg,
    transform_points,
)
from tests.frontend.start.synthetic_maps import poses, similarity, unit_descriptors
from tests.tracking.synthetic_scene import HEIGHT, WIDTH, Scene, two_cameras

DENSE = DenseMapConfig(frames=3, neighbours=8)
VERIFY = VerificationConfig()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(moving=(True, True))


def sparse_maps(scene: Scene) -> list[CameraMap]:
    """True poses of both cameras, and 400 points of either's middle frame wherever they fall."""
    random = np.random.default_rng(0)
    found = []
    for camera in (0, 1):
        x, y = random.integers(0, WIDTH, 400), random.integers(0, HEIGHT, 400)
        pixels = np.column_stack([x, y]).astype(float)
        local = backproject(pixels, scene.depths[camera][4][y, x], scene.cameras[camera].intrinsics)
        found.append(transform_points(scene.wTc[camera][4], local))
    points = np.concatenate(found)
    descriptors = unit_descriptors(random, len(points))
    maps = []
    for camera in (0, 1):
        features, rows = [], []
        for wTc in scene.wTc[camera]:
            seen, _ = project(transform_points(invert_pose(wTc), points), scene.cameras[camera].intrinsics)
            inside = np.flatnonzero((seen >= 0).all(1) & (seen <= [WIDTH - 1, HEIGHT - 1]).all(1))
            features.append(Features(seen[inside], descriptors[inside]))
            rows.append(inside)
        times = np.arange(len(scene.wTc[camera]))
        maps.append(
            CameraMap(camera, times, scene.wTc[camera].copy(), tuple(features), tuple(rows), points.copy())
        )
    return maps


@pytest.fixture(scope="module")
def dense(scene: Scene) -> tuple[DenseMap, DenseMap]:
    flow = DisFlow(FlowConfig(finest_scale=0))
    first, second = (densify_map(scene.capture(), own, flow, DENSE) for own in sparse_maps(scene))
    return first, second


def bent(scene: Scene, dense: DenseMap) -> DenseMap:
    """The map as structure from motion gives it where parallax is small: turned more and more."""
    camera = scene.cameras[dense.sparse.camera]
    mTc = dense.sparse.mTc.copy()
    for frame, turn in enumerate(np.linspace(-0.02, 0.02, len(mTc))):
        mTc[frame, :3, :3] = mTc[frame, :3, :3] @ Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
    moved = move_map(camera, dense, mTc, DENSE)
    return replace(moved, sparse=replace(dense.sparse, mTc=mTc))


def tried(scene: Scene, maps: tuple[DenseMap, DenseMap], aSb: Similarity) -> tuple[Similarity, float]:
    rows = np.arange(0, 800, 8)
    same = np.column_stack([rows, rows])
    cameras = scene.cameras[0], scene.cameras[1]
    mended, (first, second) = mend_placement(
        cameras, maps, aSb, same, AdjustmentConfig(), TrialConfig(), DENSE
    )
    verdict = verify_placement(first.views, second.views, Similarity.identity(), VERIFY, careful=True)
    return mended, verdict.trust


def test_a_rough_placement_of_a_bent_map_is_mended(scene: Scene, dense: tuple[DenseMap, DenseMap]) -> None:
    maps = dense[0], bent(scene, dense[1])
    rough = similarity(1.03, (0.0, 0.03, 0.0), (0.1, 0.0, 0.05))
    before = verify_placement(maps[0].views, maps[1].views, rough, VERIFY, careful=True)
    mended, trust = tried(scene, maps, rough)
    assert trust > 0.9 and trust > before.trust
    assert rotation_angle_deg(mended.rotation) < 0.3
    assert abs(np.log(mended.scale)) < 0.02
    # the maps handed in are as they were
    np.testing.assert_array_equal(maps[0].sparse.mTc, scene.wTc[0])


@given(st.integers(0, 10**6), st.floats(0.01, 100.0))
def test_similarity_of_frames_that_were_moved_rigidly(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    mTc = poses((0.0, 0.0, 0.0), 5)
    mTc[:, 1, 3] = 0.0  # centres on a plane through the path: their rotation alone would be undecided
    wSm = Similarity(scale, Rotation.random(rng=random).as_matrix(), scale * random.normal(size=3))
    found = similarity_of(mTc, wSm.transform_poses(mTc))
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, wSm.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, wSm.translation, atol=1e-7 * scale)


def test_nonsense_is_refused() -> None:
    for values in ({"trials": 0}, {"minimum_trust": 1.0}, {"minimum_trust": -0.1}):
        with pytest.raises(ConfigError, match="trial"):
            TrialConfig(**values)
