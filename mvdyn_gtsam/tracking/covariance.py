"""Marginal covariances of all keyframes: blocks of the inverse of the polish's information matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from factors.keys import M, S, X
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.tracking.model import Keyframe, View
from mvdyn_gtsam.tracking.normal_equations import NormalEquations, factorised, scaled
from mvdyn_gtsam.tracking.polish import NO_MOUNTS, Mounts, build_graph
from mvdyn_gtsam.tracking.window import Priors

LARGEST_INVERSE = 1000
"""Unknowns up to which a dense inverse is taken, four matrices of 8 MB."""
BLOCKS_AT_ONCE = 15
"""Blocks of the inverse solved for at once."""


def marginal_covariances(
    keyframes: list[Keyframe],
    views: tuple[View, ...],
    config: TrackingConfig,
    priors: Priors,
    mounts: Mounts = NO_MOUNTS,
) -> dict[Frame, npt.NDArray[np.float64]]:
    """``(6, 6)`` covariance of every keyframe's pose, tangent ``[omega, v]``."""
    graph, values = build_graph(keyframes, views, config, priors, mounts=mounts, room=0)
    keys = [key(*keyframe.frame) for keyframe in keyframes for key in (X, S)] + [M(*pair) for pair in mounts]
    information = NormalEquations.of(graph, values, keys).information
    # unit diagonal: the gauge is held a million times as firmly as the rest
    scale = 1.0 / np.sqrt(information.diagonal())
    information = scaled(information, scale)
    rows = [np.arange(7 * row, 7 * row + 6) for row in range(len(keyframes))]
    if len(scale) > LARGEST_INVERSE:
        blocks = _inverse_blocks(information, scale, rows)
    else:
        factor = cho_factor(information.toarray(), overwrite_a=True)
        covariance = scale[:, None] * cho_solve(factor, np.diag(scale), overwrite_b=True)
        blocks = [covariance[np.ix_(row, row)] for row in rows]
    return {keyframe.frame: block for keyframe, block in zip(keyframes, blocks, strict=True)}


def _inverse_blocks(
    information: sparse.csc_array, scale: npt.NDArray[np.float64], rows: Sequence[npt.NDArray[np.int64]]
) -> list[npt.NDArray[np.float64]]:
    """Diagonal blocks ``rows`` of the inverse, some columns at a time: never the whole of it in memory.

    ``information`` has been multiplied by ``scale`` on both sides.
    """
    solver = factorised(information)
    blocks = []
    for start in range(0, len(rows), BLOCKS_AT_ONCE):
        chosen = rows[start : start + BLOCKS_AT_ONCE]
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
