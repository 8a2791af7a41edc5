"""What other views see through: motion that the flow of a moment cannot tell.

A thing that moves evenly past a camera has the flow of a still one at another depth. At that depth it stands
where other views, of other times and of other cameras, see what is behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.views import pixels_seen

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

BEHIND = 0.15
"""Log of the depth that a view sees over that of a point from which on it sees through the point. Source:
choice, above the errors of the first depth, which are several per cent."""
AGREES = 0.1
"""The same up to which it sees the point itself. Source: choice."""
TRUSTED = 0.5
"""Trust in its own depth that a view needs to say anything. Source: choice."""
WITNESSES = 2
"""Views that must see through a point; and they must be twice as many as see the point. Source: choice."""

SIGHT = "sight"
"""The array of what others see at a frame's first depth: nothing is told, a surface, or what is behind."""
STANDS, SEEN_THROUGH = 1, 2
"""Of it."""


class SeeingView(Protocol):
    """What is asked of any view."""

    @property
    def theta(self) -> Float32: ...
    @property
    def intrinsics(self) -> Array: ...
    @property
    def jTi(self) -> Array: ...


@dataclass(frozen=True)
class DepthView:
    """A view with the depth that it sees."""

    theta: Float32
    """``(h_j, w_j)`` log inverse depth."""
    trust: Float32
    """``(h_j, w_j)`` in [0, 1]"""
    intrinsics: Array
    """``(3, 3)``"""
    jTi: Array
    """``(4, 4)``"""


@dataclass(frozen=True)
class Sight:
    """How many views see a surface behind points, and how many see the points."""

    through: npt.NDArray[np.int32]
    """``(M,)``"""
    there: npt.NDArray[np.int32]
    """``(M,)``"""

    @property
    def seen_through(self) -> Mask:
        """``(M,)`` no surface is there."""
        return (self.through >= WITNESSES) & (self.through >= 2 * self.there)

    @property
    def seen_there(self) -> Mask:
        """``(M,)`` a surface is there, at other times or for other cameras, too."""
        return (self.there >= WITNESSES) & (self.there >= 2 * self.through)


def sight(theta: Float32, rays: Float32, views: Sequence[DepthView]) -> Sight:
    """What views see of points at log inverse depth ``theta (M,)`` along ``rays (M, 3)``."""
    through, there = (np.zeros(len(theta), np.int32) for _ in range(2))
    for view in views:
        farther, pixel = depth_beyond(theta, rays, view)
        told = view.trust.ravel()[pixel] > TRUSTED
        through += told & (farther > BEHIND)
        there += told & (np.abs(farther) < AGREES)
    return Sight(through, there)


def without_outlines(mask: Mask) -> Mask:
    """``mask (h, w)`` without what is thin: depth is blurred over the outlines of things, and other views see
    through that too."""
    return np.asarray(cv2.medianBlur(mask.astype(np.uint8), 5) > 0)


def depth_beyond(theta: Float32, rays: Float32, view: SeeingView) -> tuple[Float32, npt.NDArray[np.int32]]:
    """``(M,)`` log of the depth that a view sees over that of the points in it, NaN outside of it.

    Also the flat index ``(M,)`` of the view's pixels; any outside. ``theta (M,)`` is log inverse depth along
    ``rays (M, 3)``.
    """
    inverse_depth = np.exp(theta)
    at, front = pixels_seen(inverse_depth, rays, view.jTi, view.intrinsics)
    height, width = view.theta.shape
    x, y = at.T
    inside = front & (x >= -0.5) & (y >= -0.5)
    inside &= (x < width - 0.5) & (y < height - 0.5)
    column, row = (np.rint(np.where(inside, axis, np.float32(0.0))).astype(np.int32) for axis in (x, y))
    pixel = row * np.int32(width) + column
    depth_ratio = rays @ view.jTi[2, :3].astype(np.float32) + inverse_depth * np.float32(view.jTi[2, 3])
    farther = theta - view.theta.ravel()[pixel] - np.log(np.where(inside, depth_ratio, np.float32(1.0)))
    return np.where(inside, farther, np.float32(np.nan)), pixel
