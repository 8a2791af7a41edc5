from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.baselines import BaselineSettings, run_baseline
from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.evaluation import evaluate
from mvdyn_gtsam.reconstruction import Reconstruction
from tests.baselines.scenes import write_capture

SETTINGS = BaselineSettings(num_threads=1)


def test_a_capture_that_cannot_be_read_fails_in_one_line_from_the_loader(tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match="colmap: .*nowhere.*exit code 1") as caught:
        run_baseline(tmp_path / "nowhere", "colmap", tmp_path / "out")
    assert "Traceback" not in (tmp_path / "out.log").read_text()
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_both_methods_place_the_cameras_of_a_tiny_scene(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_capture(capture, frames=6)
    matches = tmp_path / "matches"
    results = {}
    for method in ("glomap", "colmap"):
        results[method] = run_baseline(
            capture, method, tmp_path / method, settings=SETTINGS, database=matches
        )
        result = results[method]
        assert result.registered == 1.0
        assert set(result.phases) == {"frames", "features", "matching", "mapping"}
        assert result.seconds > sum(result.phases.values()) > 0.0
        assert result.peak_mb > 50.0 and result.points > 50
        assert [np.isfinite(wTc).all() for wTc in result.trajectories.values()] == [True, True]
        reconstruction = Reconstruction.load(tmp_path / method)
        scores = evaluate(reconstruction, capture / "groundtruth")
        # Known intrinsics and the shift of half a pixel are right only if rotations come out this well.
        assert scores.ate_m < 0.02 and scores.inter_camera_rot_deg is not None
        assert scores.inter_camera_rot_deg < 0.3
        assert reconstruction.groups == [["cam0", "cam1"]]
    assert results["colmap"].phases["matching"] == results["glomap"].phases["matching"]
    with pytest.raises(BaselineError, match="matches of another capture or settings"):
        run_baseline(
            capture, "glomap", tmp_path / "other", settings=BaselineSettings(inter_window=1), database=matches
        )


@pytest.mark.slow
def test_no_model_is_a_failure_that_says_so_and_leaves_no_work_behind(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    # COLMAP's default wants ten images in a model; these are two.
    write_capture(capture, frames=1)
    with pytest.raises(BaselineError, match="colmap found no model"):
        run_baseline(capture, "colmap", tmp_path / "out", settings=SETTINGS)
    assert not (tmp_path / "out" / "work").exists()
    assert Reconstruction.load(tmp_path / "out").status == "failed"
