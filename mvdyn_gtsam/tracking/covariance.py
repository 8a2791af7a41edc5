"""Marginal covariances of all keyframes: blocks of the inverse of the polish's information matrix."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu

from factors.keys import M, S, X
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.tracking.model import Keyframe, View
from mvdyn_gtsam.tracking.polish import NO_MOUNTS, Mounts, build_graph
from mvdyn_gtsam.tracking.window import Priors

LARGEST_INVERSE = 3000
"""Unknowns up to which one dense inverse is faster than marginals from the Bayes tree; 72 MB."""


def marginal_covariances(
    keyframes: list[Keyframe],
    views: tuple[View, ...],
    config: TrackingConfig,
    priors: Priors,
    mounts: Mounts = NO_MOUNTS,
) -> dict[Frame, npt.NDArray[np.float64]]:
    """``(6, 6)`` covariance of every keyframe's pose, tangent ``[omega, v]``."""
    graph, values = build_graph(keyframes, views, config, priors, mounts=mounts)
    ordering = gtsam.Ordering()
    for keyframe in keyframes:
        ordering.push_back(X(*keyframe.frame))
        ordering.push_back(S(*keyframe.frame))
    for pair in mounts:
        ordering.push_back(M(*pair))
    linear = graph.linearize(values)
    rows = [np.arange(7 * row, 7 * row + 6) for row in range(len(keyframes))]
    if 7 * len(keyframes) > LARGEST_INVERSE:
        blocks = _inverse_blocks(_sparse_information(linear, ordering, values), rows)
    else:
        information, _ = linear.hessian(ordering)
        # unit diagonal: the gauge is held a million times as firmly as the rest
        scale = 1.0 / np.sqrt(np.diagonal(information))
        factor = cho_factor(information * scale[:, None] * scale)
        covariance = scale[:, None] * cho_solve(factor, np.diag(scale))
        blocks = [covariance[np.ix_(row, row)] for row in rows]
    return {keyframe.frame: block for keyframe, block in zip(keyframes, blocks, strict=True)}


def _sparse_information(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, values: gtsam.Values
) -> sparse.csc_array:
    """The information matrix in the order of ``ordering``, of the factors' own blocks."""
    keys = [ordering.at(k) for k in range(ordering.size())]
    zeros = values.zeroVectors()
    sizes = [len(zeros.at(key)) for key in keys]
    first = dict(zip(keys, np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(int), strict=True))
    size_of = dict(zip(keys, sizes, strict=True))
    parts: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], npt.NDArray[np.int64]]] = []
    for k in range(linear.size()):
        factor = linear.at(k)
        index = np.concatenate([first[key] + np.arange(size_of[key]) for key in factor.keys()])
        block = factor.information()
        parts.append((block.ravel(), np.repeat(index, len(index)), np.tile(index, len(index))))
    data, rows, cols = (np.concatenate(part) for part in zip(*parts, strict=True))
    return sparse.csc_array(sparse.coo_array((data, (rows, cols)), shape=(sum(sizes), sum(sizes))))


def _inverse_blocks(
    information: sparse.csc_array, rows: Sequence[npt.NDArray[np.int64]], at_once: int = 30
) -> list[npt.NDArray[np.float64]]:
    """Diagonal blocks ``rows`` of the inverse, some columns at a time: never the whole of it in memory."""
    # unit diagonal, as above
    scale = 1.0 / np.sqrt(information.diagonal())
    scaling = sparse.diags_array(scale)
    solver = splu(sparse.csc_matrix(scaling @ information @ scaling), "MMD_AT_PLUS_A", 0.0,
                  options={"SymmetricMode": True})  # fmt: skip
    blocks = []
    for start in range(0, len(rows), at_once):
        chosen = rows[start : start + at_once]
        columns = np.concatenate(chosen)
        unit = np.zeros((len(scale), len(columns)))
        unit[columns, np.arange(len(columns))] = scale[columns]
        inverse = scale[columns, None] * solver.solve(unit)[columns]
        offset = 0
        for row in chosen:
            span = slice(offset, offset + len(row))
            blocks.append(inverse[span, span].copy())
            offset += len(row)
    return blocks
