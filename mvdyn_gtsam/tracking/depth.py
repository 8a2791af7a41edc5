"""Depth of a new keyframe on its grid: from sparse points, or carried over from another frame by flow."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import distance_transform_edt, median_filter

from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.geometry import backproject, invert_pose, transform_points
from mvdyn_gtsam.tracking.kept_flow import KeptFlow

Array = npt.NDArray[np.float64]

LIKE_LOG_DEPTH = 0.1
"""Difference of log depth within which neighbours are taken for one surface."""


def sparse_log_depth(pixels: Array, depth: Array, grid: Grid) -> Array:
    """Log depth ``(N,)`` at the grid from ``depth (M,)`` at ``pixels (M, 2)``: linear, nearest outside."""
    log_depth = np.log(depth)
    result = np.asarray(NearestNDInterpolator(pixels, log_depth)(grid.pixels), dtype=np.float64)
    if len(pixels) >= 4 and np.linalg.matrix_rank(pixels - pixels[0]) == 2:
        linear = LinearNDInterpolator(pixels, log_depth)(grid.pixels)
        result = np.where(np.isfinite(linear), linear, result)
    return result


def carried_log_depth(
    flow_to_source: KeptFlow,
    grid: Grid,
    wTc: Array,
    source_grid: Grid,
    source_log_depth: Array,
    source_wTc: Array,
    source_intrinsics: Array,
    minimum_weight: float,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Log depth ``(N,)`` at ``grid`` from a source frame's, and where it was carried (the rest is filled).

    The source's depth is read where the flow leads, and the point there brought into the new frame.
    ``source_intrinsics (3, 3)``. Points with a weight below ``minimum_weight`` take the nearest carried
    depth. With nothing carried, everything is filled with the source's median.
    """
    target = flow_to_source.target
    raster = (target - source_grid.pixels[0].astype(np.float32)) / np.float32(source_grid.stride)
    table = source_log_depth.reshape(source_grid.shape).astype(np.float32)
    there = cv2.remap(
        table, raster.reshape(*grid.shape, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    depth = np.exp(there.ravel().astype(np.float64))
    points = backproject(target.astype(np.float64), depth, source_intrinsics)
    z = transform_points(invert_pose(wTc) @ source_wTc, points)[:, 2]
    carried = (flow_to_source.weight >= minimum_weight) & (z > 0.01 * depth)
    if not carried.any():
        return np.full(len(z), np.median(source_log_depth)), carried
    log_depth = np.log(np.where(carried, z, 1.0))
    return fill(log_depth, carried, grid), carried


def smoothed_log_depth(log_depth: Array, information: Array, grid: Grid) -> Array:
    """Log depth ``(N,)`` averaged over 5 x 5 grid points by information, nearness and likeness.

    Bilateral around the 3 x 3 median: noise of single points would tear the images that guided flow warps,
    while an average across depth edges would bend them.
    """
    rows, cols = grid.shape
    table = log_depth.reshape(rows, cols)
    middle = median_filter(table, 3, mode="nearest")
    padded = [np.pad(a, 2, mode="edge") for a in (table, middle, information.reshape(rows, cols))]
    total, weight = np.zeros((rows, cols)), np.zeros((rows, cols))
    for y in range(5):
        for x in range(5):
            value, around, share = (a[y : y + rows, x : x + cols] for a in padded)
            unlike = (around - middle) ** 2 + (value - around) ** 2
            near = 0.5 * ((x - 2) ** 2 + (y - 2) ** 2)
            share = share * np.exp(-unlike / LIKE_LOG_DEPTH**2 - near)
            total += share * value
            weight += share
    usable = weight > 0.0
    return np.where(usable, total / np.where(usable, weight, 1.0), middle).ravel()


def fill(values: Array, known: npt.NDArray[np.bool_], grid: Grid) -> Array:
    """``values (N,)`` with the unknown replaced by the nearest known on the grid."""
    nearest = distance_transform_edt(~known.reshape(grid.shape), return_distances=False, return_indices=True)
    table: Array = values.reshape(grid.shape)[tuple(nearest)]
    return table.ravel()
