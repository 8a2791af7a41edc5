"""Images on their way into a network of another size, and depth on its way back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.depth_priors.depth_adapter import ImageInput, SizeRule
from mvdyn_gtsam.frontend.depth_priors.depth_prior import Float32

INTERPOLATIONS = {
    "nearest": cv2.INTER_NEAREST_EXACT,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "area": cv2.INTER_AREA,
}
ONE_SURFACE = 1.1
"""Largest ratio of the depths of neighbours that are taken for one surface; as ``LIKE_LOG_DEPTH`` of
tracking."""


BLOCK = 2**18
"""Pixels that are brought back at a time: what they take stays in the cache."""


@dataclass(frozen=True)
class Placement:
    """Where a frame lies in the image that a network sees; sizes are ``(width, height)`` px."""

    frame: tuple[int, int]
    inner: tuple[int, int]
    """Of the resized frame."""
    canvas: tuple[int, int]
    """Of the whole, padding included."""

    @property
    def offset(self) -> tuple[int, int]:
        """The resized frame's first pixel on the canvas."""
        return (self.canvas[0] - self.inner[0]) // 2, (self.canvas[1] - self.inner[1]) // 2

    def intrinsics(self, frame: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """``(3, 3)`` of the canvas, from those of the frame: ``x' = (x + 0.5) s - 0.5``, and the offset."""
        result = frame.copy()
        for axis in (0, 1):
            scale = self.inner[axis] / self.frame[axis]
            result[axis] *= scale
            result[axis, 2] += 0.5 * scale - 0.5 + self.offset[axis]
        return result

    def nearest(self, field: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """``(h, w)`` over the canvas, at any resolution, brought to the frame by nearest pixels."""
        columns, rows = self._positions(field.shape, 0), self._positions(field.shape, 1)
        return field[rows.nearest[:, None], columns.nearest]

    def depth(self, depth: Float32) -> Float32:
        """Depth ``(h, w)`` over the canvas, at any resolution, brought to the frame without mixing surfaces.

        Where the four pixels around are one surface it is interpolated linearly in inverse depth, which is
        exact on planes; elsewhere the nearest pixel has the word.
        """
        columns, rows = self._positions(depth.shape, 0), self._positions(depth.shape, 1)
        if not (columns.part.any() or rows.part.any()):
            return self.nearest(depth)
        result = np.empty(self.frame[::-1], np.float32)
        step = max(1, BLOCK // self.frame[0])
        for first in range(0, len(result), step):
            block = slice(first, first + step)
            result[block] = _interpolated(depth, rows.at(block), columns)
        return result

    def inside(self, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """Rows and columns of a field of ``shape`` over the canvas that show the frame, not padding."""
        bounds = []
        for axis in (1, 0):
            scale = shape[1 - axis] / self.canvas[axis]
            first = int(np.ceil(self.offset[axis] * scale - 1e-9))
            end = int(np.floor((self.offset[axis] + self.inner[axis]) * scale + 1e-9))
            bounds.append(slice(first, max(first + 1, end)))
        return bounds[0], bounds[1]

    def _positions(self, shape: tuple[int, ...], axis: int) -> _Positions:
        """Of the frame's columns (``axis`` 0) or rows in a field of ``shape``; none is in the padding."""
        scale = shape[1 - axis] / self.canvas[axis]
        size, inside = self.frame[axis], self.inside(shape)[1 - axis]
        on_canvas = (np.arange(size) + 0.5) * (self.inner[axis] / size) + self.offset[axis]
        # rounded, so that equal sizes are equal
        position = np.clip(np.round(on_canvas * scale - 0.5, 6), inside.start, inside.stop - 1)
        before = np.floor(position)
        return _Positions(
            before.astype(np.intp),
            np.ceil(position).astype(np.intp),
            (position - before).astype(np.float32),
            np.floor(position + 0.5).astype(np.intp),
        )


@dataclass(frozen=True)
class _Positions:
    """Where columns or rows of a frame fall between those of a field, each ``(N,)``."""

    before: npt.NDArray[np.intp]
    after: npt.NDArray[np.intp]
    part: Float32
    """How far behind ``before``, of the way to ``after``."""
    nearest: npt.NDArray[np.intp]

    def at(self, block: slice) -> _Positions:
        """Some of them."""
        return _Positions(self.before[block], self.after[block], self.part[block], self.nearest[block])


def _interpolated(depth: Float32, rows: _Positions, columns: _Positions) -> Float32:
    """See ``Placement.depth``."""
    upper, lower = depth[rows.before], depth[rows.after]
    corners = [row[:, column] for row in (upper, lower) for column in (columns.before, columns.after)]
    x, y = columns.part, rows.part[:, None]
    weights = ((1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x)
    smallest, largest = np.minimum.reduce(corners), np.maximum.reduce(corners)  # NaN where any is
    one_surface = (smallest > 0.0) & (largest <= np.float32(ONE_SURFACE) * smallest)
    inverse = sum(weight / corner for weight, corner in zip(weights, corners, strict=True))
    return np.where(one_surface, 1.0 / inverse, depth[rows.nearest[:, None], columns.nearest])


def place(frame: tuple[int, int], rule: SizeRule, fixed: tuple[int, int] | None) -> Placement:
    """Where a frame of ``(width, height)`` comes by ``rule``; ``fixed``: size of a network that has one."""
    if fixed is not None:
        if rule.fixed == "stretch":
            return Placement(frame, fixed, fixed)
        scale = min(fixed[0] / frame[0], fixed[1] / frame[1])
        inner = (_whole(frame[0] * scale, 1, fixed[0]), _whole(frame[1] * scale, 1, fixed[1]))
        return Placement(frame, inner, fixed)
    scale = 1.0
    if rule.short_side is not None:
        scale = rule.short_side / min(frame)
    elif rule.long_side is not None:
        scale = rule.long_side / max(frame)
    elif rule.pixels is not None:
        count = frame[0] * frame[1]
        scale = (min(max(count, rule.pixels[0]), rule.pixels[1]) / count) ** 0.5
    inner = (_whole(frame[0] * scale, rule.multiple), _whole(frame[1] * scale, rule.multiple))
    return Placement(frame, inner, inner)


def network_image(image: npt.NDArray[np.uint8], rule: ImageInput, placement: Placement) -> Float32:
    """What the network sees of ``image (H, W, 3) uint8`` RGB: ``(1, 3, H', W')``, or of rank 5."""
    colours = image.astype(np.float32) / np.float32(255.0)
    colours = colours if rule.channels == "RGB" else colours[..., ::-1]
    if placement.inner != placement.frame:
        smaller = placement.inner[0] * placement.inner[1] < placement.frame[0] * placement.frame[1]
        way = INTERPOLATIONS[rule.reduce if smaller else rule.enlarge]
        colours = cv2.resize(np.ascontiguousarray(colours), placement.inner, interpolation=way)
    canvas = np.empty((placement.canvas[1], placement.canvas[0], 3), np.float32)
    canvas[:] = rule.padding
    (left, top), (width, height) = placement.offset, placement.inner
    canvas[top : top + height, left : left + width] = colours
    mean, std = np.array(rule.mean, np.float32), np.array(rule.std, np.float32)
    canvas = (canvas * np.float32(rule.maximum) - mean) / std
    return np.ascontiguousarray(canvas.transpose(2, 0, 1)).reshape(
        (*(1,) * (rule.rank - 3), 3, *canvas.shape[:2])
    )


def _whole(length: float, multiple: int, most: int | None = None) -> int:
    rounded = max(1, round(length / multiple)) * multiple
    return rounded if most is None else min(rounded, most)
