"""Dense depth from few points: the tracker's grid brought up to the image, and sparse SfM points spread."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import Delaunay, QhullError, cKDTree

from mvdyn_gtsam.frontend.dense_flow import pixel_raster, to_grey
from mvdyn_gtsam.frontend.grid import Grid

Float32 = npt.NDArray[np.float32]

FLOOR = 1e-3
"""What is left of the share of a point that is unlike, or was filled in."""
DRAWING_BITS = 8
"""Fractional bits of the corners of drawn triangles."""


def upsample_depth(
    image: npt.NDArray[np.uint8],
    grid: Grid,
    depth: npt.NDArray[np.floating],
    weight: npt.NDArray[np.floating],
    *,
    contrast: float = 20.0,
    log_prior: Float32 | None = None,
) -> tuple[Float32, Float32]:
    """Depth and confidence, ``(H, W) float32``, of grid depths that follow the image's edges.

    Joint bilateral upsampling (https://dl.acm.org/doi/10.1145/1276377.1276497) of log depth: a pixel takes
    the four grid points around it by nearness, by likeness of luminance (``contrast`` grey levels)
    and by ``weight (N,)``. Points of ``depth (N,)`` that are not positive and finite, or have no weight, are
    filled in from their neighbours and get a confidence near 0. The depth is finite and within the range
    of the depths given; raises ValueError when none is usable.

    Where ``log_prior (H, W)``, the log depth of a prior, is known (not NaN), the detail between grid points
    is the prior's: what is brought up is how far the grid is from it.
    """
    plain, confidence = _upsampled(image, grid, depth, weight, contrast)
    if log_prior is None:
        return np.exp(plain), confidence
    prior_at_grid = grid.sample(log_prior)
    known = np.isfinite(log_prior)
    if not (np.isfinite(prior_at_grid) & _usable(depth, weight)).any():
        return np.exp(plain), confidence
    ratio = np.asarray(depth) / np.exp(prior_at_grid)
    correction, trust = _upsampled(image, grid, ratio, weight, contrast)
    log_dense = np.where(known, log_prior + correction, plain)
    return np.exp(log_dense), np.where(known, trust, confidence)


def _usable(depth: npt.NDArray[np.floating], weight: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    usable: npt.NDArray[np.bool_] = np.isfinite(depth) & (depth > 0.0) & np.isfinite(weight) & (weight > 0.0)
    return usable


def _upsampled(
    image: npt.NDArray[np.uint8],
    grid: Grid,
    depth: npt.NDArray[np.floating],
    weight: npt.NDArray[np.floating],
    contrast: float,
) -> tuple[Float32, Float32]:
    """Log of ``depth`` and its confidence ``(H, W)``."""
    usable = _usable(depth, weight)
    if not usable.any():
        raise ValueError("no grid point has a positive depth and weight")
    trust = np.where(usable, np.minimum(weight, 1.0), 0.0).astype(np.float32).reshape(grid.shape)
    log_depth = np.log(np.where(usable, depth, 1.0)).astype(np.float32).reshape(grid.shape)
    log_depth = filled(log_depth, trust)
    grey = cv2.GaussianBlur(to_grey(image), (0, 0), 1.0).astype(np.float32)
    table = np.stack([log_depth, grid.sample(grey).reshape(grid.shape), trust], axis=-1)
    return _joint_bilateral(grey, grid, table, contrast)


def interpolate_sparse_depth(
    pixels: npt.NDArray[np.floating], depth: npt.NDArray[np.floating], width: int, height: int
) -> Float32:
    """Dense depth ``(H, W) float32`` through sparse points ``(M, 2)`` px with z-depth ``(M,)``.

    Inverse depth is interpolated linearly over the points' Delaunay triangles, which is exact on planes,
    and continued smoothly beyond their hull. Points unlike nearly all around them, outside the image
    or without a positive depth are ignored; raises ValueError when none is left.
    """
    pixels, depth = np.asarray(pixels, np.float64), np.asarray(depth, np.float64)
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(pixels).all(axis=1) & np.isfinite(depth) & (depth > 0.0)
        usable &= (pixels >= -0.5).all(axis=1) & (pixels[:, 0] < width - 0.5) & (pixels[:, 1] < height - 0.5)
    if not usable.any():
        raise ValueError("no sparse point with a positive depth lies inside the image")
    points, inverse = pixels[usable].astype(np.float64), 1.0 / depth[usable].astype(np.float64)
    kept = _like_their_neighbours(points, inverse)
    points, inverse = points[kept], inverse[kept]
    values = _triangulated(points, inverse, width, height)
    if values is None:
        raster = pixel_raster((height, width)).reshape(-1, 2)
        values = inverse[cKDTree(points).query(raster)[1]].reshape(height, width).astype(np.float32)
    known = np.isfinite(values).astype(np.float32)
    return 1.0 / filled(np.nan_to_num(values), known)


def _joint_bilateral(grey: Float32, grid: Grid, table: Float32, contrast: float) -> tuple[Float32, Float32]:
    """Log depth and confidence ``(H, W)`` of ``table (rows, cols, 3)``: log depth, luminance, weight."""
    height, width = grey.shape
    rows, cols = grid.shape
    y = np.interp(np.arange(height), grid.pixels[::cols, 1], np.arange(rows))
    x = np.interp(np.arange(width), grid.pixels[:cols, 0], np.arange(cols))
    top, left = np.floor(y).astype(int), np.floor(x).astype(int)
    below, right = (y - top).astype(np.float32)[:, None], (x - left).astype(np.float32)
    total, value, confidence = (np.zeros((height, width), np.float32) for _ in range(3))
    steepness = np.float32(-1.0 / contrast**2)
    for row, near_row in ((top, 1.0 - below), (np.minimum(top + 1, rows - 1), below)):
        for col, near_col in ((left, 1.0 - right), (np.minimum(left + 1, cols - 1), right)):
            # one axis after the other: half the time of both at once
            log_depth, luminance, trust = (table[..., k].take(row, 0).take(col, 1) for k in range(3))
            share = np.exp(np.square(grey - luminance) * steepness)
            # Unlike all four: they share the pixel by nearness alone.
            share += np.float32(FLOOR)
            share *= near_row * near_col
            confidence += share * trust
            value += share * (trust + np.float32(FLOOR)) * log_depth
            total += share
    value /= confidence + np.float32(FLOOR) * total
    confidence /= total
    return value, confidence


def _triangulated(
    pixels: npt.NDArray[np.float64], values: npt.NDArray[np.float64], width: int, height: int
) -> Float32 | None:
    """``(H, W)`` linear over the Delaunay triangles, NaN outside; None when the points span no triangle."""
    try:
        corners = Delaunay(pixels).simplices
    except (QhullError, ValueError):
        return None
    # Drawn rather than located: scipy's interpolator takes 60 ms for what drawing does in 10.
    fixed = np.rint(pixels[corners] * (1 << DRAWING_BITS)).astype(np.int32)
    label = np.full((height, width), -1, np.int32)
    for number, triangle in enumerate(fixed):
        cv2.fillConvexPoly(label, triangle, number, cv2.LINE_8, DRAWING_BITS)
    (x0, y0), (x1, y1), (x2, y2) = np.moveaxis(pixels[corners], 0, -1)
    v0, v1, v2 = values[corners].T
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_x = ((v1 - v0) * (y2 - y0) - (v2 - v0) * (y1 - y0)) / area
        slope_y = ((v2 - v0) * (x1 - x0) - (v1 - v0) * (x2 - x0)) / area
    planes = np.stack([slope_x, slope_y, v0 - slope_x * x0 - slope_y * y0], axis=1)
    planes[~np.isfinite(planes).all(axis=1)] = np.nan
    drawn = np.where(label >= 0, label, len(corners))
    table = np.vstack([planes, np.full(3, np.nan)]).astype(np.float32)
    raster = pixel_raster((height, width))
    dense = table[drawn, 0] * raster[..., 0] + table[drawn, 1] * raster[..., 1] + table[drawn, 2]
    # Drawing covers up to a pixel too much, where the plane of a sliver may run away.
    extremes = np.vstack([np.sort(values[corners], axis=1)[:, [0, 2]], np.full(2, np.nan)]).astype(np.float32)
    result: Float32 = np.clip(dense, extremes[drawn, 0], extremes[drawn, 1])
    return result


def _like_their_neighbours(
    pixels: npt.NDArray[np.float64], inverse: npt.NDArray[np.float64]
) -> npt.NDArray[np.bool_]:
    """``(M,)``: whether at least two of the 8 nearest points have a depth within a fifth of the point's."""
    if len(pixels) <= 8:
        return np.ones(len(pixels), bool)
    neighbours = cKDTree(pixels).query(pixels, k=9)[1][:, 1:]
    like = np.abs(np.log(inverse[neighbours] / inverse[:, None])) < math.log(1.2)
    kept: npt.NDArray[np.bool_] = like.sum(axis=1) >= 2
    return kept if kept.any() else np.ones(len(pixels), bool)


def filled(values: Float32, weight: Float32) -> Float32:
    """``values (R, C)`` where ``weight (R, C)`` is 1, the average of ever wider surroundings as it falls to
    0.

    Push-pull (https://dl.acm.org/doi/10.1145/237170.237200, section 4): a pyramid of weighted averages.
    """
    if min(values.shape) == 1 or weight.min() >= 1.0:
        total = float(weight.sum())
        average = np.float32((values * weight).sum() / total) if total > 0.0 else np.float32(0.0)
        return weight * values + (1.0 - weight) * average
    size = ((values.shape[1] + 1) // 2, (values.shape[0] + 1) // 2)
    mass = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    pulled = cv2.resize(weight * values, size, interpolation=cv2.INTER_AREA)
    coarse = np.divide(pulled, mass, out=np.zeros_like(mass), where=mass > 0.0)
    around = filled(coarse, np.minimum(2.0 * mass, 1.0))
    pushed = cv2.resize(around, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    result: Float32 = weight * values + (1.0 - weight) * pushed
    return result
