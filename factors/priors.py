"""Priors on poses and depth scales, and smoothness of a camera's motion.

Where gtsam has a factor it is used: ``PriorFactorPose3``, ``PriorFactorDouble``. Constant velocity over three
poses has none and is written here.
"""

from __future__ import annotations

from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def pose_prior(
    pose_key: int, wTc: Array, rotation_sigma: float, translation_sigma: float
) -> gtsam.PriorFactorPose3:
    """Gaussian prior on a pose: ``wTc (4, 4)``, sigmas in radians and in the world's unit."""
    return gtsam.PriorFactorPose3(pose_key, gtsam.Pose3(wTc), _pose_noise(rotation_sigma, translation_sigma))


def scale_prior(scale_key: int, log_scale: float, sigma: float) -> gtsam.PriorFactorDouble:
    """Gaussian prior on a log depth scale."""
    return gtsam.PriorFactorDouble(scale_key, log_scale, gtsam.noiseModel.Isotropic.Sigma(1, sigma))


def constant_velocity_error(
    wTa: gtsam.Pose3, wTb: gtsam.Pose3, wTc: gtsam.Pose3, step_ab: float, step_bc: float
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Change of body velocity ``Log(bTc) / step_bc - Log(aTb) / step_ab`` at b, and its Jacobians.

    Returns the error ``(6,)`` as ``[omega, v]`` per unit of time and its three ``(6, 6)`` derivatives by
    right perturbations of a, b, c. Zero exactly when both steps follow one constant twist.
    """
    aTb, bTc = wTa.between(wTb), wTb.between(wTc)
    twist_ab, twist_bc = gtsam.Pose3.Logmap(aTb), gtsam.Pose3.Logmap(bTc)
    # right perturbation of the end of a step enters through the logarithm, of its start through the adjoint
    # as well
    by_end_ab = gtsam.Pose3.LogmapDerivative(twist_ab) / step_ab
    by_end_bc = gtsam.Pose3.LogmapDerivative(twist_bc) / step_bc
    by_a = by_end_ab @ aTb.inverse().AdjointMap()
    by_b = -by_end_bc @ bTc.inverse().AdjointMap() - by_end_ab
    return twist_bc / step_bc - twist_ab / step_ab, (by_a, by_b, by_end_bc)


def constant_velocity_factor(
    pose_keys: tuple[int, int, int],
    times: tuple[float, float, float],
    rotation_sigma: float,
    translation_sigma: float,
) -> gtsam.CustomFactor:
    """Smooth motion over three poses of one camera at increasing ``times``.

    Sigmas are changes of velocity: radians and world units per unit of ``times``. Raises ValueError when the
    times do not increase.
    """
    step_ab, step_bc = times[1] - times[0], times[2] - times[1]
    if not (step_ab > 0.0 and step_bc > 0.0):
        raise ValueError(f"times must increase, got {times}")
    error = partial(_constant_velocity_error, step_ab, step_bc)
    return gtsam.CustomFactor(_pose_noise(rotation_sigma, translation_sigma), list(pose_keys), error)


def _constant_velocity_error(
    step_ab: float,
    step_bc: float,
    this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    wTa, wTb, wTc = (values.atPose3(key) for key in this.keys())
    error, derivatives = constant_velocity_error(wTa, wTb, wTc, step_ab, step_bc)
    if jacobians is not None:
        for index, derivative in enumerate(derivatives):
            jacobians[index] = np.asfortranarray(derivative)
    return error


def _pose_noise(rotation_sigma: float, translation_sigma: float) -> gtsam.noiseModel.Diagonal:
    return gtsam.noiseModel.Diagonal.Sigmas(np.repeat([rotation_sigma, translation_sigma], 3))
