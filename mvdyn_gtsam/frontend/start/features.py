"""Sparse keypoints for what dense flow cannot bridge: fast motion, and views of different cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

ROWS_AT_ONCE = 256
"""Keypoints compared with all of the other image at once: what stays in the processor's cache."""


@dataclass(frozen=True)
class Features:
    """Keypoints of one frame."""

    pixels: npt.NDArray[np.float64]
    """``(N, 2)`` px, pixel centres at integers."""
    descriptors: npt.NDArray[np.float32]
    """``(N, 128)``, unit length."""


def extract_features(image: npt.NDArray[np.uint8], maximum: int, contrast: float) -> Features:
    """RootSIFT features (Arandjelovic and Zisserman 2012) of an ``(H, W, 3)`` RGB image.

    A contrast threshold below SIFT's usual 0.04 keeps points on nearly plain walls; false ones are
    weeded out by geometry later.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    detector = cv2.SIFT.create(maximum, contrastThreshold=contrast, enable_precise_upscale=True)
    return _rooted(*detector.detectAndCompute(grey, None))


def extract_tilted_features(image: npt.NDArray[np.uint8], maximum: int, contrast: float) -> Features:
    """RootSIFT features of an ``(H, W, 3)`` RGB image and of it as seen from aside, up to 60 degrees.

    ``maximum`` from each direction. One keypoint may be found from several, within few pixels. Source: ASIFT,
    Morel and Yu 2009.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(maximum, contrastThreshold=contrast, enable_precise_upscale=True)
    # tilts 1, sqrt(2) and 2: the cosine of 60 degrees is 1 / 2
    detector = cv2.AffineFeature.create(sift, 2, 0)
    return _rooted(*detector.detectAndCompute(grey, None))


def _rooted(keypoints: Sequence[cv2.KeyPoint], descriptors: npt.NDArray[np.float32] | None) -> Features:
    if descriptors is None or len(keypoints) == 0:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.array([keypoint.pt for keypoint in keypoints], np.float64)
    # Several orientations of one point are kept by SIFT; the first (strongest) suffices here.
    _, first = np.unique(pixels, axis=0, return_index=True)
    first = np.sort(first)
    descriptors = descriptors[first]
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return Features(pixels[first], descriptors.astype(np.float32))


def match_features(
    first: Features, second: Features, ratio: float, apart_px: float = 0.0
) -> npt.NDArray[np.int64]:
    """Index pairs ``(M, 2)`` of mutual nearest neighbours that pass Lowe's ratio test.

    With ``apart_px`` the runner-up is the best that lies farther than that from the nearest.
    """
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return np.zeros((0, 2), np.int64)
    count = len(first.pixels)
    best = np.empty(count, np.int64)
    top, runner_up = np.empty(count, np.float32), np.empty(count, np.float32)
    top_of_second = np.full(len(second.pixels), -np.inf, np.float32)
    for start in range(0, count, ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        similarity = first.descriptors[rows] @ second.descriptors.T
        np.maximum(top_of_second, similarity.max(0), out=top_of_second)
        nearest = similarity.argmax(1)
        each = np.arange(len(nearest))
        best[rows], top[rows] = nearest, similarity[each, nearest]
        similarity[each, nearest] = -1.0
        runner_up[rows] = similarity.max(1)
    if apart_px > 0.0:
        mutual = np.flatnonzero(top == top_of_second[best])
        runner_up[mutual] = _best_apart(first.descriptors[mutual], second, best[mutual], apart_px)
    # Unit descriptors: squared distance = 2 - 2 * similarity.
    distinct = (1.0 - top) < ratio**2 * (1.0 - runner_up)
    chosen = np.flatnonzero((top == top_of_second[best]) & distinct)
    # of several that look exactly alike, the first
    chosen = chosen[np.sort(np.unique(best[chosen], return_index=True)[1])]
    return np.stack([chosen, best[chosen]], axis=1)


def _best_apart(
    descriptors: npt.NDArray[np.float32], second: Features, best: npt.NDArray[np.int64], apart_px: float
) -> npt.NDArray[np.float32]:
    """Highest similarity of each to keypoints that lie farther than ``apart_px`` from its best; -1: none."""
    found = np.empty(len(best), np.float32)
    pixels = second.pixels.astype(np.float32)
    for start in range(0, len(best), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        similarity = descriptors[rows] @ second.descriptors.T
        x, y = (pixels[:, axis] - pixels[best[rows], axis, None] for axis in (0, 1))
        found[rows] = np.where(x * x + y * y > apart_px**2, similarity, -1.0).max(1)
    return found
