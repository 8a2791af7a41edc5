"""Residuals of the refinement as pure functions: L_flow, L_disp and their derivatives.

The depth of a pixel is held as inverse depth ``rho``: flow is nearly linear in it, a plane in space is linear
in it over the image, and far away is zero instead of infinity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.floating]
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FlowTerms:
    """L_flow of one directed pair at its points, linearised."""

    residual: Float
    """``(N, 2)`` px: reprojection minus flow."""
    by_inverse_depth: Float
    """``(N, 2)`` derivative by ``rho``."""
    depth_ratio: Float
    """``(N,)`` depth in frame j over depth in frame i."""
    valid: npt.NDArray[np.bool_]
    """``(N,)`` in front of camera j."""


def flow_terms(
    inverse_depth: Float, rays: Float, jTi: Array, intrinsics_j: Array, target: Float
) -> FlowTerms:
    """L_flow of points ``rho (N,)`` along ``rays (N, 3)`` (z = 1) with flow ``target (N, 2)`` px in view j.

    ``intrinsics_j`` is ``(3, 3)``. Points behind camera j have zero residual and derivative.
    """
    kind = rays.dtype
    # the point of frame j divided by its depth in frame i: finite at infinity
    x, y, z = (rays @ jTi[:3, :3].T.astype(kind)).T + jTi[:3, 3].astype(kind)[:, None] * inverse_depth
    valid = z > 1e-3
    scale = np.where(valid, 1.0 / np.where(valid, z, 1.0), 0.0).astype(kind)
    x *= scale
    y *= scale
    residual, slope = np.empty((len(x), 2), kind), np.empty((len(x), 2), kind)
    for axis, seen in enumerate((x, y)):
        focal, centre = kind.type(intrinsics_j[axis, axis]), kind.type(intrinsics_j[axis, 2])
        across, along = kind.type(jTi[axis, 3]), kind.type(jTi[2, 3])
        residual[:, axis] = seen * focal + centre - target[:, axis]
        slope[:, axis] = (across - seen * along) * (scale * focal)
    residual[~valid] = 0.0
    return FlowTerms(residual, slope, z, valid)


def pose_derivative(
    inverse_depth: Float, rays: Float, jTi: Array, intrinsics_j: Array
) -> tuple[Array, Array]:
    """Derivatives ``(N, 2, 6)`` of the reprojection by right perturbations of ``wTi`` and of ``wTj``.

    Tangent ``[omega, v]``: ``wTi exp(delta)``. With ``jTi = wTj^-1 wTi`` the point ``p_i`` moves by
    ``omega x p_i + v`` in frame i, and ``p_j`` by ``-(omega x p_j + v)`` in frame j.
    """
    point = rays @ jTi[:3, :3].T + inverse_depth[:, None] * jTi[:3, 3]
    scale = 1.0 / point[:, 2]
    fx, fy = intrinsics_j[0, 0], intrinsics_j[1, 1]
    by_point = np.zeros((len(rays), 2, 3))
    by_point[:, 0, 0] = fx * scale
    by_point[:, 0, 2] = -fx * point[:, 0] * scale**2
    by_point[:, 1, 1] = fy * scale
    by_point[:, 1, 2] = -fy * point[:, 1] * scale**2
    # points are scaled by rho, so that a translation of v moves them by rho v
    by_i = by_point @ jTi[:3, :3]
    by_wTi = np.concatenate([_cross_rows(rays, by_i), inverse_depth[:, None, None] * by_i], axis=2)
    by_wTj = -np.concatenate([_cross_rows(point, by_point), inverse_depth[:, None, None] * by_point], axis=2)
    return by_wTi, by_wTj


@dataclass(frozen=True)
class RatioTerms:
    """L_disp of one directed pair at its points, linearised."""

    residual: Float
    """``(N,)`` log of the depth in j over the depth that frame i says j has."""
    by_inverse_depth_i: Float
    """``(N,)``"""
    by_inverse_depth_j: Float
    """``(N,)``"""


def ratio_terms(inverse_depth_i: Float, inverse_depth_j: Float, depth_ratio: Float, jTi: Array) -> RatioTerms:
    """L_disp: ``log(D_j / D_j^flow)`` with ``D_j^flow = depth_ratio / rho_i``.

    ``max(a, b) / min(a, b) - 1`` of the paper is ``exp(|log(a / b)|) - 1``: the same to first order, and the
    logarithm is symmetric and does not run away. ``depth_ratio`` is ``FlowTerms.depth_ratio``.
    """
    kind = inverse_depth_i.dtype
    ratio = np.maximum(depth_ratio, 1e-3)
    residual = np.log(inverse_depth_i / (ratio * inverse_depth_j))
    by_i = 1.0 / inverse_depth_i - kind.type(jTi[2, 3]) / ratio
    return RatioTerms(residual.astype(kind), by_i.astype(kind), (-1.0 / inverse_depth_j).astype(kind))


def confidence(cost: Float, scale: float) -> Float:
    """``c`` in (0, 1] that minimises ``c * cost + scale * log(1 / c)``: ``min(1, scale / cost)``.

    The confidence of the paper is thus an iteratively reweighted least-squares weight and needs no variable:
    the minimum over it is ``cost`` below ``scale`` and ``scale * (1 + log(cost / scale))`` beyond.
    """
    return np.minimum(1.0, scale / np.maximum(cost, 1e-12)).astype(cost.dtype)


def reweighted(residual: Float, floor: float) -> Float:
    """Weight ``1 / max(|r|, floor)`` under which the square of ``r`` stands for its absolute value."""
    return (1.0 / np.maximum(np.abs(residual), floor)).astype(residual.dtype)


def _cross_rows(points: Float, by_point: Array) -> Array:
    """``(N, 2, 3)``: derivative by ``omega`` of what moves points by ``omega x point``."""
    return np.cross(points[:, None, :], by_point)
