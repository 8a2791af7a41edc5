"""Procedural textures: noise of several octaves, bricks, posters and wallpaper, and the atlas they share."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]

ATLAS_WIDTH = 4096
PADDING = 16
"""Texels repeated around a texture, so that coarser levels do not show its neighbour."""
LEVELS = 4
"""Of the pyramid; each halves the resolution."""
OCTAVES_M = (1.3, 0.55, 0.23, 0.1, 0.045, 0.02)
"""Wavelengths of the noise."""


@dataclass(frozen=True)
class Paint:
    """How one surface looks."""

    size: tuple[float, float]
    """Width and height, m."""
    seed: tuple[int, ...]
    texture: float
    style: str
    """"noise", "bricks", "posters" or "wallpaper"."""
    texel: float
    """m"""


@dataclass(frozen=True)
class Atlas:
    """All textures in one image, with its pyramid beside it."""

    image: npt.NDArray[np.uint8]
    """``(H, W + W/2, 3)`` RGB: level 0 on the left, the others below each other on the right."""
    origins: npt.NDArray[np.float64]
    """``(textures, 2)`` px of level 0: where coordinate (0, 0) of each texture is."""
    level_offsets: npt.NDArray[np.float32]
    """``(LEVELS, 2)`` px: where each level starts."""

    def sample(
        self, x: npt.NDArray[np.float32], y: npt.NDArray[np.float32], level: npt.NDArray[np.float32]
    ) -> Image:
        """Colours ``(R, C, 3)`` 0 to 255 at texels ``(R, C)`` of level 0, blended between two levels."""
        level = np.clip(level, 0.0, LEVELS - 1)
        below = np.minimum(level.astype(np.int32), LEVELS - 2)
        fine, coarse = (self._at(x, y, below + step) for step in (0, 1))
        return np.asarray(fine + (level - below)[..., None] * (coarse - fine), dtype=np.float32)

    def _at(
        self, x: npt.NDArray[np.float32], y: npt.NDArray[np.float32], level: npt.NDArray[np.int32]
    ) -> Image:
        scale = np.float32(0.5) ** np.arange(LEVELS, dtype=np.float32)
        offset, s = self.level_offsets[level], scale[level]
        half = np.float32(0.5)
        map_x = (x + half) * s - half + offset[..., 0]
        map_y = (y + half) * s - half + offset[..., 1]
        return np.asarray(cv2.remap(self.image, map_x, map_y, cv2.INTER_LINEAR), dtype=np.float32)


def build_atlas(paints: Sequence[Paint]) -> Atlas:
    """Paint every texture and pack them in rows, the tallest first."""
    sizes = [_texels(paint) for paint in paints]
    width = max([ATLAS_WIDTH, *(w + 2 * PADDING for w, _ in sizes)])
    width += -width % 2**LEVELS
    corners = np.zeros((len(paints), 2), dtype=np.int64)
    x = y = row = 0
    for index in sorted(range(len(paints)), key=lambda k: (-sizes[k][1], k)):
        w, h = sizes[index][0] + 2 * PADDING, sizes[index][1] + 2 * PADDING
        if x + w > width:
            x, y, row = 0, y + row, 0
        corners[index] = x, y
        x, row = x + w, max(row, h)
    height = y + row + (-(y + row) % 2**LEVELS)
    image = np.zeros((height, width + width // 2, 3), dtype=np.uint8)
    for paint, (left, top) in zip(paints, corners, strict=True):
        padded = cv2.copyMakeBorder(_painted(paint), PADDING, PADDING, PADDING, PADDING, cv2.BORDER_REPLICATE)
        image[top : top + padded.shape[0], left : left + padded.shape[1]] = padded
    offsets = np.zeros((LEVELS, 2), dtype=np.float32)
    level, top = image[:, :width], 0
    for k in range(1, LEVELS):
        level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        offsets[k] = width, top
        image[top : top + level.shape[0], width : width + level.shape[1]] = level
        top += level.shape[0]
    return Atlas(image, corners + np.float64(PADDING - 0.5), offsets)


def _texels(paint: Paint) -> tuple[int, int]:
    return max(2, round(paint.size[0] / paint.texel)), max(2, round(paint.size[1] / paint.texel))


def _painted(paint: Paint) -> npt.NDArray[np.uint8]:
    """``(h, w, 3)`` RGB."""
    # Two streams, because how many numbers the noise takes depends on the resolution.
    rng, fine = (np.random.default_rng([*paint.seed, stream]) for stream in (0, 1))
    w, h = _texels(paint)
    base = np.array(colorsys.hsv_to_rgb(rng.random(), 0.08 + 0.32 * rng.random(), 0.5 + 0.35 * rng.random()))
    color = np.broadcast_to(base.astype(np.float32), (h, w, 3)).copy()
    if paint.texture > 0.0:
        if paint.style == "wallpaper":
            tile = _noise(fine, 0.36, 0.36, 96, 96, OCTAVES_M[1:])
            step = max(2, round(0.36 / paint.texel))
            tile = cv2.resize(tile, (step, step), interpolation=cv2.INTER_AREA)
            pattern = np.tile(tile, (h // step + 1, w // step + 1, 1))[:h, :w]
        else:
            pattern = _noise(fine, *paint.size, w, h, OCTAVES_M)
            if paint.style == "bricks":
                pattern += _bricks(rng, paint, w, h)
            elif paint.style == "posters":
                _posters(rng, paint, pattern)
        color *= 1.0 + paint.texture * pattern
    return np.asarray(np.clip(np.rint(color * 255.0), 4, 255), dtype=np.uint8)


def _noise(
    rng: np.random.Generator, width: float, height: float, w: int, h: int, octaves: Sequence[float]
) -> Image:
    """Value noise ``(h, w, 3)``, about -1 to 1; the grid of each octave does not depend on the resolution."""
    result = np.zeros((h, w, 3), dtype=np.float32)
    for octave in octaves:
        if octave * w / width < 1.0:
            break  # finer than the texels: would only alias
        columns, rows = int(width / octave) + 3, int(height / octave) + 3
        grey = rng.uniform(-1.0, 1.0, (rows, columns, 1))
        grid = (0.8 * grey + 0.2 * rng.uniform(-1.0, 1.0, (rows, columns, 3))).astype(np.float32)
        x = (np.arange(w, dtype=np.float32) + 0.5) * np.float32(width / w / octave)
        y = (np.arange(h, dtype=np.float32) + 0.5) * np.float32(height / h / octave)
        map_x, map_y = np.meshgrid(x, y)
        result += 0.3 * cv2.remap(grid, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result


def _bricks(rng: np.random.Generator, paint: Paint, w: int, h: int) -> Image:
    """Courses of bricks 0.24 x 0.08 m, each of its own shade, with dark joints."""
    x = (np.arange(w) + 0.5) * paint.size[0] / w / 0.24
    y = (np.arange(h) + 0.5) * paint.size[1] / h / 0.08
    row = y.astype(np.int64)
    shifted = x[None, :] + 0.5 * (row[:, None] % 2)
    column = shifted.astype(np.int64)
    shades = rng.uniform(-0.45, 0.35, (row.max() + 1, column.max() + 1)).astype(np.float32)
    result = shades[np.broadcast_to(row[:, None], column.shape), column]
    joint = (shifted - column < 0.05) | (y - row < 0.13)[:, None]
    return np.asarray(np.where(joint, -0.5, result)[..., None], dtype=np.float32)


def _posters(rng: np.random.Generator, paint: Paint, pattern: Image) -> None:
    """Rectangles and discs of 0.1 to 0.7 m, three a square metre."""
    h, w = pattern.shape[:2]
    scale = np.array([w / paint.size[0], h / paint.size[1]])
    for _ in range(max(1, round(3 * paint.size[0] * paint.size[1]))):
        center = rng.random(2) * np.array(paint.size)
        half = rng.uniform(0.05, 0.35, 2)
        shade = rng.uniform(-0.6, 0.5, 3)
        low, high = np.rint((center - half) * scale), np.rint((center + half) * scale)
        if rng.random() < 0.6:
            patch = pattern[
                max(0, int(low[1])) : max(0, int(high[1])), max(0, int(low[0])) : max(0, int(high[0]))
            ]
            patch[...] = 0.5 * patch + shade
        else:
            middle, axes = np.rint(center * scale).astype(int), np.rint(half * scale / 2).astype(int)
            cv2.ellipse(pattern, middle.tolist(), np.maximum(axes, 1).tolist(), 0, 0, 360, shade.tolist(), -1)
