"""nerfstudio's transforms.json: https://docs.nerf.studio/quickstart/data_conventions.html."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.reconstruction.export.images import image_name, write_image
from mvdyn_gtsam.reconstruction.export.ply import points_to_ply
from mvdyn_gtsam.reconstruction.export.points import checked_times, group_points, placed_groups
from mvdyn_gtsam.reconstruction.files import write_json
from mvdyn_gtsam.reconstruction.result import Reconstruction

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes x right, y up, z backward, from x right, y down, z forward."""
PIXEL_CENTRE = 0.5
"""nerfstudio keeps COLMAP's convention: the centre of the first pixel is (0.5, 0.5)."""


def export_nerfstudio(
    reconstruction: Reconstruction,
    folder: Path,
    *,
    times: Sequence[int] | None = None,
    capture: Capture | None = None,
    stride: int = 16,
    min_confidence: float = 0.3,
) -> list[Path]:
    """Write ``transforms.json``, ``points.ply`` to start from and, with ``capture``, ``images/``.

    One entry per frame AND time: ``transform_matrix`` (camera-to-world, OpenGL camera axes), per-camera
    ``fl_x .. h``, ``time`` in [0, 1] as the dynamic dataparsers (D-NeRF, 4D-GS) read it, ``timestamp`` in
    seconds and ``camera``. With several groups, ``group<i>/transforms.json``. Returns the JSON files.
    """
    chosen = checked_times(reconstruction, times, capture)
    groups = placed_groups(reconstruction)
    written = []
    for index, group in enumerate(groups):
        target = folder if len(groups) == 1 else folder / f"group{index}"
        frames: list[dict[str, Any]] = []
        positions = [np.empty((0, 3))]
        colours = [np.empty((0, 3), np.uint8)]
        for seen in group_points(
            reconstruction, group, chosen, capture, stride=stride, min_confidence=min_confidence
        ):
            frames.append(_frame(reconstruction, seen.camera, seen.time, seen.wTc))
            positions.append(seen.positions)
            colours.append(seen.colours)
            if capture is not None:
                write_image(capture, seen.camera, seen.time, target / "images")
        points_to_ply(target / "points.ply", np.concatenate(positions), np.concatenate(colours))
        path = target / "transforms.json"
        write_json(path, {"camera_model": "OPENCV", "ply_file_path": "points.ply", "frames": frames})
        written.append(path)
    return written


def _frame(reconstruction: Reconstruction, name: str, time: int, wTc: np.ndarray) -> dict[str, Any]:
    camera = reconstruction.camera(name)
    return {
        "file_path": f"images/{image_name(name, time)}",
        "camera": name,
        "time": time / max(reconstruction.frame_count - 1, 1),
        "timestamp": time / reconstruction.fps,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE,
        "transform_matrix": (wTc @ OPENGL_FROM_OPENCV).tolist(),
    }
