"""Cameras mounted rigidly on one another: one relative pose, the mount, holds at every instant."""

from __future__ import annotations

import gtsam
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def mount_error(
    wTa: gtsam.Pose3, wTb: gtsam.Pose3, aTb: gtsam.Pose3
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Deviation ``Log(aTb^-1 wTa^-1 wTb)`` of two cameras at one instant from their mount ``aTb``.

    Returns the error ``(6,)`` as ``[omega, v]`` in the axes of b and its three ``(6, 6)`` derivatives by
    right perturbations of ``wTa``, ``wTb`` and ``aTb``.
    """
    seen = wTa.between(wTb)
    deviation = aTb.between(seen)
    error = gtsam.Pose3.Logmap(deviation)
    by_b = gtsam.Pose3.LogmapDerivative(error)
    by_a = -by_b @ seen.inverse().AdjointMap()
    by_mount = -by_b @ deviation.inverse().AdjointMap()
    return error, (by_a, by_b, by_mount)


def mount_factor(
    keys: tuple[int, int, int], rotation_sigma: float, translation_sigma: float
) -> gtsam.CustomFactor:
    """Factor over ``wTa``, ``wTb`` and the mount ``aTb``; sigmas in radians and in the world's unit."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([rotation_sigma, translation_sigma], 3))
    return gtsam.CustomFactor(noise, list(keys), _mount_error)


def _mount_error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
    wTa, wTb, aTb = (values.atPose3(key) for key in this.keys())
    error, derivatives = mount_error(wTa, wTb, aTb)
    if jacobians is not None:
        for index, derivative in enumerate(derivatives):
            jacobians[index] = np.asfortranarray(derivative)
    return error
