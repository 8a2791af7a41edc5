"""Reprojection of grid points from one frame into others, with analytic Jacobians; numpy only.

``u_ij = pi(K_j, jTi * z_i * ray_i)`` with ``z_i = exp(log_depth)``. Poses are ``wTc`` matrices; Jacobians are
for right perturbations ``wTc * Exp([omega, v])``, the retraction of ``gtsam.Pose3``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MINIMUM_DEPTH_RATIO = 0.01
"""A point counts as seen in j when its z-depth there exceeds this fraction of its z-depth in i
(unit-free)."""


@dataclass(frozen=True)
class Reprojection:
    """Grid points of frame i seen in E other frames."""

    pixels: Array
    """``(E, N, 2)``, px; finite but meaningless where not ``valid``."""
    depth: Array
    """``(E, N)`` z-depth in frame j."""
    valid: npt.NDArray[np.bool_]
    """``(E, N)`` in front of camera j."""


@dataclass(frozen=True)
class ReprojectionJacobians:
    """Derivatives of ``Reprojection.pixels``; zero where not valid."""

    wTi: Array
    """``(E, N, 2, 6)``"""
    wTj: Array
    """``(E, N, 2, 6)``"""
    log_depth: Array
    """``(E, N, 2)``"""


def relative_poses(wTi: Array, wTj: Array) -> Array:
    """``jTi (E, 4, 4)`` of ``wTi (4, 4)`` and ``wTj (E, 4, 4)``."""
    jRw = np.swapaxes(wTj[:, :3, :3], 1, 2)
    jTi = np.zeros_like(wTj)
    jTi[:, :3, :3] = jRw @ wTi[:3, :3]
    jTi[:, :3, 3] = (jRw @ (wTi[:3, 3] - wTj[:, :3, 3])[:, :, None])[:, :, 0]
    jTi[:, 3, 3] = 1.0
    return jTi


def adjoint(aTb: Array) -> Array:
    """Adjoint ``(E, 6, 6)`` of ``aTb (E, 4, 4)`` for tangents ``[omega, v]``: ``aTb Exp(x) = Exp(Ad x)
    aTb``."""
    result = np.zeros((len(aTb), 6, 6))
    aRb = aTb[:, :3, :3]
    result[:, :3, :3] = aRb
    result[:, 3:, 3:] = aRb
    result[:, 3:, :3] = skew(aTb[:, :3, 3]) @ aRb
    return result


def skew(vectors: Array) -> Array:
    """Cross-product matrices ``(E, 3, 3)`` of ``vectors (E, 3)``."""
    result = np.zeros((len(vectors), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    result[:, 1, 0], result[:, 2, 0], result[:, 2, 1] = vectors[:, 2], -vectors[:, 1], vectors[:, 0]
    return result


def intrinsics_vectors(intrinsics: Array) -> Array:
    """``(E, 4)`` rows ``fx fy cx cy`` of intrinsics given so or as ``(E, 3, 3)`` matrices.

    Raises ValueError for another shape.
    """
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    if intrinsics.ndim == 2 and intrinsics.shape[1] == 4:
        return intrinsics
    if intrinsics.ndim == 3 and intrinsics.shape[1:] == (3, 3):
        return np.stack(
            [intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics[:, 0, 2], intrinsics[:, 1, 2]], axis=1
        )
    raise ValueError(f"intrinsics must be (E, 4) or (E, 3, 3), got {intrinsics.shape}")


def reproject(rays: Array, log_depth: Array, wTi: Array, wTj: Array, intrinsics_j: Array) -> Reprojection:
    """Pixels in frames j of grid points of frame i.

    ``rays (N, 3)`` with z = 1, ``log_depth (N,)``, ``wTi (4, 4)``, ``wTj (E, 4, 4)``, ``intrinsics_j`` ``(E,
    4)`` as fx fy cx cy or ``(E, 3, 3)``.
    """
    return _reproject_points(rays, log_depth, relative_poses(wTi, wTj), intrinsics_vectors(intrinsics_j))[0]


def reproject_with_jacobians(
    rays: Array, log_depth: Array, wTi: Array, wTj: Array, intrinsics_j: Array
) -> tuple[Reprojection, ReprojectionJacobians]:
    """``reproject`` and its derivatives by ``wTi``, ``wTj`` (right perturbations) and ``log_depth``."""
    jTi = relative_poses(wTi, wTj)
    intrinsics = intrinsics_vectors(intrinsics_j)
    reprojection, j_points, j_directions = _reproject_points(rays, log_depth, jTi, intrinsics)
    by_point = _pixel_by_point(j_points, reprojection.valid, intrinsics)
    x, y, z = j_points[..., 0], j_points[..., 1], j_points[..., 2]
    # d point / d (left perturbation of jTi) = [-skew(point), I]
    point_by_twist = np.zeros((*x.shape, 3, 6))
    point_by_twist[..., 0, 1], point_by_twist[..., 0, 2], point_by_twist[..., 1, 2] = z, -y, x
    point_by_twist[..., 1, 0], point_by_twist[..., 2, 0], point_by_twist[..., 2, 1] = -z, y, -x
    point_by_twist[..., [0, 1, 2], [3, 4, 5]] = 1.0
    by_twist = by_point @ point_by_twist
    depth_derivative = j_directions * np.exp(log_depth)[:, None]
    return reprojection, ReprojectionJacobians(
        wTi=by_twist @ adjoint(jTi)[:, None],
        wTj=-by_twist,
        log_depth=(by_point @ depth_derivative[..., None])[..., 0],
    )


def _reproject_points(
    rays: Array, log_depth: Array, jTi: Array, intrinsics: Array
) -> tuple[Reprojection, Array, Array]:
    i_depth = np.exp(log_depth)
    j_directions = rays @ np.swapaxes(jTi[:, :3, :3], 1, 2)
    j_points = j_directions * i_depth[:, None] + jTi[:, None, :3, 3]
    depth = j_points[..., 2]
    nearest = MINIMUM_DEPTH_RATIO * i_depth
    valid = depth > nearest
    normalized = j_points[..., :2] / np.where(valid, depth, nearest)[..., None]
    pixels = normalized * intrinsics[:, None, :2] + intrinsics[:, None, 2:]
    return Reprojection(pixels, depth, valid), j_points, j_directions


def _pixel_by_point(j_points: Array, valid: npt.NDArray[np.bool_], intrinsics: Array) -> Array:
    depth = j_points[..., 2]
    inverse_depth = np.divide(1.0, depth, out=np.zeros_like(depth), where=valid)
    scaled = intrinsics[:, None, :2] * inverse_depth[..., None]
    by_point = np.zeros((*depth.shape, 2, 3))
    by_point[..., 0, 0], by_point[..., 1, 1] = scaled[..., 0], scaled[..., 1]
    by_point[..., 2] = -scaled * j_points[..., :2] * inverse_depth[..., None]
    return by_point
