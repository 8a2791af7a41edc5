"""Noisy depth of plain surfaces, smoothed without flattening what slants."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32

Array = npt.NDArray[np.float64]

ROUNDS = 3
"""Fits, each weighted by the residuals of the one before. Source: choice."""
TOLERANCE = 0.05
"""Relative residual at which a pixel counts half. Source: choice, what swept depth errs by."""
SPREAD = 0.03
"""Of the square's side: slopes of pixels that spread less are taken for noise. Source: choice, a tenth of
what a whole square spreads."""
FARTHEST = 1.4
"""Times nearer or farther than it was that a pixel is moved at most. Source: choice."""


def on_local_planes(inverse_depth: Float32, weight: Float32, side: int) -> Float32:
    """Inverse depth ``(h, w)`` of the plane that fits the square of ``side`` px around each pixel best.

    Inverse depth is linear over the image on any plane, so this is weighted linear regression, by box
    filters; pixels off their own square's plane lose weight (Cauchy). ``weight (h, w)`` says how far each
    pixel counts; where nothing does, ``inverse_depth`` stays.
    """
    height, width = inverse_depth.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    value, given = inverse_depth.astype(np.float64), weight.astype(np.float64)
    each, fit = given, value
    for _ in range(ROUNDS):
        fit, known = _regression(x, y, value, each, side)
        fit = np.where(known, fit, value)
        each = given / (1.0 + ((value / np.maximum(fit, 1e-9) - 1.0) / TOLERANCE) ** 2)
    return np.clip(fit, value / FARTHEST, value * FARTHEST).astype(np.float32)


def _regression(
    x: Array, y: Array, value: Array, weight: Array, side: int
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """At each pixel the linear function of ``x`` and ``y`` that fits ``value`` around it, all ``(h, w)``; and
    where there is one."""

    def mean(image: Array) -> Array:
        total = cv2.blur(weight * image, (side, side), borderType=cv2.BORDER_CONSTANT)
        return np.asarray(total / np.maximum(amount, 1e-9), np.float64)

    amount = cv2.blur(weight, (side, side), borderType=cv2.BORDER_CONSTANT)
    mean_x, mean_y, mean_value = mean(x), mean(y), mean(value)
    floor = (SPREAD * side) ** 2
    xx, yy = mean(x * x) - mean_x**2 + floor, mean(y * y) - mean_y**2 + floor
    xy = mean(x * y) - mean_x * mean_y
    xv, yv = mean(x * value) - mean_x * mean_value, mean(y * value) - mean_y * mean_value
    # the floor keeps it above zero
    determinant = xx * yy - xy * xy
    across, down = (xv * yy - yv * xy) / determinant, (yv * xx - xv * xy) / determinant
    return mean_value + across * (x - mean_x) + down * (y - mean_y), amount > 1e-9
