"""Directions in which a scene is built: what stands upright on its floor, and what is parallel to it.

The rim of a plain wall is often one line, where it meets the floor; through a line there are many planes, of
which walls are mostly the upright one. Most rooms and streets have few directions ("Atlanta worlds",
Schindler and Dellaert, CVPR 2004): those of the surfaces that are well seen.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MOST_NORMALS = 1000
"""Compared with each other, evenly drawn beyond. Source: choice; bounds time and memory."""
ALIKE_DEG = 4.0
"""Angle up to which two normals are of one direction. Source: choice, above what one frame errs by."""
LEAST_FRAMES = 0.25
"""Of the frames, in which a direction must be seen. Source: choice."""
MOST_AXES = 3
"""Source: choice, those of a room."""
EXACT_DEG = 2.5
"""Angle up to which a plane counts as upright, or as parallel. Source: choice."""


def main_axes(normals: Array, share: Array, frames: npt.NDArray[np.int64]) -> Array:
    """The commonest directions ``(K, 3)`` of the unit ``normals (N, 3)``, ``K`` at most ``MOST_AXES``.

    Each normal counts by its ``share (N,)`` of what is seen in its frame, ``frames (N,)``. Signs mean
    nothing.
    """
    chosen = np.unique(np.linspace(0, len(normals) - 1, min(len(normals), MOST_NORMALS)).astype(np.int64))
    normals, share, frames = normals[chosen], share[chosen], frames[chosen]
    wanted = LEAST_FRAMES * len(np.unique(frames))
    found: list[Array] = []
    while len(normals) and len(found) < MOST_AXES:
        alike = np.abs(normals @ normals.T) > np.cos(np.radians(ALIKE_DEG))
        same = alike[(alike @ share).argmax()]
        if len(np.unique(frames[same])) >= wanted:
            moments = (normals[same] * share[same, None]).T @ normals[same]
            found.append(np.linalg.eigh(moments)[1][:, -1])
        normals, share, frames = normals[~same], share[~same], frames[~same]
    return np.array(found).reshape(-1, 3)


def bases(axes: Array) -> list[Array]:
    """What planes ``q``, as of ``PlainRegion``, are looked for: ``(3, d)`` each, of whose columns they are.

    Any plane; those upright on one of ``axes (K, 3)``; those with one of them for a normal.
    """
    return [np.eye(3), *(_upright(axis) for axis in axes), *(axis[:, None] for axis in axes)]


def basis_of(plane: Array, axes: Array) -> Array:
    """That of ``bases`` with the fewest columns to which ``plane (3,)`` belongs."""
    normal = plane / np.linalg.norm(plane)
    along = np.abs(axes @ normal)
    if (along > np.cos(np.radians(EXACT_DEG))).any():
        return axes[along.argmax()][:, None]
    if (along < np.sin(np.radians(EXACT_DEG))).any():
        return _upright(axes[along.argmin()])
    return np.eye(3)


def _upright(axis: Array) -> Array:
    """``(3, 2)`` orthonormal, perpendicular to an axis."""
    return np.linalg.svd(axis[None])[2][1:].T
