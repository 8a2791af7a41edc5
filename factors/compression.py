"""Square-root compression: thousands of residual rows to the few that carry the same quadratic.

A least-squares term ``1/2 ||J d + r||^2`` over n unknowns depends only on the Gram matrix
``[J|r]^T [J|r]`` of size n + 1, so an upper-triangular root with n + 1 rows replaces it exactly.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

RELATIVE_JITTER = 1e-12
"""Information added per unknown, relative to its own diagonal: keeps Cholesky going on gauge freedoms."""


def gram_matrix(jacobian: Array, residual: Array) -> Array:
    """``[J|r]^T [J|r]``, ``(n+1, n+1)``, of ``jacobian (M, n)`` and ``residual (M,)``."""
    augmented = np.column_stack([jacobian, residual])
    return augmented.T @ augmented


def compress_gram(gram: Array) -> Array:
    """Upper-triangular ``root (n, n)`` with ``root.T @ root == gram`` for a positive semidefinite ``gram (n,
    n)``.

    Rank-deficient input is allowed: columns are scaled to unit diagonal, ``RELATIVE_JITTER`` is added, and
    should Cholesky still fail (rounding made the matrix slightly indefinite) negative eigenvalues are
    clipped.
    """
    scale = np.sqrt(np.maximum(np.diagonal(gram), 0.0))
    used = scale > 0.0
    inverse_scale = np.divide(1.0, scale, out=np.zeros_like(scale), where=used)
    scaled = gram * inverse_scale
    scaled *= inverse_scale[:, None]
    np.fill_diagonal(scaled, 1.0 + RELATIVE_JITTER)
    try:
        root: Array = np.asarray(np.linalg.cholesky(scaled).T, dtype=np.float64)
    except np.linalg.LinAlgError:
        root = _clipped_root(scaled)
    return root * scale


def compress(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """``(n+1)``-row ``(jacobian (n+1, n), residual (n+1,))`` with the Gram matrix of the ``M`` given rows."""
    root = compress_gram(gram_matrix(jacobian, residual))
    return root[:, :-1], root[:, -1]


def rotate_residual_to_last(root: Array) -> Array:
    """Rotate rows so that the last column is ``[0, ..., 0, norm]``; same Gram matrix, ``root (n, n)``.

    One Householder reflection. It makes the error vector of a compressed factor the same function of the cost
    alone whether or not Jacobians are asked for.
    """
    residual = root[:, -1]
    above = float(residual[:-1] @ residual[:-1])
    if above == 0.0 and residual[-1] >= 0.0:
        return root
    norm = np.sqrt(above + residual[-1] ** 2)
    reflector = residual.copy()
    # residual[-1] - norm without cancellation when the upper part is small
    reflector[-1] = -above / (residual[-1] + norm) if residual[-1] > 0.0 else residual[-1] - norm
    rotated = root - np.outer(reflector, (2.0 / (reflector @ reflector)) * (reflector @ root))
    rotated[:-1, -1] = 0.0
    rotated[-1, -1] = norm
    return rotated


def _clipped_root(matrix: Array) -> Array:
    eigenvalues, eigenvectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * eigenvectors.T
    return np.asarray(np.linalg.qr(root, mode="r"), dtype=np.float64)
