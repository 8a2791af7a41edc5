"""Pictures and exact ground truth of one camera at one instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.geometry import invert_pose, pixel_rays, project
from mvdyn_gtsam.scenes.mesh import MISS, Hits, Instant, Mesh, View
from mvdyn_gtsam.scenes.motion import Array
from mvdyn_gtsam.scenes.rig import visible
from mvdyn_gtsam.scenes.settings import SceneSettings

SAMPLES = 2
"""Rays a pixel in x and in y that colours are averaged from."""
SKY = np.array([[150.0, 185.0, 235.0], [215.0, 228.0, 245.0]], dtype=np.float32)
"""RGB at the zenith and at the horizon."""


@dataclass(frozen=True)
class Truth:
    """What is known exactly of the centre of each pixel."""

    depth: Array
    """``(H, W)`` m, z-depth; NaN where there is nothing."""
    moving: npt.NDArray[np.bool_]
    """``(H, W)``: belongs to something that moves."""
    points: Array
    """``(H, W, 3)`` m, in the camera's frame."""
    body: npt.NDArray[np.int64]
    """``(H, W)`` number of the body, -1 where there is nothing."""


@dataclass(frozen=True)
class Flow:
    """Where the surface points of each pixel are in the same camera at another instant."""

    flow: npt.NDArray[np.float32]
    """``(H, W, 2)`` px; NaN where there is nothing, or it comes to lie behind the camera."""
    visible: npt.NDArray[np.bool_]
    """``(H, W)``: inside the image there, and not hidden."""


class Renderer:
    """Casts the rays of every pixel; they are the same in every frame."""

    def __init__(self, mesh: Mesh, settings: SceneSettings) -> None:
        self._mesh = mesh
        self._settings = settings
        self._centres = self._rays(1)
        self._samples = self._rays(SAMPLES).astype(np.float32)

    def truth(self, view: View) -> Truth:
        """Depth and motion at the pixel centres."""
        shape = (self._settings.height, self._settings.width)
        hits = view.cast(self._centres.astype(np.float32))
        points = view.exact_points(hits, self._centres)
        body = np.where(hits.face == MISS, -1, self._mesh.face_body[hits.face])
        moving = (body >= 0) & self._mesh.moving[body]
        return Truth(
            points[:, 2].reshape(shape), moving.reshape(shape), points.reshape(*shape, 3), body.reshape(shape)
        )

    def image(self, view: View) -> npt.NDArray[np.float32]:
        """``(H, W, 3)`` RGB, 0 to 255, without noise."""
        s, n = self._settings, SAMPLES
        hits = view.cast(self._samples)
        colors = self._colors(hits, view.instant, n)
        sky = hits.face == MISS
        if sky.any():
            rays = self._samples[sky]
            up = -(rays @ view.wTc[2, :3].astype(np.float32)) / np.linalg.norm(rays, axis=1)
            share = np.clip(np.abs(up), 0.0, 1.0)[:, None]
            colors[sky] = share * SKY[0] + (1.0 - share) * SKY[1]
        return np.asarray(colors.reshape(s.height, n, s.width, n, 3).mean(axis=(1, 3)), dtype=np.float32)

    def flow(self, truth: Truth, here: View, there: View) -> Flow:
        """Flow of the pixels of ``truth``, taken ``here``, to where their points are ``there``."""
        s = self._settings
        # One rigid motion per body takes camera coordinates here to camera coordinates there.
        dTc = invert_pose(there.wTc) @ there.instant.wTb @ invert_pose(here.instant.wTb) @ here.wTc
        motion = dTc[truth.body.ravel()]
        points = np.einsum("nij,nj->ni", motion[:, :3, :3], truth.points.reshape(-1, 3)) + motion[:, :3, 3]
        pixels, _ = project(points, s.intrinsics)
        grid = np.stack(np.meshgrid(np.arange(s.width), np.arange(s.height)), axis=-1)
        flow = pixels.reshape(s.height, s.width, 2) - grid
        return Flow(flow.astype(np.float32), visible(s, there, points).reshape(s.height, s.width))

    def _colors(self, hits: Hits, instant: Instant, samples: int) -> npt.NDArray[np.float32]:
        """``(N, 3)`` RGB; anything where nothing was hit."""
        mesh, s = self._mesh, self._settings
        corners = np.concatenate([mesh.texels, instant.shades()[:, None]], axis=1)[mesh.faces]
        plane = np.stack(
            [corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1
        )
        hit = plane[hits.face]
        u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
        x, y, shade = (hit[:, 0] + u * hit[:, 1] + v * hit[:, 2]).T
        texel_px = np.float32(1.0 / (s.focal_length * samples)) / mesh.face_texel[hits.face]
        depth = np.where(hits.face == MISS, np.float32(1.0), hits.depth)
        level = np.log2(np.maximum(depth * texel_px, np.float32(1e-3)))
        shape = (s.height * samples, s.width * samples)
        colors = mesh.atlas.sample(x.reshape(shape), y.reshape(shape), level.reshape(shape))
        return colors.reshape(-1, 3) * shade[:, None]

    def _rays(self, samples: int) -> Array:
        s = self._settings
        x = (np.arange(s.width * samples) + 0.5) / samples - 0.5
        y = (np.arange(s.height * samples) + 0.5) / samples - 0.5
        return pixel_rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), s.intrinsics)
