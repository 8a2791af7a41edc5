"""Colours of cameras, depth, confidence and motion, all ``uint8`` RGB."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]

CAMERA_COLOURS = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189),
    (140, 86, 75), (227, 119, 194), (127, 127, 127), (188, 189, 34), (23, 190, 207),
)  # fmt: skip
"""Matplotlib's, as in the plots of ``mvdyn evaluate``; cameras beyond take them again."""
MOVES = (230, 60, 40)
MOVES_UNCONFIRMED = (240, 180, 40)
UNKNOWN = 128


def camera_colour(index: int) -> tuple[int, int, int]:
    """Colour of camera number ``index``."""
    return CAMERA_COLOURS[index % len(CAMERA_COLOURS)]


def colour_depth(depth: npt.NDArray[np.float32], low: float, high: float) -> Image:
    """Inverse depth ``(H, W)`` between depths ``low`` and ``high`` as colours ``(H, W, 3)``: near yellow,
    far blue, invalid black."""
    valid = np.isfinite(depth)
    inverse = 1.0 / np.where(valid, depth, high)
    coloured = _colour_map((inverse - 1.0 / high) / max(1.0 / low - 1.0 / high, 1e-12), cv2.COLORMAP_PARULA)
    coloured[~valid] = 0
    return coloured


def colour_confidence(confidence: npt.NDArray[np.float32]) -> Image:
    """Confidence ``(H, W)`` in [0, 1] as colours ``(H, W, 3)``: low dark, high yellow."""
    return _colour_map(confidence, cv2.COLORMAP_VIRIDIS)


def colour_motion(motion: Image, image: Image | None) -> Image:
    """What moves in red, what moves unconfirmed in yellow, upon the grey image where there is one.

    ``motion`` is ``(H, W)`` of 255, 128 or 0; returns ``(H, W, 3)``.
    """
    grey = np.full(motion.shape, UNKNOWN, np.uint8)
    if image is not None:
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    coloured = np.repeat(grey[..., None], 3, axis=2)
    for chosen, colour in ((motion == 255, MOVES), ((motion > 0) & (motion < 255), MOVES_UNCONFIRMED)):
        coloured[chosen] = coloured[chosen] // 2 + np.array(colour, np.uint8) // 2
    return coloured


def _colour_map(values: npt.NDArray[np.floating], colour_map: int) -> Image:
    steps = np.rint(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(steps, colour_map)[..., ::-1], dtype=np.uint8).copy()
