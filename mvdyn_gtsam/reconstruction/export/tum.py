"""TUM trajectory files, as evo reads them."""

from __future__ import annotations

from pathlib import Path

from mvdyn_gtsam.reconstruction.export.points import placed_groups
from mvdyn_gtsam.reconstruction.files import format_tum, write_atomically
from mvdyn_gtsam.reconstruction.result import Reconstruction


def export_tum(reconstruction: Reconstruction, folder: Path) -> list[Path]:
    """Write ``<camera>.txt`` for every placed camera: timestamp tx ty tz qx qy qz qw of wTc.

    Cameras of different groups go to ``group0/``, ``group1/``: their worlds differ. Returns the files.
    """
    groups = placed_groups(reconstruction)
    written = []
    for index, group in enumerate(groups):
        target = folder if len(groups) == 1 else folder / f"group{index}"
        for camera in group:
            path = target / f"{camera}.txt"
            write_atomically(path, format_tum(*reconstruction.trajectory(camera)).encode())
            written.append(path)
    return written
