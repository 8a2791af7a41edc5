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
    inside, visible, parallax = (np.zeros(len(candidates)) for _ in range(3))
    rays = _normalised(w_points - w_centre)
    for index, view in enumerate(candidates):
        cRw = view.wTc[:3, :3].T
        offsets = w_points - view.wTc[:3, 3]
        points = offsets @ cRw.T
        z = points[:, 2]
        fx, fy, cx, cy = view.intrinsics
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy
            seen = (z > 0) & (x >= 0) & (y >= 0) & (x <= view.size[0] - 1) & (y <= view.size[1] - 1)
        inside[index] = np.mean(seen)
        if not seen.any():
            parallax[index] = np.nan
            continue
        rows, cols = view.depth.shape
        col = np.clip(np.rint((x[seen] - view.origin[0]) / view.stride).astype(int), 0, cols - 1)
        row = np.clip(np.rint((y[seen] - view.origin[1]) / view.stride).astype(int), 0, rows - 1)
        with np.errstate(invalid="ignore"):
            same = np.abs(np.log(z[seen] / view.depth[row, col])) < occlusion_tolerance
        visible[index] = same.sum() / len(w_points)
        cosine = np.einsum("nc,nc->n", _normalised(offsets[seen]), rays[seen])
        parallax[index] = np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return Overlap(inside, visible, parallax)


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
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)
