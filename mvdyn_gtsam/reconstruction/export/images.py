"""The undistorted frames as image files, one per camera and time, under the names the exports refer to."""

from __future__ import annotations

from pathlib import Path

import cv2

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.reconstruction.export.points import read_image
from mvdyn_gtsam.reconstruction.files import write_atomically


def image_name(camera: str, time: int) -> str:
    """Path of a frame below the folder of images: one folder per camera, one file per time."""
    return f"{camera}/{time:06d}.jpg"


def write_image(capture: Capture, camera: str, time: int, folder: Path) -> None:
    """Write frame ``time`` of ``camera``, undistorted, to ``folder / image_name(...)`` (JPEG, quality 95)."""
    image = cv2.cvtColor(read_image(capture, camera, time), cv2.COLOR_RGB2BGR)
    done, buffer = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 95))
    if not done:
        raise RuntimeError(f"OpenCV could not encode frame {time} of {camera}")
    write_atomically(folder / image_name(camera, time), buffer.tobytes())
