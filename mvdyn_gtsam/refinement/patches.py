"""Patches of two views compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.views import pixels_seen

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NOISE = 2.0
"""Grey levels: patches with less contrast say nothing."""
NOTHING = -1000.0
"""Luminance outside an image."""


class PictureView(Protocol):
    """What is asked of any view; ``Picture`` says what each is."""

    @property
    def grey(self) -> Float32: ...
    @property
    def intrinsics(self) -> Array: ...
    @property
    def jTi(self) -> Array: ...


@dataclass(frozen=True)
class Picture:
    """A view as an image alone."""

    grey: Float32
    """``(h_j, w_j)``"""
    intrinsics: Array
    """``(3, 3)``"""
    jTi: Array
    """``(4, 4)``"""


def likeness(
    grey: Float32, inverse_depth: Float32, rays: Float32, view: PictureView, side: int
) -> tuple[Float32, Mask]:
    """Correlation ``(h, w)`` in [0, 1] of the patches of an image and of a view, at ``inverse_depth (h w,)``.

    Also where the view sees the pixel at all; elsewhere the correlation means nothing. ``grey (h, w)`` is the
    image, ``rays (h w, 3)`` those of its pixels, ``side`` that of the patches, px.
    """
    pixels, front = pixels_seen(inverse_depth, rays, view.jTi, view.intrinsics)
    at = pixels.reshape(*grey.shape, 2)
    warped = cv2.remap(
        view.grey, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=NOTHING
    )
    inside = warped >= 0.0
    correlation = _correlation(grey, np.where(inside, warped, grey).astype(np.float32), side)
    return correlation, np.asarray(inside & front.reshape(grey.shape))


def contrast(grey: Float32, side: int) -> Float32:
    """Standard deviation ``(h, w)`` of an image's patches of ``side`` px, grey levels."""
    size = (side, side)
    mean = cv2.blur(grey, size)
    return np.sqrt(np.maximum(cv2.blur(grey * grey, size) - mean * mean, 0.0))


def _correlation(one: Float32, other: Float32, side: int) -> Float32:
    """Normalised correlation ``(h, w)`` of the patches of two images, not below zero."""
    size = (side, side)
    mean_one, mean_other = cv2.blur(one, size), cv2.blur(other, size)
    covariance = cv2.blur(one * other, size) - mean_one * mean_other
    deviation_one, deviation_other = (
        np.sqrt(contrast(image, side) ** 2 + NOISE**2) for image in (one, other)
    )
    return np.asarray(np.maximum(covariance, 0.0) / (deviation_one * deviation_other), np.float32)
