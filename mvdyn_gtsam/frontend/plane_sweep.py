"""Dense depth by plane sweep: the classical stand-in for a monocular depth network where weights are missing.

For every pixel and every inverse depth of a ladder, patches of other views are compared; semi-global
aggregation (https://doi.org/10.1109/TPAMI.2007.1166) picks a depth that its neighbours can share. Views of
the same instant see moving things frozen; views of other times see only what stands still. So what stands
still is swept against all views together, what moves against those of its instant alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.geometry import pixel_rays

Float32 = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

RASTER = 7
"""Points across and down an image at which it is asked how far pixels move between two inverse depths."""
FORBIDDEN = np.float32(1e6)
"""Cost of stepping off the ladder."""


@dataclass(frozen=True)
class SweepConfig:
    """Plane sweep. Choices marked "compared" were tried beside others on a few frames of robodog_overlap,
    dynamic_human and three_cameras; no sweep of them is kept."""

    scale: float = 0.25
    """Size of the images swept over the input's. Source: choice; a third took twice as long."""
    levels: int = 120
    """Inverse depths tried. Source: 80 to 160 compared on robodog_overlap, 96 to 160 on dynamic_human and
    three_cameras: more are no better on the whole, fewer lose what moves."""
    step_px: float = 0.25
    """Motion of a pixel between two inverse depths that are compared, px of the swept size; a view near by is
    compared at fewer, and what lies between is interpolated. Source: a quarter leaves
    the depth of the rendered room of the tests as it is, a half moves it by a fifteenth of a level."""
    window: int = 5
    """Side of the compared patches, px of the swept size. Source: choice."""
    noise: float = 2.0
    """Image noise, grey levels: patches with less contrast than this say nothing. Source: choice."""
    unseen: float = 0.3
    """What a depth gets from a view that would not see it: more than from one that contradicts. Source:
    compared."""
    temporal_offsets: tuple[int, ...] = (8, 24)
    """Distances in frames, both ways, of the other views of the same camera. Source: 8 with 16, 24 and 32
    compared on every tenth frame of robodog_overlap, dynamic_human and three_cameras."""
    least_shared: float = 0.6
    """Share of the view that such a view must see, else one at half the distance is taken, and so on. Source:
    0.5 to 0.7 compared on HoloLens; the others share that much anyway."""
    temporal_weight: float = 0.75
    """Say of a view of another time against one of the same instant. Source: compared."""
    instant_weight: float = 3.0
    """Say of the views of the same instant when they are believed alone. Source: compared."""
    prior_weight: float = 1.0
    """Say of the known depth at full confidence. Source: compared."""
    prior_tolerance: float = 0.1
    """Relative depth difference at which the known depth says nothing any more. Source: choice."""
    small_step: float = 0.4
    """Cost of a change by one level between neighbours. Source: compared."""
    large_step: float = 4.0
    """Cost of any larger change where the image is flat; falls towards ``small_step`` at edges. Source:
    compared."""
    edge_contrast: float = 20.0
    """Grey levels between neighbours at which the cost of a large change has fallen to 1/e. Source:
    compared."""

    def __post_init__(self) -> None:
        if not 0.0 < self.scale <= 1.0:
            raise ConfigError(f"refinement.sweep.scale is {self.scale}; it must be above 0 and at most 1")
        if self.levels < 3:
            raise ConfigError(f"refinement.sweep.levels is {self.levels}; it must be at least 3")
        if self.window < 3 or self.window % 2 == 0:
            raise ConfigError(f"refinement.sweep.window is {self.window}; it must be odd and at least 3")
        for name in ("step_px", "noise", "prior_tolerance", "edge_contrast"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"refinement.sweep.{name} is {getattr(self, name)}; it must be above 0")
        if not 0.0 <= self.least_shared <= 1.0:
            raise ConfigError(
                f"refinement.sweep.least_shared is {self.least_shared}; it must be between 0 and 1"
            )
        if any(offset < 1 for offset in self.temporal_offsets):
            raise ConfigError(
                f"refinement.sweep.temporal_offsets is {list(self.temporal_offsets)}; it must hold distances"
                " >= 1"
            )


