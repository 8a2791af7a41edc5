"""Patches of two views compared: a textured wall, seen from the side."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.patches import Picture, contrast, likeness
from mvdyn_gtsam.refinement.views import DenseView

SHAPE = (60, 80)
VIEW = DenseView.of(Camera("cam0", 80, 60, 70.0, 70.0, 39.5, 29.5), 1.0)
WALL = 4.0
PATCH = 9
SHIFT = 8
"""Pixels by which the wall moves in the view at the side."""


def texture() -> np.ndarray:
    noise = np.random.default_rng(3).uniform(0.0, 255.0, (SHAPE[0], SHAPE[1] + SHIFT)).astype(np.float32)
    return 10.0 * cv2.GaussianBlur(noise, (0, 0), 1.5)


def wall_and_side() -> tuple[np.ndarray, Picture]:
    wide = texture()
    jTi = np.eye(4)
    jTi[0, 3] = -SHIFT * WALL / 70.0  # the view stands to the right, the wall moves to the left
    return wide[:, : SHAPE[1]].copy(), Picture(wide[:, SHIFT:].copy(), VIEW.intrinsics, jTi)


def at(depth: float) -> np.ndarray:
    return np.full(VIEW.rays.shape[0], 1.0 / depth, np.float32)


def test_patches_are_alike_at_the_true_depth_only() -> None:
    grey, side = wall_and_side()
    alike, seen = likeness(grey, at(WALL), VIEW.rays, side, PATCH)
    assert seen[:, SHIFT:].all() and not seen[:, : SHIFT - 1].any()
    assert alike[:, SHIFT + PATCH :].min() > 0.99
    wrong, there = likeness(grey, at(2.0 * WALL), VIEW.rays, side, PATCH)
    assert np.median(wrong[there]) < 0.3


def test_brightness_and_contrast_of_the_view_do_not_matter() -> None:
    grey, side = wall_and_side()
    darker = Picture(0.5 * side.grey + 20.0, side.intrinsics, side.jTi)
    alike, _ = likeness(grey, at(WALL), VIEW.rays, darker, PATCH)
    assert alike[:, SHIFT + PATCH :].min() > 0.95


def test_without_texture_nothing_is_alike() -> None:
    _, side = wall_and_side()
    plain = np.full(SHAPE, 90.0, np.float32)
    alike, _ = likeness(plain, at(WALL), VIEW.rays, Picture(plain, side.intrinsics, side.jTi), PATCH)
    assert alike.max() < 1e-3


def test_nothing_is_seen_behind_the_view() -> None:
    grey, side = wall_and_side()
    ahead = side.jTi.copy()
    ahead[2, 3] = -2.0 * WALL
    assert not likeness(grey, at(WALL), VIEW.rays, Picture(side.grey, side.intrinsics, ahead), PATCH)[1].any()


@pytest.mark.parametrize("make", [lambda x: x, lambda x: 0.3 * x + 50.0])
def test_contrast_is_the_deviation_of_the_patch(make: Callable[[np.ndarray], np.ndarray]) -> None:
    image = make(texture()).astype(np.float32)
    half = PATCH // 2
    patch = image[30 - half : 31 + half, 40 - half : 41 + half]
    assert contrast(image, PATCH)[30, 40] == pytest.approx(patch.std(), rel=1e-2)
