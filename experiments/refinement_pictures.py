"""Pictures of a refined result: depth before and after, and the points of one instant from above.

From above, walls should be straight and thin and what two cameras see should lie in one place. --quick draws
the tiny generated scene, refined by experiments.refinement_phases where that was not done yet.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from experiments import refinement_phases
from experiments.records import QUICK, QUICK_FRAMES, ROOT, ExperimentError, quick_scene
from mvdyn_gtsam.capture import Capture, load_capture
from mvdyn_gtsam.errors import MvdynError
from mvdyn_gtsam.geometry import backproject, invert_pose, transform_points
from mvdyn_gtsam.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MINIMUM_CONFIDENCE = 0.5
"""Points trusted less are not drawn."""


def depth_picture(capture: Capture, result: Reconstruction, times: Sequence[int], path: Path) -> None:
    """A row per camera and time: image, inverse depth tracked and refined, confidence, motion."""
    from matplotlib.figure import Figure

    tracked = result.tracked()
    frames = [(camera, time) for camera in range(len(capture.cameras)) for time in times]
    picture = Figure(figsize=(15, 2.4 * len(frames)), layout="tight")
    axes = picture.subplots(len(frames), 5, squeeze=False)
    titles = ("image", "inverse depth, tracked", "refined", "confidence", "motion")
    for row, (camera, time) in zip(axes, frames, strict=True):
        name = capture.cameras[camera].name
        refined = 1.0 / result.depth(name, time)
        low, high = np.nanpercentile(refined, [1, 99])
        row[0].imshow(capture.read(camera, time))
        row[1].imshow(1.0 / tracked.depth(name, time), vmin=low, vmax=high)
        row[2].imshow(refined, vmin=low, vmax=high)
        row[3].imshow(result.confidence(name, time), vmin=0.0, vmax=1.0)
        row[4].imshow(result.motion(name, time), vmin=0, vmax=255, cmap="gray")
        row[0].set_ylabel(f"{name}, frame {time}")
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title)
    picture.savefig(path, dpi=60)


def points_picture(capture: Capture, result: Reconstruction, time: int, path: Path) -> None:
    """Points of all cameras at one instant from above the first camera, tracked and refined."""
    from matplotlib.figure import Figure

    picture = Figure(figsize=(13, 6.5), layout="tight")
    left, right = picture.subplots(1, 2, sharex=True, sharey=True)
    for axis, title, source in ((left, "tracked", result.tracked()), (right, "refined", result)):
        _draw_from_above(axis, capture, source, result, time)
        axis.set_title(f"{title}, frame {time}")
    picture.savefig(path, dpi=60)


def _draw_from_above(
    axis: Axes, capture: Capture, source: Reconstruction, refined: Reconstruction, time: int
) -> None:
    first = source.trajectory(source.cameras[0])[1][time]
    farthest = 0.0
    for number, name in enumerate(source.groups[0]):
        points = _points(capture, source, refined, name, time)
        own = transform_points(invert_pose(first) @ source.trajectory(name)[1][time], points)
        axis.scatter(own[:, 0], own[:, 2], s=0.3, color=f"C{number}", label=name)
        farthest = max(farthest, float(np.percentile(own[:, 2], 99)))
    axis.set_xlim(-0.8 * farthest, 0.8 * farthest)
    axis.set_ylim(-0.1 * farthest, 1.2 * farthest)
    axis.set_aspect("equal")
    axis.legend(markerscale=20)


def _points(
    capture: Capture, source: Reconstruction, refined: Reconstruction, name: str, time: int
) -> npt.NDArray[np.float64]:
    """``(M, 3)`` in the camera's frame: the same pixels before and after, those that are trusted after."""
    depth = source.depth(name, time)
    rows, cols = np.nonzero(refined.confidence(name, time) > MINIMUM_CONFIDENCE)
    rows, cols = rows[::7], cols[::7]
    pixels = np.stack([cols, rows], axis=1).astype(np.float64)
    return backproject(pixels, depth[rows, cols].astype(np.float64), source.intrinsics(name))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    result.add_argument("capture", type=Path, nargs="?")
    result.add_argument("result", type=Path, nargs="?", help="refined result of that capture")
    result.add_argument("--quick", action="store_true", help="of a tiny generated scene, into out/quick")
    result.add_argument("--frames", nargs="+", type=int, help="default: 30, or 7 of --quick")
    result.add_argument("--out", type=Path, metavar="DIR", help="default: docs/pictures, or out/quick")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw both pictures."""
    command_line = parser()
    options = command_line.parse_args(arguments)
    if options.quick == (options.result is not None):
        command_line.error("name a capture and its refined result, or give --quick")
    out = options.out or (QUICK if options.quick else ROOT / "docs" / "pictures")
    frames = options.frames or ([QUICK_FRAMES // 2] if options.quick else [30])
    try:
        folders = _quick(out) if options.quick else (options.capture, options.result)
        capture, result = load_capture(folders[0]), Reconstruction.load(folders[1])
        if max(frames) >= capture.frame_count:
            raise ExperimentError(f"{capture.name}: has {capture.frame_count} frames, no frame {max(frames)}")
        out.mkdir(parents=True, exist_ok=True)
        depth_picture(capture, result, frames, out / f"depth_{capture.name}.jpg")
        points_picture(capture, result, frames[0], out / f"points_{capture.name}.jpg")
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stderr.write(f"written: {out}\n")
    return 0


def _quick(out: Path) -> tuple[Path, Path]:
    """The scene of ``--quick`` and its refined result. Raises ExperimentError where it cannot be refined."""
    capture, work = quick_scene(out), out / "work" / refinement_phases.NAME
    folder = refinement_phases.folder_of(work, capture, refinement_phases.FULL)
    if not (folder.is_dir() and "refinement" in Reconstruction.load(folder).stages):
        refinement_phases.measure(capture, refinement_phases.FULL, work, None, [])
    return capture, folder


if __name__ == "__main__":
    sys.exit(main())
