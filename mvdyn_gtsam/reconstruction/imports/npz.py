"""One ``.npz`` file with an array of poses per camera."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.imports.options import ImportOptions
from mvdyn_gtsam.reconstruction.imports.poses import ImportedPoses, to_wTc

CONVENTION_KEY = "convention"


def read_npz(path: Path, capture: Capture, options: ImportOptions) -> ImportedPoses:
    """``(T, 4, 4)`` or ``(T, 3, 4)`` under each camera's name, NaN for frames without a pose.

    ``np.savez("poses.npz", cam0=..., cam1=..., convention="cTw")`` says world-to-camera. Raises ResultError
    for a missing camera, another number of frames, and matrices that are no pose.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ResultError(f"{path}: cannot be read as a npz file of plain arrays ({error})") from error
    if CONVENTION_KEY in arrays:
        options = _with_convention(path, str(arrays.pop(CONVENTION_KEY)), options)
    names = [camera.name for camera in capture.cameras]
    for name in (*names, *arrays):
        if name not in arrays or name not in names:
            raise ResultError(
                f"{path}: holds {', '.join(arrays) or 'nothing'}, the capture has cameras"
                f" {', '.join(names)}; save one array per camera under its name"
            )
    result = {}
    for name in names:
        matrices = arrays[name]
        if matrices.ndim != 3 or matrices.shape[1:] not in ((4, 4), (3, 4)) or matrices.dtype.kind != "f":
            raise ResultError(
                f"{path}: {name} is {matrices.dtype} of shape {matrices.shape}; it must be float (T, 4, 4) or"
                " (T, 3, 4)"
            )
        if len(matrices) != capture.frame_count:
            raise ResultError(
                f"{path}: {name} has {len(matrices)} poses, the capture {capture.frame_count} frames; put NaN"
                " where a frame has no pose"
            )
        result[name] = to_wTc(matrices.astype(np.float64), options, f"{path}: {name}")
    return ImportedPoses(result)


def _with_convention(path: Path, given: str, options: ImportOptions) -> ImportOptions:
    if given not in ("wTc", "cTw"):
        raise ResultError(f"{path}: {CONVENTION_KEY} is {given!r}; it must be wTc or cTw")
    if options.convention not in (None, given):
        raise ResultError(f"{path}: says {given}, import.json beside it {options.convention}; keep one")
    return replace(options, convention=given)
