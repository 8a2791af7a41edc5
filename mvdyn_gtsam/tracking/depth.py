"""Depth of a new keyframe on its grid: from sparse points, carried over from another frame by flow, or a
prior's."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import distance_transform_edt, median_filter

from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import GridDepth
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.geometry import backproject, invert_pose, transform_points
from mvdyn_gtsam.tracking.kept_flow import KeptFlow

Array = npt.NDArray[np.float64]

LIKE_LOG_DEPTH = 0.1
"""Difference of log depth within which neighbours are taken for one surface."""
PAPER_STRIDE = 8
"""Pixels to one of those in which the paper measures flow: at 1/8 resolution, as DROID-SLAM does."""


@dataclass(frozen=True)
class DepthBelief:
    """What is believed of a frame's depth before its own flow says more."""

    log_depth: Array
    """``(N,)`` where its solution starts."""
    prior_log_depth: Array
    """``(N,)`` mean before the scale."""
    prior_sigma: Array
    """``(N,)``"""
    log_scale: float


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


def prior_information(config: TrackingConfig) -> float:
    """Inverse variance of log depth that ``depth_prior_lambda`` gives a prior of confidence one.

    The paper's Eq. 4 adds ``w r^2 + lambda (d - D)^2`` with r in pixels of 1/8 resolution and d inverse
    depth. Ours is ``w r^2 / (2 noise_px^2) + (l - L)^2 / (2 sigma^2)`` with r in pixels and l log depth. At
    the median depth, which is 1, a change of d is one of l, so both weigh alike where ``1 / sigma^2`` is
    ``64 lambda / noise_px^2``. Sigma is the same at other depths: errors of a prior grow with depth.
    """
    return PAPER_STRIDE**2 * config.depth_prior_lambda / config.noise_px**2


def with_prior(
    log_depth: Array, carried: npt.NDArray[np.bool_], prior: GridDepth, config: TrackingConfig
) -> DepthBelief:
    """What carrying (``log_depth (N,)``, which is filled in where not ``carried``) and a prior say together.

    Where something was carried, the solution starts there, and both are believed, each by its information;
    elsewhere the prior takes the place of what was filled in. The frame's scale is the one on which most of
    what was carried agrees with the prior. A prior without weight only fills in.
    """
    known = np.isfinite(prior.log_depth)
    both = carried & known
    scale = float(np.median(log_depth[both] - prior.log_depth[both])) if both.any() else 0.0
    log_depth = np.where(known & ~carried, prior.log_depth + scale, log_depth)
    carried_information = config.carried_sigma**-2.0
    information = np.where(known, prior_information(config) * prior.confidence, 0.0)
    share = information / (information + carried_information)
    # nothing would hold a scale of its own where the prior has no weight
    log_scale = scale if information.any() else 0.0
    mean = log_depth - log_scale
    return DepthBelief(
        log_depth,
        mean + share * (np.where(known, prior.log_depth, mean) - mean),
        (carried_information + information) ** -0.5,
        log_scale,
    )


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
