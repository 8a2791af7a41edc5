"""Pictures of a refined result: depth before and after, and the points of one instant from above.

From above, walls should be straight and thin and what two cameras see should lie in one place.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from experiments.records import ROOT
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw both pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("result", type=Path, help="refined result of that capture")
    parser.add_argument("--frames", nargs="+", type=int, default=[30], help="default: 30")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures", metavar="DIR")
    options = parser.parse_args(arguments)
    try:
        capture, result = load_capture(options.capture), Reconstruction.load(options.result)
        options.out.mkdir(parents=True, exist_ok=True)
        depth_picture(capture, result, options.frames, options.out / f"depth_{capture.name}.jpg")
        points_picture(capture, result, options.frames[0], options.out / f"points_{capture.name}.jpg")
    except MvdynError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stderr.write(f"written: {options.out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
