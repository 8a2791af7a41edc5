"""Cameras whose focal length is not known: what is taken as a first guess, and what they must be like."""

from __future__ import annotations

from dataclasses import replace

from mvdyn_gtsam.capture.model import FIRST_FOCAL, Camera, Capture
from mvdyn_gtsam.errors import CaptureError


def first_intrinsics(width: int, height: int) -> tuple[float, float, float, float]:
    """``(fx, fy, cx, cy)`` in px where none are given: ``FIRST_FOCAL``, and the centre of the image."""
    focal = FIRST_FOCAL * max(width, height)
    return focal, focal, (width - 1) / 2, (height - 1) / 2


def camera_with_unknown_focal(camera: Camera, where: str | None = None) -> Camera:
    """``camera`` with ``fx`` as the first guess of both focal lengths; ``cx, cy`` stay.

    Messages call it ``where``, by default "camera <name>". Raises CaptureError where it has distortion.
    """
    if any(camera.distortion):
        raise CaptureError(
            f"{where or f'camera {camera.name}'}: has distortion, which cannot be taken out of frames of"
            " unknown focal length; undistort the frames and leave distortion out, or give its intrinsics"
        )
    return replace(camera, fy=camera.fx, distortion=(), focal_known=False)


def with_unknown_focal(capture: Capture) -> Capture:
    """``capture`` with every focal length yet to be found; the intrinsics that it has are first guesses.

    Raises CaptureError, naming the camera, where one has distortion.
    """
    cameras = tuple(camera_with_unknown_focal(camera) for camera in capture.cameras)
    return replace(capture, cameras=cameras)
