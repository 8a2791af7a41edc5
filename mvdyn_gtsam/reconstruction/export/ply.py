"""A coloured point cloud of one instant, or of all, fused over the cameras of each group."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.export.points import checked_times, group_points, placed_groups
from mvdyn_gtsam.reconstruction.files import write_atomically
from mvdyn_gtsam.reconstruction.result import Reconstruction

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def export_ply(
    reconstruction: Reconstruction,
    file: Path,
    *,
    times: Sequence[int] | None = None,
    capture: Capture | None = None,
    stride: int = 2,
    min_confidence: float = 0.3,
) -> list[Path]:
    """Write the points of frames ``times`` (None: all) of every camera to the binary PLY ``file``.

    World coordinates (OpenCV axes of the world frame) in the reconstruction's unit. With several groups,
    ``<stem>_group<i>.ply``. Raises ResultError when no pixel passes ``min_confidence``. Returns the files.
    """
    chosen = checked_times(reconstruction, times, capture)
    groups = placed_groups(reconstruction)
    written = []
    for index, group in enumerate(groups):
        target = file if len(groups) == 1 else file.with_name(f"{file.stem}_group{index}.ply")
        parts = [
            _vertices(seen.positions, seen.colours)
            for seen in group_points(
                reconstruction, group, chosen, capture, stride=stride, min_confidence=min_confidence
            )
        ]
        vertices = np.concatenate(parts) if parts else np.empty(0, _VERTEX)
        if not len(vertices):
            raise ResultError(
                f"{reconstruction.folder}: no depth of confidence {min_confidence}; lower --min-confidence"
            )
        write_ply(target, vertices)
        written.append(target)
    return written


def write_ply(path: Path, vertices: npt.NDArray[np.void]) -> None:
    """Write a structured array ``x y z red green blue`` as binary little-endian PLY."""
    properties = "".join(
        f"property {'float' if vertices.dtype[name].kind == 'f' else 'uchar'} {name}\n"
        for name in vertices.dtype.names or ()
    )
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    write_atomically(path, header.encode() + vertices.tobytes())


def points_to_ply(path: Path, positions: npt.NDArray[np.float64], colours: npt.NDArray[np.uint8]) -> None:
    """Write points ``(N, 3)`` with RGB ``(N, 3)``."""
    write_ply(path, _vertices(positions, colours))


def _vertices(positions: npt.NDArray[np.float64], colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.void]:
    vertices = np.empty(len(positions), _VERTEX)
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = positions[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, column]
    return vertices
