"""Surfaces of a moving region that patches of another camera's image fit: depth and slant.

A sweep compares patches as if they faced the camera. Cameras that stand apart see a surface
foreshortened, and where it lies between two depths of the sweep nothing looks alike. So every few pixels
get a plane of their own, which they improve by those of their neighbours and by chance (PatchMatch
stereo, https://doi.org/10.5244/C.25.14).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

MOST_CELLS = 1000
"""Cells of a region at most, each with a plane, and no smaller than ``LEAST_SIDE`` px of the view."""
LEAST_SIDE = 2
RADIUS, SPACING = 4, 2
"""Half the side of a patch, and the distance of the points compared, px of the view. Source: 3 and 1, 4 and
1, and these compared on four rendered scenes, all within 4 %; without colour robodog_overlap and
three_cameras are worse by 6 %."""
ALIKE_GREYS = 15.0
"""Difference of luminance from the middle at which a point of a patch counts 1/e, so that a patch ends where
its thing does. Source: 15, 40 and 1000 compared on two of them; wider is worse."""
OUTSIDE = 0.1
"""What a point outside of the region counts."""
NOISE = 2.0
"""Of the image, grey levels: patches with less contrast look like nothing. Source: as ``SweepConfig``."""
LEAST_INSIDE = 0.8
"""Share of a patch that another image must hold."""
STEEPEST = 1.5
"""Change of inverse depth, relative, per focal length: a surface turned by 56 degrees."""
FARTHEST = 0.7
"""Log depth from the region's at most."""
PRIOR, PRIOR_REACH = np.float32(0.1), np.float32(0.3)
"""Likeness that a plane loses at such a log depth from the region's, or farther."""
ROUNDS, FIRST_GUESSES, GUESSES = 2, 8, 4
"""Source: 2, 3 and 5 rounds compared there, all within 2 %."""
GUESS = 0.2
"""Log depth by which the first guesses of a round differ at most; every next one by half as much."""
NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0), (0, 3), (0, -3), (3, 0), (-3, 0))
"""Cells down and across whose planes are tried."""


@dataclass(frozen=True)
class PatchView:
    """Another camera at the same instant."""

    colour: Float32
    """``(h_j, w_j, C)``"""
    intrinsics: Array
    """``(3, 3)``"""
    jTi: Array
    """``(4, 4)``"""
    say: float
    """In [0, 1] what it counts that a patch looks alike there."""


@dataclass(frozen=True)
class Planes:
    """A plane for each of ``M`` pixels: ``d`` px beside it lies at the inverse depth ``exp(theta) (1 + slope
    d)``."""

    theta: Float32
    """``(M,)`` log inverse depth."""
    slope: Float32
    """``(M, 2)`` across and down, per px."""

    def at(self, offset: Float32) -> Planes:
        """The same planes, of the pixels at ``offset (M, 2)``."""
        growth = np.maximum(1.0 + (self.slope * offset).sum(axis=1), np.float32(0.3))
        return Planes(self.theta + np.log(growth), self.slope / growth[:, None])

    def of(self, pixels: Index) -> Planes:
        """Those of some pixels."""
        return Planes(self.theta[pixels], self.slope[pixels])


@dataclass(frozen=True)
class Fit:
    """What is found at the ``N`` pixels of a region."""

    theta: Float32
    """``(N,)`` log inverse depth."""
    slope: Float32
    """``(N, 2)`` its change across and down, per px."""
    likeness: Float32
    """``(N,)`` how alike patches look there, at most 1."""


