"""The mount factor: value, Jacobian, and what it makes of a rig."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.keys import M, X
from factors.rig import mount_error, mount_factor
from tests.factors.synthetic import numerical_jacobian


def _random_poses(seed: int) -> list[gtsam.Pose3]:
    rng = np.random.default_rng(seed)
    return [gtsam.Pose3.Expmap(rng.normal(size=6) * 0.4) for _ in range(3)]


def test_a_kept_mount_has_no_error() -> None:
    wTa, _, aTb = _random_poses(0)
    np.testing.assert_allclose(mount_error(wTa, wTa.compose(aTb), aTb)[0], 0.0, atol=1e-14)


def test_error_is_the_deviation_over_sigma() -> None:
    wTa, _, aTb = _random_poses(1)
    off = gtsam.Pose3.Expmap(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0]))
    values = gtsam.Values()
    for key, pose in ((X(0, 4), wTa), (X(1, 4), wTa.compose(aTb).compose(off)), (M(0, 1), aTb)):
        values.insert(key, pose)
    factor = mount_factor((X(0, 4), X(1, 4), M(0, 1)), 0.01, 0.05)
    np.testing.assert_allclose(factor.error(values), 0.5 * 2.0**2)


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_numerical_ones(seed: int) -> None:
    poses = _random_poses(seed)

    def error(delta: np.ndarray) -> np.ndarray:
        a, b, mount = (pose.retract(delta[6 * k : 6 * k + 6]) for k, pose in enumerate(poses))
        return mount_error(a, b, mount)[0]

    _, derivatives = mount_error(*poses)
    np.testing.assert_allclose(np.hstack(derivatives), numerical_jacobian(error, 18), rtol=1e-5, atol=1e-7)


def test_instants_that_see_the_mount_give_it_to_those_that_do_not() -> None:
    rng = np.random.default_rng(3)
    aTb = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.05, 0.5, 0.0, 0.1]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(M(0, 1), gtsam.Pose3())
    for time in range(4):
        wTa = gtsam.Pose3.Expmap(rng.normal(size=6) * 0.3)
        graph.add(gtsam.PriorFactorPose3(X(0, time), wTa, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        if time < 3:
            wTb = wTa.compose(aTb)
            graph.add(gtsam.PriorFactorPose3(X(1, time), wTb, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        graph.add(mount_factor((X(0, time), X(1, time), M(0, 1)), 1e-4, 1e-4))
        values.insert(X(0, time), wTa)
        values.insert(X(1, time), wTa)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert solution.atPose3(M(0, 1)).equals(aTb, 1e-6)
    assert solution.atPose3(X(0, 3)).between(solution.atPose3(X(1, 3))).equals(aTb, 1e-6)
