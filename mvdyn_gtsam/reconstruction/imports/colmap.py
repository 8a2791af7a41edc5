"""COLMAP models, text or binary: https://colmap.github.io/format.html."""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.reconstruction.imports.options import OPTIONS_NAME, ImportOptions
from mvdyn_gtsam.reconstruction.imports.poses import (
    Array,
    ImportedPoses,
    PoseTable,
    frame_of,
    input_intrinsics,
    median_intrinsics,
)

logger = logging.getLogger(__name__)


def is_model(folder: Path) -> bool:
    """Whether ``folder`` holds ``cameras`` and ``images``, as text or binary."""
    return any(
        all((folder / f"{name}{end}").is_file() for name in ("cameras", "images")) for end in (".txt", ".bin")
    )


def read_model(folder: Path, capture: Capture, options: ImportOptions) -> ImportedPoses:
    """Poses by image name (see ``frame_of``) and the model's own intrinsics, which have centres at +0.5.

    Raises ResultError for a model that pycolmap cannot read, and for ``convention`` or ``axes`` in
    ``import.json``, since the format fixes both.
    """
    if options.convention is not None or options.axes is not None:
        raise ResultError(
            f"{folder}: a COLMAP model fixes its convention and axes; take them out of {OPTIONS_NAME}"
        )
    names, cTw, matrices, sizes, distorted = _read(folder)
    cameras = {camera.name: camera for camera in capture.cameras}
    table = PoseTable(folder, capture)
    intrinsics: dict[str, list[Array]] = {name: [] for name in cameras}
    for index, name in enumerate(names):
        camera, time = frame_of(name, capture, options, folder)
        table.put(camera, time, invert_pose(cTw[index]), name)
        size = float(sizes[index, 0]), float(sizes[index, 1])
        intrinsics[camera].append(input_intrinsics(matrices[index], size, cameras[camera]))
    if distorted.any():
        logger.warning("%s: its lens distortion is ignored; frames are compared undistorted", folder)
    return ImportedPoses(table.wTc, median_intrinsics(intrinsics))


def _read(folder: Path) -> tuple[list[str], Array, Array, Array, Array]:
    # In a process of its own: a damaged model can abort COLMAP's reader, and its zlib disturbs OpenCV's.
    with tempfile.TemporaryDirectory(prefix="mvdyn-import-") as work:
        target = Path(work) / "model.npz"
        command = [sys.executable, "-m", f"{__package__}.colmap_worker", str(folder), str(target)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not target.is_file():
            lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
            reason = lines[-1][:200] if lines else f"exit code {done.returncode}"
            raise ResultError(f"{folder}: cannot be read as a COLMAP model ({reason}); write it again")
        with np.load(target, allow_pickle=False) as stored:
            return (
                [str(name) for name in stored["names"]],
                stored["cTw"],
                stored["intrinsics"],
                stored["sizes"],
                stored["distorted"],
            )
