"""A tiny rendered scene: textured planes seen by moving cameras, every pixel by exact ray casting."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.frontend.start.model import Start, StartFrame

WIDTH, HEIGHT = 160, 120


def camera(name: str) -> Camera:
    return Camera(name, WIDTH, HEIGHT, 150.0, 150.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def texture(seed: int) -> np.ndarray:
    """``(512, 512)`` grey levels with detail at every scale that flow uses."""
    rng = np.random.default_rng(seed)
    total = np.zeros((512, 512), np.float32)
    for sigma in (2, 4, 9, 20):
        layer = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), sigma)
        total += layer / layer.std()
    return 128 + 35 * total


PLANES = [  # point, first axis, second axis, texture, half size
    ((0.0, 0.0, 5.0), (1.0, 0.0, 0.15), (0.0, 1.0, 0.1), 1, 20.0),
    ((-0.6, 0.2, 3.2), (0.9, 0.0, -0.3), (0.0, 1.0, 0.0), 2, 0.8),
]


def render(wTc: np.ndarray, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Image ``(H, W, 3) uint8`` and z-depth ``(H, W)``."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x, float)], -1)
    w_rays = rays @ wTc[:3, :3].T
    image, depth = np.zeros((HEIGHT, WIDTH), np.float32), np.full((HEIGHT, WIDTH), np.inf)
    for point, first, second, seed, half in PLANES:
        a, b = (np.array(v) / np.linalg.norm(v) for v in (first, second))
        normal = np.cross(a, b)
        z = ((np.array(point) - wTc[:3, 3]) @ normal) / (w_rays @ normal)
        offset = wTc[:3, 3] + w_rays * z[..., None] - np.array(point)
        u, v = offset @ a, offset @ b
        hit = (z > 0) & (z < depth) & (abs(u) < half) & (abs(v) < half)
        x_there, y_there = ((256 + 60 * c).astype(np.float32) for c in (u, v))
        colour = cv2.remap(texture(seed), x_there, y_there, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        image[hit], depth[hit] = colour[hit], z[hit]
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2), depth


@dataclass(frozen=True)
class Frames:
    """A stream that is already decoded."""

    images: list[np.ndarray]

    def __len__(self) -> int:
        return len(self.images)

    def read(self, time: int) -> np.ndarray:
        return self.images[time]


@dataclass(frozen=True)
class Scene:
    cameras: tuple[Camera, ...]
    wTc: np.ndarray
    """``(N, T, 4, 4)``"""
    images: list[list[np.ndarray]]
    depths: list[list[np.ndarray]]

    def capture(self) -> Capture:
        return Capture("planes", 10.0, self.cameras, tuple(Frames(track) for track in self.images))

    def start(
        self,
        groups: tuple[tuple[int, ...], ...],
        times: tuple[int, ...] = (0, 4, 8),
        noise: float = 1.0,
        seed: int = 0,
    ) -> Start:
        """Poses off by about 0.2 degrees and 0.5 % of the depth, sparse depths by 2 %."""
        rng = np.random.default_rng(seed)
        frames = []
        for index in range(len(self.cameras)):
            track = []
            for time in times:
                wTc = self.wTc[index, time].copy()
                if (index, time) != (groups[0][0], 0):
                    turn = Rotation.from_rotvec(noise * rng.normal(0, np.radians(0.12), 3))
                    wTc[:3, :3] = wTc[:3, :3] @ turn.as_matrix()
                    wTc[:3, 3] += noise * rng.normal(0, 0.013, 3)
                pixels = rng.integers(0, (WIDTH, HEIGHT), (120, 2))
                depth = self.depths[index][time][pixels[:, 1], pixels[:, 0]]
                depth = depth * np.exp(noise * rng.normal(0, 0.02, len(depth)))
                track.append(StartFrame(time, wTc, pixels.astype(float), depth))
            frames.append(tuple(track))
        return Start(groups, tuple(frames))


def two_cameras(count: int = 9, moving: tuple[bool, ...] = (True, True)) -> Scene:
    cameras = tuple(camera(f"cam{index}") for index in range(len(moving)))
    wTc = np.tile(np.eye(4), (len(moving), count, 1, 1))
    for index, moves in enumerate(moving):
        for time in range(count):
            s = time if moves else 0
            angle = (0.004 * s, -0.006 * s + 0.12 * index, 0.002 * s)
            wTc[index, time, :3, :3] = Rotation.from_rotvec(angle).as_matrix()
            wTc[index, time, :3, 3] = (0.05 * s - 0.9 * index, 0.02 * s + 0.1 * index, 0.03 * s)
    return _rendered(cameras, wTc)


def rig(count: int = 9) -> Scene:
    """Two cameras mounted on one another, so far apart that they see much the same."""
    wTc = np.tile(np.eye(4), (2, count, 1, 1))
    for time in range(count):
        turn = Rotation.from_rotvec((0.006 * time, -0.01 * time, 0.02 * np.sin(time)))
        wTc[0, time, :3, :3] = turn.as_matrix()
        wTc[0, time, :3, 3] = (0.05 * time, 0.02 * np.sin(time), 0.04 * time)
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec((0.01, 0.1, 0.0)).as_matrix()
    mount[:3, 3] = (-0.7, 0.1, 0.0)
    wTc[1] = wTc[0] @ mount
    return _rendered((camera("cam0"), camera("cam1")), wTc)


def _rendered(cameras: tuple[Camera, ...], wTc: np.ndarray) -> Scene:
    pairs = [[render(pose, view) for pose in track] for view, track in zip(cameras, wTc, strict=True)]
    images = [[image for image, _ in track] for track in pairs]
    return Scene(cameras, wTc, images, [[depth for _, depth in track] for track in pairs])