@dataclass(frozen=True)
class SweepView:
    """One view to compare with."""

    grey: npt.NDArray[np.uint8]
    """``(H_j, W_j)`` of the swept size."""
    intrinsics: Array
    """``(3, 3)`` of the swept size."""
    jTi: Array
    """``(4, 4)``"""
    same_instant: bool


def sweep(
    grey: npt.NDArray[np.uint8],
    intrinsics: Array,
    views: Sequence[SweepView],
    ladder: Float32,
    known: Float32,
    confidence: Float32,
    config: SweepConfig,
) -> Float32:
    """Inverse depth ``(h, w)`` of an image ``(h, w)`` that all ``views`` support, as if nothing moved.

    Of the evenly spaced ``ladder (D,)``, finite and positive. ``known`` and ``confidence``, both ``(h, w)``,
    are an inverse depth believed so far and how far. Raises ValueError for a ladder that is not ascending and
    positive.
    """
    weights = [1.0 if view.same_instant else config.temporal_weight for view in views]
    score = _score(grey, intrinsics, views, weights, ladder, config)
    score += _prior_score(ladder, known.ravel(), confidence.ravel(), config)
    return _settled(score, grey, ladder, config)


def sweep_instant(
    grey: npt.NDArray[np.uint8],
    intrinsics: Array,
    views: Sequence[SweepView],
    ladder: Float32,
    config: SweepConfig,
) -> Float32:
    """Inverse depth ``(h, w)`` that the ``views`` of an image's instant support alone, of what moves too; as
    ``sweep``."""
    # alone they must carry what all views together carry there
    weights = [config.instant_weight] * len(views)
    return _settled(_score(grey, intrinsics, views, weights, ladder, config), grey, ladder, config)


def _score(
    grey: npt.NDArray[np.uint8],
    intrinsics: Array,
    views: Sequence[SweepView],
    weights: Sequence[float],
    ladder: Float32,
    config: SweepConfig,
) -> Float32:
    """What the views say for each level, ``(D, h * w)``."""
    if len(ladder) < 3 or not (ladder[0] > 0.0 and (np.diff(ladder) > 0.0).all()):
        raise ValueError("the inverse depths to sweep must be positive and ascending, three at least")
    score = np.zeros((len(ladder), grey.size), np.float32)
    for view, weight in zip(views, weights, strict=True):
        likeness = patch_likeness(grey, intrinsics, view, ladder, config).reshape(len(ladder), -1)
        cv2.scaleAdd(likeness, weight, score, dst=score)
    return score


def _prior_score(ladder: Float32, known: Float32, confidence: Float32, config: SweepConfig) -> Float32:
    """What the inverse depth ``known (N,)`` so far says for each level, ``(D, N)``."""
    score = np.log(ladder)[:, None] - np.log(known)
    np.abs(score, out=score)
    score *= np.float32(1.0 / config.prior_tolerance)
    np.minimum(score, np.float32(1.0), out=score)
    np.subtract(np.float32(1.0), score, out=score)
    score *= np.float32(config.prior_weight) * confidence
    return score


def _settled(score: Float32, grey: npt.NDArray[np.uint8], ladder: Float32, config: SweepConfig) -> Float32:
    """Inverse depth ``(h, w)`` with the best ``score (D, h * w)`` after aggregation; ``score`` is spent."""
    cost = cv2.transpose(np.negative(score, out=score)).reshape(*grey.shape, len(ladder))
    total = semi_global(np.asarray(cost, np.float32), grey, config)
    level, fraction = lowest(total)
    inverse_depth = ladder[level] + fraction * (ladder[1] - ladder[0])
    return np.maximum(inverse_depth, 0.5 * ladder[0]).astype(np.float32)


