"""A wall of hardly any texture: no flow to trust, but images of other times tell its depth together."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig
from mvdyn_gtsam.refinement.context import COLOUR, Context, smooth_colour, trust_of
from mvdyn_gtsam.refinement.edges import flow_targets
from mvdyn_gtsam.refinement.moving.free_space import SIGHT
from mvdyn_gtsam.refinement.moving.motion import settle_task
from mvdyn_gtsam.refinement.other_times import FirstDepth, told_by_other_times
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

FRAMES, FRAME = 17, (0, 8)
WIDTH, HEIGHT, FOCAL, WALL, WRONG = 320, 240, 300.0, 4.0, 8.0
PX_PER_FRAME = 4.0
CONFIG = RefinementConfig(workers=1)


@pytest.fixture
def faint(tmp_path: Path) -> Context:
    return made(tmp_path, contrast=3.0)


def made(folder: Path, contrast: float) -> Context:
    """A camera passes by a wall of that ``contrast``, grey levels, filmed with noise of one.

    Its first depth is twice too far, its swept depth right but for noise.
    """
    view = DenseView.of(Camera("c", WIDTH, HEIGHT, FOCAL, FOCAL, 159.5, 119.5), 1.0 / CONFIG.stride)
    workspace = Workspace(folder / "work", (view,), FRAMES)
    workspace.prepare("settings")
    workspace.create("grey", np.uint8, full_size=True)
    workspace.create(COLOUR, np.uint8, channels=(3,))
    for name in ("held", "fails", "labels", SIGHT):
        workspace.create(name, np.uint8)
    for name in ("tracked", "aligned", "swept", "first", "information", "prior", "prior_weight"):
        workspace.create(name)
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH + 80)), (0, 0), 6.0)
    texture = 120.0 + contrast * texture / texture.std()
    for time in range(FRAMES):
        shift = round(PX_PER_FRAME * time)
        image = texture[:, shift : shift + WIDTH] + rng.standard_normal((HEIGHT, WIDTH))
        grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        workspace.write("grey", (0, time), grey)
        workspace.write(COLOUR, (0, time), smooth_colour(grey, view))
        for name in ("tracked", "aligned"):
            workspace.write(name, (0, time), np.full(view.shape, 1.0 / WRONG, np.float32))
    noise = np.exp(0.05 * rng.standard_normal(view.shape))
    workspace.write("swept", FRAME, (noise / WALL).astype(np.float32))
    wTc = np.tile(np.eye(4), (1, FRAMES, 1, 1))
    wTc[0, :, 0, 3] = PX_PER_FRAME * WALL / FOCAL * np.arange(FRAMES)
    workspace.write_array("poses", wTc)
    context = Context(workspace, ((0,),), {}, CONFIG, DisFlow(), FlowConfig())
    context.keep_flow_targets(FRAME, flow_targets([], view.shape[0] * view.shape[1]))
    return context


def first_depth(context: Context, depth: float = WRONG) -> FirstDepth:
    shape = context.workspace.views[0].shape
    nothing = np.zeros(shape, np.uint8)
    return FirstDepth(
        np.full(shape, -np.log(depth), np.float32), np.zeros(shape, np.float32), nothing, nothing
    )


def test_its_swept_depth_is_taken_smoothed_and_held(faint: Context) -> None:
    found = told_by_other_times(faint, FRAME, first_depth(faint))
    held = found.held > 0
    assert held.mean() > 0.5
    error = np.abs(np.exp(found.theta) * WALL - 1.0)[held]
    # a fifth of the noise of the sweep
    assert error.mean() < 0.01
    assert 0.0 < trust_of(found.information)[held].max() < 0.5


def test_a_right_depth_without_flow_is_not_replaced(faint: Context) -> None:
    faint.workspace.write("swept", FRAME, np.full(faint.workspace.views[0].shape, 1.0 / WRONG, np.float32))
    found = told_by_other_times(faint, FRAME, first_depth(faint, WALL))
    assert not found.held.any() and np.allclose(found.theta, -np.log(WALL))


def test_nor_is_any_where_there_is_nothing_but_noise(tmp_path: Path) -> None:
    context = made(tmp_path, contrast=0.0)
    assert told_by_other_times(context, FRAME, first_depth(context)).held.mean() < 0.02


def test_what_is_held_weighs_more_when_phase_2_begins(faint: Context) -> None:
    told = told_by_other_times(faint, FRAME, first_depth(faint))
    workspace = faint.workspace
    workspace.write("first", FRAME, told.theta)
    workspace.write("information", FRAME, told.information)
    workspace.write("held", FRAME, told.held)
    settle_task(faint, FRAME)
    weight, held = faint.image("prior_weight", FRAME), told.held > 0
    assert np.allclose(weight[held], CONFIG.held_sigma**-2) and weight[~held].max() < weight[held].min()
