"""A regular grid of pixels: what the tracker keeps of a dense field, and the way back to a dense one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Grid:
    """Every ``stride``-th pixel of an image, row by row, the same margin left and right (to one pixel)."""

    pixels: npt.NDArray[np.float64]
    """``(N, 2)`` x, y; whole numbers, so that sampling mixes no neighbours across a depth edge."""
    shape: tuple[int, int]
    """``(rows, cols)``, ``rows * cols == N``."""
    stride: int

    @staticmethod
    def covering(width: int, height: int, stride: int) -> Grid:
        """The centred grid of an image. Raises ValueError when image or stride is empty."""
        if min(width, height, stride) < 1:
            raise ValueError(f"a grid of stride {stride} over {width} x {height} pixels is empty")
        x, y = (_positions(length, stride) for length in (width, height))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
        return Grid(pixels, (len(y), len(x)), stride)

    def __len__(self) -> int:
        return len(self.pixels)

    def sample(self, field: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values ``(N[, C])`` of a dense ``(H, W[, C])`` field at the grid's pixels, a copy."""
        x, y = self.pixels[0].astype(int)
        last_x, last_y = self.pixels[-1].astype(int)
        if last_y >= field.shape[0] or last_x >= field.shape[1]:
            raise ValueError(f"a field of shape {field.shape} does not hold pixel ({last_x}, {last_y})")
        picked = field[y : last_y + 1 : self.stride, x : last_x + 1 : self.stride]
        return picked.reshape(len(self), *field.shape[2:]).copy()

    def expand(self, values: npt.NDArray[Any], width: int, height: int) -> npt.NDArray[np.float32]:
        """Dense ``(H, W) float32`` field through the grid's values ``(N,)``.

        Bilinear between grid points, constant beyond the outermost; exact at the grid's pixels. NaN
        values reach as far as their cells.
        """
        table = np.asarray(values, np.float32).reshape(self.shape)
        rows = _interpolate(table.T, self.pixels[:: self.shape[1], 1], height).T
        return np.ascontiguousarray(_interpolate(rows, self.pixels[: self.shape[1], 0], width))


def _positions(length: int, stride: int) -> npt.NDArray[np.int64]:
    count = max(1, length // stride)
    return (length - 1 - (count - 1) * stride) // 2 + stride * np.arange(count)


def _interpolate(
    table: npt.NDArray[np.float32], positions: npt.NDArray[np.float64], length: int
) -> npt.NDArray[np.float32]:
    """``(R, length)`` from ``(R, C)`` columns given at ``positions (C,)``."""
    index = np.interp(np.arange(length), positions, np.arange(len(positions)))
    low = np.floor(index).astype(int)
    fraction = (index - low).astype(np.float32)
    high = np.where(fraction > 0.0, low + 1, low)
    return table[:, low] * (1.0 - fraction) + table[:, high] * fraction
