"""One frame of a result as it is shown: small rasters, whatever the size of the video."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.reconstruction.export.points import read_image

LARGEST_RASTER = 250_000
"""Pixels of a frame that are kept at most; more than a browser draws of several cameras."""


@dataclass(frozen=True)
class Frame:
    """What is known of one camera at one time, every n-th pixel; all rasters are ``(h, w)``."""

    camera: str
    time: int
    intrinsics: npt.NDArray[np.float64]
    """``(3, 3)`` of the raster, pixel centres at integers."""
    depth: npt.NDArray[np.float32] | None
    """z-depth in the reconstruction's unit, NaN = invalid; None where it is not there yet."""
    confidence: npt.NDArray[np.float32] | None
    """0 to 1, with ``depth``."""
    motion: npt.NDArray[np.uint8] | None
    """255 moves, 128 moves unconfirmed, 0 stands still; None of a result that was not refined."""
    image: npt.NDArray[np.uint8] | None
    """``(h, w, 3)`` RGB; None without a capture."""


def read_frame(
    depths: Reconstruction, motions: Reconstruction | None, capture: Capture | None, camera: str, time: int
) -> Frame:
    """Read frame ``time`` of ``camera``. Raises ResultError or CaptureError when a file is damaged."""
    size = depths.camera(camera)
    step = raster_step(size)
    depth = confidence = motion = image = None
    if depths.has_depth(camera, time):
        depth = depths.depth(camera, time)[::step, ::step].copy()
        confidence = depths.confidence(camera, time)[::step, ::step].copy()
    if motions is not None:
        motion = motions.motion(camera, time)[::step, ::step].copy()
    if capture is not None:
        image = read_image(capture, camera, time)[::step, ::step].copy()
    # Pixel x of the raster is pixel x * step of the frame, so the raster is a pinhole camera of its own.
    intrinsics = size.intrinsics / step
    intrinsics[2, 2] = 1.0
    return Frame(camera, time, intrinsics, depth, confidence, motion, image)


def raster_step(camera: Camera) -> int:
    """Every which row and column of a frame is kept."""
    return max(1, math.ceil(math.sqrt(camera.width * camera.height / LARGEST_RASTER)))
