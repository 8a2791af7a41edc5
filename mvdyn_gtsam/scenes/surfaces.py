"""Triangle meshes with texture coordinates in metres: boxes, spheres, cylinders, made of curved patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Patch:
    """A piece of surface with a texture of its own, as a grid of vertices."""

    points: Array
    """``(R, C, 3)`` m, in the frame of the body it belongs to."""
    normals: Array
    """``(R, C, 3)`` unit vectors pointing out."""
    size: tuple[float, float]
    """Metres of texture along the columns and along the rows."""


def quad(corner: Sequence[float], along: Sequence[float], up: Sequence[float]) -> Patch:
    """Flat parallelogram; its outward normal is ``along x up``."""
    c, a, b = (np.asarray(v, dtype=np.float64) for v in (corner, along, up))
    points = c + np.array([[0.0, 1.0]] * 2)[..., None] * a + np.array([[0.0] * 2, [1.0] * 2])[..., None] * b
    normal = np.cross(a, b)
    normals = np.broadcast_to(normal / np.linalg.norm(normal), points.shape)
    return Patch(points, normals.copy(), (float(np.linalg.norm(a)), float(np.linalg.norm(b))))


def box(size: Sequence[float], center: Sequence[float] = (0.0, 0.0, 0.0)) -> list[Patch]:
    """The six sides of a box of ``size`` (m) along x, y and z."""
    sx, sy, sz = size
    x0, y0, z0 = np.asarray(center, dtype=np.float64) - np.asarray(size) / 2
    x1, y1, z1 = x0 + sx, y0 + sy, z0 + sz
    return [
        quad((x0, y0, z0), (sx, 0, 0), (0, 0, sz)),
        quad((x1, y1, z0), (-sx, 0, 0), (0, 0, sz)),
        quad((x1, y0, z0), (0, sy, 0), (0, 0, sz)),
        quad((x0, y1, z0), (0, -sy, 0), (0, 0, sz)),
        quad((x0, y0, z1), (sx, 0, 0), (0, sy, 0)),
        quad((x0, y1, z0), (sx, 0, 0), (0, -sy, 0)),
    ]


def sphere(radius: float, center: Sequence[float] = (0.0, 0.0, 0.0)) -> list[Patch]:
    """A sphere of 32 x 16 facets; the facets, not the ideal sphere, are the truth."""
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 33), np.linspace(-np.pi / 2, np.pi / 2, 17))
    normals = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)],
        axis=-1,
    )
    size = (2 * np.pi * radius, np.pi * radius)
    return [Patch(np.asarray(center) + radius * normals, normals, size)]


def cylinder(radius: float, height: float) -> list[Patch]:
    """An upright cylinder of 32 facets that stands on ``z = 0``, with its lid and no bottom."""
    angle = np.broadcast_to(np.linspace(0, 2 * np.pi, 33), (2, 33))
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    side = radius * normals + np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, height]]])
    lid = np.stack([side[1], np.broadcast_to([0.0, 0.0, height], side[1].shape)])
    up = np.broadcast_to([0.0, 0.0, 1.0], lid.shape).copy()
    return [Patch(side, normals, (2 * np.pi * radius, height)), Patch(lid, up, (np.pi * radius, radius))]


def moved(patches: Sequence[Patch], aTb: Array) -> list[Patch]:
    """``patches`` of frame b in frame a."""
    R, t = aTb[:3, :3], aTb[:3, 3]
    return [Patch(p.points @ R.T + t, p.normals @ R.T, p.size) for p in patches]
