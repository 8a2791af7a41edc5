"""Choosing whom to connect a frame to, by what its grid would see: arrays in, choices out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """A candidate frame as the selection needs it."""

    wTc: Array
    """``(4, 4)``"""
    intrinsics: Array
    """``(4,)`` fx fy cx cy, px."""
    size: tuple[int, int]
    """width, height"""
    depth: Array
    """``(rows, cols)`` z-depth on the grid, NaN where unknown."""
    origin: tuple[float, float]
    """x, y of the grid's first pixel."""
    stride: float
    """Grid spacing, px."""


@dataclass(frozen=True)
class Overlap:
    """How much of one frame's grid M candidates would see."""

    inside: Array
    """``(M,)`` share of the grid landing inside the image, in front of the camera."""
    visible: Array
    """``(M,)`` share landing inside where the candidate's depth says that the same surface is seen."""
    parallax_deg: Array
    """``(M,)`` median angle between the two rays of the points inside; NaN if none."""


def predicted_overlap(
    w_points: Array, w_centre: Array, candidates: Sequence[View], occlusion_tolerance: float
) -> Overlap:
    """Overlap of world points ``(N, 3)`` seen from ``w_centre (3,)`` with each candidate.

    A point counts as visible where its depth differs from the candidate's by less than
    ``occlusion_tolerance`` (relative).
    """
    if not candidates:
        return Overlap(*(np.zeros(0) for _ in range(3)))
    # all candidates at once: one after the other they took four times as long
    wTc = np.stack([view.wTc for view in candidates])
    fx, fy, cx, cy = np.stack([view.intrinsics for view in candidates]).T[..., None]
    last_x, last_y = np.array([view.size for view in candidates]).T[..., None] - 1
    offsets = w_points - wTc[:, None, :3, 3]
    points = offsets @ wTc[:, :3, :3]
    z = points[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy
        seen = (z > 0) & (x >= 0) & (y >= 0) & (x <= last_x) & (y <= last_y)
        surface = _depths_at(candidates, np.where(seen, x, 0.0), np.where(seen, y, 0.0))
        same = seen & (np.abs(np.log(z / surface)) < occlusion_tolerance)
    cosine = np.einsum("mnc,nc->mn", _normalised(offsets), _normalised(w_points - w_centre))
    angle = np.where(seen, np.arccos(np.clip(cosine, -1.0, 1.0)), np.inf)
    return Overlap(seen.mean(axis=1), same.mean(axis=1), np.degrees(_median_of_finite(angle)))


def _depths_at(views: Sequence[View], x: Array, y: Array) -> Array:
    """``(M, N)``: each view's depth at the grid point nearest to its pixels ``x``, ``y (M, N)``."""
    origin_x, origin_y = np.array([view.origin for view in views]).T[..., None]
    rows, cols = np.array([view.depth.shape for view in views]).T[..., None]
    stride = np.array([[view.stride] for view in views])
    first = np.cumsum([0, *(view.depth.size for view in views[:-1])])[:, None]
    col = np.clip(np.rint((x - origin_x) / stride).astype(int), 0, cols - 1)
    row = np.clip(np.rint((y - origin_y) / stride).astype(int), 0, rows - 1)
    return np.concatenate([view.depth.ravel() for view in views])[first + row * cols + col]


def _median_of_finite(values: Array) -> Array:
    """``(M,)`` of each row of ``values (M, N)``, in which inf is no value; NaN where there is none."""
    ordered, count, row = np.sort(values, axis=1), np.isfinite(values).sum(axis=1), np.arange(len(values))
    middle = 0.5 * (ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, count // 2 - (count == 0)])
    return np.where(count > 0, middle, np.nan)


def choose_spread(
    score: Array, times: npt.NDArray[np.int64], separation: int, count: int, taken: Sequence[int] = ()
) -> list[int]:
    """Indices of the best candidates, greedily, no two closer in time than ``separation``.

    Candidates with a score of zero or NaN are never chosen; ``taken`` are times chosen already. Equal
    scores go to the later time, so the choice is deterministic.
    """
    chosen: list[int] = []
    occupied = list(taken)
    order = sorted(np.flatnonzero(score > 0.0), key=lambda index: (-score[index], -times[index]))
    for index in order:
        if len(chosen) >= count:
            break
        if all(abs(int(times[index]) - time) >= separation for time in occupied):
            chosen.append(int(index))
            occupied.append(int(times[index]))
    return chosen


def edge_score(overlap: Overlap, minimum: float, max_parallax_deg: float) -> Array:
    """``(M,)`` score of candidates: the visible share, fading with the viewing angle, 0 where not usable.

    Flow across a wide angle is measured badly however much is shared: the fading is a half cosine that
    reaches 0 at ``max_parallax_deg``.
    """
    fade = np.cos(0.5 * np.pi * np.clip(overlap.parallax_deg / max_parallax_deg, 0.0, 1.0))
    return np.where(overlap.visible >= minimum, overlap.visible * np.nan_to_num(fade), 0.0)


def _normalised(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)
