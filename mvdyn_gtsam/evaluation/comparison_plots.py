"""Several methods on one capture in one figure; needs matplotlib and evo, which are extras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mvdyn_gtsam.evaluation.association import CameraMatch, PoseSource, associate
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth
from mvdyn_gtsam.evaluation.plots import panels_of, save_figure
from mvdyn_gtsam.evaluation.trajectory import TrajectoryErrors, trajectory_errors

_Errors = Mapping[str, tuple[Mapping[str, CameraMatch], TrajectoryErrors]]
"""Method -> its frames by camera, and their errors under its own Sim(3)."""


def save_comparison_plots(
    methods: Mapping[str, PoseSource], groundtruth: GroundTruth, folder: Path
) -> list[Path]:
    """Write ``trajectories.png`` (X-Y, metres, each method under its own Sim(3), one panel per camera) and
    ``error.png`` (position error over time, one row per camera, crosses where a frame has no pose).

    Raises EvaluationError when matplotlib is missing, a method cannot be aligned, or the folder cannot be
    written.
    """
    matches = {name: associate(source, groundtruth) for name, source in methods.items()}
    errors = {name: (found, trajectory_errors(found.values())) for name, found in matches.items()}
    return [
        save_figure(trajectories_figure(errors), folder / "trajectories.png"),
        save_figure(errors_figure(errors), folder / "error.png"),
    ]


def trajectories_figure(errors: _Errors) -> Any:
    """The figure of ``trajectories.png``."""
    cameras = _cameras(errors)
    figure, panels = panels_of(1, len(cameras), (5.0 * len(cameras), 4.8))
    for axes, camera in zip(panels[0], cameras, strict=True):
        for index, (method, (matches, found)) in enumerate(errors.items()):
            truth = matches[camera].truth[:, :3, 3]
            if index == 0:
                axes.plot(truth[:, 0], truth[:, 1], color="black", linestyle=":", linewidth=2, label="true")
            estimated = found.gSe.transform_poses(matches[camera].estimated)[:, :3, 3]
            axes.plot(estimated[:, 0], estimated[:, 1], color=f"C{index % 10}", label=method)
        axes.set_title(camera)
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    panels[0][0].legend()
    return figure


def errors_figure(errors: _Errors) -> Any:
    """The figure of ``error.png``."""
    cameras = _cameras(errors)
    figure, panels = panels_of(len(cameras), 1, (9.0, 1.0 + 2.4 * len(cameras)))
    for axes, camera in zip(panels[:, 0], cameras, strict=True):
        for index, (method, (matches, found)) in enumerate(errors.items()):
            times, error = matches[camera].timestamps, found.position_m[camera]
            label = f"{method}, ATE {found.ate_m:.4f} m"
            axes.plot(times, error, color=f"C{index % 10}", label=label)
            missing = times[np.isnan(error)]
            axes.plot(missing, np.zeros(len(missing)), "x", color=f"C{index % 10}")
        axes.set_title(camera)
        axes.set_ylabel("position error (m)")
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    panels[-1, 0].set_xlabel("time (s); a cross marks a frame without a pose")
    panels[0, 0].legend()
    return figure


def _cameras(errors: _Errors) -> list[str]:
    """Every camera of the ground truth; all methods have the same."""
    return list(next(iter(errors.values()))[0])
