"""A tiny static scene, ray cast: a wall, a floor and a block in front, all with blurred noise on them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from tests.evaluation.fakes import write_groundtruth

Array = npt.NDArray[np.float64]
WIDTH, HEIGHT, FOCAL, CX, CY = 240, 180, 200.0, 118.0, 91.0


def write_capture(folder: Path, frames: int, cameras: int = 2) -> dict[str, Array]:
    """Write images, ``capture.json`` and ground truth at 10 frames per second; returns ``wTc`` per camera."""
    textures = [_texture(seed) for seed in range(3)]
    poses: dict[str, Array] = {}
    entries = []
    for camera in range(cameras):
        name = f"cam{camera}"
        wTc = np.tile(np.eye(4), (frames, 1, 1))
        for time in range(frames):
            wTc[time, :3, 3] = [0.7 * camera + 0.12 * time, 0.05 * np.sin(time), 0.06 * time]
            turn = [0.0, -0.08 * camera - 0.01 * time, 0.01 * np.cos(time)]
            wTc[time, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
            path = folder / name / f"{time:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), _render(wTc[time], textures))
        poses[name] = wTc
        entries.append(
            {"name": name, "source": f"{name}/*.png", "width": WIDTH, "height": HEIGHT}
            | {"fx": FOCAL, "fy": FOCAL, "cx": CX, "cy": CY}
        )
    (folder / "capture.json").write_text(json.dumps({"name": "tiny", "fps": 10.0, "cameras": entries}))
    write_groundtruth(folder, poses)
    return poses


def _texture(seed: int) -> npt.NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=(1024, 1024)), (0, 0), sigma) for sigma in (2.0, 5.0, 12.0)]
    mixed = sum(layer / layer.std() for layer in layers)
    return np.clip(128 + 40 * mixed, 0, 255).astype(np.uint8)


def _render(wTc: Array, textures: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    rays = np.stack([(u - CX) / FOCAL, (v - CY) / FOCAL, np.ones_like(u)], axis=-1) @ wTc[:3, :3].T
    origin = wTc[:3, 3]
    image, nearest = np.zeros((HEIGHT, WIDTH), dtype=np.uint8), np.full((HEIGHT, WIDTH), np.inf)
    # (axis held constant, its value, half-width limit along x or none)
    for texture, (axis, value, limit) in zip(
        textures, ((2, 5.0, np.inf), (1, 1.2, np.inf), (2, 3.5, 0.6)), strict=True
    ):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (value - origin[axis]) / rays[..., axis]
            points = origin + distance[..., None] * rays
        hit = (distance > 0) & (distance < nearest) & (np.abs(points[..., 0] - 0.6) < limit)
        other = 1 if axis == 2 else 2
        x = np.nan_to_num(100.0 * points[..., 0] + 300.0, posinf=0, neginf=0).astype(np.float32)
        y = np.nan_to_num(100.0 * points[..., other] + 300.0, posinf=0, neginf=0).astype(np.float32)
        sampled = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        image[hit], nearest[hit] = sampled[hit], distance[hit]
    return image
