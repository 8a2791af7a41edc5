"""Trajectory error of the tracker over values of its settings, on captures with ground truth.

    python -m experiments.tracking_sweep CAPTURE... --vary tracking.robust_px=0.2,0.5,1.0 --start-folder DIR

The wide-baseline start is computed once per capture and kept in ``--start-folder``. Each setting is varied
alone, the others at their defaults; one line per capture and value, with one Sim(3) per connected group.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from time import process_time

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.loader import load_capture
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import Config, load_config
from mvdyn_gtsam.evaluation.alignment import align
from mvdyn_gtsam.evaluation.groundtruth import load_groundtruth
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start import Start, start_from_arrays, start_to_arrays
from mvdyn_gtsam.frontend.wide_baseline import ClassicalInitializer
from mvdyn_gtsam.progress import NullProgress
from mvdyn_gtsam.tracking.model import TrackingResult
from mvdyn_gtsam.tracking.tracker import Tracker

Array = npt.NDArray[np.float64]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sweep; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--vary", action="append", default=[], metavar="KEY=V1,V2,...")
    parser.add_argument("--start-folder", type=Path, required=True, help="keeps the wide-baseline starts")
    parser.add_argument("--frames", type=int, default=None, help="only the first so many instants")
    options = parser.parse_args(arguments)
    print("capture | setting | ATE mm per group | keyframes | CPU s")
    for path in options.captures:
        capture = load_capture(path)
        start = _start(capture, options.start_folder)
        for setting in ["", *_settings(options.vary)]:
            config = load_config(None, [setting] if setting else [])
            began = process_time()
            result = _track(capture, start, config, options.frames)
            seconds = process_time() - began
            errors = " ".join(f"{1e3 * ate:.2f}" for ate in _errors(capture, path, result))
            keyframes = " ".join(str(len(times)) for times in result.keyframe_times)
            row = (capture.name, setting or "defaults", errors, keyframes, f"{seconds:.0f}")
            print(" | ".join(row), flush=True)
    return 0


def _settings(vary: Sequence[str]) -> list[str]:
    pairs = [item.split("=", 1) for item in vary]
    return [f"{key}={value}" for key, values in pairs for value in values.split(",")]


def _start(capture: Capture, folder: Path) -> Start:
    kept = folder / f"{capture.name}.npz"
    if kept.exists():
        with np.load(kept) as arrays:
            return start_from_arrays(dict(arrays))
    config = Config()
    flow = DisFlow(config.frontend.flow)
    start = ClassicalInitializer(flow, config.frontend.wide_baseline)(capture, NullProgress())
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(kept, **start_to_arrays(start))  # type: ignore[arg-type]
    return start


def _track(capture: Capture, start: Start, config: Config, frames: int | None) -> TrackingResult:
    tracker = Tracker(capture.cameras, start, DisFlow(config.frontend.flow), config, read=capture.read)
    for time in range(min(frames or capture.frame_count, capture.frame_count)):
        tracker.step(time, [capture.read(camera, time) for camera in range(len(capture.cameras))])
    return tracker.finish()


def _errors(capture: Capture, path: Path, result: TrackingResult) -> list[float]:
    """ATE in metres of every group, over all frames tracked; true poses are matched by time stamp."""
    truth = load_groundtruth(path / "groundtruth")
    errors = []
    for group in result.groups:
        estimated, true = [], []
        for camera in group:
            stamps, wTc = truth.trajectories[capture.cameras[camera].name]
            for time, stamp in enumerate(capture.timestamps[: result.wTc.shape[1]]):
                nearest = int(np.argmin(np.abs(stamps - stamp)))
                if abs(stamps[nearest] - stamp) < 0.5 / capture.fps:
                    estimated.append(result.wTc[camera, time])
                    true.append(wTc[nearest])
        aligned = align(np.stack(true), np.stack(estimated)).transform_poses(np.stack(estimated))
        distance: Array = np.linalg.norm(aligned[:, :3, 3] - np.stack(true)[:, :3, 3], axis=1)
        errors.append(float(np.sqrt(np.mean(distance**2))))
    return errors


if __name__ == "__main__":
    sys.exit(main())
