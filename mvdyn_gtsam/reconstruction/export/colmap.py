"""COLMAP text models: https://colmap.github.io/format.html#text-format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.reconstruction.export.images import image_name, write_image
from mvdyn_gtsam.reconstruction.export.points import (
    FramePoints,
    checked_times,
    group_points,
    placed_groups,
)
from mvdyn_gtsam.reconstruction.files import write_atomically
from mvdyn_gtsam.reconstruction.result import Reconstruction

PIXEL_CENTRE = 0.5
"""COLMAP puts the centre of the first pixel at (0.5, 0.5), this project at (0, 0)."""


def export_colmap(
    reconstruction: Reconstruction,
    folder: Path,
    *,
    times: Sequence[int] | None = None,
    capture: Capture | None = None,
    stride: int = 16,
    min_confidence: float = 0.3,
) -> list[Path]:
    """Write ``sparse/<group>/{cameras,images,points3D}.txt`` and, with ``capture``, ``images/``.

    One PINHOLE camera per device (the frames are undistorted), one image ``<camera>/<time>.jpg`` per
    camera and time, and a point for every ``stride``-th pixel of confident depth, observed in its own
    image. Poses become camera-to-world's inverse and pixels move by half a pixel, as COLMAP wants.
    Returns the folders of the models, one per group (groups do not share a world frame).
    """
    chosen = checked_times(reconstruction, times, capture)
    models = []
    for index, group in enumerate(placed_groups(reconstruction)):
        images = [
            "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID ...; +0.5 px centres\n"
        ]
        points = ["# POINT3D_ID X Y Z R G B ERROR TRACK (IMAGE_ID POINT2D_IDX)\n"]
        frames = group_points(
            reconstruction, group, chosen, capture, stride=stride, min_confidence=min_confidence
        )
        for image_id, seen in enumerate(frames, start=1):
            camera_id = reconstruction.cameras.index(seen.camera) + 1
            first = len(points)
            images.append(_image_lines(image_id, camera_id, seen, first))
            points += _point_lines(image_id, seen, first)
            if capture is not None:
                write_image(capture, seen.camera, seen.time, folder / "images")
        model = folder / "sparse" / str(index)
        cameras = [_camera_line(reconstruction.cameras.index(c) + 1, reconstruction.camera(c)) for c in group]
        write_atomically(model / "cameras.txt", "".join(cameras).encode())
        write_atomically(model / "images.txt", "".join(images).encode())
        write_atomically(model / "points3D.txt", "".join(points).encode())
        models.append(model)
    return models


def _camera_line(camera_id: int, camera: Camera) -> str:
    numbers = (camera.fx, camera.fy, camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE)
    return f"{camera_id} PINHOLE {camera.width} {camera.height} " + _join(numbers) + "\n"


def _image_lines(image_id: int, camera_id: int, seen: FramePoints, first_point: int) -> str:
    cTw = invert_pose(seen.wTc)
    qx, qy, qz, qw = Rotation.from_matrix(cTw[:3, :3]).as_quat(canonical=True)
    name = image_name(seen.camera, seen.time)
    pixels = seen.pixels + PIXEL_CENTRE
    observations = " ".join(f"{x:g} {y:g} {first_point + i}" for i, (x, y) in enumerate(pixels))
    return f"{image_id} {_join((qw, qx, qy, qz, *cTw[:3, 3]))} {camera_id} {name}\n{observations}\n"


def _point_lines(image_id: int, seen: FramePoints, first_point: int) -> list[str]:
    return [
        f"{first_point + i} {_join(position)} {red} {green} {blue} 0 {image_id} {i}\n"
        for i, (position, (red, green, blue)) in enumerate(zip(seen.positions, seen.colours, strict=True))
    ]


def _join(numbers: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)
