"""Coloured points of the depth maps of several frames, in the world frame of their group."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import backproject, transform_points
from mvdyn_gtsam.reconstruction.result import Reconstruction

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FramePoints:
    """World points seen in one frame."""

    camera: str
    time: int
    wTc: npt.NDArray[np.float64]
    """``(4, 4)``"""
    positions: npt.NDArray[np.float64]
    """``(N, 3)`` world, the reconstruction's unit."""
    pixels: npt.NDArray[np.float64]
    """``(N, 2)`` px, centres at integers."""
    colours: npt.NDArray[np.uint8]
    """``(N, 3)`` RGB; mid grey without a capture."""


def placed_groups(reconstruction: Reconstruction) -> list[list[str]]:
    """The groups of cameras with poses. Raises ResultError when there is none, so nothing to export."""
    groups = [group for group in reconstruction.groups if group]
    if not groups:
        raise ResultError(
            f"{reconstruction.folder}: no camera has been placed yet (the run is {reconstruction.status});"
            " continue it with mvdyn reconstruct --resume"
        )
    return groups


def posed_frames(reconstruction: Reconstruction, camera: str) -> list[tuple[int, npt.NDArray[np.float64]]]:
    """``(time, wTc (4, 4))`` of the frames of ``camera`` that have a pose; missing ones are logged."""
    _, wTc = reconstruction.trajectory(camera)
    present = np.isfinite(wTc).reshape(len(wTc), -1).all(axis=1)
    if not present.all():
        log.warning("%s: %d of %d frames have no pose: left out", camera, np.sum(~present), len(wTc))
    return [(int(time), wTc[time]) for time in np.flatnonzero(present)]


def check_capture(reconstruction: Reconstruction, capture: Capture) -> None:
    """Raise ResultError unless ``capture`` has the cameras, sizes and length of the reconstruction."""
    for name in reconstruction.cameras:
        camera = reconstruction.camera(name)
        same = [
            c for c in capture.cameras if (c.name, c.width, c.height) == (name, camera.width, camera.height)
        ]
        if not same or capture.frame_count < reconstruction.frame_count:
            raise ResultError(
                f"{reconstruction.folder}: was not made from capture {capture.name!r}: {name} has"
                f" {reconstruction.frame_count} frames of {camera.width}x{camera.height}; give its --capture"
            )


def checked_times(
    reconstruction: Reconstruction, times: Sequence[int] | None, capture: Capture | None
) -> set[int]:
    """``times``, or every frame when None. Raises ResultError for a frame or a capture that does not fit."""
    if capture is not None:
        check_capture(reconstruction, capture)
    return set(check_times(reconstruction, times))


def group_points(
    reconstruction: Reconstruction,
    group: Sequence[str],
    times: set[int],
    capture: Capture | None,
    *,
    stride: int,
    min_confidence: float,
) -> Iterator[FramePoints]:
    """Points of every frame of ``group`` at ``times`` that has a pose, grey without a capture."""
    for camera in group:
        for time, wTc in posed_frames(reconstruction, camera):
            if time in times:
                image = None if capture is None else read_image(capture, camera, time)
                yield frame_points(
                    reconstruction, camera, time, wTc,
                    stride=stride, min_confidence=min_confidence, image=image,
                )  # fmt: skip


def read_image(capture: Capture, camera: str, time: int) -> npt.NDArray[np.uint8]:
    """Frame ``time`` of the camera called ``camera``, ``(H, W, 3) uint8`` RGB."""
    index = [item.name for item in capture.cameras].index(camera)
    return capture.read(index, time)


def frame_points(
    reconstruction: Reconstruction,
    camera: str,
    time: int,
    wTc: npt.NDArray[np.float64],
    *,
    stride: int,
    min_confidence: float,
    image: npt.NDArray[np.uint8] | None,
) -> FramePoints:
    """Points of every ``stride``-th pixel with a valid depth of at least ``min_confidence``.

    ``image`` is the frame, ``(H, W, 3) uint8`` RGB, or None for grey points.
    """
    depth = reconstruction.depth(camera, time)[::stride, ::stride]
    confidence = reconstruction.confidence(camera, time)[::stride, ::stride]
    rows, columns = np.nonzero(np.isfinite(depth) & (confidence >= min_confidence))
    pixels = np.column_stack([columns, rows]).astype(np.float64) * stride
    z = depth[rows, columns].astype(np.float64)
    positions = transform_points(wTc, backproject(pixels, z, reconstruction.intrinsics(camera)))
    colours = np.full((len(z), 3), 128, np.uint8) if image is None else image[rows * stride, columns * stride]
    return FramePoints(camera, time, wTc, positions, pixels, colours)


def check_times(reconstruction: Reconstruction, times: Sequence[int] | None) -> list[int]:
    """``times``, or every frame when None. Raises ResultError for a frame that does not exist."""
    if times is None:
        return list(range(reconstruction.frame_count))
    for time in times:
        if not 0 <= time < reconstruction.frame_count:
            raise ResultError(
                f"{reconstruction.folder}: no frame {time}; frames are 0..{reconstruction.frame_count - 1}"
            )
    return list(times)
