"""The inner loop shared by the flow factors: residuals, weights and Jacobian rows over E edges of N points.

Arrays are planar, ``(2, E, N)`` for x and y, because each then is one contiguous pass. A pixel is
``(z * direction + offset)[:2] / (...)[2]`` with the intrinsics folded into ``direction`` and ``offset``, so its
derivative by z is ``numerator / depth^2`` with a numerator that does not depend on z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factors.projection import MINIMUM_DEPTH_RATIO
from factors.robust import Loss

Array = npt.NDArray[np.float64]

BEHIND_CAMERA_SQUARED_PX = 1e6
"""Squared residual charged to a point behind camera j: losing points must not look like a gain to the optimiser."""


@dataclass(frozen=True, slots=True)
class EdgeRays:
    """Grid rays of frame i as seen by the cameras j, before depth is applied."""

    direction: Array
    """``(3, E, N)`` K_j jRi ray."""
    offset: Array
    """``(3, E, 1)`` K_j jti."""
    numerator: Array
    """``(2, E, N)`` derivative of the pixel by z, times the squared depth in j."""


@dataclass(frozen=True, slots=True)
class FlowTerms:
    """Flow residuals at given depths."""

    inverse_depth: Array
    """``(E, N)`` in frame j."""
    residual: Array
    """``(2, E, N)`` reprojected minus measured, px."""
    by_log_depth: Array
    """``(2, E, N)``"""
    squared_norm: Array
    """``(E, N)`` of the residual; a constant where the point is behind the camera."""
    weight: Array
    """``(E, N)`` measurement information times robust weight, zero behind the camera."""


def edge_rays(rays: Array, jTi: Array, intrinsics: Array) -> EdgeRays:
    """``rays (3, N)``, ``jTi (E, 4, 4)``, ``intrinsics (E, 4)``."""
    edges = len(jTi)
    rows = np.empty((3, edges, 4))
    rows[2] = jTi[:, 2]
    rows[0] = intrinsics[:, :1] * jTi[:, 0] + intrinsics[:, 2:3] * rows[2]
    rows[1] = intrinsics[:, 1:2] * jTi[:, 1] + intrinsics[:, 3:4] * rows[2]
    direction = (rows[:, :, :3].reshape(3 * edges, 3) @ rays).reshape(3, edges, -1)
    offset = rows[:, :, 3:]
    numerator = direction[:2] * offset[2]
    numerator -= direction[2] * offset[:2]
    return EdgeRays(direction, offset, numerator)


def flow_terms(rays: EdgeRays, depth: Array, target: Array, information: Array, loss: Loss) -> FlowTerms:
    """Residuals and weights at z-depths ``depth (N,)``; ``target (2, E, N)`` px, ``information (E, N)``."""
    j_depth = rays.direction[2] * depth
    j_depth += rays.offset[2]
    nearest = MINIMUM_DEPTH_RATIO * depth
    behind = j_depth <= nearest
    any_behind = bool(behind.any())
    if any_behind:
        np.maximum(j_depth, nearest, out=j_depth)
    inverse_depth = np.divide(1.0, j_depth, out=j_depth)
    residual = rays.direction[:2] * depth
    residual += rays.offset[:2]
    residual *= inverse_depth
    residual -= target
    slope = inverse_depth * inverse_depth
    slope *= depth
    by_log_depth = rays.numerator * slope
    squared_norm = residual[0] * residual[0]
    squared_norm += residual[1] * residual[1]
    weight = loss.weight(squared_norm)
    weight *= information
    if any_behind:
        weight[behind] = 0.0
        squared_norm[behind] = BEHIND_CAMERA_SQUARED_PX
    return FlowTerms(inverse_depth, residual, by_log_depth, squared_norm, weight)


def weighted_rows(rays: EdgeRays, terms: FlowTerms, depth: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Rows of the weighted Jacobian, ready for Gram matrices, and the weighted derivative by log depth.

    Returns ``rows (E, 7, 2, N)``: derivative by the six components of the left perturbation of ``jTi`` and, seventh,
    the residual, x and y; and ``by_log_depth (2, E, N)``. Both are multiplied by the root of the weight.
    """
    root_weight = np.sqrt(terms.weight)
    inverse_depth = terms.inverse_depth
    # normalised coordinates from the rays, not from pixels: directions carry K, so undo it once
    x, y = _normalized(rays, depth, inverse_depth, intrinsics)
    weight_x = root_weight * intrinsics[:, :1]
    weight_y = root_weight * intrinsics[:, 1:2]
    edges, points = inverse_depth.shape
    rows = np.empty((edges, 7, 2, points))
    x_weight_x, y_weight_x = x * weight_x, y * weight_x
    x_weight_y, y_weight_y = x * weight_y, y * weight_y
    np.negative(x_weight_x * y, out=rows[:, 0, 0])
    np.multiply(x_weight_x, x, out=rows[:, 1, 0])
    rows[:, 1, 0] += weight_x
    np.negative(y_weight_x, out=rows[:, 2, 0])
    np.multiply(weight_x, inverse_depth, out=rows[:, 3, 0])
    rows[:, 4, 0] = 0.0
    x_weight_x *= inverse_depth
    np.negative(x_weight_x, out=rows[:, 5, 0])
    np.multiply(y_weight_y, y, out=rows[:, 0, 1])
    rows[:, 0, 1] += weight_y
    np.negative(rows[:, 0, 1], out=rows[:, 0, 1])
    np.multiply(x_weight_y, y, out=rows[:, 1, 1])
    rows[:, 2, 1] = x_weight_y
    rows[:, 3, 1] = 0.0
    np.multiply(weight_y, inverse_depth, out=rows[:, 4, 1])
    y_weight_y *= inverse_depth
    np.negative(y_weight_y, out=rows[:, 5, 1])
    np.multiply(terms.residual[0], root_weight, out=rows[:, 6, 0])
    np.multiply(terms.residual[1], root_weight, out=rows[:, 6, 1])
    return rows, terms.by_log_depth * root_weight


def _normalized(rays: EdgeRays, depth: Array, inverse_depth: Array, intrinsics: Array) -> Array:
    pixels = rays.direction[:2] * depth
    pixels += rays.offset[:2]
    pixels *= inverse_depth
    pixels -= intrinsics[:, 2:].T[:, :, None]
    pixels /= intrinsics[:, :2].T[:, :, None]
    return pixels
