"""Depth of the road before a car, where there is no ground truth of depth but the cameras' height is known.

The lane is where the road, a plane that far below a level camera, lies less than 2 m to the side and 20 m
ahead. The result gets the scale of the true trajectories. By default the height is that of KITTI's cameras
(https://www.cvlibs.net/datasets/kitti/setup.php).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiments.records import RESULTS, ExperimentError, commit, exit_status, figure, page, table, write_text
from mvdyn_gtsam.evaluation.alignment import align
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth, load_groundtruth
from mvdyn_gtsam.reconstruction import Reconstruction

NAME = "road_depth"
KITTI_HEIGHT = 1.65
HALF_WIDTH, FARTHEST = 2.0, 20.0
"""Of the lane, m."""
STEP = 5
"""Frames between those that are looked at."""


def lane_depth(
    intrinsics: npt.NDArray[np.float64], shape: tuple[int, int], height: float
) -> npt.NDArray[np.float64]:
    """Depth ``(H, W)`` m of the lane before a level camera ``height`` m above the road; NaN elsewhere."""
    rows, cols = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = height * intrinsics[1, 1] / (rows - intrinsics[1, 2])
        aside = (cols - intrinsics[0, 2]) / intrinsics[0, 0] * depth
        lane = (depth > 0.0) & (depth <= FARTHEST) & (np.abs(aside) <= HALF_WIDTH)
    return np.where(lane, depth, np.nan)


def lane_errors(result: Reconstruction, truth: GroundTruth, height: float) -> npt.NDArray[np.float64]:
    """Relative errors ``(M,)`` of the depth of the lane, of every fifth frame of all cameras.

    Raises ExperimentError where the lane is in no image.
    """
    cameras = [name for name in result.cameras if name in truth.trajectories]
    true_poses = np.concatenate([truth.trajectories[name][1][: result.frame_count] for name in cameras])
    estimated = np.concatenate(
        [result.trajectory(name)[1][: len(truth.trajectories[name][1])] for name in cameras]
    )
    known = np.isfinite(estimated).all(axis=(1, 2)) & np.isfinite(true_poses).all(axis=(1, 2))
    scale = align(true_poses[known], estimated[known]).scale
    errors = []
    for name in cameras:
        camera = result.camera(name)
        road = lane_depth(result.intrinsics(name), (camera.height, camera.width), height)
        lane = np.isfinite(road)
        for time in range(0, result.frame_count, STEP):
            errors.append(np.abs(scale * result.depth(name, time)[lane] / road[lane] - 1.0))
    found = np.concatenate(errors) if errors else np.zeros(0)
    if not len(found):
        raise ExperimentError(f"{result.folder}: the lane is in no image; is --height right?")
    return found


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("capture", type=Path, help="capture filmed from a car, with groundtruth/")
    result.add_argument("result", type=Path, help="refined result of that capture")
    result.add_argument("--height", type=float, default=KITTI_HEIGHT, help="of the cameras, m (%(default)s)")
    result.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="default: %(default)s")
    return result


def measure(capture: Path, result: Path, height: float) -> str:
    """The table: the lane before and after the refinement."""
    refined, truth = Reconstruction.load(result), load_groundtruth(capture / "groundtruth")
    rows = []
    for name, depths in (("tracking", refined.tracked()), ("phases 1, 2", refined)):
        errors = lane_errors(depths, truth, height)
        near = 100.0 * float((errors < 0.25).mean())
        rows.append(
            [name, figure(float(np.median(errors)), 3), figure(float(errors.mean()), 3), figure(near)]
        )
    columns = ["depth", "median relative error", "mean", "within 25 % of the road, %"]
    return f"{refined.name}, commit {commit()}.\n\n" + table(columns, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print and keep the table."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    options = parser().parse_args(words)

    def work() -> None:
        body = measure(options.capture, options.result, options.height)
        text = page("Depth of the road", NAME, words, body)
        sys.stdout.write(text)
        write_text(options.results / f"{NAME}.md", text)

    return exit_status(work)


if __name__ == "__main__":
    sys.exit(main())
