"""Rigid and similarity transforms and the pinhole camera, on plain numpy arrays.

Transforms are ``(..., 4, 4) float64`` matrices and are named by direction: ``wTc`` maps camera
coordinates to world coordinates. Pixels are ``(x, y)`` with integer coordinates at pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


def invert_pose(aTb: Array) -> Array:
    """Inverse ``bTa`` of rigid transforms ``aTb``, both ``(..., 4, 4)``."""
    aRb = aTb[..., :3, :3]
    bTa = np.zeros_like(aTb)
    bRa = np.swapaxes(aRb, -1, -2)
    bTa[..., :3, :3] = bRa
    bTa[..., :3, 3] = -(bRa @ aTb[..., :3, 3:])[..., 0]
    bTa[..., 3, 3] = 1.0
    return bTa


def transform_points(aTb: Array, b_points: Array) -> Array:
    """Points ``(N, 3)`` of frame b in frame a; ``aTb`` is ``(4, 4)`` rigid or similarity."""
    return b_points @ aTb[:3, :3].T + aTb[:3, 3]


def rotation_angle_deg(aRb: Array) -> Array:
    """Angle in degrees of rotation matrices ``(..., 3, 3)``."""
    return np.degrees(Rotation.from_matrix(aRb).magnitude())


def interpolate_pose(aTb: Array, aTc: Array, fraction: float) -> Array:
    """Pose on the way from ``aTb`` (fraction 0) to ``aTc`` (1): slerp and straight line; extrapolates."""
    bRc = Rotation.from_matrix(aTb[:3, :3].T @ aTc[:3, :3])
    result = np.eye(4)
    result[:3, :3] = aTb[:3, :3] @ Rotation.from_rotvec(fraction * bRc.as_rotvec()).as_matrix()
    result[:3, 3] = (1.0 - fraction) * aTb[:3, 3] + fraction * aTc[:3, 3]
    return result


def backproject(pixels: Array, depth: Array, intrinsics: Array) -> Array:
    """Camera-frame points ``(N, 3)`` of pixels ``(N, 2)`` at z-depths ``(N,)``; ``intrinsics (3, 3)``."""
    rays = pixel_rays(pixels, intrinsics)
    return rays * depth[:, None]


def pixel_rays(pixels: Array, intrinsics: Array) -> Array:
    """Rays ``(N, 3)`` with ``z = 1`` through pixels ``(N, 2)``."""
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (pixels[:, 0] - intrinsics[0, 2]) / intrinsics[0, 0]
    rays[:, 1] = (pixels[:, 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    return rays


def project(points: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Pixels ``(N, 2)`` and z-depths ``(N,)`` of camera-frame points ``(N, 3)``.

    Points at or behind the camera get NaN pixels.
    """
    z = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(z > 0.0, 1.0 / z, np.nan)
    pixels = np.stack(
        [
            intrinsics[0, 0] * points[:, 0] * inverse + intrinsics[0, 2],
            intrinsics[1, 1] * points[:, 1] * inverse + intrinsics[1, 2],
        ],
        axis=1,
    )
    return pixels, z


@dataclass(frozen=True)
class Similarity:
    """``aSb``: maps points of frame b to frame a, ``x_a = scale * rotation @ x_b + translation``."""

    scale: float
    rotation: Array
    """``(3, 3)``"""
    translation: Array
    """``(3,)``"""

    @staticmethod
    def identity() -> Similarity:
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def matrix(self) -> Array:
        """``(4, 4)`` matrix ``[[scale * rotation, translation], [0, 1]]``."""
        result = np.eye(4)
        result[:3, :3] = self.scale * self.rotation
        result[:3, 3] = self.translation
        return result

    def transform_points(self, b_points: Array) -> Array:
        """Points ``(N, 3)`` of frame b in frame a."""
        return self.scale * (b_points @ self.rotation.T) + self.translation

    def transform_poses(self, bTc: Array) -> Array:
        """Poses ``(..., 4, 4)`` given in frame b, re-expressed in frame a (rotations stay rotations)."""
        aTc = np.array(bTc, dtype=np.float64)
        aTc[..., :3, :3] = self.rotation @ bTc[..., :3, :3]
        aTc[..., :3, 3] = self.scale * (bTc[..., :3, 3] @ self.rotation.T) + self.translation
        return aTc

    def inverse(self) -> Similarity:
        """``bSa``."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def compose(self, bSc: Similarity) -> Similarity:
        """``aSc = aSb * bSc``."""
        return Similarity(
            self.scale * bSc.scale,
            self.rotation @ bSc.rotation,
            self.scale * (self.rotation @ bSc.translation) + self.translation,
        )