def patch_likeness(
    grey: npt.NDArray[np.uint8], intrinsics: Array, view: SweepView, ladder: Float32, config: SweepConfig
) -> Float32:
    """Normalised cross-correlation ``(D, h, w)`` in [0, 1] with a view at every inverse depth; ``unseen``
    where the point lies outside its image."""
    rungs = compared_levels(grey.shape, intrinsics, view, ladder, config.step_px)
    found = _correlations(grey, intrinsics, view, ladder[rungs], config)
    if len(rungs) == len(ladder):
        return found
    likeness = np.empty((len(ladder), *grey.shape), np.float32)
    for below, above, low, high in zip(found, found[1:], rungs, rungs[1:], strict=False):
        for level in range(low, high):
            share = (level - low) / (high - low)
            cv2.addWeighted(below, 1.0 - share, above, share, 0.0, dst=likeness[level])
    likeness[-1] = found[-1]
    return likeness


def compared_levels(
    shape: tuple[int, ...], intrinsics: Array, view: SweepView, ladder: Float32, step_px: float
) -> npt.NDArray[np.int64]:
    """Indices of the levels of ``ladder (D,)``, the first and last among them, between which no pixel of an
    image of ``shape`` moves over the view by more than ``step_px``; all where that cannot be or be told."""
    across, down = np.linspace(0, shape[1] - 1, RASTER), np.linspace(0, shape[0] - 1, RASTER)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    turned = pixel_rays(pixels, intrinsics) @ view.jTi[:3, :3].T
    point = turned + ladder[:, None, None].astype(np.float64) * view.jTi[:3, 3]
    front = point[..., 2] > 1e-6
    seen = (point / np.where(front, point[..., 2], 1.0)[..., None]) @ view.intrinsics[:2].T
    inside = front & ((seen >= 0.0) & (seen <= np.array(view.grey.shape[::-1]) - 1)).all(axis=2)
    motion = np.linalg.norm(np.diff(seen, axis=0), axis=2)
    largest = np.max(motion, initial=0.0, where=inside[1:] & inside[:-1])
    if not inside.any():
        return np.arange(len(ladder))
    stride = int(np.clip(step_px / max(largest, 1e-9), 1, len(ladder) - 1))
    return np.unique(np.append(np.arange(0, len(ladder), stride), len(ladder) - 1))


