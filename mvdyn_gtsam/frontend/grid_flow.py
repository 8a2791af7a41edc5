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

from mvdyn_gtsam.frontend.dense_flow import Float32, FlowConfig, GridFlow, Image, inside, pixel_raster
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.geometry import invert_pose

Array = npt.NDArray[np.float64]

NOWHERE = np.float32(-1e7)
"""Flow of a pixel whose target is unknown: so far out that no interpolation with it falls into an image."""


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
    """One direction, at the resolution the flow was measured at ("small"): ``residual`` leads from pixel x to
    where ``seed`` (if any) is to be read."""

    residual: Float32
    """``(h_i, w_i, 2)`` small px"""
    seed: Float32 | None
    """``(h_i, w_i, 2)`` small px: predicted flow, ``NOWHERE`` where unknown."""
    small_i: Image
    small_j: Image
    size_i: tuple[int, ...]
    size_j: tuple[int, ...]
    """height, width of the whole images"""

    def follow(self, pixels: Float32, residual: Float32) -> Float32:
        """Positions in j of ``pixels (R, C, 2)`` with the given ``residual``; far outside where unknown."""
        moved = pixels + residual
        return moved if self.seed is None else moved + _bilinear(self.seed, moved)


def measure_grid(
    flow: OneWayFlow, grey_i: Image, grey_j: Image, grid_i: Grid, grid_j: Grid
) -> tuple[GridFlow, GridFlow]:
    """Plain flow between grey images ``(H, W)`` of one size: ``(i -> j at grid_i, j -> i at grid_j)``.

    The weights are those of ``dense_flow.measure_both``. Raises ValueError for images of different size.
    """
    if grey_i.shape != grey_j.shape:
        raise ValueError(f"images of {grey_i.shape} and {grey_j.shape} pixels need a seed for their flow")
    forward, backward = (
        _OneWay(flow.flow(a, b), None, a, b, a.shape, b.shape)
        for a, b in ((grey_i, grey_j), (grey_j, grey_i))
    )
    return (
        _sampled(forward, backward, grid_i, flow.config),
        _sampled(backward, forward, grid_j, flow.config),
    )


def measure_grid_predicted(
    flow: OneWayFlow,
    grey_i: Image,
    grey_j: Image,
    grid_i: Grid,
    grid_j: Grid,
    view_i: GridView,
    view_j: GridView,
    jTi: Array,
) -> tuple[GridFlow, GridFlow]:
    """Flow on top of what two views predict, whose grids may be others than ``grid_i`` and ``grid_j``."""
    forward, backward = _predicted(flow, grey_i, grey_j, view_i, view_j, jTi)
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
    forward, backward = _predicted(flow, grey_i, grey_j, view_i, view_j, jTi)
    iTj = invert_pose(jTi)
    results = []
    for one, other, view_a, view_b, bTa in (
        (forward, backward, view_i, view_j, jTi),
        (backward, forward, view_j, view_i, iTj),
    ):
        sampled = _sampled(one, other, view_a.grid, flow.config)
        weight = _look_weight(one, view_a.grid, config)
        weight *= _occlusion_weight(sampled.target, view_a, view_b, bTa, config)
        results.append(GridFlow(sampled.target, sampled.weight * weight))
    return results[0], results[1]


def _predicted(
    flow: OneWayFlow, grey_i: Image, grey_j: Image, view_i: GridView, view_j: GridView, jTi: Array
) -> tuple[_OneWay, _OneWay]:
    level = flow.config.finest_scale
    return (
        _seeded(flow, grey_i, grey_j, predict_grid_flow(view_i, view_j, jTi, level)),
        _seeded(flow, grey_j, grey_i, predict_grid_flow(view_j, view_i, invert_pose(jTi), level)),
    )


def predict_grid_flow(view_i: GridView, view_j: GridView, jTi: Array, level: int) -> Float32:
    """``(h_i, w_i, 2)``: static flow in pixels of images halved ``level`` times, ``NOWHERE`` behind camera j.

    The grid is projected and the flow between its points interpolated: bending over one cell is far less
    than the flow on top corrects.
    """
    grid, stride = view_i.grid, view_i.grid.stride
    rows, cols = grid.shape
    depth = np.pad(view_i.depth.reshape(rows, cols), 1, mode="edge")
    first = grid.pixels[0] - stride
    x = first[0] + stride * np.arange(cols + 2.0)
    y = first[1] + stride * np.arange(rows + 2.0)[:, None]
    homography = view_j.intrinsics @ jTi[:3, :3] @ np.linalg.inv(view_i.intrinsics)
    epipole = view_j.intrinsics @ jTi[:3, 3]
    u, v, z = (depth * (a * x + b * y + c) + e for (a, b, c), e in zip(homography, epipole, strict=True))
    front = z > 1e-6 * depth
    scale = np.divide(1.0, z, out=np.zeros_like(z), where=front)
    (width_i, height_i), (width_j, height_j) = _halved(view_i.size, level), _halved(view_j.size, level)
    at_x, at_y = _to_small(x, width_i, view_i.size[0]), _to_small(y, height_i, view_i.size[1])
    table = np.empty((rows + 2, cols + 2, 2), np.float32)
    # far out and unknown are the same, and interpolation must not overflow
    for k, (there, own) in enumerate(
        (
            (_to_small(u * scale, width_j, view_j.size[0]), at_x),
            (_to_small(v * scale, height_j, view_j.size[1]), at_y),
        )
    ):
        table[..., k] = np.where(front, np.clip(there - own, NOWHERE, -NOWHERE), NOWHERE)
    wide = _interpolation(at_x, width_i) @ table
    return (_interpolation(at_y[:, 0], height_i) @ wide.reshape(rows + 2, -1)).reshape(height_i, width_i, 2)


