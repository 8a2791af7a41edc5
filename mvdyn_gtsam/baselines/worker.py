"""The process in which COLMAP or GLOMAP runs: ``python -m mvdyn_gtsam.baselines.worker REQUEST_JSON``.

A process of its own, since pycolmap and OpenCV disturb each other and so that time and memory are its own.
"""

from __future__ import annotations

import json
import shutil
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.baselines import sfm
from mvdyn_gtsam.baselines.retrieval import describe_images, retrieved_pairs
from mvdyn_gtsam.baselines.settings import ALL_FOCALS_REFINED, RESULT_NAME, Request
from mvdyn_gtsam.baselines.shared import Phases, SharedCost, shared_folder
from mvdyn_gtsam.capture import open_capture, with_unknown_focal
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import BaselineError, MvdynError
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter


def run(request: Request) -> None:
    """Reconstruct and write ``out``: a reconstruction folder without depth, ``sparse/``, ``baseline.json``.

    Raises MvdynError when the capture cannot be read or no model was found.
    """
    capture = open_capture(request.capture, truncate=request.truncate)
    if request.estimate_focal:
        capture = with_unknown_focal(capture)
    config = {"baseline": {"method": request.method, **request.settings.to_json()}}
    info = CaptureInfo.from_capture(capture)
    if request.database is None:
        work = request.out / "work"
    else:
        work = shared_folder(request.database, request, info, version("pycolmap"))
    with ReconstructionWriter.create(request.out, info, config, overwrite=True) as writer:
        try:
            _reconstruct(request, capture, work, writer)
        finally:
            if request.database is None:
                shutil.rmtree(work, ignore_errors=True)


def _reconstruct(request: Request, capture: Capture, work: Path, writer: ReconstructionWriter) -> None:
    phases = Phases()
    reused = _match(request, capture, work, phases)
    # Before mapping: a method that fails there took these phases over all the same.
    _write_result(request, {**reused.seconds, **phases.seconds}, reused, points=None)
    # The mapper writes into the database; another method must find it as the matching left it.
    database = work / f"{request.method}.db"
    shutil.copyfile(work / "database.db", database)
    sparse = request.out / "sparse"
    shutil.rmtree(sparse, ignore_errors=True)
    try:
        model = phases.run(
            "mapping",
            lambda: sfm.reconstruct(
                request.method, work / "images", database, sparse, request.settings, capture.cameras
            ),
        )
    finally:
        database.unlink()
    trajectories = sfm.read_trajectories(
        model, [camera.name for camera in capture.cameras], capture.frame_count
    )
    _write(writer, capture, trajectories)
    seconds = {**reused.seconds, **phases.seconds}
    for name, value in seconds.items():
        writer.finish_stage(name, value)
    _write_result(request, seconds, reused, points=model.num_points3D())
    known = [camera.focal_known for camera in capture.cameras]
    if request.method == "glomap" and any(known) and not all(known):
        writer.add_note(ALL_FOCALS_REFINED)
    refined = zip(capture.cameras, sfm.read_cameras(model, capture.cameras), strict=True)
    writer.set_found_intrinsics({now.name: now for before, now in refined if now != before}, {})


def _match(request: Request, capture: Capture, work: Path, phases: Phases) -> SharedCost:
    """Frames, features and matches in ``work``; returns the cost of those that an earlier run had made."""
    done_path = work / "phases.json"
    if done_path.is_file():
        return SharedCost.from_json(json.loads(done_path.read_text()))
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    settings, images, database = request.settings, work / "images", work / "database.db"
    count = capture.frame_count
    phases.run("frames", lambda: sfm.write_frames(capture, images))
    masks = None
    if settings.masks is not None:
        moving, masks = settings.masks, work / "masks"
        phases.run("masks", lambda: sfm.write_masks(capture, moving, work / "masks"))
    pairs = sfm.pairs_to_match([camera.name for camera in capture.cameras], count, settings)
    if settings.pairing == "retrieval":
        pairs += phases.run("retrieval", lambda: _retrieve(request, capture, images, pairs))
    phases.run(
        "features",
        lambda: sfm.extract_features(capture.cameras, count, images, database, settings, masks),
    )
    phases.run("matching", lambda: sfm.match_features(pairs, database, settings))
    done_path.write_text(json.dumps(phases.cost().to_json()))
    return SharedCost()


def _retrieve(
    request: Request, capture: Capture, images: Path, known: list[tuple[str, str]]
) -> list[tuple[str, str]]:
    settings = request.settings
    if settings.descriptor is None:
        raise BaselineError("retrieval needs a global descriptor: give its ONNX model, or match exhaustively")
    names = [sfm.image_name(camera.name, t) for camera in capture.cameras for t in range(capture.frame_count)]
    descriptors = describe_images(settings.descriptor, images, names, settings.num_threads)
    return retrieved_pairs(names, descriptors, settings.retrieval_pairs, known)


def _write_result(request: Request, phases: dict[str, float], reused: SharedCost, points: int | None) -> None:
    result = {"phases": phases, "reused": reused.to_json(), "points": points}
    (request.out / RESULT_NAME).write_text(json.dumps(result, indent=1))


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
