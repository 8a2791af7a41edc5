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
    """``(N, 2)`` px: reprojection minus flow; its transpose is in one piece of memory."""
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
    return turned_flow_terms(inverse_depth, turned_rays(rays, jTi), jTi[:3, 3], intrinsics_j, target)


def turned_rays(rays: Float, jTi: Array) -> Float:
    """``rays (N, 3)`` of frame i in the axes of frame j, ``(3, N)``."""
    return np.asarray(jTi[:3, :3].astype(rays.dtype) @ rays.T)


def turned_flow_terms(
    inverse_depth: Float, turned: Float, translation: Array, intrinsics_j: Array, target: Float
) -> FlowTerms:
    """``flow_terms`` of rays that are ``turned (3, N)`` already, which is the same at every depth.

    ``translation`` of ``jTi`` is ``(3,)`` or ``(3, N)``, ``intrinsics_j`` is ``(3, 3)`` or ``(N, 3, 3)``.
    """
    kind = turned.dtype
    shift = translation.astype(kind)
    # the point of frame j divided by its depth in frame i: finite at infinity
    x, y, z = (turned[axis] + shift[axis] * inverse_depth for axis in range(3))
    valid = z > 1e-3
    behind = not valid.all()
    scale = kind.type(1.0) / (np.where(valid, z, kind.type(1.0)) if behind else z)
    # each axis in one piece of memory, as everything here is done by axis
    residual, slope = np.empty((2, len(x)), kind), np.empty((2, len(x)), kind)
    for axis, seen in enumerate((x, y)):
        focal, centre = (intrinsics_j[..., axis, column].astype(kind) for column in (axis, 2))
        seen *= scale
        np.multiply(seen, focal, out=residual[axis])
        residual[axis] += centre - target[:, axis]
        np.multiply(seen, -shift[2], out=slope[axis])
        slope[axis] += shift[axis]
        slope[axis] *= scale * focal
    if behind:
        residual[:, ~valid] = slope[:, ~valid] = 0.0
    return FlowTerms(residual.T, slope.T, z, valid)


def twist_derivative(point: Array, inverse_depth: Array, intrinsics_j: Array) -> Array:
    """Derivative ``(3, 6, N)`` of the reprojection, in x and y px, and of L_disp's residual by a twist
    ``[omega, v]`` of the points in frame j, which moves them by ``omega x p + v``.

    ``point (3, N)`` are the points divided by their depths in i, whose inverses are ``inverse_depth (N,)``.
    By right perturbations of ``wTi`` the derivative is this times the adjoint of ``jTi``, by those of ``wTj``
    its negative. ``intrinsics_j`` is ``(3, 3)`` or ``(N, 3, 3)``.
    """
    x, y = point[0] / point[2], point[1] / point[2]
    # a translation counts by the true depth in j
    near = inverse_depth / point[2]
    result = np.zeros((3, 6, len(near)))
    fx, fy = intrinsics_j[..., 0, 0], intrinsics_j[..., 1, 1]
    result[0, 0], result[0, 1], result[0, 2] = -fx * x * y, fx * (1.0 + x * x), -fx * y
    result[0, 3], result[0, 5] = fx * near, -fx * x * near
    result[1, 0], result[1, 1], result[1, 2] = -fy * (1.0 + y * y), fy * x * y, fy * x
    result[1, 4], result[1, 5] = fy * near, -fy * y * near
    # of log rho_i - log rho_j - log z
    result[2, 0], result[2, 1], result[2, 5] = -y, x, -near
    return result


@dataclass(frozen=True)
class RatioTerms:
    """L_disp of one directed pair at its points, linearised."""

    residual: Float
    """``(N,)`` log of the depth in j over the depth that frame i says j has."""
    by_inverse_depth_i: Float
    """``(N,)``"""
    by_inverse_depth_j: Float
    """``(N,)``"""


def ratio_terms(
    inverse_depth_i: Float, inverse_depth_j: Float, depth_ratio: Float, along: Array | float
) -> RatioTerms:
    """L_disp: ``log(D_j / D_j^flow)`` with ``D_j^flow = depth_ratio / rho_i``.

    ``max(a, b) / min(a, b) - 1`` of the paper is ``exp(|log(a / b)|) - 1``: the same to first order, and the
    logarithm is symmetric and does not run away. ``depth_ratio`` is ``FlowTerms.depth_ratio``, ``along`` the
    translation of ``jTi`` along the axis of camera j, one number or ``(N,)``.
    """
    kind = inverse_depth_i.dtype
    ratio = np.maximum(depth_ratio, 1e-3)
    residual = np.log(inverse_depth_i / (ratio * inverse_depth_j))
    by_i = 1.0 / inverse_depth_i - np.asarray(along, kind) / ratio
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
