"""Flow between two images at the points of a grid: what ``dense_flow`` and ``guided_flow`` measure for every
pixel, for a fraction of the time.

The tracker keeps flow at some hundred points. Only the optical flow itself needs all pixels; composing it
with what predicted it, and everything its weight is made of, is done at those points alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32, FlowConfig, GridFlow, Image, inside
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.geometry import invert_pose

Array = npt.NDArray[np.float64]

NOWHERE = np.float32(-1e7)
"""Where the target of a pixel is unknown: so far out that no interpolation with it falls into an image."""


@runtime_checkable
class OneWayFlow(Protocol):
    """A ``DenseFlow`` that can also measure one direction between two grey images of one size."""

    config: FlowConfig

    def flow(self, grey_i: Image, grey_j: Image, halved: int = 0) -> Float32:
        """``(H, W, 2)`` px; safe to call from several threads.

        ``halved`` is how often the images have been halved already, at most ``config.finest_scale`` times.
        """
        ...


@dataclass(frozen=True)
class GridView:
    """What predicts the flow from a view: its pinhole, and smooth depth on its grid."""

    grid: Grid
    size: tuple[int, int]
    """width, height"""
    intrinsics: Array
    """``(3, 3)``"""
    depth: Array
    """``(N,)`` z-depth at the grid."""


@dataclass(frozen=True)
class _OneWay:
    """One direction: ``residual`` leads from pixel x to where ``seed`` (if any) is to be read."""

    residual: Float32
    """``(H_i, W_i, 2)`` px"""
    seed: Float32 | None
    """``(H_i, W_i, 2)`` predicted position in image j, ``NOWHERE`` where unknown."""
    size_j: tuple[int, ...]
    """height, width of image j"""

    def follow(self, pixels: Float32, residual: Float32) -> tuple[Float32, npt.NDArray[np.bool_]]:
        """Positions in image j of ``pixels (R, C, 2)`` with the given ``residual``, and where known."""
        moved = pixels + residual
        if self.seed is None:
            return moved, np.ones(moved.shape[:2], bool)
        target = _bilinear(self.seed, moved)
        return target, inside(target, self.size_j, 0)


def measure_grid(
    flow: OneWayFlow, grey_i: Image, grey_j: Image, grid_i: Grid, grid_j: Grid
) -> tuple[GridFlow, GridFlow]:
    """Plain flow between grey images ``(H, W)`` of one size: ``(i -> j at grid_i, j -> i at grid_j)``.

    The weights are those of ``dense_flow.measure_both``. Raises ValueError for images of different size.
    """
    if grey_i.shape != grey_j.shape:
        raise ValueError(f"images of {grey_i.shape} and {grey_j.shape} pixels need a seed for their flow")
    forward = _OneWay(flow.flow(grey_i, grey_j), None, grey_j.shape)
    backward = _OneWay(flow.flow(grey_j, grey_i), None, grey_i.shape)
    return (
        _sampled(forward, backward, grid_i, flow.config),
        _sampled(backward, forward, grid_j, flow.config),
    )


def measure_grid_seeded(
    flow: OneWayFlow,
    grey_i: Image,
    grey_j: Image,
    grid_i: Grid,
    grid_j: Grid,
    seed_i: Float32,
    seed_j: Float32,
) -> tuple[GridFlow, GridFlow]:
    """Flow on top of a predicted ``seed_i (H_i, W_i, 2)`` and ``seed_j (H_j, W_j, 2)`` px, NaN = unknown."""
    forward = _seeded(flow, grey_i, grey_j, _positions(seed_i))
    backward = _seeded(flow, grey_j, grey_i, _positions(seed_j))
    return (
        _sampled(forward, backward, grid_i, flow.config),
        _sampled(backward, forward, grid_j, flow.config),
    )


def guide_grid(
    flow: OneWayFlow,
    grey_i: Image,
    grey_j: Image,
    view_i: GridView,
    view_j: GridView,
    jTi: Array,
    config: FlowConfig,
) -> tuple[GridFlow, GridFlow]:
    """``guided_flow`` at the grids of both views, whose depths and relative pose are known roughly."""
    iTj = invert_pose(jTi)
    forward = _seeded(flow, grey_i, grey_j, predict_targets(view_i, view_j, jTi))
    backward = _seeded(flow, grey_j, grey_i, predict_targets(view_j, view_i, iTj))
    results = []
    for one, other, grey_a, grey_b, view_a, view_b, bTa in (
        (forward, backward, grey_i, grey_j, view_i, view_j, jTi),
        (backward, forward, grey_j, grey_i, view_j, view_i, iTj),
    ):
        sampled = _sampled(one, other, view_a.grid, flow.config)
        weight = _look_weight(one, grey_a, grey_b, view_a.grid, config)
        weight *= _occlusion_weight(sampled.target, view_a, view_b, bTa, config)
        results.append(GridFlow(sampled.target, sampled.weight * weight))
    return results[0], results[1]


def predict_targets(view_i: GridView, view_j: GridView, jTi: Array) -> Float32:
    """``(H_i, W_i, 2)``: where a static scene puts every pixel of view i in view j, ``NOWHERE`` if behind.

    The grid is projected and what lies between interpolated: bending over one cell is far less than the
    flow on top corrects.
    """
    grid, stride = view_i.grid, view_i.grid.stride
    rows, cols = grid.shape
    depth = np.pad(view_i.depth.reshape(rows, cols), 1, mode="edge")
    # cv2.resize puts nodes in the middle of their cells: half a pixel before the grid's for an even stride
    first = grid.pixels[0] - stride - (0.5 if stride % 2 == 0 else 0.0)
    x = first[0] + stride * np.arange(cols + 2.0)
    y = first[1] + stride * np.arange(rows + 2.0)[:, None]
    homography = view_j.intrinsics @ jTi[:3, :3] @ np.linalg.inv(view_i.intrinsics)
    epipole = view_j.intrinsics @ jTi[:3, 3]
    u, v, z = (depth * (a * x + b * y + c) + e for (a, b, c), e in zip(homography, epipole, strict=True))
    front = z > 1e-6 * depth
    scale = np.divide(1.0, z, out=np.zeros_like(z), where=front)
    table = np.where(front[..., None], np.stack([u * scale, v * scale], axis=-1), NOWHERE)
    # far out and unknown are the same, and interpolation must not overflow
    table = np.maximum(np.minimum(table, -NOWHERE), NOWHERE).astype(np.float32)
    dense = cv2.resize(table, ((cols + 2) * stride, (rows + 2) * stride), interpolation=cv2.INTER_LINEAR)
    left, top = (np.rint((stride - 1) / 2 - first)).astype(int)
    width, height = view_i.size
    return np.asarray(dense[top : top + height, left : left + width])


def _positions(seed: Float32) -> Float32:
    height, width = seed.shape[:2]
    target = np.empty_like(seed)
    np.add(seed[..., 0], np.arange(width, dtype=np.float32), out=target[..., 0])
    np.add(seed[..., 1], np.arange(height, dtype=np.float32)[:, None], out=target[..., 1])
    return np.nan_to_num(target, copy=False, nan=float(NOWHERE))


def _seeded(flow: OneWayFlow, grey_i: Image, grey_j: Image, seed: Float32) -> _OneWay:
    """The flow never looks at levels finer than its finest: image j is warped at that level already."""
    level = flow.config.finest_scale
    size_i = grey_i.shape[1], grey_i.shape[0]
    small_i, small_j = _shrunk(grey_i, level), _shrunk(grey_j, level)
    target = seed
    if level:
        x, y = np.divide(small_j.shape[::-1], grey_j.shape[::-1])
        target = cv2.transform(_shrunk(seed, level), np.array([[x, 0, 0.5 * x - 0.5], [0, y, 0.5 * y - 0.5]]))
    height, width = small_j.shape
    warped = cv2.remap(small_j, target, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.inRange(target, (-0.5, -0.5, 0.0, 0.0), (width - 0.5, height - 0.5, 0.0, 0.0))
    # Where nothing is known the image itself stands in: no residual there, and no false edges.
    cv2.copyTo(small_i, cv2.bitwise_not(seen), warped)
    residual = flow.flow(small_i, np.asarray(warped, np.uint8), level)
    if level:
        residual = cv2.multiply(residual, (*np.divide(size_i, small_i.shape[::-1]), 1.0, 1.0))
        residual = np.asarray(cv2.resize(residual, size_i, interpolation=cv2.INTER_LINEAR), np.float32)
    return _OneWay(residual, seed, grey_j.shape)


def _shrunk(field: npt.NDArray[Any], level: int) -> npt.NDArray[Any]:
    """``(H, W[, C])`` halved ``level`` times, as DIS does for its pyramid."""
    for _ in range(level):
        size = field.shape[1] // 2, field.shape[0] // 2
        field = np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_AREA))
    return field


def _sampled(one: _OneWay, other: _OneWay, grid: Grid, config: FlowConfig) -> GridFlow:
    """Target and weight at the grid: seeded trust times agreement of the two directions, none at borders."""
    height, width = one.residual.shape[:2]
    pixels = grid.pixels.astype(np.float32).reshape(*grid.shape, 2)
    residual = grid.sample(one.residual).reshape(pixels.shape)
    target, known = one.follow(pixels, residual)
    margin = config.border_margin
    known &= inside(target, one.size_j, margin) & inside(pixels, (height, width), margin)
    reachable = np.where(known[..., None], target, np.float32(0.0))
    returned, back_known = other.follow(reachable, _bilinear(other.residual, reachable))
    known &= back_known
    squared = _squared(returned - pixels) * np.float32(1.0 / config.forward_backward_sigma**2)
    if one.seed is not None:
        squared += _squared(residual) * np.float32(1.0 / config.residual_limit**2)
    weight = np.where(known, np.exp(-np.minimum(squared, 80.0)), np.float32(0.0))
    # what is unknown must still be finite
    target = np.where(np.abs(target) < 1e5, target, pixels)
    return GridFlow(target.reshape(-1, 2), weight.reshape(-1).astype(np.float32))


def _look_weight(one: _OneWay, grey_i: Image, grey_j: Image, grid: Grid, config: FlowConfig) -> Float32:
    """``(N,)`` in [0, 1]: normalised cross-correlation of the windows around the grid's points."""
    window, (rows, cols) = config.ncc_window, grid.shape
    own = _windows(grey_i, grid, window).astype(np.float32)
    offset = np.arange(window) - window // 2
    pixels = np.empty((rows * window, cols * window, 2), np.float32)
    pixels[..., 0] = (grid.pixels[:cols, 0, None] + offset).ravel()
    pixels[..., 1] = (grid.pixels[::cols, 1, None] + offset).reshape(-1, 1)
    target, _ = one.follow(pixels, _windows(one.residual, grid, window))
    there = cv2.remap(grey_j, target, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there = there.astype(np.float32)

    def mean(field: Float32) -> Float32:
        return np.asarray(cv2.resize(field, (cols, rows), interpolation=cv2.INTER_AREA), np.float32)

    mean_own, mean_there = mean(own), mean(there)
    covariance = mean(own * there) - mean_own * mean_there
    variance_own = np.maximum(mean(own * own) - mean_own * mean_own, 0.0)
    variance_there = np.maximum(mean(there * there) - mean_there * mean_there, 0.0)
    floor = np.float32(config.ncc_noise**2)
    correlation = covariance / np.sqrt((variance_own + floor) * (variance_there + floor))
    slope = np.float32(1.0 / (config.ncc_high - config.ncc_low))
    weight: Float32 = np.clip((correlation - np.float32(config.ncc_low)) * slope, 0.0, 1.0)
    return weight.ravel()


def _windows(field: npt.NDArray[Any], grid: Grid, window: int) -> npt.NDArray[Any]:
    """The windows of ``(H, W[, C])`` around the grid's points side by side, ``(rows * window, cols * window
    [, C])``; beyond the border its last pixel."""
    before, after = window // 2, window - 1 - window // 2
    first, last = grid.pixels[0].astype(int), grid.pixels[-1].astype(int)
    height, width = field.shape[:2]
    if min(first) < before or last[0] + after >= width or last[1] + after >= height:
        field = np.asarray(cv2.copyMakeBorder(field, before, after, before, after, cv2.BORDER_REPLICATE))
    else:
        first = first - before
    views = np.lib.stride_tricks.sliding_window_view(field, (window, window), (0, 1))
    (rows, cols), stride = grid.shape, grid.stride
    chosen = views[first[1] :: stride, first[0] :: stride][:rows, :cols]
    # (rows, cols[, C], y, x) to (rows, y, cols, x[, C])
    order = (0, 2, 1, 3) if field.ndim == 2 else (0, 3, 1, 4, 2)
    return chosen.transpose(order).reshape(rows * window, cols * window, *field.shape[2:])


def _occlusion_weight(
    target: Float32, view_i: GridView, view_j: GridView, jTi: Array, config: FlowConfig
) -> Float32:
    """``(N,)``: exp(-(log depth difference / tolerance)^2) of the points of i against the depth of view j."""
    ray = (
        np.column_stack([view_i.grid.pixels, np.ones(len(view_i.grid))]) @ np.linalg.inv(view_i.intrinsics).T
    )
    z = view_i.depth * (ray @ jTi[2, :3]) + jTi[2, 3]
    grid = view_j.grid
    raster = (target - grid.pixels[0].astype(np.float32)) / np.float32(grid.stride)
    table = np.log(view_j.depth).astype(np.float32).reshape(grid.shape)
    there = _bilinear(table, raster.reshape(*view_i.grid.shape, 2)).ravel()
    front = z > 0.0
    difference = np.log(np.where(front, z, 1.0)) - there
    weight = np.where(front, np.exp(-np.square(difference / config.occlusion_tolerance)), 1.0)
    return weight.astype(np.float32)


def _bilinear(field: Float32, positions: Float32) -> Float32:
    """Values of ``(H, W[, C])`` at ``(R, C, 2)`` px; beyond the border those of the border."""
    found = cv2.remap(field, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32)


def _squared(vectors: Float32) -> Float32:
    x, y = vectors[..., 0], vectors[..., 1]
    return np.asarray(x * x + y * y, np.float32)
