"""A contact sheet: frames and their depth side by side, as one image file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.reconstruction.files import write_atomically
from mvdyn_gtsam.viewer.colours import colour_depth

TILE_WIDTH = 256


def save_depth_sheet(
    reconstruction: Reconstruction, capture: Capture, times: Sequence[int], path: Path
) -> Path:
    """Write a PNG with, per camera, a row of the frames at ``times`` and below it a row of their depth.

    One colour scale per camera (near yellow, far blue, its 2nd to 98th percentile); invalid depth is black.
    """
    rows: list[npt.NDArray[np.uint8]] = []
    for index, camera in enumerate(capture.cameras):
        size = (TILE_WIDTH, round(TILE_WIDTH * camera.height / camera.width))
        depths = [reconstruction.depth(camera.name, time) for time in times]
        low, high = _depth_range(depths)
        images = [cv2.cvtColor(capture.read(index, time), cv2.COLOR_RGB2BGR) for time in times]
        tiles = [cv2.cvtColor(colour_depth(depth, low, high), cv2.COLOR_RGB2BGR) for depth in depths]
        rows.append(np.hstack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]))
        rows.append(np.hstack([cv2.resize(tile, size, interpolation=cv2.INTER_NEAREST) for tile in tiles]))
    done, buffer = cv2.imencode(".png", np.vstack(rows))
    if not done:
        raise RuntimeError("OpenCV could not encode the contact sheet")
    write_atomically(path, buffer.tobytes())
    return path


def _depth_range(depths: Sequence[npt.NDArray[np.float32]]) -> tuple[float, float]:
    values = np.concatenate([depth[np.isfinite(depth)] for depth in depths])
    if not len(values):
        return 1.0, 1.0
    low, high = np.percentile(values, (2.0, 98.0))
    return float(low), float(high)
