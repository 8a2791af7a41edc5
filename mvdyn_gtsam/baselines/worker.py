"""The process in which COLMAP or GLOMAP runs: ``python -m mvdyn_gtsam.baselines.worker REQUEST_JSON``.

A process of its own, since pycolmap and OpenCV disturb each other and so that time and memory are its own.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.baselines import sfm
from mvdyn_gtsam.baselines.settings import RESULT_NAME, Request
from mvdyn_gtsam.capture import open_capture
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import BaselineError, MvdynError
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter

_SHARED_PHASES = ("frames", "features", "matching")

Value = TypeVar("Value")


class _Phases:
    """Wall-clock seconds of each phase."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def run(self, name: str, work: Callable[[], Value]) -> Value:
        start = time.monotonic()
        value = work()
        self.seconds[name] = time.monotonic() - start
        return value


def run(request: Request) -> None:
    """Reconstruct and write ``out``: a reconstruction folder without depth, ``sparse/``, ``baseline.json``.

    Raises MvdynError when the capture cannot be read or no model was found.
    """
    capture = open_capture(request.capture, truncate=request.truncate)
    config = {"baseline": {"method": request.method, **request.settings.to_json()}}
    info = CaptureInfo.from_capture(capture)
    work = request.database or request.out / "work"
    with ReconstructionWriter.create(request.out, info, config, overwrite=True) as writer:
        try:
            _reconstruct(request, capture, work, writer)
        finally:
            if request.database is None:
                shutil.rmtree(work, ignore_errors=True)


def _reconstruct(request: Request, capture: Capture, work: Path, writer: ReconstructionWriter) -> None:
    reused, phases = _match(request, capture, work)
    # The mapper writes into the database; another method must find it as the matching left it.
    database = work / f"{request.method}.db"
    shutil.copyfile(work / "database.db", database)
    sparse = request.out / "sparse"
    shutil.rmtree(sparse, ignore_errors=True)
    try:
        model = phases.run(
            "mapping",
            lambda: sfm.reconstruct(request.method, work / "images", database, sparse, request.settings),
        )
    finally:
        database.unlink()
    trajectories = sfm.read_trajectories(
        model, [camera.name for camera in capture.cameras], capture.frame_count
    )
    _write(writer, capture, trajectories)
    for name, seconds in {**reused, **phases.seconds}.items():
        writer.finish_stage(name, seconds)
    result = {"phases": {**reused, **phases.seconds}, "reused": reused, "points": model.num_points3D()}
    (request.out / RESULT_NAME).write_text(json.dumps(result, indent=1))


def _match(request: Request, capture: Capture, work: Path) -> tuple[dict[str, float], _Phases]:
    """Frames, features and matches in ``work``; seconds of phases done by an earlier run, and timers."""
    phases, done_path = _Phases(), work / "phases.json"
    key = {"capture": str(request.capture.resolve()), "settings": request.settings.to_json()}
    if done_path.is_file():
        done = json.loads(done_path.read_text())
        if done["key"] != key:
            raise BaselineError(
                f"{work}: holds matches of another capture or settings; choose another folder"
            )
        return {name: float(done["phases"][name]) for name in _SHARED_PHASES}, phases
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    settings, images, database = request.settings, work / "images", work / "database.db"
    masks = None if settings.masks is None else work / "masks"
    phases.run("frames", lambda: sfm.write_frames(capture, images))
    if settings.masks is not None and masks is not None:
        sfm.write_masks(capture, settings.masks, masks)
    count = capture.frame_count
    phases.run(
        "features",
        lambda: sfm.extract_features(capture.cameras, count, images, database, settings, masks),
    )
    pairs = sfm.pairs_to_match([camera.name for camera in capture.cameras], count, settings)
    phases.run("matching", lambda: sfm.match_features(pairs, database, settings))
    done_path.write_text(json.dumps({"key": key, "phases": phases.seconds}))
    return {}, phases


def _write(
    writer: ReconstructionWriter, capture: Capture, trajectories: dict[str, npt.NDArray[np.float64]]
) -> None:
    for camera, wTc in trajectories.items():
        writer.write_trajectory(camera, capture.timestamps, wTc)
    placed = [camera for camera, wTc in trajectories.items() if np.isfinite(wTc).any()]
    writer.set_groups([placed])
    found = sum(int(np.isfinite(wTc).all(axis=(1, 2)).sum()) for wTc in trajectories.values())
    total = len(trajectories) * capture.frame_count
    if found < total:
        writer.add_note(f"{total - found} of {total} frames are not in the largest model and have no pose.")


def main(arguments: list[str]) -> int:
    """Read the request, run it; one line on stderr and 1 when that fails."""
    try:
        run(Request.from_json(json.loads(Path(arguments[0]).read_text())))
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except OSError as error:
        sys.stderr.write(f"{error.filename}: {error.strerror}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