def _correlations(
    grey: npt.NDArray[np.uint8], intrinsics: Array, view: SweepView, ladder: Float32, config: SweepConfig
) -> Float32:
    """``patch_likeness`` at every level of a ladder."""
    height, width = grey.shape
    image, other = grey.astype(np.float32), view.grey.astype(np.float32)
    size = (config.window, config.window)
    floor = np.float32(config.noise**2)
    mean = cv2.blur(image, size)
    deviation = np.sqrt(np.maximum(cv2.sqrBoxFilter(image, cv2.CV_32F, size) - mean * mean, 0.0) + floor)
    homography = view.intrinsics @ view.jTi[:3, :3] @ np.linalg.inv(intrinsics)
    epipole = view.intrinsics @ view.jTi[:3, 3]
    x, y = np.arange(width), np.arange(height)[:, None]
    far = [(row[0] * x + row[1] * y + row[2]).astype(np.float32) for row in homography]
    nearest = min(float(far[2][corner]) for corner in ((0, 0), (0, -1), (-1, 0), (-1, -1)))
    likeness = np.empty((len(ladder), height, width), np.float32)
    for level, inverse_depth in enumerate(ladder):
        shift = inverse_depth * epipole
        depth = far[2] + np.float32(shift[2])
        # depth is linear in the pixel: least at a corner
        behind = nearest + shift[2] <= 1e-6
        if behind:
            depth[depth <= 1e-6] = np.nan
        u = far[0] + np.float32(shift[0])
        v = far[1] + np.float32(shift[1])
        u /= depth
        v /= depth
        if behind:
            u[np.isnan(u)] = -1.0
            v[np.isnan(v)] = -1.0
        seen_u, seen_v = cv2.inRange(u, 0.0, other.shape[1] - 1.0), cv2.inRange(v, 0.0, other.shape[0] - 1.0)
        warped = cv2.remap(other, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        there = cv2.blur(warped, size)
        covariance = cv2.blur(image * warped, size)
        covariance -= mean * there
        warped *= warped
        variance = cv2.blur(warped, size)
        there *= there
        variance -= there
        np.maximum(variance, 0.0, out=variance)
        variance += floor
        np.sqrt(variance, out=variance)
        variance *= deviation
        covariance /= variance
        # correlation below zero is no worse than none: robust against what is hidden
        np.maximum(covariance, 0.0, out=likeness[level])
        likeness[level][cv2.bitwise_and(seen_u, seen_v) == 0] = config.unseen
    return likeness


def semi_global(cost: Float32, grey: npt.NDArray[np.uint8], config: SweepConfig) -> Float32:
    """Cost ``(h, w, D)`` summed over the cheapest paths from left, right, above and below."""
    luminance = grey.astype(np.float32)
    turned = np.ascontiguousarray(cost.transpose(1, 0, 2))
    total = _along_rows(cost, luminance, config)
    total += _along_rows(turned, luminance.T, config).transpose(1, 0, 2)
    return total


def lowest(cost: Float32) -> tuple[npt.NDArray[np.int64], Float32]:
    """Level ``(h, w)`` of the lowest of ``cost (h, w, D)`` and the fraction of a level to add, by a
    parabola."""
    level = cost.argmin(axis=2)
    middle = np.clip(level, 1, cost.shape[2] - 2)
    below, at, above = (
        np.take_along_axis(cost, (middle + offset)[..., None], axis=2)[..., 0] for offset in (-1, 0, 1)
    )
    fraction = 0.5 * (below - above) / np.maximum(below - 2.0 * at + above, 1e-6)
    return level, np.where(level == middle, np.clip(fraction, -0.5, 0.5), 0.0).astype(np.float32)


def ladder_of(inverse_depths: npt.NDArray[np.floating], levels: int) -> Float32:
    """``levels`` evenly spaced inverse depths that hold those known and what may be nearer or farther."""
    far, near = np.percentile(inverse_depths, [1.0, 99.0])
    # What moves is often nearer than anything that was tracked, and far walls are the least known.
    return np.linspace(0.5 * far, 1.6 * near, levels, dtype=np.float32)


def _along_rows(cost: Float32, luminance: Float32, config: SweepConfig) -> Float32:
    """Cost ``(h, w, D)`` summed over the cheapest paths that run down from the first row and up from the
    last."""
    small, large = np.float32(config.small_step), np.float32(config.large_step)
    contrast = np.abs(np.diff(luminance, axis=0))
    jump = small + (large - small) * np.exp(contrast / np.float32(-config.edge_contrast))
    height, width, levels = cost.shape
    total = np.zeros(cost.shape, np.float32)
    # both ways in one array: half the calls, which are what small images take time for
    cheapest = np.stack([cost[0], cost[-1]])
    padded = np.full((2, width, levels + 2), FORBIDDEN)
    for row in range(height):
        down, up = row, height - 1 - row
        if row > 0:
            previous, lowest_previous = cheapest, cheapest.min(axis=2, keepdims=True)
            padded[..., 1:-1] = previous
            cheapest = np.minimum(padded[..., :-2], padded[..., 2:])
            cheapest += small
            np.minimum(cheapest, previous, out=cheapest)
            jumped = lowest_previous + np.stack([jump[down - 1], jump[up]])[..., None]
            np.minimum(cheapest, jumped, out=cheapest)
            cheapest -= lowest_previous
            cheapest[0] += cost[down]
            cheapest[1] += cost[up]
        total[down] += cheapest[0]
        total[up] += cheapest[1]
    return total
