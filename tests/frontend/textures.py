"""Synthetic images whose every sub-pixel value is known: sums of waves, so warping them is exact."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def values(
    x: npt.NDArray[np.floating], y: npt.NDArray[np.floating], seed: int = 0
) -> npt.NDArray[np.float64]:
    """Grey levels of an endless texture at positions of any shape."""
    rng = np.random.default_rng(seed)
    total = np.full(np.shape(x), 128.0)
    for wavelength in np.geomspace(4.0, 60.0, 60):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        frequency = 2.0 * np.pi / wavelength
        wave = np.sin(frequency * (np.cos(angle) * x + np.sin(angle) * y) + phase)
        total += 2.0 * wavelength**0.3 * wave
    return total


def texture(shape: tuple[int, int], seed: int = 0) -> npt.NDArray[np.uint8]:
    """``(H, W) uint8``."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    return to_image(values(x, y, seed))


def warped(jHi: npt.NDArray[np.float64], shape: tuple[int, int], seed: int = 0) -> npt.NDArray[np.uint8]:
    """The same texture seen after the homography: pixel p of ``texture`` is seen at ``jHi p``."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    source = np.linalg.inv(jHi) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    return to_image(values(source[0] / source[2], source[1] / source[2], seed).reshape(shape))


def to_image(grey: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    """Rounded and clipped."""
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
