"""The stage's journal: a step counts when it is done, and is not done twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import DenseFlow, Float32, FlowConfig, FlowPair
from mvdyn_gtsam.progress import NullProgress
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.stage import WORKSPACE_FORMAT, Refinement, Tracked
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

SHAPE = (24, 32)
CONFIG = RefinementConfig(workers=1, temporal_offsets=(1,), depth_iterations=2)


class EvenFlow:
    """A wall passes by at a pixel per frame; in measurement number ``dies_at`` the run is killed."""

    def __init__(self, dies_at: int | None = None) -> None:
        self.dies_at, self.measured = dies_at, 0

    def measure(
        self,
        image_i: npt.NDArray[np.uint8],
        image_j: npt.NDArray[np.uint8],
        seed: Float32 | None = None,
        seed_backward: Float32 | None = None,
    ) -> FlowPair:
        if self.measured == self.dies_at:
            raise KeyboardInterrupt
        self.measured += 1
        flow, sure = np.zeros((*SHAPE, 2), np.float32), np.ones(SHAPE, np.float32)
        flow[..., 0] = -1.0
        return FlowPair(flow, -flow, sure, sure)


def read(camera: int, time: int) -> npt.NDArray[np.uint8]:
    wall = np.random.default_rng(0).integers(0, 255, (*SHAPE, 3)).astype(np.uint8)
    return np.roll(wall, -time, axis=1)


def depth(camera: int, time: int) -> tuple[Float32, Float32]:
    return np.full(SHAPE, 3.0, np.float32), np.full(SHAPE, 0.5, np.float32)


CAMERA = Camera("c", SHAPE[1], SHAPE[0], 30.0, 30.0, 15.5, 11.5)


def refinement(folder: Path, flow: DenseFlow) -> Refinement:
    """One camera that moves by 0.1 per frame for four frames."""
    wTc = np.tile(np.eye(4), (1, 4, 1, 1))
    wTc[0, :, 0, 3] = 0.1 * np.arange(4)
    covariance = np.full((1, 4, 6, 6), np.nan)
    tracked = Tracked((CAMERA,), ((0,),), wTc, covariance, (), read, depth)
    return Refinement(tracked, folder, CONFIG, flow, FlowConfig(), NullProgress())


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "work"
    with pytest.raises(KeyboardInterrupt):
        refinement(folder, EvenFlow(dies_at=2)).run()
    workspace = Workspace(folder, (DenseView.of(CAMERA, 1.0 / CONFIG.stride),), 4)
    # not the step it died in, nor any after it
    assert workspace.finished() == ["images", "sweep"]
    second = EvenFlow()
    resumed = refinement(folder, second)
    refined = resumed.run()
    # two of the three pairs were measured before
    assert second.measured == 1
    assert "sweep" not in refined.seconds and "temporal flow" in refined.seconds
    names = workspace.finished()
    assert names[:2] == ["images", "sweep"] and len(set(names)) == len(names)
    assert {"begin", "depth 0", "poses 1", "depth 1"} <= set(names)
    # flow, tracked poses and tracked depth agree: there is nothing to mend
    np.testing.assert_allclose(refined.wTc[0, :, 0, 3], 0.1 * np.arange(4), atol=2e-3)
    for frame in resumed.frames():
        np.testing.assert_allclose(frame.depth, 3.0, rtol=0.05)


def test_a_finished_run_does_nothing_again(tmp_path: Path) -> None:
    folder = tmp_path / "work"
    first = refinement(folder, EvenFlow())
    before = first.run()
    again = EvenFlow()
    second = refinement(folder, again)
    after = second.run()
    assert again.measured == 0 and after.seconds == {}
    np.testing.assert_array_equal(before.wTc, after.wTc)
    for one, other in zip(first.frames(), second.frames(), strict=True):
        np.testing.assert_array_equal(one.depth, other.depth)


def test_a_camera_that_stands_still_keeps_its_tracked_depth(tmp_path: Path) -> None:
    wTc, covariance = np.tile(np.eye(4), (1, 4, 1, 1)), np.full((1, 4, 6, 6), np.nan)
    tracked = Tracked((CAMERA,), ((0,),), wTc, covariance, (), read, depth)
    still = EvenFlow()
    made = Refinement(tracked, tmp_path / "work", CONFIG, still, FlowConfig(), NullProgress())
    made.run()
    for frame in made.frames():
        np.testing.assert_allclose(frame.depth, 3.0, rtol=0.05)


def test_another_number_of_processes_goes_on_with_the_same_work(tmp_path: Path) -> None:
    refinement(tmp_path / "work", EvenFlow()).run()
    workspace = Workspace(tmp_path / "work", (DenseView.of(CAMERA, 1.0 / CONFIG.stride),), 4)
    before = workspace.finished()
    workspace.prepare(repr((WORKSPACE_FORMAT, replace(CONFIG, workers=0), FlowConfig())))
    assert workspace.finished() == before
    workspace.prepare(repr((WORKSPACE_FORMAT, replace(CONFIG, workers=0, rounds=3), FlowConfig())))
    assert workspace.finished() == []


def test_what_an_earlier_version_began_is_begun_anew(tmp_path: Path) -> None:
    """Its files are others; with the same settings it would be continued with what is not there."""
    earlier = Workspace(tmp_path / "work", (DenseView.of(CAMERA, 1.0 / CONFIG.stride),), 4)
    earlier.prepare(repr((WORKSPACE_FORMAT - 1, replace(CONFIG, workers=0), FlowConfig())))
    for step in ("images", "sweep", "temporal flow"):
        earlier.finish(step)
    flow = EvenFlow()
    refinement(tmp_path / "work", flow).run()
    assert flow.measured > 0
