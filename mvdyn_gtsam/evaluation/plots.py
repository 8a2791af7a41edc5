"""Plots of trajectories, of the error over time and of depth errors; needs matplotlib, an extra."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.association import CameraMatch, ReconstructionLike, associate
from mvdyn_gtsam.evaluation.depth import frame_depth_error
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth
from mvdyn_gtsam.evaluation.trajectory import TrajectoryErrors, trajectory_errors

DEPTH_FRAMES = 3
"""Frames of one camera in a plot of depth errors."""
WORST_SHOWN = 0.25
"""Relative depth error at the end of the colours: where the ratio test of delta < 1.25 fails."""


def save_plots(reconstruction: ReconstructionLike, groundtruth: GroundTruth, folder: Path) -> list[Path]:
    """Write ``trajectories.png`` (X-Y and X-Z, metres), ``error.png`` (position error over time) and, of each
    camera with estimated and true depth, ``depth_<camera>.png`` (error maps of some frames spread over time).

    Raises EvaluationError when matplotlib is missing or the folder cannot be written.
    """
    matches = associate(reconstruction, groundtruth)
    errors = trajectory_errors(matches.values())
    paths = [
        save_figure(_trajectory_figure(matches, errors), folder / "trajectories.png"),
        save_figure(_error_figure(matches, errors), folder / "error.png"),
    ]
    for camera, match in matches.items():
        both = [
            time
            for time in groundtruth.depth_frames(camera)
            if time < match.estimated_frame_count and reconstruction.has_depth(camera, time)
        ]
        if both:
            path = folder / f"depth_{camera}.png"
            paths.append(save_depth_plot(reconstruction, groundtruth, camera, spread(both), path))
    return paths


def spread(frames: Sequence[int], count: int = DEPTH_FRAMES) -> list[int]:
    """The middle frame of each of ``count`` equal stretches, every frame once."""
    places = ((2 * np.arange(count) + 1) * len(frames)) // (2 * count)
    return [frames[place] for place in dict.fromkeys(places.tolist())]


def save_depth_plot(
    reconstruction: ReconstructionLike,
    groundtruth: GroundTruth,
    camera: str,
    times: Sequence[int],
    path: Path,
) -> Path:
    """Write the maps of relative depth error of some frames of one camera side by side.

    Each after its own scale and offset, as Abs.Rel is taken; white where there is no true or no estimated
    depth. Raises EvaluationError when matplotlib is missing or ``path`` cannot be written.
    """
    figure, panels = panels_of(1, len(times), (1.0 + 4.5 * len(times), 4.0))
    for axes, time in zip(panels[0], times, strict=True):
        error = frame_depth_error(reconstruction, groundtruth, camera, time)
        shown = axes.imshow(error, vmin=0.0, vmax=WORST_SHOWN, cmap="magma")
        mean = f"{np.nanmean(error):.3f}" if np.isfinite(error).any() else "-"
        axes.set_title(f"{camera} frame {time}: Abs.Rel {mean}")
        axes.set_axis_off()
    figure.colorbar(shown, ax=panels, label="relative depth error", extend="max")
    return save_figure(figure, path)


def panels_of(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    """A figure of ``size`` inches and its panels ``(rows, columns)``. Raises EvaluationError without
    matplotlib."""
    try:
        # The figure without pyplot: no window system, no global state.
        figure_module = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise EvaluationError("plots need matplotlib: pip install mvdyn_gtsam[eval]") from error
    figure = figure_module.Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def save_figure(figure: Any, path: Path) -> Path:
    """Write ``figure``. Raises EvaluationError where that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise EvaluationError(f"{path}: plot cannot be written ({error.strerror})") from error
    return path


def _trajectory_figure(matches: Mapping[str, CameraMatch], errors: TrajectoryErrors) -> Any:
    figure, panels = panels_of(1, 2, (11.0, 5.0))
    both = panels[0]
    for axes, (horizontal, vertical) in zip(both, ((0, 1), (0, 2)), strict=True):
        for index, match in enumerate(matches.values()):
            color = f"C{index % 10}"
            true, estimated = match.truth[:, :3, 3], errors.gSe.transform_poses(match.estimated)[:, :3, 3]
            axes.plot(true[:, horizontal], true[:, vertical], color=color, linestyle=":", linewidth=2)
            axes.plot(estimated[:, horizontal], estimated[:, vertical], color=color, label=match.camera)
            axes.plot(*true[:1, [horizontal, vertical]].T, marker="o", color=color)
        axes.set_xlabel(f"{'xyz'[horizontal]} (m)")
        axes.set_ylabel(f"{'xyz'[vertical]} (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    both[0].legend(title="dotted: true")
    return figure


def _error_figure(matches: Mapping[str, CameraMatch], errors: TrajectoryErrors) -> Any:
    figure, panels = panels_of(1, 1, (9.0, 4.0))
    axes = panels[0, 0]
    for index, match in enumerate(matches.values()):
        axes.plot(
            match.timestamps, errors.position_m[match.camera], color=f"C{index % 10}", label=match.camera
        )
        missing = match.timestamps[np.isnan(errors.position_m[match.camera])]
        axes.plot(missing, np.zeros(len(missing)), "x", color=f"C{index % 10}")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("position error (m)")
    axes.set_title(f"ATE {errors.ate_m:.4f} m; a cross marks a frame without a pose")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure
