"""How bodies and cameras move: rigid poses as exact functions of time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Motion = Callable[[float], Array]
"""Seconds -> ``wTb (4, 4)``, the body in the world."""


def rigid(rotation: Array | Rotation, translation: Sequence[float] | Array) -> Array:
    """``(4, 4)``"""
    aTb = np.eye(4)
    aTb[:3, :3] = rotation.as_matrix() if isinstance(rotation, Rotation) else rotation
    aTb[:3, 3] = translation
    return aTb


def turn(axis: str, angle: float) -> Rotation:
    """Rotation by ``angle`` (rad) about the axis "x", "y" or "z"."""
    return Rotation.from_euler(axis, angle)


@dataclass(frozen=True)
class Orbit:
    """A walk in a circle on the floor; the body's x axis looks outward, y where it goes."""

    center: tuple[float, float]
    radius: float
    """m"""
    speed: float
    """m/s"""
    phase: float
    """rad"""

    def angle(self, seconds: float) -> float:
        """rad"""
        return self.phase + self.speed / self.radius * seconds

    def __call__(self, seconds: float) -> Array:
        angle = self.angle(seconds)
        x, y = self.center
        return rigid(
            turn("z", angle), (x + self.radius * np.cos(angle), y + self.radius * np.sin(angle), 0.0)
        )


@dataclass(frozen=True)
class Rolling:
    """A ball that rolls along an orbit without slipping."""

    orbit: Orbit
    radius: float

    def __call__(self, seconds: float) -> Array:
        roll = -self.orbit.speed * seconds / self.radius
        return np.asarray(self.orbit(seconds) @ rigid(turn("x", roll), (0.0, 0.0, self.radius)))


@dataclass(frozen=True)
class Limb:
    """A limb that swings to and fro about a hinge of a walking body."""

    orbit: Orbit
    hinge: tuple[float, float, float]
    """In the frame of the body, m."""
    swing: float
    """rad"""
    stride: float
    """m walked from step to step of the same foot."""
    phase: float

    def __call__(self, seconds: float) -> Array:
        angle = self.swing * np.sin(2 * np.pi * self.orbit.speed * seconds / self.stride + self.phase)
        return np.asarray(self.orbit(seconds) @ rigid(turn("x", angle), self.hinge))


@dataclass(frozen=True)
class HandHeld:
    """A camera somebody holds and walks about with, looking along a heading."""

    position: tuple[float, float, float]
    heading: float
    """rad about z, 0 along x."""
    pitch: float
    """rad, up."""
    drift: Array
    """``(3 + 2, 3)``: amplitude, frequency (Hz), phase (rad) of x, y, z (m), heading, pitch (rad)."""
    shake: Array
    """``(3 + 3, 3, 3)``: the same, three waves each, of x, y, z (m) and the turns about x, y, z (rad)."""

    def __call__(self, seconds: float) -> Array:
        """``wTc (4, 4)``, OpenCV axes."""
        drift = self.drift[:, 0] * np.sin(2 * np.pi * self.drift[:, 1] * seconds + self.drift[:, 2])
        waves = self.shake[..., 0] * np.sin(2 * np.pi * self.shake[..., 1] * seconds + self.shake[..., 2])
        shake = waves.sum(axis=1)
        heading, pitch = self.heading + drift[3], self.pitch + drift[4]
        forward = np.array([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)])
        right = np.array([np.sin(heading), -np.cos(heading), 0.0])
        wRc = np.stack([right, np.cross(forward, right), forward], axis=1)
        wRc = wRc @ Rotation.from_rotvec(shake[3:]).as_matrix()
        return rigid(wRc, np.asarray(self.position) + drift[:3] + shake[:3])
