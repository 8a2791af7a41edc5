"""Several methods in one figure: each under its own Sim(3), missing frames as gaps and crosses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation import comparison_plots, load_groundtruth
from mvdyn_gtsam.evaluation.association import associate
from mvdyn_gtsam.evaluation.trajectory import trajectory_errors
from tests.evaluation.fakes import FakeReconstruction, random_poses, random_similarity, write_groundtruth

pytest.importorskip("matplotlib", reason="matplotlib, the eval extra, is not installed")

COUNT = 8


def errors_of(folder: Path) -> tuple[dict[str, np.ndarray], Any]:
    """Method ``moved`` is the truth in another world and scale, ``lost`` lacks three frames of cam1."""
    rng = np.random.default_rng(0)
    truth = {camera: random_poses(rng, COUNT) for camera in ("cam0", "cam1")}
    gSe = random_similarity(rng)
    lost = {camera: poses.copy() for camera, poses in truth.items()}
    lost["cam1"][2:5] = np.nan
    groundtruth = load_groundtruth(write_groundtruth(folder, truth))
    methods = {
        "moved": FakeReconstruction({c: gSe.transform_poses(p) for c, p in truth.items()}),
        "lost": FakeReconstruction(lost),
    }
    found = {name: associate(method, groundtruth) for name, method in methods.items()}
    return truth, {name: (matches, trajectory_errors(matches.values())) for name, matches in found.items()}


def test_all_methods_lie_on_the_true_path_of_each_camera(tmp_path: Path) -> None:
    truth, errors = errors_of(tmp_path)
    figure = comparison_plots.trajectories_figure(errors)
    assert [axes.get_title() for axes in figure.axes] == ["cam0", "cam1"]
    for axes, camera in zip(figure.axes, truth, strict=True):
        lines = {line.get_label(): np.column_stack(line.get_data()) for line in axes.lines}
        assert set(lines) == {"true", "moved", "lost"}
        for points in lines.values():
            has = np.isfinite(points).all(axis=1)
            np.testing.assert_allclose(points[has], truth[camera][has, :2, 3], atol=1e-6)
    assert np.isnan(lines["lost"]).any(axis=1).tolist() == [2 <= time < 5 for time in range(COUNT)]


def test_frames_without_a_pose_are_crosses(tmp_path: Path) -> None:
    _, errors = errors_of(tmp_path)
    figure = comparison_plots.errors_figure(errors)
    crosses = [
        [list(line.get_xdata()) for line in axes.lines if line.get_marker() == "x"] for axes in figure.axes
    ]
    assert crosses == [[[], []], [[], [0.2, 0.3, 0.4]]]
    assert {text.get_text() for text in figure.axes[0].get_legend().get_texts()} == {
        "moved, ATE 0.0000 m",
        "lost, ATE 0.0000 m",
    }


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    truth, _ = errors_of(tmp_path)
    (tmp_path / "file").touch()
    groundtruth = load_groundtruth(tmp_path / "groundtruth")
    with pytest.raises(EvaluationError, match="trajectories.png: plot cannot be written"):
        comparison_plots.save_comparison_plots(
            {"a": FakeReconstruction(truth)}, groundtruth, tmp_path / "file"
        )
