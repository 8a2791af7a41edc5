"""Linear systems over the pixels of an image, each tied to its four neighbours.

Sparse, symmetric and positive definite, with five diagonals: of the depth solve and of outlines.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import cg

Float32 = npt.NDArray[np.float32]


def lattice_system(diagonal: Float32, across: Float32, down: Float32) -> sparse.dia_array:
    """Matrix ``(h w, h w)`` of the quadratic form ``sum diagonal x^2 + sum across (x - right)^2 + sum down (x
    - below)^2``.

    ``diagonal (h, w)`` has two columns at least; ``across`` and ``down (h, w)`` are the weights to the right
    and lower neighbours, 0 in the last column and row.
    """
    width, size = diagonal.shape[1], diagonal.size
    total = diagonal + across + down
    total[:, 1:] += across[:, :-1]
    total[1:] += down[:-1]
    # dia_array: entry k of the diagonal with offset d belongs to column k
    bands = np.zeros((5, size), np.float32)
    bands[0] = total.ravel()
    bands[1, 1:] = -across.ravel()[:-1]
    bands[2, :-1] = -across.ravel()[:-1]
    bands[3, width:] = -down.ravel()[:-width]
    bands[4, :-width] = -down.ravel()[:-width]
    return sparse.dia_array((bands, [0, 1, -1, width, -width]), (size, size))


def lattice_solution(matrix: sparse.dia_array, right: Float32, tolerance: float, steps: int) -> Float32:
    """``(N,)`` that solves ``matrix x = right (N,)``, by at most so many ``steps`` of conjugate gradients up
    to that relative residual.

    The diagonal as preconditioner is put into the system, ``(S A S) (S^-1 x) = S b`` with ``S`` the inverse
    root of the diagonal: applied in every iteration it took a tenth of the solve or more.
    """
    offsets, bands = matrix.offsets, matrix.data
    scale = 1.0 / np.sqrt(matrix.diagonal())
    # entry k of the diagonal with offset d belongs to column k and row k - d; beyond the ends bands are zero
    scaled = np.stack(
        [band * scale * np.roll(scale, offset) for band, offset in zip(bands, offsets, strict=True)]
    )
    solution, _ = cg(
        sparse.dia_array((scaled, offsets), matrix.shape), scale * right, rtol=tolerance, maxiter=steps
    )
    return np.asarray(scale * solution, np.float32)


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
