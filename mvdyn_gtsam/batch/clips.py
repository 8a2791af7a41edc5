"""The captures of a folder, and the ground truth each of them brings."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mvdyn_gtsam.capture.dispatch import LAYOUTS
from mvdyn_gtsam.capture.euroc import is_euroc
from mvdyn_gtsam.capture.folder_per_camera import is_folder_per_camera
from mvdyn_gtsam.capture.images import natural_key
from mvdyn_gtsam.capture.loader import CAPTURE_FILE
from mvdyn_gtsam.capture.multicamvideo import is_multicamvideo, multicamvideo_poses
from mvdyn_gtsam.errors import MvdynError

if TYPE_CHECKING:
    from mvdyn_gtsam.evaluation import GroundTruth
    from mvdyn_gtsam.reconstruction import Reconstruction

DEPTH = 4
"""Levels below the folder that are searched: MultiCamVideo has train/f18_aperture10/scene1."""

logger = logging.getLogger(__name__)


class BatchError(MvdynError):
    """A batch cannot be started, or some of its clips failed."""


@dataclass(frozen=True)
class Clip:
    """One capture of a batch."""

    name: str
    """Of its result folder: the path below the batch's folder, parts joined by ``-``."""
    folder: Path


def find_clips(folder: Path, out: Path | None = None) -> list[Clip]:
    """All captures below ``folder``, in natural order; ``out`` is not searched.

    Folders directly in ``folder`` that hold none are named in a warning. Raises BatchError where there are
    none at all, or two would get one name.
    """
    folder = folder.absolute()
    if not folder.is_dir():
        raise BatchError(f"{folder}: there is no such folder; check the path")
    if is_capture(folder):
        raise BatchError(f"{folder}: is one capture itself; give the folder above, or use mvdyn reconstruct")
    without, clips = [], []
    for child in _folders(folder, out):
        found = list(_captures(child, out, DEPTH - 1))
        clips += [Clip("-".join(path.relative_to(folder).parts), path) for path in found]
        if not found:
            without.append(child.name)
    if not clips:
        raise BatchError(f"{folder}: holds no captures; each must be {'; or '.join(LAYOUTS)}")
    by_name: dict[str, Clip] = {}
    for clip in clips:
        other = by_name.setdefault(clip.name, clip)
        if other is not clip:
            raise BatchError(f"{other.folder} and {clip.folder}: both would be named {clip.name}; rename one")
    if without:
        logger.warning("%s: no capture in %s; left out", folder, ", ".join(without))
    return clips


def is_capture(folder: Path) -> bool:
    """Whether ``folder`` has one of the layouts of ``capture.dispatch``."""
    return (
        (folder / CAPTURE_FILE).is_file()
        or is_euroc(folder)
        or is_multicamvideo(folder)
        or is_folder_per_camera(folder)
    )


def has_groundtruth(folder: Path) -> bool:
    """Whether the capture ``folder`` brings true poses."""
    return (
        (folder / "groundtruth").is_dir() or is_multicamvideo(folder) or any(folder.glob("*/groundtruth.txt"))
    )


def groundtruth_of(folder: Path, reconstruction: Reconstruction) -> GroundTruth:
    """True poses of the cameras of ``reconstruction``, and depth where ``groundtruth/`` has it.

    Raises EvaluationError, CaptureError or ResultError where the files cannot be read.
    """
    import numpy as np

    from mvdyn_gtsam.evaluation import GroundTruth, load_groundtruth
    from mvdyn_gtsam.reconstruction.files import read_tum

    if (folder / "groundtruth").is_dir():
        return load_groundtruth(folder / "groundtruth")
    if is_multicamvideo(folder):
        poses = {name: multicamvideo_poses(folder, name) for name in reconstruction.cameras}
        trajectories = {name: (np.arange(len(wTc)) / reconstruction.fps, wTc) for name, wTc in poses.items()}
    else:
        files = {path.parent.name: path for path in folder.glob("*/groundtruth.txt")}
        trajectories = {name: read_tum(path) for name, path in files.items()}
    return GroundTruth(folder / "groundtruth", trajectories)


def _folders(folder: Path, out: Path | None) -> list[Path]:
    left_out = None if out is None else out.resolve()
    children = (path for path in folder.iterdir() if not path.name.startswith(".") and path.is_dir())
    return sorted((path for path in children if path.resolve() != left_out), key=natural_key)


def _captures(folder: Path, out: Path | None, depth: int) -> Iterator[Path]:
    if is_capture(folder):
        yield folder
    elif depth > 0:
        for child in _folders(folder, out):
            yield from _captures(child, out, depth - 1)
