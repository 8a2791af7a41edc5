"""``<camera>.txt`` of TUM lines: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.imports.options import OPTIONS_NAME, ImportOptions
from mvdyn_gtsam.reconstruction.imports.poses import Array, ImportedPoses, PoseTable, to_wTc

TIME_TOLERANCE = 0.25
"""Of a frame interval: timestamps are often printed with two digits."""


def read_tum_folder(folder: Path, capture: Capture, options: ImportOptions) -> ImportedPoses:
    """``timestamp tx ty tz qx qy qz qw`` per line; frames without a line, or with NaN for all, have no pose.

    Raises ResultError for a missing camera, a timestamp that is not a frame's, and lines that are no pose.
    """
    table = PoseTable(folder, capture)
    for camera in capture.cameras:
        path = folder / f"{camera.name}.txt"
        if not path.is_file():
            raise ResultError(
                f"{path}: missing; write one file per camera of the capture, an empty one for a camera"
                " without a pose"
            )
        timestamps, matrices = _read(path)
        frames = _frames(path, timestamps, capture, options)
        for row, (time, wTc) in enumerate(zip(frames, to_wTc(matrices, options, str(path)), strict=True)):
            table.put(camera.name, int(time), wTc, f"{path.name}, timestamp {timestamps[row]:g}")
    return ImportedPoses(table.wTc)


def _read(path: Path) -> tuple[Array, Array]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file is a camera without a pose
            rows = np.loadtxt(path, dtype=np.float64, comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise ResultError(
            f"{path}: no trajectory of lines timestamp tx ty tz qx qy qz qw ({error})"
        ) from error
    if rows.size == 0:
        return np.zeros(0), np.zeros((0, 4, 4))
    if rows.shape[1] != 8:
        raise ResultError(
            f"{path}: {rows.shape[1]} numbers a line; it must be timestamp tx ty tz qx qy qz qw"
        )
    matrices = np.full((len(rows), 4, 4), np.nan)
    given = ~np.isnan(rows[:, 1:]).all(axis=1)
    for row in np.flatnonzero(given):
        norm = np.linalg.norm(rows[row, 4:])
        if not np.isfinite(rows[row]).all() or abs(norm - 1.0) > 1e-2:
            raise ResultError(
                f"{path}: pose {row}: NaN, or a quaternion that is not of unit length; the order is"
                " timestamp tx ty tz qx qy qz qw, and a frame without a pose has no line"
            )
    if given.any():
        matrices[given] = np.eye(4)
        matrices[given, :3, :3] = Rotation.from_quat(rows[given, 4:]).as_matrix()
        matrices[given, :3, 3] = rows[given, 1:4]
    return rows[:, 0], matrices


def _frames(path: Path, timestamps: Array, capture: Capture, options: ImportOptions) -> Array:
    if options.timestamps == "frames":
        position = timestamps - options.first_frame
    else:
        position = (timestamps - capture.start_time) * capture.fps
    frames = np.rint(position)
    wrong = ~(np.abs(position - frames) <= TIME_TOLERANCE) | (frames < 0) | (frames >= capture.frame_count)
    if wrong.any():
        raise ResultError(
            f"{path}: timestamp {timestamps[wrong][0]:g} is not that of one of the {capture.frame_count}"
            f" frames at {capture.fps:g} frames per second; if it is a frame number, write"
            f' {{"timestamps": "frames"}} to {OPTIONS_NAME} beside the poses'
        )
    return frames
