"""Swept depth of the frames of a workspace: a board before a wall, which two cameras film."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.plane_sweep import SweepConfig
from mvdyn_gtsam.refinement.measurement import carry_sweep, sweep_frame, sweep_moving
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace
from tests.frontend.test_plane_sweep import BOARD, SHAPE, TRUTH, inner, pose, render

CAMERA = Camera("c", SHAPE[1], SHAPE[0], 80.0, 80.0, 47.5, 35.5)
CONFIG = SweepConfig(scale=1.0, levels=48)
POSES = [pose(0.0), pose(0.3, 0.1), pose(-0.25)]


@pytest.fixture
def filmed(tmp_path: Path) -> Workspace:
    """Three cameras at one instant; tracking knows depth roughly, and is not believed."""
    view = DenseView.of(CAMERA, 1.0)
    workspace = Workspace(tmp_path / "work", (view,) * 3, 1)
    workspace.prepare("settings")
    workspace.create("grey", np.uint8, full_size=True)
    for name in ("tracked", "tracked_confidence", "swept"):
        workspace.create(name)
    for camera, wTc in enumerate(POSES):
        workspace.write("grey", (camera, 0), render(wTc)[0])
        workspace.write("tracked", (camera, 0), np.linspace(0.2, 0.5, TRUTH.size).reshape(SHAPE))
        workspace.write("swept", (camera, 0), np.full(SHAPE, 0.1, np.float32))
    return workspace


def test_a_frame_is_swept_against_the_others(filmed: Workspace) -> None:
    found = sweep_frame(filmed, (0, 0), (0, 1, 2), np.array(POSES)[:, None], CONFIG)
    assert np.median(np.abs(found - TRUTH)[inner(BOARD)]) < 0.01


def test_what_moves_is_swept_alone_and_the_rest_left(filmed: Workspace) -> None:
    found = sweep_moving(filmed, (0, 0), (0, 1, 2), np.array(POSES)[:, None], BOARD, CONFIG)
    assert np.median(np.abs(found - TRUTH)[inner(BOARD)]) < 0.01
    rows, columns = np.nonzero(BOARD)
    beside = np.ones(SHAPE, bool)
    beside[rows.min() - 9 : rows.max() + 10, columns.min() - 9 : columns.max() + 10] = False
    assert beside.any()
    np.testing.assert_allclose(found[beside], 0.1)


@pytest.mark.parametrize("turn_deg", [0.0, 2.0])
def test_swept_depth_is_carried_to_another_time(filmed: Workspace, turn_deg: float) -> None:
    """Of a frame a step aside and ahead: at its own pixels, as its own depth."""
    there = pose(0.08, 0.02, 0.15, turn_deg)
    filmed.write("swept", (1, 0), render(there)[1])
    carried = carry_sweep(filmed, (0, 0), (1, 0), np.array([POSES[0], there, POSES[2]])[:, None])
    wall = inner(~BOARD, 6) & (np.indices(SHAPE)[1] > 8)
    for surface in (inner(BOARD, 6), wall):
        assert np.median(np.abs(carried / TRUTH - 1.0)[surface]) < 0.003
        assert np.percentile(np.abs(carried / TRUTH - 1.0)[surface], 95) < 0.02
        # and not because nothing had changed
        assert np.median(np.abs(render(there)[1] / TRUTH - 1.0)[surface]) > 0.01
