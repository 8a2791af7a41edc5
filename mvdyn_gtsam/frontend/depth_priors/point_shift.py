"""The offset along the optical axis that MoGe leaves open, from the known intrinsics."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SAMPLES = 64
"""Rows and columns of the points that are used, as MoGe's own code does (``recover_focal_shift_numpy``)."""
LEAST_SAMPLES = 20
ITERATIONS = 20
"""Of Gauss-Newton steps; as many as needed, usually 5."""


def recover_shift(
    points: npt.NDArray[np.floating], known: npt.NDArray[np.bool_], focal: tuple[float, float]
) -> float | None:
    """``s`` for which ``points (H, W, 3)`` with z + s lie on the rays of their pixels; ``known (H, W)``.

    MoGe's points are right up to it: https://github.com/microsoft/MoGe (moge/utils/geometry_numpy.py,
    ``solve_optimal_shift``: ``min |focal xy / (z + s) - uv|``). ``focal`` is fx, fy in pixels of the points;
    as there, uv is counted from the middle of the image, where the network takes the optical axis to be.
    Unlike there, a median begins and Cauchy's loss follows, so that edges and mistakes do not pull. None
    where too few points are known or none fits.
    """
    xy, z, uv = _samples(points, known, focal)
    if len(z) < LEAST_SAMPLES:
        return None
    shift = _median_shift(xy, z, uv)
    for _ in range(ITERATIONS):
        depth = z + shift
        ahead = depth > 1e-3 * np.abs(depth).max()
        if ahead.sum() < LEAST_SAMPLES:
            return None
        seen = xy[ahead] / depth[ahead, None]
        residual = seen - uv[ahead]
        distance = np.linalg.norm(residual, axis=1)
        spread = max(1.4826 * float(np.median(distance)), 1e-6)
        weight = 1.0 / (1.0 + (distance / spread) ** 2)
        slope = -seen / depth[ahead, None]
        information = float((weight[:, None] * slope**2).sum())
        if not information > 0.0:
            return None
        step = -float((weight[:, None] * slope * residual).sum()) / information
        shift += step
        if abs(step) <= 1e-7 * float(np.median(depth[ahead])):
            break
    return shift if np.median(z + shift) > 0.0 else None


def _samples(
    points: npt.NDArray[np.floating], known: npt.NDArray[np.bool_], focal: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """``xy (N, 2)`` times focal, ``z (N,)`` and ``uv (N, 2)`` px of every few known points."""
    height, width = known.shape
    rows = np.unique(np.linspace(0, height - 1, SAMPLES).round().astype(int))
    columns = np.unique(np.linspace(0, width - 1, SAMPLES).round().astype(int))
    y, x = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
    picked = points[y, x].astype(np.float64)
    good = known[y, x] & np.isfinite(picked).all(axis=1)
    uv = np.stack([x - 0.5 * (width - 1), y - 0.5 * (height - 1)], axis=1)
    return picked[good, :2] * np.asarray(focal), picked[good, 2], uv[good]


def _median_shift(xy: Array, z: Array, uv: Array) -> float:
    """Weighted median of what each point says alone; the middle of the image says least."""
    squared = (uv**2).sum(axis=1)
    usable = squared > 0.0
    alone = (xy[usable] * uv[usable]).sum(axis=1) / squared[usable] - z[usable]
    order = np.argsort(alone)
    total = np.cumsum(np.sqrt(squared[usable])[order])
    return float(alone[order][np.searchsorted(total, 0.5 * total[-1])])