def fitted_planes(
    theta: Float32,
    region: Mask,
    colour: Float32,
    intrinsics: Array,
    views: Sequence[PatchView],
    seed: tuple[int, ...],
) -> Fit:
    """The surface of ``region (h, w)`` that fits ``views`` best.

    The search begins at ``theta (h, w)``. Where no view sees the surface it finds nonsense: only what the
    searches of two cameras agree on is right. ``colour (h, w, C)`` is the image, ``intrinsics (3, 3)`` are
    its; ``seed`` decides what is tried.
    """
    cells = _Cells(region)
    search = _Search(cells, theta, region, colour, intrinsics, views)
    generator = np.random.default_rng(seed)
    steepest = STEEPEST / float(intrinsics[0, 0])
    for _ in range(FIRST_GUESSES):
        search.guess(generator, GUESS, steepest)
    for number in range(ROUNDS):
        for down, across in NEIGHBOURS:
            search.take_from(*cells.neighbours(down, across))
        for guess in range(GUESSES):
            share = 0.5 ** (number + guess)
            search.guess(generator, GUESS * share, steepest, share)
    planes = search.planes.of(cells.of_pixel).at(cells.offset)
    return Fit(planes.theta, planes.slope, search.likeness[cells.of_pixel])


class _Cells:
    """A region in squares, each with the pixel of the region that is nearest to its middle."""

    def __init__(self, region: Mask) -> None:
        rows, columns = np.nonzero(region)
        side = max(LEAST_SIDE, int(np.ceil(np.sqrt(len(rows) / MOST_CELLS))))
        at = np.stack([rows // side, columns // side], axis=1)
        shape = at.max(axis=0) + 1
        middle = np.hypot(rows - (at[:, 0] + 0.5) * side + 0.5, columns - (at[:, 1] + 0.5) * side + 0.5)
        number = at[:, 0] * shape[1] + at[:, 1]
        order = np.lexsort((middle, number))
        cell, first, inverse = np.unique(number[order], return_index=True, return_inverse=True)
        self.row, self.column = rows[order[first]], columns[order[first]]
        self.of_pixel = np.empty(len(rows), np.int64)
        self.of_pixel[order] = inverse
        """``(N,)`` cell of each pixel of the region."""
        self.offset = self._from(rows, columns, self.of_pixel)
        """``(N, 2)`` of each pixel from that of its cell, px across and down."""
        self._at = np.stack(np.divmod(cell, shape[1]), axis=1)
        self._table = np.full(shape, -1, np.int64)
        self._table[tuple(self._at.T)] = np.arange(len(cell))

    def neighbours(self, down: int, across: int) -> tuple[Index, Index, Float32]:
        """Cells that have another so far away, that one, and the offset ``(K, 2)`` from it, px."""
        row, column = (self._at + np.array([down, across])).T
        inside = (row >= 0) & (column >= 0) & (row < self._table.shape[0]) & (column < self._table.shape[1])
        other = np.where(inside, self._table[np.where(inside, row, 0), np.where(inside, column, 0)], -1)
        own = np.flatnonzero(other >= 0)
        return own, other[own], self._from(self.row[own], self.column[own], other[own])

    def _from(self, rows: Index, columns: Index, cell: Index) -> Float32:
        return np.stack([columns - self.column[cell], rows - self.row[cell]], axis=1).astype(np.float32)


class _Search:
    """The best planes so far of the pixels of ``cells``, and how alike their patches look."""

    def __init__(
        self,
        cells: _Cells,
        theta: Float32,
        region: Mask,
        colour: Float32,
        intrinsics: Array,
        views: Sequence[PatchView],
    ) -> None:
        row, column = cells.row, cells.column
        across = np.arange(-RADIUS, RADIUS + 1, SPACING)
        self._offset = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2).astype(np.float32)
        x = np.clip(column[:, None] + self._offset[:, 0], 0, region.shape[1] - 1).astype(np.int64)
        y = np.clip(row[:, None] + self._offset[:, 1], 0, region.shape[0] - 1).astype(np.int64)
        patch, middle = colour[y, x], colour[row, column, 0][:, None]
        weight = np.exp(np.abs(patch[..., 0] - middle) / np.float32(-ALIKE_GREYS))
        weight *= np.where(region[y, x], np.float32(1.0), np.float32(OUTSIDE))
        self._weight = weight / weight.sum(axis=1, keepdims=True)
        patch = patch - np.einsum("ms,msc->mc", self._weight, patch)[:, None]
        self._patch = self._weight[..., None] * patch
        self._variance = np.einsum("msc,msc->m", self._patch, patch) + np.float32(NOISE**2)
        pixels = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
        turned = [view.intrinsics @ view.jTi[:3, :3] @ np.linalg.inv(intrinsics) for view in views]
        far = [(each @ pixels).astype(np.float32).reshape(3, *x.shape) for each in turned]
        self._views = list(zip(views, far, strict=True))
        """Each with where it sees what is infinitely far away in the patches, ``(3, M, S)`` homogeneous."""
        self._middle = np.float32(np.median(theta[region]))
        self.planes = Planes(theta[row, column].astype(np.float32), np.zeros((len(row), 2), np.float32))
        every = np.arange(len(row))
        self.likeness = self._likeness(every, self.planes)

    def take_from(self, own: Index, other: Index, offset: Float32) -> None:
        """Let pixels ``own (K,)`` take the planes of ``other (K,)``, ``offset (K, 2)`` px away, where those
        look more alike."""
        # a small region has no cells so far apart
        if len(own):
            self._offer(own, self.planes.of(other).at(offset))

    def guess(
        self, generator: np.random.Generator, depth: float, steepest: float, share: float = 1.0
    ) -> None:
        """Try planes whose log depth differs by ``depth`` at most, whose slopes by a ``share`` of the
        ``steepest``."""
        count = len(self.likeness)
        chance = generator.uniform(-1.0, 1.0, (3, count)).astype(np.float32)
        slope = self.planes.slope + np.float32(share * steepest) * chance[1:].T
        theta = self.planes.theta + np.float32(depth) * chance[0]
        limit = np.float32(steepest)
        self._offer(np.arange(count), Planes(theta, np.clip(slope, -limit, limit)))

    def _offer(self, pixels: Index, planes: Planes) -> None:
        low, high = self._middle - np.float32(FARTHEST), self._middle + np.float32(FARTHEST)
        planes = Planes(np.clip(planes.theta, low, high), planes.slope)
        likeness = self._likeness(pixels, planes)
        better = np.flatnonzero(likeness > self.likeness[pixels])
        theta, slope = self.planes.theta.copy(), self.planes.slope.copy()
        theta[pixels[better]], slope[pixels[better]] = planes.theta[better], planes.slope[better]
        self.likeness[pixels[better]] = likeness[better]
        self.planes = Planes(theta, slope)

    def _likeness(self, pixels: Index, planes: Planes) -> Float32:
        """Correlation ``(K,)`` of the patches of ``pixels (K,)`` with the view that likes them best."""
        growth = np.maximum(1.0 + planes.slope @ self._offset.T, np.float32(0.2))
        inverse_depth = np.exp(planes.theta)[:, None] * growth
        best = np.zeros(len(pixels), np.float32)
        for view, far in self._views:
            np.maximum(best, np.float32(view.say) * self._alike(pixels, inverse_depth, view, far), out=best)
        off = np.minimum(np.abs(planes.theta - self._middle) / PRIOR_REACH, np.float32(1.0))
        return np.asarray(best - PRIOR * off, np.float32)

    def _alike(self, pixels: Index, inverse_depth: Float32, view: PatchView, far: Float32) -> Float32:
        shift = (view.intrinsics @ view.jTi[:3, 3]).astype(np.float32)
        u, v, depth = (far[axis, pixels] + shift[axis] * inverse_depth for axis in range(3))
        front = depth > 1e-3
        depth = np.where(front, depth, np.float32(1.0))
        u, v = u / depth, v / depth
        height, width = view.colour.shape[:2]
        inside = front & (u >= 0.0) & (v >= 0.0) & (u <= width - 1.0) & (v <= height - 1.0)
        seen = cv2.remap(view.colour, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        weight = self._weight[pixels]
        # the own patch has no mean, so that the other's need not be taken away
        covariance = np.einsum("msc,msc->m", self._patch[pixels], seen)
        mean = np.einsum("ms,msc->mc", weight, seen)
        seen *= seen
        variance = np.einsum("ms,msc->m", weight, seen) - (mean * mean).sum(axis=1)
        variance = np.maximum(variance, np.float32(0.0)) + np.float32(NOISE**2)
        alike = covariance / np.sqrt(variance * self._variance[pixels])
        return np.where(inside.mean(axis=1) >= LEAST_INSIDE, alike, np.float32(0.0))
