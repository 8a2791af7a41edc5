"""Keypoints followed along dense flow: which keypoint of one frame is which of the next ones.

Descriptors cannot tell one tile of a wallpaper from the next, and what moves past it may be all that they
match. Flow from frame to frame is short and knows which tile is which.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from mvdyn_gtsam.frontend.dense_flow import DenseFlow, Float32, FlowPair, Image
from mvdyn_gtsam.frontend.start.features import Features

Index = npt.NDArray[np.int64]
Matches = dict[tuple[int, int], Index]
"""Rows ``(M, 2)`` of keypoints by pair of frames."""

NEAR_PX = 1.5
"""Distance from where flow leads within which a keypoint is the same one. Source: choice; about what chained
flow is off by."""
LEAST_WEIGHT = 0.5
"""Weight of the flow from which it is followed. Source: choice, as in ``dense_map``."""


def follow_keypoints(
    read: Callable[[int], Image], features: Sequence[Features], neighbours: int, flow: DenseFlow
) -> Matches:
    """Matches of every frame's keypoints with those of the ``neighbours`` frames after it.

    ``read(row)`` gives the image of a frame, grey or RGB; each is asked for once or twice, in order.
    """
    matches: Matches = {}
    positions: dict[int, npt.NDArray[np.float64]] = {}
    for row in range(1, len(features)):
        step = flow.measure(read(row - 1), read(row))
        positions[row - 1] = features[row - 1].pixels
        positions.pop(row - 1 - neighbours, None)
        for first in positions:
            positions[first] = _moved(positions[first], step)
            matches[first, row] = _nearest(positions[first], features[row])
    return matches


def joined_matches(first: Matches, second: Matches) -> Matches:
    """Matches found in either way."""
    pairs = sorted({*first, *second})
    return {
        pair: np.unique(np.concatenate([found[pair] for found in (first, second) if pair in found]), axis=0)
        for pair in pairs
    }


def _moved(pixels: npt.NDArray[np.float64], step: FlowPair) -> npt.NDArray[np.float64]:
    """Where flow takes ``(N, 2)`` pixels; NaN where it is not to be trusted, and for NaN."""
    shift = np.column_stack([_at(step.forward[..., axis], pixels) for axis in (0, 1)])
    sure = _at(step.forward_weight, pixels) > LEAST_WEIGHT
    return np.where(sure[:, None], pixels + shift, np.nan)


def _at(field: Float32, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Bilinear values ``(N,)`` of a field ``(H, W)``; 0 outside of it."""
    if len(pixels) == 0:
        return np.zeros(0)
    x, y = np.nan_to_num(pixels, nan=-1e4).astype(np.float32).T[..., None]
    values = cv2.remap(np.ascontiguousarray(field), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(values[:, 0], np.float64)


def _nearest(pixels: npt.NDArray[np.float64], features: Features) -> Index:
    """Rows of pixels ``(N, 2)`` and of the keypoints that are nearest to each other, and near."""
    known = np.flatnonzero(np.isfinite(pixels).all(1))
    if len(known) == 0 or len(features.pixels) == 0:
        return np.zeros((0, 2), np.int64)
    distance, keypoint = cKDTree(features.pixels).query(pixels[known])
    order = np.argsort(distance, kind="stable")
    order = order[distance[order] < NEAR_PX]
    _, first = np.unique(keypoint[order], return_index=True)
    chosen = np.sort(order[first])
    return np.column_stack([known[chosen], keypoint[chosen]])
