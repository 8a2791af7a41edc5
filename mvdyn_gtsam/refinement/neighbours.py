"""Which other times of a camera still see what a frame sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.views import DenseView, pixels_seen
from mvdyn_gtsam.refinement.workspace import Workspace

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SHARED_RASTER = 12
"""Points across and down an image at which it is asked whether another time sees them."""


def times_in_view(
    workspace: Workspace, frame: Frame, wTc: Array, offsets: Sequence[int], least_shared: float
) -> list[int]:
    """Times of the camera whose images a frame is compared with, in order.

    Those at ``offsets`` frames, both ways, each halved until ``least_shared`` of the view is: 8 frames are a
    step aside of a camera held still, and another room of one that is carried around. ``wTc (N, T, 4, 4)``.
    """
    raster, time = _Raster.of(workspace, frame), frame[1]

    def shared(other: int) -> float:
        if not 0 <= other < workspace.frame_count:
            return 0.0
        return float(raster.inside(*raster.seen(wTc, other)).mean())

    found = set()
    for offset in offsets:
        for sign in (-1, 1):
            step = offset
            while step > 1 and shared(time + sign * step) < least_shared:
                step //= 2
            if 0 <= time + sign * step < workspace.frame_count:
                found.add(time + sign * step)
    return sorted(found)


def swept_times(workspace: Workspace, camera: int, wTc: Array, reach: float) -> list[int]:
    """For every time of a ``camera`` the one, itself perhaps, whose depth is swept and serves both.

    Between the two the image moves by ``reach`` at most, as a share of its width, added up over the times
    between. ``wTc (N, T, 4, 4)``.
    """
    steps = [
        _Raster.of(workspace, (camera, time)).motion(wTc, time + 1)
        for time in range(workspace.frame_count - 1)
    ]
    return middles(np.cumsum([0.0, *steps]), reach)


def middles(way: npt.NDArray[np.floating], reach: float) -> list[int]:
    """For every point of an ascending ``way (T,)`` the index of one no farther than ``reach``, few in all."""
    result: list[int] = []
    while len(result) < len(way):
        first = len(result)
        middle = int(np.searchsorted(way, way[first] + reach, side="right")) - 1
        end = int(np.searchsorted(way, way[middle] + reach, side="right"))
        result += [middle] * (end - first)
    return result


@dataclass(frozen=True)
class _Raster:
    """Points of a frame at their tracked depth."""

    frame: Frame
    view: DenseView
    pixels: Float32
    """``(M, 2)``"""
    rays: Float32
    """``(M, 3)``"""
    inverse_depth: Float32
    """``(M,)``"""

    @staticmethod
    def of(workspace: Workspace, frame: Frame) -> _Raster:
        view = workspace.views[frame[0]]
        across = np.rint(np.linspace(0, view.shape[1] - 1, SHARED_RASTER)).astype(np.int64)
        down = np.rint(np.linspace(0, view.shape[0] - 1, SHARED_RASTER)).astype(np.int64)
        rows, columns = (index.ravel() for index in np.meshgrid(down, across, indexing="ij"))
        points = rows * view.shape[1] + columns
        inverse_depth = np.asarray(workspace.read("tracked", frame), np.float32).ravel()[points]
        pixels = np.stack([columns, rows], axis=1).astype(np.float32)
        return _Raster(frame, view, pixels, view.rays[points], inverse_depth)

    def seen(self, wTc: Array, other: int) -> tuple[Float32, Mask]:
        """Pixels ``(M, 2)`` at another time of the camera, and whether they are in front of it."""
        jTi = invert_pose(wTc[self.frame[0], other]) @ wTc[self.frame]
        return pixels_seen(self.inverse_depth, self.rays, jTi, self.view.intrinsics)

    def inside(self, at: Float32, front: Mask) -> Mask:
        """``(M,)`` which of the pixels ``(M, 2)`` ``seen`` lie in the image."""
        size = np.array(self.view.shape[::-1])
        return front & (at >= -0.5).all(axis=1) & (at < size - 0.5).all(axis=1)

    def motion(self, wTc: Array, other: int) -> float:
        """Mean motion over the image to another time, as a share of its width, at most all of it."""
        at, front = self.seen(wTc, other)
        share = np.hypot(*(at - self.pixels).T) / self.view.shape[1]
        return float(np.where(front, np.minimum(share, 1.0), 1.0).mean())
