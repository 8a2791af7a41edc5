"""Which other times of a camera still see what a frame sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.views import pixels_seen
from mvdyn_gtsam.refinement.workspace import Workspace

Array = npt.NDArray[np.float64]

SHARED_RASTER = 12
"""Points across and down an image at which it is asked whether another time sees them."""


def times_in_view(
    workspace: Workspace, frame: Frame, wTc: Array, offsets: Sequence[int], least_shared: float
) -> list[int]:
    """Times of the camera whose images a frame is compared with, in order.

    Those at ``offsets`` frames, both ways, each halved until ``least_shared`` of the view is: 8 frames are a
    step aside of a camera held still, and another room of one that is carried around. ``wTc (N, T, 4, 4)``.
    """
    camera, time = frame
    view = workspace.views[camera]
    across = np.rint(np.linspace(0, view.shape[1] - 1, SHARED_RASTER)).astype(np.int64)
    down = np.rint(np.linspace(0, view.shape[0] - 1, SHARED_RASTER)).astype(np.int64)
    points = (down[:, None] * view.shape[1] + across).ravel()
    inverse_depth = np.asarray(workspace.read("tracked", frame), np.float32).ravel()[points]
    size = np.array(view.shape[::-1])

    def shared(other: int) -> float:
        if not 0 <= other < workspace.frame_count:
            return 0.0
        jTi = invert_pose(wTc[camera, other]) @ wTc[frame]
        at, front = pixels_seen(inverse_depth, view.rays[points], jTi, view.intrinsics)
        return float((front & (at >= -0.5).all(axis=1) & (at < size - 0.5).all(axis=1)).mean())

    found = set()
    for offset in offsets:
        for sign in (-1, 1):
            step = offset
            while step > 1 and shared(time + sign * step) < least_shared:
                step //= 2
            if 0 <= time + sign * step < workspace.frame_count:
                found.add(time + sign * step)
    return sorted(found)
