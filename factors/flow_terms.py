"""The inner loop shared by the flow factors: residuals, weights and Jacobian rows over E edges of N points.

Arrays are planar, ``(2, E, N)`` for x and y, because each then is one contiguous pass. A pixel is
``(z * direction + offset)[:2] / (...)[2]`` with the intrinsics folded into ``direction`` and ``offset``, so
its derivative by z is ``numerator / depth^2`` with a numerator that does not depend on z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factors.projection import MINIMUM_DEPTH_RATIO
from factors.robust import Loss

Array = npt.NDArray[np.float64]

BEHIND_CAMERA_SQUARED_PX = 1e6
"""Squared residual charged to a point behind camera j: losing points must not look like a gain to the
optimiser."""


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
    """Flow residuals at given depths; ``flow_terms`` fills the arrays of an existing one."""

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
    scratch: Array
    """``(2, E, N)`` for intermediate results."""

    @staticmethod
    def empty(edges: int, points: int) -> FlowTerms:
        """Room for the terms of E edges and N points."""
        single, double = (edges, points), (2, edges, points)
        return FlowTerms(
            np.empty(single),
            np.empty(double),
            np.empty(double),
            np.empty(single),
            np.empty(single),
            np.empty(double),
        )


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


def flow_terms(
    rays: EdgeRays, depth: Array, target: Array, information: Array, loss: Loss, out: FlowTerms
) -> None:
    """Fill ``out`` at z-depths ``depth (N,)``; ``target (2, E, N)`` px, ``information (E, N)``.

    Writing into ``out`` matters: fresh arrays of this size cost more in page faults than in arithmetic.
    """
    inverse_depth, residual, scratch = out.inverse_depth, out.residual, out.scratch
    np.multiply(rays.direction[2], depth, out=inverse_depth)
    inverse_depth += rays.offset[2]
    nearest = MINIMUM_DEPTH_RATIO * depth
    behind = inverse_depth <= nearest
    any_behind = bool(behind.any())
    if any_behind:
        np.maximum(inverse_depth, nearest, out=inverse_depth)
    np.divide(1.0, inverse_depth, out=inverse_depth)
    np.multiply(rays.direction[:2], depth, out=residual)
    residual += rays.offset[:2]
    residual *= inverse_depth
    residual -= target
    slope = np.multiply(inverse_depth, inverse_depth, out=scratch[0])
    slope *= depth
    np.multiply(rays.numerator, slope, out=out.by_log_depth)
    np.multiply(residual, residual, out=scratch)
    np.add(scratch[0], scratch[1], out=out.squared_norm)
    np.multiply(loss.weight(out.squared_norm), information, out=out.weight)
    if any_behind:
        out.weight[behind] = 0.0
        out.squared_norm[behind] = BEHIND_CAMERA_SQUARED_PX


def weighted_rows(terms: FlowTerms, edge: int, target: Array, intrinsics: Array, out: Array) -> Array:
    """Rows of one edge's weighted Jacobian, ready for Gram matrices; returns its root weight ``(N,)``.

    Fills ``out (7, 2, N)`` with the derivatives of x and y by the six components of the left perturbation of
    ``jTi`` and, seventh, the residual, all times the root of the weight. ``target (2, N)`` px, ``intrinsics
    (4,)``.
    """
    focal_x, focal_y, centre_x, centre_y = intrinsics
    residual, inverse_depth = terms.residual[:, edge], terms.inverse_depth[edge]
    root_weight = np.sqrt(terms.weight[edge])
    x = residual[0] + target[0]
    x -= centre_x
    x *= 1.0 / focal_x
    y = residual[1] + target[1]
    y -= centre_y
    y *= 1.0 / focal_y
    weight_x, weight_y = focal_x * root_weight, focal_y * root_weight
    # x: f_x [-x y, 1 + x^2, -y, 1/z, 0, -x/z]    y: f_y [-(1 + y^2), x y, x, 0, 1/z, -y/z]
    np.multiply(y, -weight_x, out=out[2, 0])
    np.multiply(x, out[2, 0], out=out[0, 0])
    x_weight_x = x * weight_x
    np.multiply(x_weight_x, x, out=out[1, 0])
    out[1, 0] += weight_x
    np.multiply(weight_x, inverse_depth, out=out[3, 0])
    out[4, 0] = 0.0
    np.multiply(x_weight_x, -inverse_depth, out=out[5, 0])
    np.multiply(x, weight_y, out=out[2, 1])
    np.multiply(out[2, 1], y, out=out[1, 1])
    y_weight_y = y * -weight_y
    np.multiply(y_weight_y, y, out=out[0, 1])
    out[0, 1] -= weight_y
    out[3, 1] = 0.0
    np.multiply(weight_y, inverse_depth, out=out[4, 1])
    np.multiply(y_weight_y, inverse_depth, out=out[5, 1])
    np.multiply(residual, root_weight, out=out[6])
    return root_weight


def read_only_copy(array: Array) -> Array:
    """A float64, C-contiguous copy that raises when written to: a factor's measurement must never change."""
    copy = np.array(array, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy
