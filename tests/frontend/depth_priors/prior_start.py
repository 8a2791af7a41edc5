"""Cameras with a start, and priors to align to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.start.model import Start, StartFrame

WIDTH, HEIGHT = 48, 32
CAMERAS = tuple(Camera(name, WIDTH, HEIGHT, 40.0, 40.0, 23.5, 15.5) for name in ("left", "right", "door"))
GROUPS = ((0, 1), (2,))
UNITS = (1.0, 20.0)
"""Of the groups' worlds."""
TIMES = (0, 3, 7)


def true_depth(camera: int, time: int) -> np.ndarray:
    """``(H, W)``, another in every frame."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return 2.0 + 0.05 * x + 0.02 * y + 0.1 * time + camera + 0.5 * (x > 20)


def image_of(camera: int, time: int) -> np.ndarray:
    """An image that tells its frame."""
    return np.full((HEIGHT, WIDTH, 3), 10 * camera + time, np.uint8)


def make_start(points: int = 60, noise: float = 0.0) -> Start:
    """True depth at random pixels, in the units of the groups."""
    rng = np.random.default_rng(0)
    unit = {camera: unit for group, unit in zip(GROUPS, UNITS, strict=True) for camera in group}
    frames = []
    for camera in range(len(CAMERAS)):
        own = []
        for time in TIMES:
            pixels = rng.uniform(0, [WIDTH - 1, HEIGHT - 1], (points, 2))
            x, y = np.rint(pixels).astype(int).T
            depth = (
                unit[camera] * true_depth(camera, time)[y, x] * np.exp(noise * rng.standard_normal(points))
            )
            own.append(StartFrame(time, np.eye(4), pixels, depth))
        frames.append(tuple(own))
    return Start(GROUPS, tuple(frames))


class GivenPrior:
    """Hands out what ``answer`` makes of the true depth, and counts how often each frame is asked for."""

    name = "GivenPrior"

    def __init__(self, answer: Callable[[np.ndarray], Any] = lambda depth: (depth, None)) -> None:
        self.answer = answer
        self.asked: list[tuple[str, int]] = []

    def predict(self, image: np.ndarray, intrinsics: np.ndarray, camera: str, time: int) -> Any:
        index = [one.name for one in CAMERAS].index(camera)
        np.testing.assert_array_equal(image, image_of(index, time))
        np.testing.assert_array_equal(intrinsics, CAMERAS[index].intrinsics)
        self.asked.append((camera, time))
        return self.answer(true_depth(index, time).astype(np.float32))
