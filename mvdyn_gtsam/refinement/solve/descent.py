"""Gauss-Newton over frames: the sparse system of phase 1 and of phase 2's poses, and its descent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import spsolve

Array = npt.NDArray[np.float64]
State = TypeVar("State")
Direction = TypeVar("Direction")

SMALLEST_STEP = 1.0 / 128.0
"""Share of a Gauss-Newton step below which the descent gives up."""
CONVERGED = 1e-10
"""Relative decrease of the cost below which another iteration is not worth its pass over the disk."""


class FrameSystem:
    """Normal equations over frames of ``width`` unknowns each: cost, gradient and the blocks of coupled
    frames."""

    def __init__(self, frames: int, width: int) -> None:
        self.cost = 0.0
        self.gradient = np.zeros((frames, width))
        self.diagonal = np.zeros((frames, width, width))
        self._coupled: dict[tuple[int, int], Array] = {}

    def add(self, frames: Sequence[int], hessian: Array, gradient: Array, cost: float = 0.0) -> None:
        """Add a term of some frames: ``hessian (n width, n width)``, ``gradient (n width,)``."""
        self.cost += cost
        width = self.gradient.shape[1]
        for p, a in enumerate(frames):
            rows = slice(p * width, (p + 1) * width)
            self.gradient[a] += gradient[rows]
            self.diagonal[a] += hessian[rows, rows]
            for q in range(p + 1, len(frames)):
                self._couple(a, frames[q], hessian[rows, q * width : (q + 1) * width])

    def _couple(self, a: int, b: int, block: Array) -> None:
        if a == b:
            self.diagonal[a] += block + block.T
            return
        key, block = ((a, b), block) if a < b else ((b, a), block.T)
        self._coupled[key] = self._coupled[key] + block if key in self._coupled else block.copy()

    def step(self, free: npt.NDArray[np.bool_]) -> Array:
        """Gauss-Newton step ``(frames, width)``; zero for frames that are not ``free (frames,)``."""
        width = self.gradient.shape[1]
        step = np.zeros_like(self.gradient)
        if not free.any():
            return step
        position = np.cumsum(free) - 1
        blocks = [(int(a), int(a), self.diagonal[a]) for a in np.flatnonzero(free)]
        for (a, b), block in self._coupled.items():
            if free[a] and free[b]:
                blocks += [(a, b, block), (b, a, block.T)]
        inner_row, inner_col = (index.ravel() for index in np.indices((width, width)))
        rows = np.concatenate([position[a] * width + inner_row for a, _, _ in blocks])
        cols = np.concatenate([position[b] * width + inner_col for _, b, _ in blocks])
        values = np.concatenate([block.ravel() for _, _, block in blocks])
        size = int(free.sum()) * width
        matrix = sparse.coo_array((values, (rows, cols)), shape=(size, size)).tocsc()
        step[free] = spsolve(matrix, -self.gradient[free].ravel()).reshape(-1, width)
        return step


def descend(
    state: State,
    evaluate: Callable[[State], FrameSystem],
    direction: Callable[[State, FrameSystem], Direction],
    move: Callable[[State, Direction, float], State],
    iterations: int,
) -> State:
    """Gauss-Newton with a step that is halved until the cost falls; the cost never rises.

    ``move(state, direction, share)`` goes a share of the way. A system evaluated to judge a step is the next
    iteration's, so that a step taken at once costs one pass over the data.
    """
    system = evaluate(state)
    for _ in range(iterations):
        way, share = direction(state, system), 1.0
        while True:
            candidate = move(state, way, share)
            found = evaluate(candidate)
            if found.cost < system.cost:
                break
            share *= 0.5
            if share < SMALLEST_STEP:
                return state
        small = system.cost - found.cost < CONVERGED * system.cost
        state, system = candidate, found
        if small:
            break
    return state
