"""The normal equations of a large graph as one sparse matrix, and Levenberg-Marquardt on them.

GTSAM's sequential elimination copies the information of everything a variable touches for each variable. In
a long video of cameras that see each other at all times that is nearly all of the graph: 424 keyframes took
13 s per solve where SuperLU takes 1.3 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

Array = npt.NDArray[np.float64]

FACTORS_AT_ONCE = 25
"""Factors whose blocks are held before they are summed: all at once would be the largest thing in memory."""
MAXIMUM_DAMPING = 1e5
"""At which no step is found any more; GTSAM's."""


@dataclass(frozen=True)
class NormalEquations:
    """``information x = gradient`` in the order of the keys they were made for."""

    information: sparse.csc_array
    """``(N, N)``"""
    gradient: Array
    """``(N,)`` steepest descent"""
    spans: dict[int, npt.NDArray[np.int32]]
    """Rows of each key."""

    @staticmethod
    def of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: Sequence[int]) -> NormalEquations:
        """``graph`` linearised at ``values``, whose keys are all of ``keys``."""
        zeros = values.zeroVectors()
        sizes = [len(zeros.at(key)) for key in keys]
        first = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)
        spans = {
            key: start + np.arange(size, dtype=np.int32)
            for key, start, size in zip(keys, first, sizes, strict=True)
        }
        shape = (sum(sizes), sum(sizes))
        total, gradient = sparse.csc_array(shape), np.zeros(sum(sizes))
        for start in range(0, graph.size(), FACTORS_AT_ONCE):
            parts = []
            for k in range(start, min(start + FACTORS_AT_ONCE, graph.size())):
                factor = graph.at(k).linearize(values)
                index = np.concatenate([spans[key] for key in factor.keys()])
                augmented = factor.augmentedInformation()
                gradient[index] += augmented[:-1, -1]
                block = augmented[:-1, :-1].ravel()
                parts.append((block, np.repeat(index, len(index)), np.tile(index, len(index))))
            data, rows, cols = (np.concatenate(part) for part in zip(*parts, strict=True))
            total += sparse.csc_array(sparse.coo_array((data, (rows, cols)), shape=shape))
        return NormalEquations(total, gradient, spans)

    def step(self, damping: float) -> gtsam.VectorValues:
        """The solution with ``damping`` added to the diagonal."""
        diagonal = self.information.diagonal() + damping
        scale = 1.0 / np.sqrt(diagonal)
        damped = scaled(self.information, scale)
        # of unit diagonal then, the damping included
        damped.setdiag(np.ones(len(scale)))
        solution = scale * factorised(damped).solve(scale * self.gradient)
        result = gtsam.VectorValues()
        for key, span in self.spans.items():
            result.insert(key, solution[span])
        return result


def scaled(matrix: sparse.csc_array, scale: Array) -> sparse.csc_array:
    """``matrix`` times ``scale`` on both sides."""
    result = matrix.copy()
    result.data *= scale[result.indices]
    result.data *= np.repeat(scale, np.diff(result.indptr))
    return result


def factorised(matrix: sparse.csc_array) -> Any:
    """SuperLU of a symmetric positive definite matrix. Raises RuntimeError where it is singular."""
    return splu(sparse.csc_matrix(matrix), "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})


def descend(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    error: float,
    damping: float,
    iterations: int,
    tolerance: float,
) -> tuple[gtsam.Values, float]:
    """Levenberg-Marquardt as GTSAM's: at most so many steps, until one gains less than ``tolerance``."""
    keys = list(values.keys())
    for _ in range(iterations):
        equations = NormalEquations.of(graph, values, keys)
        before = error
        while damping <= MAXIMUM_DAMPING:
            try:
                candidate = values.retract(equations.step(damping))
            except RuntimeError:  # singular: SuperLU says so this way
                damping *= 10.0
                continue
            candidate_error = graph.error(candidate)
            if candidate_error < error:
                values, error = candidate, candidate_error
                damping *= 0.1
                break
            damping *= 10.0
        if before - error < tolerance * before:
            break
    return values, error
