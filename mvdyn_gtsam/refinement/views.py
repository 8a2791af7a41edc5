"""A camera at the resolution at which its depth is solved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import Float32, pixel_raster
from mvdyn_gtsam.geometry import pixel_rays

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DenseView:
    """Every ``stride``-th pixel of a camera as a camera of its own; its pixels are averages of the
    input's."""

    camera: Camera
    shape: tuple[int, int]
    """``(h, w)``"""
    intrinsics: Array
    """``(3, 3)`` of the small image."""
    rays: Float32
    """``(h * w, 3)`` with z = 1."""

    @staticmethod
    def of(camera: Camera, scale: float) -> DenseView:
        """The view whose images are ``scale`` times the camera's."""
        return _view(camera, (max(1, round(camera.height * scale)), max(1, round(camera.width * scale))))

    def __reduce__(self) -> tuple[Callable[..., DenseView], tuple[Camera, tuple[int, int]]]:
        """Without the rays: a megabyte that a process makes sooner than it receives."""
        return _view, (self.camera, self.shape)

    def shrink(self, image: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """``image (H, W[, C])`` averaged down to ``shape``."""
        if image.shape[:2] == self.shape:
            return image
        return np.asarray(cv2.resize(image, self.shape[::-1], interpolation=cv2.INTER_AREA))

    def grow(self, image: Float32) -> Float32:
        """``image (h, w)`` brought up to the camera's size, linearly."""
        size = (self.camera.width, self.camera.height)
        if image.shape == size[::-1]:
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))


def _view(camera: Camera, shape: tuple[int, int]) -> DenseView:
    intrinsics = scaled_intrinsics(camera.intrinsics, shape[1] / camera.width, shape[0] / camera.height)
    raster = pixel_raster(shape).reshape(-1, 2).astype(np.float64)
    return DenseView(camera, shape, intrinsics, pixel_rays(raster, intrinsics).astype(np.float32))


def scaled_intrinsics(intrinsics: Array, scale_x: float, scale_y: float) -> Array:
    """``(3, 3)`` of an image resized by the scales; pixel centres are at integers: x' = (x + 0.5) s - 0.5."""
    scaled = intrinsics.copy()
    scaled[0] *= scale_x
    scaled[1] *= scale_y
    scaled[0, 2] = (intrinsics[0, 2] + 0.5) * scale_x - 0.5
    scaled[1, 2] = (intrinsics[1, 2] + 0.5) * scale_y - 0.5
    return scaled


def pixels_seen(
    inverse_depth: Float32, rays: Float32, jTi: Array, intrinsics_j: Array
) -> tuple[Float32, npt.NDArray[np.bool_]]:
    """Pixels ``(M, 2)`` of view j of points at ``inverse_depth (M,)`` along ``rays (M, 3)`` of view i.

    Also ``(M,)`` whether they are in front of it. Points are scaled by their inverse depth, so that those at
    infinity are finite.
    """
    # coordinate by coordinate in single precision: a quarter of the time of points in rows, to 1e-4 px
    turned, shift = ((intrinsics_j @ part).astype(np.float32) for part in (jTi[:3, :3], jTi[:3, 3]))
    point = turned @ rays.T
    point += shift[:, None] * inverse_depth
    front = point[2] > 1e-6
    scale = np.reciprocal(np.where(front, point[2], np.float32(1.0)))
    pixels = np.empty((len(rays), 2), np.float32)
    for axis in (0, 1):
        np.multiply(point[axis], scale, out=pixels[:, axis])
    return pixels, front
