from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation import evaluate, format_table, load_groundtruth, save_depth_plot, save_plots
from mvdyn_gtsam.evaluation.plots import spread
from tests.evaluation.fakes import FakeReconstruction, perturbed, random_poses, write_groundtruth


@pytest.fixture
def case(tmp_path: Path) -> tuple[FakeReconstruction, Path]:
    rng = np.random.default_rng(0)
    truth = {camera: random_poses(rng, 10) for camera in ("cam0", "cam1")}
    depth = {("cam0", 3): (1.0 + rng.random((24, 32))).astype(np.float32)}
    mask = {("cam0", 3): rng.random((24, 32)) > 0.5}
    folder = write_groundtruth(tmp_path, truth, depth, mask, depth_scale=1e-4)
    estimate = {camera: perturbed(rng, poses, 0.01, 0.01) for camera, poses in truth.items()}
    estimate["cam1"][4] = np.nan
    return FakeReconstruction(estimate, depth, groups=[["cam0"], ["cam1"]]), folder


CONTRACT = {"registered", "ate_m", "rte_m", "rre_deg", "abs_rel", "delta_1_25", "m_d"}
CONTRACT |= {"m_d_scale_only", "abs_rel_static", "abs_rel_moving", "m_d_static", "m_d_moving"}
BETWEEN = {"inter_camera_trans_m", "inter_camera_rot_deg"}


def test_json_holds_the_keys_of_the_contract_and_no_nan(case: tuple[FakeReconstruction, Path]) -> None:
    content = evaluate(*case).to_json()
    assert content.keys() >= CONTRACT | BETWEEN | {"per_camera", "groups"}
    for camera in ("cam0", "cam1"):
        assert content["per_camera"][camera].keys() >= CONTRACT
    assert content["registered"] == pytest.approx(19 / 20) and content["complete"] is False
    json.dumps(content, allow_nan=False)


def test_the_table_says_what_is_missing(case: tuple[FakeReconstruction, Path]) -> None:
    console = Console(width=100, record=True, quiet=True)
    with console.capture() as capture:
        console.quiet = False
        console.print(format_table(evaluate(*case)))
    text = capture.get()
    assert "INCOMPLETE: 1 of 20 frames have no pose" in text
    assert "Group cam1 alone" in text
    assert "cam0" in text and "95.0" in text


def test_the_table_names_both_distances_and_fits_a_terminal(
    case: tuple[FakeReconstruction, Path],
) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(format_table(evaluate(*case)))
    text = console.export_text()
    assert "…" not in text
    assert "m_d)" in text and "m_d_scale_only" in text
    heading = text[: text.index("cam0")]
    assert heading.count("M_d") == 2 and "scale" in heading


def test_frames_of_a_plot_are_spread_over_time() -> None:
    assert spread(list(range(10, 40)), 3) == [15, 25, 35]
    assert spread([4, 7], 3) == [4, 7]
    assert spread([4], 3) == [4]


def test_plots_are_written(case: tuple[FakeReconstruction, Path], tmp_path: Path) -> None:
    reconstruction, folder = case
    groundtruth = load_groundtruth(folder)
    paths = save_plots(reconstruction, groundtruth, tmp_path / "plots")
    paths.append(save_depth_plot(reconstruction, groundtruth, "cam0", [3], tmp_path / "plots" / "depth.png"))
    assert [path.name for path in paths] == ["trajectories.png", "error.png", "depth_cam0.png", "depth.png"]
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG")


def test_without_matplotlib_the_error_says_what_to_install(
    case: tuple[FakeReconstruction, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(EvaluationError, match=r"pip install mvdyn_gtsam\[eval\]"):
        save_plots(case[0], load_groundtruth(case[1]), tmp_path)
