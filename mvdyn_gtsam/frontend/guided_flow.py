"""Geometry-guided flow: the classical way to bridge wide baselines and fast motion.

The current depth and poses predict the flow; image j is warped by the prediction into view i and only
the residual is measured. It is trusted where the two directions agree, the warped patches look alike and
the depths of both views say that the same surface is seen. Repeating prediction, flow and solve stands in
for the learned recurrent flow update of the paper.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import (
    DenseFlow,
    Float32,
    FlowConfig,
    FlowPair,
    Image,
    inside,
    pixel_raster,
    to_grey,
)
from mvdyn_gtsam.geometry import invert_pose

Array = npt.NDArray[np.float64]


def predicted_flow(
    depth_i: npt.NDArray[np.floating],
    intrinsics_i: Array,
    intrinsics_j: Array,
    jTi: Array,
    shape_j: tuple[int, ...],
) -> Float32:
    """Flow ``(H_i, W_i, 2) float32`` px of a static scene with z-depth ``depth_i (H_i, W_i)``.

    NaN where the depth is invalid or the point is behind camera j or outside its image ``(H_j, W_j)``.
    """
    return _predict(depth_i, intrinsics_i, intrinsics_j, jTi, shape_j)[0]


def guided_flow(
    flow: DenseFlow,
    image_i: Image,
    image_j: Image,
    depth_i: npt.NDArray[np.floating],
    depth_j: npt.NDArray[np.floating],
    intrinsics_i: Array,
    intrinsics_j: Array,
    jTi: Array,
    config: FlowConfig,
) -> FlowPair:
    """Flow between two views whose depths ``(H, W)`` (NaN = unknown) and relative pose are known roughly.

    Images ``(H, W[, 3]) uint8`` may differ in size and intrinsics. The weights are those of ``flow`` times
    the correlation of the patches times the occlusion test.
    """
    grey_i, grey_j = to_grey(image_i), to_grey(image_j)
    iTj = invert_pose(jTi)
    seed, forward_depth = _predict(depth_i, intrinsics_i, intrinsics_j, jTi, grey_j.shape)
    seed_backward, backward_depth = _predict(depth_j, intrinsics_j, intrinsics_i, iTj, grey_i.shape)
    pair = flow.measure(grey_i, grey_j, seed, seed_backward)
    return FlowPair(
        pair.forward,
        pair.backward,
        pair.forward_weight * guided_weight(pair.forward, grey_i, grey_j, forward_depth, depth_j, config),
        pair.backward_weight * guided_weight(pair.backward, grey_j, grey_i, backward_depth, depth_i, config),
    )


def guided_weight(
    flow: Float32,
    grey_i: Image,
    grey_j: Image,
    transformed_depth: Float32,
    depth_j: npt.NDArray[np.floating],
    config: FlowConfig,
) -> Float32:
    """``(H_i, W_i)`` in [0, 1]: patch correlation times occlusion test at the targets of ``flow``."""
    target = pixel_raster(flow.shape) + flow
    warped = cv2.remap(grey_j, target, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    correlation = local_correlation(grey_i, warped, config.ncc_window, config.ncc_noise)
    slope = np.float32(1.0 / (config.ncc_high - config.ncc_low))
    weight = np.clip((correlation - np.float32(config.ncc_low)) * slope, 0.0, 1.0)
    weight *= occlusion_weight(target, transformed_depth, depth_j, config)
    return weight


def local_correlation(
    grey_i: npt.NDArray[np.uint8], grey_j: npt.NDArray[np.uint8], window: int, noise: float
) -> Float32:
    """``(H, W)`` normalised cross-correlation in [-1, 1] of ``window``-sided squares of two images.

    ``noise`` (grey levels) is added to both contrasts: flat windows correlate with nothing.
    """
    a, b = grey_i.astype(np.float32), grey_j.astype(np.float32)
    size = (window, window)
    mean_a, mean_b = cv2.blur(a, size), cv2.blur(b, size)
    covariance = cv2.blur(a * b, size) - mean_a * mean_b
    variance_a = np.maximum(cv2.sqrBoxFilter(a, cv2.CV_32F, size) - mean_a * mean_a, 0.0)
    variance_b = np.maximum(cv2.sqrBoxFilter(b, cv2.CV_32F, size) - mean_b * mean_b, 0.0)
    floor = np.float32(noise * noise)
    correlation: Float32 = covariance / np.sqrt((variance_a + floor) * (variance_b + floor))
    return correlation


def occlusion_weight(
    target: Float32,
    transformed_depth: Float32,
    depth_j: npt.NDArray[np.floating],
    config: FlowConfig,
) -> Float32:
    """``(H_i, W_i)``: exp(-(log depth difference / tolerance)^2) of the points of i, given their depth in
    camera j, against the depth map of j at their targets; 1 where either is unknown."""
    depth = np.asarray(depth_j, np.float32)
    there = cv2.remap(depth, target, None, cv2.INTER_NEAREST, borderValue=float("nan"))
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = np.log(transformed_depth / there) / np.float32(config.occlusion_tolerance)
    weight: Float32 = np.exp(-np.square(difference))
    weight[np.isnan(weight)] = 1.0
    return weight


def _predict(
    depth_i: npt.NDArray[np.floating],
    intrinsics_i: Array,
    intrinsics_j: Array,
    jTi: Array,
    shape_j: tuple[int, ...],
) -> tuple[Float32, Float32]:
    """The predicted flow, and the depth ``(H_i, W_i)`` of its points in camera j."""
    flow, depth = _project(depth_i, intrinsics_i, intrinsics_j, jTi)
    flow[~inside(flow + pixel_raster(flow.shape), shape_j, 0)] = np.nan
    return flow, depth


def _project(
    depth_i: npt.NDArray[np.floating], intrinsics_i: Array, intrinsics_j: Array, jTi: Array
) -> tuple[Float32, Float32]:
    """Flow ``(H, W, 2)`` and depth in camera j ``(H, W)``; NaN at or behind the camera."""
    height, width = depth_i.shape
    depth = np.asarray(depth_i, np.float32)
    homography = intrinsics_j @ jTi[:3, :3] @ np.linalg.inv(intrinsics_i)
    epipole = (intrinsics_j @ jTi[:3, 3]).astype(np.float32)
    x, y = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]

    def component(row: int) -> Float32:
        a, b, c = homography[row]
        ray = (a * x).astype(np.float32) + (b * y + c).astype(np.float32)
        ray *= depth
        ray += epipole[row]
        return ray

    depth_j = component(2)
    depth_j[~(depth_j > 0.0) | ~(depth > 0.0)] = np.nan
    inverse = 1.0 / depth_j
    flow = np.empty((height, width, 2), np.float32)
    flow[..., 0] = component(0) * inverse - x.astype(np.float32)
    flow[..., 1] = component(1) * inverse - y.astype(np.float32)
    return flow, depth_j
