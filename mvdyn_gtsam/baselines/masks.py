"""Where the motion masks of a comparison come from."""

from __future__ import annotations

from pathlib import Path

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.evaluation.groundtruth import MASK_FOLDERS
from mvdyn_gtsam.reconstruction import is_reconstruction
from mvdyn_gtsam.reconstruction.layout import motion_path

_REMEDY = (
    "give --masks DIR: a folder <camera>/000012.png with 255 where something moves, one per frame, or the"
    " folder of a refined reconstruction"
)


def find_masks(capture: Capture, given: Path | None, groundtruth: Path | None) -> Path:
    """Folder ``<camera>/<%06d>.png`` with a mask of every frame of ``capture``.

    ``given`` is such a folder, or a reconstruction, whose ``motion/`` (255 and 128 where something moves) is
    taken; without it, ``dynamic/`` or ``masks/`` of the ground truth. Raises BaselineError where there is
    none, or not one of every frame.
    """
    if given is not None and is_reconstruction(given):
        folder = motion_path(given, "camera", 0).parents[1]
        if not folder.is_dir():
            raise BaselineError(
                f"{given}: has no motion masks, which the refinement finds; run mvdyn reconstruct --resume"
                " --stage refinement"
            )
    elif given is not None:
        folder = given
    else:
        folders = [] if groundtruth is None else [groundtruth / name for name in MASK_FOLDERS]
        present = [candidate for candidate in folders if candidate.is_dir()]
        if not present:
            raise BaselineError(f"{capture.name}: there are no motion masks with the ground truth; {_REMEDY}")
        folder = present[0]
    for camera in capture.cameras:
        found = sum((folder / camera.name / f"{t:06d}.png").is_file() for t in range(capture.frame_count))
        if found < capture.frame_count:
            raise BaselineError(
                f"{folder / camera.name}: has masks of {found} of {capture.frame_count} frames; {_REMEDY}"
            )
    return folder