def _interpolation(positions: Array, length: int) -> Float32:
    """``(length, R)``: interpolates values at even ``positions (R,)`` linearly at 0, 1, ...

    As a matrix product it takes a tenth of the time of adding up indexed rows.
    """
    step = positions[1] - positions[0]
    where = np.clip((np.arange(length) - positions[0]) / step, 0.0, len(positions) - 1.0)
    low = np.minimum(where.astype(np.int64), len(positions) - 2)
    weights, each = np.zeros((length, len(positions)), np.float32), np.arange(length)
    weights[each, low + 1] = where - low
    weights[each, low] = np.float32(1.0) - weights[each, low + 1]
    return weights


def _halved(size: tuple[int, int], level: int) -> tuple[int, int]:
    return size[0] >> level, size[1] >> level


def _to_small(positions: Array, small: int, whole: int) -> Array:
    """Along one axis, from pixels of ``whole`` of them to pixels of ``small``; centres are at integers."""
    return (positions + 0.5) * (small / whole) - 0.5


def _seeded(flow: OneWayFlow, grey_i: Image, grey_j: Image, seed: Float32) -> _OneWay:
    """The flow never looks at levels finer than its finest: all is done at that level."""
    level = flow.config.finest_scale
    small_i, small_j = _shrunk(grey_i, level), _shrunk(grey_j, level)
    target = seed + pixel_raster(seed.shape)
    height, width = small_j.shape
    warped = cv2.remap(small_j, target, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.inRange(target, (-0.5, -0.5, 0.0, 0.0), (width - 0.5, height - 0.5, 0.0, 0.0))
    # Where nothing is known the image itself stands in: no residual there, and no false edges.
    cv2.copyTo(small_i, cv2.bitwise_not(seen), warped)
    residual = flow.flow(small_i, np.asarray(warped, np.uint8), level)
    return _OneWay(residual, seed, small_i, small_j, grey_i.shape, grey_j.shape)


def _shrunk(field: npt.NDArray[Any], level: int) -> npt.NDArray[Any]:
    """``(H, W[, C])`` halved ``level`` times, as DIS does for its pyramid."""
    for _ in range(level):
        size = field.shape[1] // 2, field.shape[0] // 2
        field = np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_AREA))
    return field


def _sampled(one: _OneWay, other: _OneWay, grid: Grid, config: FlowConfig) -> GridFlow:
    """Target and weight at the grid: seeded trust times agreement of the two directions, none at borders."""
    scale_i, scale_j = _scale(one.small_i, one.size_i), _scale(one.small_j, one.size_j)
    pixels = grid.pixels.astype(np.float32).reshape(*grid.shape, 2)
    small = (pixels + np.float32(0.5)) * scale_i - np.float32(0.5)
    residual = _bilinear(one.residual, small)
    there = one.follow(small, residual)
    target = (there + np.float32(0.5)) / scale_j - np.float32(0.5)
    margin = config.border_margin
    known = inside(target, one.size_j, margin) & inside(pixels, one.size_i, margin)
    there = np.where(known[..., None], there, np.float32(0.0))
    returned = other.follow(there, _bilinear(other.residual, there))
    known &= inside(returned, one.small_i.shape, -0.5)
    squared = _squared((returned - small) / scale_i)
    squared *= np.float32(1.0 / config.forward_backward_sigma**2)
    if one.seed is not None:
        squared += _squared(residual / scale_i) * np.float32(1.0 / config.residual_limit**2)
    weight = np.where(known, np.exp(-np.minimum(squared, 80.0)), np.float32(0.0))
    # what is unknown must still be finite
    target = np.where(np.abs(target) < 1e5, target, pixels)
    return GridFlow(target.reshape(-1, 2), weight.reshape(-1).astype(np.float32))


def _scale(small: Image, size: tuple[int, ...]) -> Float32:
    """``(2,)`` x, y: small pixels per pixel."""
    return np.array([small.shape[1] / size[1], small.shape[0] / size[0]], np.float32)


def _look_weight(one: _OneWay, grid: Grid, config: FlowConfig) -> Float32:
    """``(N,)`` in [0, 1]: normalised cross-correlation of the windows around the grid's points."""
    scale = _scale(one.small_i, one.size_i)
    window, (rows, cols) = max(3, round(config.ncc_window * float(scale[0]))), grid.shape
    height, width = one.small_i.shape
    centre = (grid.pixels + 0.5) * scale - 0.5
    x = _around(centre[:cols, 0], window, width)
    y = _around(centre[::cols, 1], window, height)
    chosen = np.ix_(y, x)
    own = one.small_i[chosen].astype(np.float32)
    pixels = np.empty((*own.shape, 2), np.float32)
    pixels[..., 0], pixels[..., 1] = x, y[:, None]
    target = one.follow(pixels, one.residual[chosen])
    there = cv2.remap(one.small_j, target, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
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


def _around(centres: Array, window: int, length: int) -> npt.NDArray[np.int64]:
    """``(K * window,)`` pixels of the windows around K ``centres`` of one axis, kept inside the image."""
    first = np.rint(centres - 0.5 * (window - 1)).astype(np.int64)
    return np.clip(first[:, None] + np.arange(window), 0, length - 1).ravel()


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


def _squared(vectors: npt.NDArray[np.floating]) -> Float32:
    x, y = vectors[..., 0], vectors[..., 1]
    return np.asarray(x * x + y * y, np.float32)
