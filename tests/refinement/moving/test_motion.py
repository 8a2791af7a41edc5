"""What phase 2 begins with where something moves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.frontend.dense_flow import DisFlow, FlowConfig, FlowPair
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import COLOUR, LABELS, Context
from mvdyn_gtsam.refinement.edges import flow_targets
from mvdyn_gtsam.refinement.moving.free_space import SEEN_THROUGH, SIGHT, STANDS
from mvdyn_gtsam.refinement.moving.motion import (
    LEAK_REACH,
    OWN_SHARE,
    carry_task,
    free_space_task,
    kept_far_off,
    settle_task,
)
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace


def test_depth_is_kept_far_from_what_moves_only() -> None:
    moves = np.zeros((40, 100), bool)
    moves[:, :10] = True
    share = kept_far_off(moves)
    near = 10 + round(100 * LEAK_REACH)
    assert (share[:, :near] == 0.0).all()
    np.testing.assert_allclose(share[:, near + round(100 * LEAK_REACH) + 1 :], OWN_SHARE)
    assert (np.diff(share, axis=1) >= 0.0).all()


def test_without_motion_every_pixel_keeps_its_share() -> None:
    np.testing.assert_allclose(kept_far_off(np.zeros((4, 5), bool)), OWN_SHARE)


def test_what_is_too_fast_for_flow_is_carried_from_the_next_frames(tmp_path: Path) -> None:
    # one camera that stands still and has no flow at all; a block moves in frames 1 and 2
    view = DenseView.of(Camera("cam0", 64, 48, 60.0, 60.0, 31.5, 23.5), 1.0)
    workspace = Workspace(tmp_path, (view,), 5)
    workspace.prepare("test")
    for name in ("first", "information"):
        workspace.create(name)
    for name in ("fails", "carried", SIGHT):
        workspace.create(name, np.uint8)
    block = np.zeros(view.shape, np.uint8)
    block[10:30, 20:40] = 1
    for time in (1, 2):
        workspace.write("fails", (0, time), block)
    workspace.write_array("poses", np.tile(np.eye(4), (1, 5, 1, 1)))
    context = Context(workspace, ((0,),), {}, RefinementConfig(stride=1), DisFlow(), FlowConfig())
    for time in range(5):
        context.keep_flow_targets((0, time), flow_targets([], block.size))

    def carried(time: int) -> np.ndarray:
        carry_task(context, ("fails", "carried", (0, time)))
        return np.asarray(workspace.read("carried", (0, time))) > 0

    # the first frame has one neighbour, which sees it move; frame 3 has another that does not
    assert carried(0)[block > 0].mean() > 0.9 and carried(0)[block == 0].mean() < 0.02
    assert not carried(3).any() and not carried(4).any()
    # a depth that flow settles stands, whatever the neighbours see
    workspace.write("information", (0, 0), np.full(view.shape, 1e6, np.float32))
    assert not carried(0).any()


VIEW = DenseView.of(Camera("cam0", 64, 48, 60.0, 60.0, 31.5, 23.5), 1.0)
BLOCK = np.zeros(VIEW.shape, bool)
BLOCK[14:34, 24:40] = True


def block_before_a_wall(folder: Path, frames: int, times: Sequence[int], depth: float) -> Workspace:
    """One camera that stands still before a dark wall 2 m away, well known.

    At some ``times`` a bright block hides it, at the ``depth`` that its flow suggests.
    """
    workspace = Workspace(folder, (VIEW,), frames)
    workspace.prepare("test")
    for name in ("first", "information", "prior", "prior_weight"):
        workspace.create(name)
    for name in ("fails", "held", LABELS, SIGHT):
        workspace.create(name, np.uint8)
    workspace.create(COLOUR, np.uint8, channels=(3,))
    for time in range(frames):
        here = BLOCK & (time in times)
        workspace.write("first", (0, time), -np.log(np.where(here, depth, 2.0)))
        workspace.write("information", (0, time), np.full(VIEW.shape, 1e6, np.float32))
        workspace.write(COLOUR, (0, time), np.dstack([np.where(here, 200, 100), *[0 * here + 128] * 2]))
    workspace.write_array("poses", np.tile(np.eye(4), (1, frames, 1, 1)))
    return workspace


def test_what_other_times_see_behind_a_thing_holds_the_depth_beside_it(tmp_path: Path) -> None:
    # in the middle frame flow calls more than the block moving, and settles nothing around
    config, middle = RefinementConfig(stride=1), (0, 12)
    workspace = block_before_a_wall(tmp_path, 25, (12,), 2.0)
    fat = np.zeros(VIEW.shape, bool)
    fat[12:36, 22:42] = True
    workspace.write("fails", middle, fat)
    context = Context(workspace, ((0,),), {}, config, DisFlow(), FlowConfig())
    context.keep_flow_targets(middle, flow_targets([], fat.size))

    settle_task(context, middle)
    found = np.asarray(workspace.read(LABELS, middle)) > 0
    assert np.count_nonzero(found ^ BLOCK) <= 12
    beside = fat & ~found
    np.testing.assert_allclose(context.image("prior", middle)[beside], -np.log(2.0), atol=1e-3)
    np.testing.assert_allclose(context.image("prior_weight", middle)[beside], config.behind_sigma**-2)


def test_a_thing_with_the_flow_of_a_still_one_moves_where_others_see_through_it(tmp_path: Path) -> None:
    # flow finds the block at rest, 1 m away; later and earlier the wall is seen behind it
    config, middle, around = RefinementConfig(stride=1), 40, (38, 40, 42)
    workspace = block_before_a_wall(tmp_path, 81, around, 1.0)
    for time in around:
        workspace.write("fails", (0, time), BLOCK)
    rest, sure = np.zeros((*VIEW.shape, 2), np.float32), np.ones(VIEW.shape, np.float32)
    for pair in (((0, 38), (0, 40)), ((0, 40), (0, 42))):
        workspace.write_flow(*pair, FlowPair(rest, rest, sure, sure))
    neighbours: dict[Frame, tuple[Frame, ...]] = {(0, middle): ((0, 38), (0, 42))}
    context = Context(workspace, ((0,),), neighbours, config, DisFlow(), FlowConfig())
    edges = context.edges((0, middle), context.poses(), own_camera=True)
    context.keep_flow_targets((0, middle), flow_targets(edges, BLOCK.size))

    def moving() -> np.ndarray:
        settle_task(context, (0, middle))
        return np.asarray(workspace.read(LABELS, (0, middle))) > 0

    # flow proves it still where others see it stand
    workspace.write(SIGHT, (0, middle), np.full(VIEW.shape, STANDS, np.uint8))
    assert not moving().any()
    workspace.write(SIGHT, (0, middle), np.zeros(VIEW.shape, np.uint8))
    assert moving()[BLOCK].mean() > 0.9
    free_space_task(context, (0, middle))
    sight = np.asarray(workspace.read(SIGHT, (0, middle)))
    assert (sight[BLOCK] == SEEN_THROUGH).mean() > 0.9 and (sight[~BLOCK] == STANDS).mean() > 0.9
    assert moving()[BLOCK].mean() > 0.9 and moving()[~BLOCK].mean() < 0.02
