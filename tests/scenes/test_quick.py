"""The scene of every ``--quick``: made once, and solved with all cameras in one frame."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="the extra scenes is not installed")

from experiments.quick import quick_capture
from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.evaluation import evaluate_poses
from mvdyn_gtsam.pipeline import reconstruct


@pytest.mark.slow
def test_the_quick_scene_is_solved_with_all_cameras_in_one_frame(tmp_path: Path) -> None:
    folder = quick_capture(tmp_path, cameras=3)
    made = (folder / "scene.json").stat().st_mtime_ns
    assert quick_capture(tmp_path, cameras=3) == folder
    assert (folder / "scene.json").stat().st_mtime_ns == made
    result = reconstruct(load_capture(folder), tmp_path / "out", stage="tracking")
    assert result.groups == [["cam0", "cam1", "cam2"]]
    scores = evaluate_poses(result, folder / "groundtruth").to_json()
    assert scores["registered"] == 1.0 and scores["ate_m"] < 0.006
