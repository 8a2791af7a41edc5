"""Robust losses on the squared norm of a residual, for iteratively re-weighted least squares.

Every loss is ``cost(s)`` with ``s = ||r||^2``, equal to ``s / 2`` near zero, and its IRLS weight
``weight(s) = 2 d cost / d s``, so the gradient of the re-weighted problem is that of the robust one. All
losses here are concave in ``s``, hence ``2 cost(s) >= weight(s) s``, which the compressed factors rely on.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
LossName = Literal["cauchy", "huber", "none"]


class Loss(Protocol):
    """A robust loss with a fixed scale."""

    def cost(self, squared_norm: Array) -> Array:
        """Cost per residual, same shape as ``squared_norm``."""
        ...

    def weight(self, squared_norm: Array) -> Array:
        """IRLS weight in (0, 1], same shape as ``squared_norm``."""
        ...


class Cauchy:
    """Cauchy (Lorentzian) loss ``c^2/2 log(1 + s/c^2)``; ``scale`` c in the residual's unit."""

    def __init__(self, scale: float) -> None:
        self.squared_scale = _checked_scale(scale) ** 2

    def cost(self, squared_norm: Array) -> Array:
        return (0.5 * self.squared_scale) * np.log1p(squared_norm * (1.0 / self.squared_scale))

    def weight(self, squared_norm: Array) -> Array:
        return self.squared_scale / (squared_norm + self.squared_scale)


class Huber:
    """Huber loss: quadratic up to ``scale``, linear beyond."""

    def __init__(self, scale: float) -> None:
        self.scale = _checked_scale(scale)

    def cost(self, squared_norm: Array) -> Array:
        norm = np.sqrt(squared_norm)
        linear = self.scale * (norm - 0.5 * self.scale)
        return np.where(norm <= self.scale, 0.5 * squared_norm, linear)

    def weight(self, squared_norm: Array) -> Array:
        return self.scale / np.maximum(np.sqrt(squared_norm), self.scale)


class Squared:
    """No robustness: ``s / 2`` with weight one."""

    def cost(self, squared_norm: Array) -> Array:
        return 0.5 * squared_norm

    def weight(self, squared_norm: Array) -> Array:
        return np.ones_like(squared_norm)


def make_loss(name: LossName, scale: float) -> Loss:
    """The loss called ``name``; raises ValueError for an unknown name or a scale that is not positive."""
    if name == "cauchy":
        return Cauchy(scale)
    if name == "huber":
        return Huber(scale)
    if name == "none":
        return Squared()
    raise ValueError(f"unknown robust loss {name!r}: use 'cauchy', 'huber' or 'none'")


def _checked_scale(scale: float) -> float:
    if not scale > 0.0:
        raise ValueError(f"robust scale must be positive, got {scale}")
    return float(scale)
