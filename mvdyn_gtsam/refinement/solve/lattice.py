"""Linear systems over the pixels of an image, each tied to its four neighbours.

Sparse, symmetric and positive definite, with five diagonals: of the depth solve and of outlines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Lattice:
    """The quadratic form ``sum diagonal x^2 + sum across (x - right)^2 + sum down (x - below)^2``."""

    diagonal: Float32
    """``(h, w)`` above 0."""
    across: Float32
    """``(h, w)`` weights to the right neighbours, 0 in the last column."""
    down: Float32
    """``(h, w)`` to the lower neighbours, 0 in the last row."""

    def total(self) -> Float32:
        """Diagonal ``(h, w)`` of the form's matrix."""
        total = self.diagonal + self.across + self.down
        total[:, 1:] += self.across[:, :-1]
        total[1:] += self.down[:-1]
        return total

    def matrix(self) -> sparse.coo_array:
        """``(h w, h w)``: the form is ``x^T matrix x``."""
        pixel = np.arange(self.diagonal.size).reshape(self.diagonal.shape)
        here = np.concatenate([pixel[:, :-1].ravel(), pixel[:-1].ravel()])
        there = np.concatenate([pixel[:, 1:].ravel(), pixel[1:].ravel()])
        tie = -np.concatenate([self.across[:, :-1].ravel(), self.down[:-1].ravel()])
        values = np.concatenate([self.total().ravel(), tie, tie])
        rows, columns = np.r_[pixel.ravel(), here, there], np.r_[pixel.ravel(), there, here]
        return sparse.coo_array((values, (rows, columns)), (pixel.size, pixel.size))


def lattice_solution(lattice: Lattice, right: Float32, tolerance: float, steps: int) -> Float32:
    """``x (h, w)`` with ``matrix x = right (h, w)``, by at most so many ``steps`` of conjugate gradients up
    to that relative residual.

    The pixels are those of a chessboard: black ones are tied to red ones only, so that these are eliminated
    by a division each. What is left, ``I - C^T C`` once the diagonal is scaled to 1, takes half the steps at
    the same price (https://doi.org/10.1137/0709032).
    """
    width = lattice.diagonal.shape[1]
    # even, so that every row has as many black pixels as red ones, and no two diagonals fall together
    more = max(4, width + width % 2) - width
    if more:
        ties = (_widened(values, more, 0.0) for values in (lattice.across, lattice.down))
        wider = Lattice(_widened(lattice.diagonal, more, 1.0), *ties)
        return lattice_solution(wider, _widened(right, more, 0.0), tolerance, steps)[:, :width]
    scale = np.asarray(1.0 / np.sqrt(lattice.total()), np.float32)
    black_right, red_right = _split(scale * right)
    to_red, to_black = _couplings(lattice, scale)

    def without_red(black: Float32) -> Float32:
        return np.asarray(black - to_black @ (to_red @ black))

    operator = LinearOperator(to_red.shape, matvec=without_red, dtype=np.float32)
    black, _ = cg(operator, black_right + to_black @ red_right, rtol=tolerance, maxiter=steps)
    return np.asarray(scale * _joined(black, red_right + to_red @ black, scale.shape), np.float32)


def _couplings(lattice: Lattice, scale: Float32) -> tuple[sparse.dia_array, sparse.dia_array]:
    """``C (N, N)`` from black pixels to red ones, of the matrix with its diagonal scaled to 1, and its
    transpose; both colours are numbered by rows.

    Black pixel ``k`` of a row lies left of red pixel ``k`` in even rows, right of it in odd ones.
    """
    across, down = lattice.across * scale, lattice.down * scale
    across[:, :-1] *= scale[:, 1:]
    down[:-1] *= scale[1:]
    (black_right, red_right), (black_below, red_below) = _split(across), _split(down)
    width = across.shape[1] // 2
    odd = (np.arange(len(black_right)) // width) % 2 == 1
    same = np.where(odd, red_right, black_right)
    even_next, odd_next = np.where(odd, 0.0, red_right), np.where(odd, black_right, 0.0)
    # dia_array: entry k of the diagonal with offset d belongs to column k
    to_red = [same, _later(even_next, 1), odd_next, _later(red_below, width), black_below]
    to_black = [same, even_next, _later(odd_next, 1), red_below, _later(black_below, width)]
    offsets, shape = np.array([0, 1, -1, width, -width]), (len(same), len(same))
    return (
        sparse.dia_array((np.stack(to_red).astype(np.float32), offsets), shape),
        sparse.dia_array((np.stack(to_black).astype(np.float32), -offsets), shape),
    )


def _split(values: Float32) -> tuple[Float32, Float32]:
    """``(N,)`` each of ``values (h, w)``, w even: those of the black pixels, x + y even, and of the red."""
    black = np.empty((values.shape[0], values.shape[1] // 2), np.float32)
    red = np.empty_like(black)
    black[::2], black[1::2] = values[::2, ::2], values[1::2, 1::2]
    red[::2], red[1::2] = values[::2, 1::2], values[1::2, ::2]
    return black.ravel(), red.ravel()


def _joined(black: Float32, red: Float32, shape: tuple[int, ...]) -> Float32:
    """``(h, w)`` of what ``_split`` makes."""
    values = np.empty(shape, np.float32)
    black, red = black.reshape(len(values), -1), red.reshape(len(values), -1)
    values[::2, ::2], values[1::2, 1::2] = black[::2], black[1::2]
    values[::2, 1::2], values[1::2, ::2] = red[::2], red[1::2]
    return values


def _later(values: Float32, count: int) -> Float32:
    """``values (N,)`` after ``count`` zeros, cut to ``N``."""
    return np.concatenate([np.zeros(count, values.dtype), values[:-count]])


def _widened(values: Float32, more: int, beside: float) -> Float32:
    """``(h, w + more)``: beside ``values (h, w)`` one number."""
    return np.pad(values, ((0, 0), (0, more)), constant_values=beside)


def neighbour_likeness(colour: Float32, contrast: float) -> tuple[Float32, Float32]:
    """``(h, w)`` each: in [0, 1] how like its right and lower neighbour a pixel of ``colour (h, w, C)`` is.

    1/e at a difference of ``contrast``; 0 in the last column and row, which have none.
    """
    across, down = (np.zeros(colour.shape[:2], np.float32) for _ in range(2))
    # channel by channel, a third of the time less
    channels = np.ascontiguousarray(np.moveaxis(colour, 2, 0))
    for likeness, axis in ((across[:, :-1], 2), (down[:-1], 1)):
        difference = np.diff(channels, axis=axis)
        likeness[:] = np.exp(np.sqrt((difference * difference).sum(axis=0)) / np.float32(-contrast))
    return across, down
