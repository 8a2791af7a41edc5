from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.keys import S, X
from factors.priors import constant_velocity_error, constant_velocity_factor, pose_prior, scale_prior
from tests.factors.synthetic import numerical_jacobian

KEYS = (X(0, 0), X(0, 1), X(0, 2))


def _random_poses(seed: int) -> list[gtsam.Pose3]:
    rng = np.random.default_rng(seed)
    return [gtsam.Pose3.Expmap(rng.normal(size=6) * 0.4) for _ in range(3)]


def _values(poses: list[gtsam.Pose3]) -> gtsam.Values:
    values = gtsam.Values()
    for key, pose in zip(KEYS, poses, strict=True):
        values.insert(key, pose)
    return values


def test_constant_twist_has_no_error_at_uneven_times() -> None:
    start, twist = _random_poses(0)[0], np.array([0.1, -0.2, 0.05, 0.3, 0.1, -0.4])
    poses = [start.compose(gtsam.Pose3.Expmap(time * twist)) for time in (0.0, 1.0, 2.5)]
    factor = constant_velocity_factor(KEYS, (0.0, 1.0, 2.5), 0.1, 0.2)
    assert factor.error(_values(poses)) < 1e-24


def test_error_is_the_change_of_velocity_over_sigma() -> None:
    twists = [np.zeros(6), np.r_[np.zeros(3), 0.3, 0.0, 0.0], np.r_[np.zeros(3), 0.5, 0.0, 0.0]]
    factor = constant_velocity_factor(KEYS, (0.0, 1.0, 2.0), 0.1, 0.05)
    poses = [gtsam.Pose3.Expmap(twist) for twist in twists]
    # moved 0.3, then 0.2: velocity changed by 0.1, two sigmas
    np.testing.assert_allclose(factor.error(_values(poses)), 0.5 * 2.0**2)


@pytest.mark.parametrize("seed", range(5))
def test_constant_velocity_jacobians_are_numerical_ones(seed: int) -> None:
    poses = _random_poses(seed)

    def error(delta: np.ndarray) -> np.ndarray:
        moved = [pose.retract(delta[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)]
        return constant_velocity_error(moved[0], moved[1], moved[2], 0.7, 1.6)[0]

    _, derivatives = constant_velocity_error(poses[0], poses[1], poses[2], 0.7, 1.6)
    np.testing.assert_allclose(np.hstack(derivatives), numerical_jacobian(error, 18), rtol=1e-5, atol=1e-7)


def test_linearisation_of_the_second_step_is_the_native_between_factor() -> None:
    poses = _random_poses(11)
    values = _values(poses)
    factor = constant_velocity_factor(KEYS, (0.0, 1.0, 2.0), 1.0, 1.0)
    between = gtsam.BetweenFactorPose3(KEYS[1], KEYS[2], gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))
    first = gtsam.BetweenFactorPose3(KEYS[0], KEYS[1], gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))
    jacobian, rhs = factor.linearize(values).jacobian()
    native, native_rhs = between.linearize(values).jacobian()
    native_first, native_first_rhs = first.linearize(values).jacobian()
    np.testing.assert_allclose(jacobian[:, 12:], native[:, 6:], atol=1e-12)
    np.testing.assert_allclose(jacobian[:, 6:12], native[:, :6] - native_first[:, 6:], atol=1e-12)
    np.testing.assert_allclose(jacobian[:, :6], -native_first[:, :6], atol=1e-12)
    np.testing.assert_allclose(rhs, native_rhs - native_first_rhs, atol=1e-12)


def test_times_must_increase() -> None:
    with pytest.raises(ValueError, match="increase"):
        constant_velocity_factor(KEYS, (0.0, 1.0, 1.0), 1.0, 1.0)


def test_native_priors_take_rotation_first() -> None:
    values = gtsam.Values()
    values.insert(KEYS[0], gtsam.Pose3.Expmap(np.array([0.02, 0, 0, 0, 0, 0])))
    values.insert(S(0, 0), 0.3)
    np.testing.assert_allclose(pose_prior(KEYS[0], np.eye(4), 0.01, 10.0).error(values), 0.5 * 4.0)
    np.testing.assert_allclose(scale_prior(S(0, 0), 0.1, 0.1).error(values), 0.5 * 4.0)
