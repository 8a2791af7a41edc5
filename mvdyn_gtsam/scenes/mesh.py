"""All bodies of a scene as one triangle mesh, and the rays cast at it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.scenes.motion import Array
from mvdyn_gtsam.scenes.settings import SceneSettings
from mvdyn_gtsam.scenes.textures import Atlas, Paint, build_atlas
from mvdyn_gtsam.scenes.world import Body

MISS = -1
_TEXTURES = 3
TEXEL_AT_M, FINEST_TEXEL_M = 1.5, 0.003
LIGHT = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])
FILL = np.array([-0.8, 0.6, 0.1]) / np.linalg.norm([-0.8, 0.6, 0.1])


@dataclass(frozen=True)
class Mesh:
    """Triangles of every body in that body's frame; they move with it."""

    vertices: Array
    """``(V, 3)`` m, in the frame of the body."""
    normals: Array
    """``(V, 3)``"""
    texels: npt.NDArray[np.float32]
    """``(V, 2)`` px in level 0 of the atlas."""
    vertex_body: npt.NDArray[np.int64]
    """``(V,)``"""
    faces: npt.NDArray[np.int32]
    """``(F, 3)``"""
    face_body: npt.NDArray[np.int64]
    """``(F,)``"""
    face_texel: npt.NDArray[np.float32]
    """``(F,)`` m a texel."""
    moving: npt.NDArray[np.bool_]
    """``(B,)``"""
    atlas: Atlas


@dataclass(frozen=True)
class Hits:
    """What rays from a camera hit first."""

    face: npt.NDArray[np.int32]
    """``(N,)``, MISS where nothing."""
    barycentric: npt.NDArray[np.float32]
    """``(N, 2)``: weights of a face's second and third vertex."""
    depth: npt.NDArray[np.float32]
    """``(N,)`` z-depth as the ray caster gives it (single precision), infinite where nothing."""


def build_mesh(bodies: Sequence[Body], settings: SceneSettings) -> Mesh:
    """Triangulate and paint every patch."""
    rng = np.random.default_rng([settings.seed, _TEXTURES])
    texel = max(FINEST_TEXEL_M, TEXEL_AT_M / settings.focal_length)
    paints: list[Paint] = []
    parts: list[tuple[Array, ...]] = []
    faces, start = [], 0
    for number, body in enumerate(bodies):
        for patch, style in zip(body.patches, body.styles, strict=True):
            rows, columns = patch.points.shape[:2]
            wallpaper = rng.random() < settings.repeat
            # Large surfaces are far from the cameras, so they do with larger texels.
            own = texel * max(1.0, max(patch.size) / 9.0)
            paint = Paint(
                patch.size,
                (settings.seed, _TEXTURES, len(paints)),
                settings.texture,
                "wallpaper" if wallpaper else style,
                own,
            )
            s, t = np.meshgrid(np.linspace(0, 1, columns), np.linspace(1, 0, rows))
            st = np.stack([s.ravel(), t.ravel()], axis=1) * np.array(patch.size) / own
            count = rows * columns
            ones = np.ones((count, 1))
            parts.append(
                (patch.points.reshape(-1, 3), patch.normals.reshape(-1, 3), st, ones * [number, len(paints)])
            )
            paints.append(paint)
            grid = start + np.arange(count).reshape(rows, columns)
            a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
            faces.append(np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))
            start += count
    vertices, normals, st, owner = (np.concatenate(column) for column in zip(*parts, strict=True))
    atlas = build_atlas(paints)
    body_of, paint_of = owner.astype(np.int64).T
    face_array = np.concatenate(faces).astype(np.int32)
    return Mesh(
        vertices,
        normals,
        (st + atlas.origins[paint_of]).astype(np.float32),
        body_of,
        face_array,
        body_of[face_array[:, 0]],
        np.array([paint.texel for paint in paints], dtype=np.float32)[paint_of[face_array[:, 0]]],
        np.array([body.motion is not None for body in bodies]),
        atlas,
    )


class Instant:
    """The mesh with every body where it is at one time, ready for rays from any camera."""

    def __init__(self, mesh: Mesh, wTb: Array) -> None:
        """Bodies at ``wTb (B, 4, 4)``. Raises ConfigError where the ray caster is not installed."""
        self.mesh = mesh
        self.wTb = wTb
        self.vertices = _apply(wTb[mesh.vertex_body], mesh.vertices)
        corners = self.vertices[mesh.faces]
        self.anchors = corners[:, 0]
        """``(F, 3)``: a point of each face's plane, world."""
        self.face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        """``(F, 3)``, world, not of unit length."""
        self._scene = _embree_scene(self.vertices, mesh.faces)

    def shades(self) -> npt.NDArray[np.float32]:
        """Lambert shading ``(V,)`` by two far lights and some light from everywhere."""
        normals = np.einsum("vij,vj->vi", self.wTb[self.mesh.vertex_body][:, :3, :3], self.mesh.normals)
        lit = 0.55 + 0.4 * np.maximum(normals @ LIGHT, 0.0) + 0.2 * np.maximum(normals @ FILL, 0.0)
        return lit.astype(np.float32)

    def first_hits(self, origin: Array, directions: npt.NDArray[np.float32]) -> dict[str, Any]:
        """Of rays from a point ``(3,)`` along ``(N, 3)``, world; lengths are in those of the directions."""
        origins = np.broadcast_to(origin.astype(np.float32), directions.shape)
        hits: dict[str, Any] = self._scene.run(np.ascontiguousarray(origins), directions, output=True)
        return hits


class View:
    """What one camera sees at one instant."""

    def __init__(self, instant: Instant, wTc: Array) -> None:
        self.instant = instant
        self.wTc = wTc

    def cast(self, rays: npt.NDArray[np.float32]) -> Hits:
        """First hits of ``rays (N, 3)`` from the camera's centre, in its frame and with ``z = 1``."""
        hits = self.instant.first_hits(self.wTc[:3, 3], rays @ self.wTc[:3, :3].T.astype(np.float32))
        depth = np.where(hits["primID"] == MISS, np.float32(np.inf), hits["tfar"])
        return Hits(hits["primID"], np.stack([hits["u"], hits["v"]], axis=1), depth)

    def exact_points(self, hits: Hits, rays: Array) -> Array:
        """Camera-frame points ``(N, 3)`` where the rays meet the planes of the faces they hit; NaN if none.

        The ray caster says which face, in single precision; where on it is computed here, in double.
        """
        normals = self.instant.face_normals
        away = np.einsum("fi,fi->f", normals, self.instant.anchors - self.wTc[:3, 3])[hits.face]
        along = np.einsum("ni,ni->n", normals[hits.face], rays @ self.wTc[:3, :3].T)
        depth = np.divide(away, along, out=np.full(len(along), np.nan), where=along != 0.0)
        depth[hits.face == MISS] = np.nan
        return rays * depth[:, None]


def _embree_scene(vertices: Array, faces: npt.NDArray[np.int32]) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise ConfigError(
            f"making scenes needs the ray caster embreex ({error}); run: pip install 'mvdyn_gtsam[scenes]'"
        ) from error
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, dtype=np.float32), faces)
    return scene


def _apply(aTb: Array, points: Array) -> Array:
    return np.einsum("nij,nj->ni", aTb[:, :3, :3], points) + aTb[:, :3, 3]
