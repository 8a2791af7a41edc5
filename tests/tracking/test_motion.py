"""Pose of one frame: which predictions are tried, and what is found."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import invert_pose, transform_points
from mvdyn_gtsam.tracking import motion
from mvdyn_gtsam.tracking.motion import Correspondences, locate, refine_pose

INTRINSICS = np.array([300.0, 300.0, 160.0, 120.0])
ROBUST_PX = 0.5


def pose(angle: float, shift: float) -> np.ndarray:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_rotvec([0.3 * angle, angle, 0.0]).as_matrix()
    wTc[:3, 3] = [shift, 0.5 * shift, 0.0]
    return wTc


def seen_from(wTc: np.ndarray, wrong: float) -> Correspondences:
    """Points before the camera, a share of them measured ``wrong``."""
    random = np.random.default_rng(0)
    points = random.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 6.0], (300, 3))
    x, y, z = transform_points(invert_pose(wTc), points).T
    target = np.column_stack([300.0 * x / z + 160.0, 300.0 * y / z + 120.0]) + random.normal(0, 0.1, (300, 2))
    target[: round(300 * wrong)] += random.uniform(-40.0, 40.0, (round(300 * wrong), 2))
    return Correspondences(points, target, np.ones(300))


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The poses that a solve was begun from."""
    begun: list[np.ndarray] = []

    def noting(seen: Correspondences, intrinsics: np.ndarray, wTc: np.ndarray, robust_px: float):  # type: ignore[no-untyped-def]
        begun.append(wTc)
        return refine_pose(seen, intrinsics, wTc, robust_px)

    monkeypatch.setattr(motion, "refine_pose", noting)
    return begun


def test_a_prediction_that_explains_nearly_all_is_as_good_as_the_best_of_all(tried: list[np.ndarray]) -> None:
    truth = pose(0.05, 0.1)
    seen, predictions = seen_from(truth, wrong=0.1), [pose(0.04, 0.08), pose(0.06, 0.14), np.eye(4)]
    found = locate(seen, INTRINSICS, predictions, ROBUST_PX)
    assert len(tried) == 1
    every = [refine_pose(seen, INTRINSICS, wTc, ROBUST_PX) for wTc in predictions]
    best = min(every, key=lambda fit: fit.cost)
    np.testing.assert_allclose(found.wTc, best.wTc, atol=1e-6)
    np.testing.assert_allclose(found.wTc, truth, atol=2e-3)


def test_where_much_is_wrong_every_prediction_is_tried(tried: list[np.ndarray]) -> None:
    truth = pose(0.05, 0.1)
    locate(seen_from(truth, wrong=0.25), INTRINSICS, [truth, pose(0.04, 0.08)], ROBUST_PX)
    assert len(tried) == 2


def test_pnp_finds_what_no_prediction_leads_to(tried: list[np.ndarray]) -> None:
    truth = pose(0.05, 0.1)
    far = pose(2.0, 30.0)
    found = locate(seen_from(truth, wrong=0.1), INTRINSICS, [far], ROBUST_PX)
    assert len(tried) == 2
    np.testing.assert_allclose(found.wTc, truth, atol=2e-3)
