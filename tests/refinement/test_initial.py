"""Where the depth solve begins: the choice between depths, what is found to move, and its depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.edges import SURE_WEIGHT, Edge, FlowTargets, flow_targets
from mvdyn_gtsam.refinement.initial import (
    _triangulated,
    before_all_around,
    best_candidate,
    carried_regions,
    failing_regions,
    most_telling,
    moving_regions,
    proven_still,
    static_residual,
)
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.depth import DepthPrior, FrameProblem, solve_frame
from mvdyn_gtsam.refinement.solve.lattice import neighbour_likeness
from mvdyn_gtsam.refinement.solve.residuals import confidence
from tests.refinement.dense_edges import (
    Mask,
    small_view,
    true_edge,
    true_edges,
    true_theta,
    with_motion,
    with_wrong_flow,
)
from tests.refinement.scenes import Scene, two_cameras

CONFIG = RefinementConfig()
FRAME: Frame = (0, 2)
VIEW = small_view(2)
TIME = FRAME[1]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(times=5)


@pytest.fixture(scope="module")
def truth(scene: Scene) -> Float32:
    """Inverse depth."""
    return np.exp(true_theta(scene, FRAME, VIEW))


@pytest.fixture(scope="module")
def edges(scene: Scene) -> list[Edge]:
    return true_edges(scene, FRAME, VIEW)


@pytest.fixture(scope="module")
def own_edges(edges: list[Edge]) -> list[Edge]:
    """Within the camera."""
    return [edge for edge in edges if edge.j[0] == FRAME[0]]


def square(row: int, col: int, size: int) -> Mask:
    mask = np.zeros(VIEW.shape, bool)
    mask[row : row + size, col : col + size] = True
    return mask


def targets(edges: list[Edge]) -> FlowTargets:
    return flow_targets(edges, VIEW.shape[0] * VIEW.shape[1])


def middle() -> tuple[slice, slice]:
    """Without the border, where few edges see anything."""
    return np.s_[6:-6, 8:-8]


def test_each_pixel_takes_the_candidate_that_the_flow_likes(truth: Float32, own_edges: list[Edge]) -> None:
    """The first is right on the left, the second in the middle, the third on the right."""
    third = VIEW.shape[1] // 3
    parts = (np.s_[:, :third], np.s_[:, third : 2 * third], np.s_[:, 2 * third :])
    candidates = []
    for part in parts:
        candidate = 0.5 * truth
        candidate[part] = truth[part]
        candidates.append(candidate)
    # flow to anywhere is no better for any of them, and no depth can be triangulated from it
    found = best_candidate(candidates, with_wrong_flow(own_edges, 0.1), CONFIG)
    right = np.abs(np.log(found / truth)) < 0.02
    assert right[middle()].mean() > 0.97
    assert (np.abs(np.log(candidates[0] / truth)) < 0.02)[middle()].mean() < 0.4


def test_the_first_candidate_stays_unless_another_is_clearly_better(
    truth: Float32, own_edges: list[Edge]
) -> None:
    for first, second in ((1.002 * truth, truth), (truth, 1.002 * truth)):
        found = best_candidate([first, second], own_edges, CONFIG, margin=2.0)
        np.testing.assert_array_equal(found[middle()], first[middle()])


def test_without_edges_the_first_candidate_stays(truth: Float32) -> None:
    np.testing.assert_array_equal(best_candidate([truth, 2.0 * truth], [], CONFIG), truth)


def test_triangulated_depth_is_a_candidate(truth: Float32, edges: list[Edge]) -> None:
    """No candidate is right anywhere."""
    across = next(edge for edge in edges if edge.same_instant)
    found = best_candidate([0.7 * truth], edges, CONFIG)
    right = np.abs(np.log(found / truth)) < 0.02
    # the other camera alone is far enough away
    assert right.ravel()[across.pixels].mean() > 0.95


def test_triangulation_from_exact_flow_is_exact(scene: Scene, truth: Float32) -> None:
    edge = true_edge(scene, FRAME, (1, 2), VIEW)
    found = _triangulated(edge, np.full(truth.shape, -1.0, np.float32))
    inside = np.zeros(truth.size, bool)
    inside[edge.pixels] = True
    known = found.ravel() > 0.0
    # where the edge says nothing, or all is too far for its baseline, the fallback stays
    assert (found.ravel()[~inside] == -1.0).all()
    assert known.sum() > 0.95 * inside.sum()
    np.testing.assert_allclose(found.ravel()[known], truth.ravel()[known], rtol=2e-4)


def test_triangulation_needs_parallax(scene: Scene, truth: Float32) -> None:
    edge = true_edge(scene, FRAME, (1, 2), VIEW)
    jTi = edge.jTi.copy()
    jTi[:3, 3] *= 0.01
    close = replace(edge, jTi=jTi)
    residual = np.asarray(close.terms(truth.ravel()[edge.pixels]).residual, np.float32)
    close = replace(close, target=edge.target + residual)
    np.testing.assert_array_equal(_triangulated(close, truth), truth)


def test_the_static_model_explains_a_static_scene(truth: Float32, edges: list[Edge]) -> None:
    residual = static_residual(truth, edges)
    seen = np.isfinite(residual)
    assert seen[middle()].all() and residual[seen].max() < 1e-3


def test_the_static_model_fails_where_something_moves(truth: Float32, edges: list[Edge]) -> None:
    block = square(20, 30, 16)
    residual = static_residual(truth, with_motion(edges, block, (2.0, -3.0)))
    length = np.hypot(2.0, 3.0)
    # offsets of 1 and 2 frames: the median of four is that of one frame
    np.testing.assert_allclose(residual[block], length, rtol=1e-3)
    assert np.nanmax(residual[~block]) < 1e-3


def test_only_sure_flow_within_the_camera_in_front_of_it_judges(
    scene: Scene, truth: Float32, edges: list[Edge], own_edges: list[Edge]
) -> None:
    across = [edge for edge in edges if edge.j[0] != FRAME[0]]
    assert len(across) == 1 and np.isnan(static_residual(truth, across)).all()
    unsure = [replace(edge, weight=edge.weight * np.float32(0.9 * SURE_WEIGHT)) for edge in own_edges]
    assert np.isnan(static_residual(truth, unsure)).all()
    jTi = own_edges[0].jTi.copy()
    jTi[2, 3] = -100.0
    behind = replace(own_edges[0], jTi=jTi)
    assert np.isnan(static_residual(truth, [behind])).all(), "a point behind the camera explains nothing"


def test_a_block_where_the_static_model_fails_is_found() -> None:
    block = square(20, 30, 16)
    residual = np.where(block, 3.0 * CONFIG.moving_px, 0.1).astype(np.float32)
    found = failing_regions(residual, CONFIG) > 0
    assert (found & block).sum() > 0.95 * block.sum() and (found & ~block).sum() == 0


def test_specks_noise_and_the_unknown_do_not_fail() -> None:
    rng = np.random.default_rng(0)
    specks = np.where(rng.random(VIEW.shape) < 0.03, 20.0, 0.1).astype(np.float32)
    small = np.where(square(20, 30, 4), 20.0, 0.1).astype(np.float32)
    # a large patch that hardly fails: flow on a plain wall
    weak = np.where(square(20, 30, 16), 1.5 * CONFIG.moving_px, 0.1).astype(np.float32)
    unknown = np.full(VIEW.shape, np.nan, np.float32)
    for residual in (specks, small, weak, unknown):
        assert (failing_regions(residual, CONFIG) == 0).all()


def test_gaps_in_a_failing_region_are_closed() -> None:
    residual = np.where(square(20, 30, 20), 5.0, 0.1).astype(np.float32)
    # its plain inside: static as far as flow can tell
    residual[28:31, 30:50] = 0.1
    assert (failing_regions(residual, CONFIG)[22:38, 34:46] == 1).all()


def test_what_the_frames_around_agree_on_moves(own_edges: list[Edge]) -> None:
    """Of two blocks the frame itself saw one; the frames around saw the other, 20 pixels to the right."""
    seen, missed, there = square(10, 10, 12), square(35, 15, 12), square(35, 35, 12)
    edges = [
        replace(edge, nearest=np.where(edge.pixels % VIEW.shape[1] < 60, edge.pixels + 20, -1))
        for edge in own_edges
    ]
    votes = [there.astype(np.uint8)] * len(edges)
    labels = moving_regions(seen.astype(np.uint8), targets(edges), votes, CONFIG)
    assert (labels[seen] == 0).all()
    assert (labels[missed] > 0).mean() > 0.9 and len(np.unique(labels[missed & (labels > 0)])) == 1
    assert (labels[~missed] > 0).mean() < 0.01


def test_flow_targets_are_where_sure_flow_leads(own_edges: list[Edge]) -> None:
    edge = own_edges[0]
    half = replace(edge, weight=np.where(edge.pixels % 2 == 0, edge.weight, 0.9 * SURE_WEIGHT))
    found = targets([edge, half])
    assert found.times.tolist() == [edge.j[1]] * 2
    sure = edge.weight >= SURE_WEIGHT
    np.testing.assert_array_equal(found.pixels[0, edge.pixels[sure]], edge.nearest[sure])
    assert (found.pixels[1, 1::2] == -1).all() and (found.pixels[1, ::2] >= 0).any()


def test_flow_of_little_weight_carries_no_vote(own_edges: list[Edge]) -> None:
    seen = square(10, 10, 12)
    unsure = [replace(edge, weight=edge.weight * np.float32(0.9 * SURE_WEIGHT)) for edge in own_edges]
    nothing = [np.zeros(VIEW.shape, np.uint8)] * len(own_edges)
    own = seen.astype(np.uint8)
    assert (moving_regions(own, targets(own_edges), nothing, CONFIG) == 0).all()
    for edges in (unsure, []):
        labels = moving_regions(own, targets(edges), nothing[: len(edges)], CONFIG)
        assert (labels[seen] > 0).mean() > 0.9


def test_what_flows_out_of_the_image_has_no_vote(own_edges: list[Edge]) -> None:
    gone = [replace(edge, nearest=np.full_like(edge.nearest, -1)) for edge in own_edges]
    votes = [np.ones(VIEW.shape, np.uint8)] * len(gone)
    assert (moving_regions(np.zeros(VIEW.shape, np.uint8), targets(gone), votes, CONFIG) == 0).all()


def carried(edges: list[Edge], block: Mask, seen_by: Callable[[Edge], bool], stands: Mask) -> Mask:
    """Where the static model fails in a frame that saw nothing itself, of a block that some others saw."""
    there = [(block & seen_by(edge)).astype(np.uint8) for edge in edges]
    own, nowhere = np.zeros(VIEW.shape, np.uint8), np.zeros(VIEW.shape, bool)
    return carried_regions(own, TIME, targets(edges), there, nowhere, stands, CONFIG) > 0


def test_what_all_frames_of_one_side_see_move_is_carried(own_edges: list[Edge]) -> None:
    edges = [replace(edge, nearest=edge.pixels) for edge in own_edges]
    block, nothing = square(20, 30, 16), np.zeros(VIEW.shape, bool)
    assert {edge.j[1] < edge.i[1] for edge in edges} == {True, False}
    for past in (True, False):
        side = {edge.j for edge in edges if (edge.j[1] < edge.i[1]) == past}
        found = carried(edges, block, lambda edge: edge.j in side, nothing)  # noqa: B023
        assert found[block].mean() > 0.9 and found[~block].mean() < 0.02
    assert not carried(edges, block, lambda _: False, nothing).any()


def test_what_half_of_each_side_sees_is_not_carried(own_edges: list[Edge]) -> None:
    edges = [replace(edge, nearest=edge.pixels) for edge in own_edges]
    steps = sorted({abs(edge.j[1] - edge.i[1]) for edge in edges})
    near = steps[: len(steps) // 2]
    block, nothing = square(20, 30, 16), np.zeros(VIEW.shape, bool)
    assert near
    found = carried(edges, block, lambda edge: abs(edge.j[1] - edge.i[1]) in near, nothing)
    assert not found.any()


def test_what_others_see_stand_there_is_not_carried(own_edges: list[Edge]) -> None:
    edges = [replace(edge, nearest=edge.pixels) for edge in own_edges]
    block = square(20, 30, 16)
    assert not carried(edges, block, lambda _: True, block).any()


def test_what_a_frame_sees_itself_stays(own_edges: list[Edge]) -> None:
    own, nothing = square(20, 30, 16).astype(np.uint8), np.zeros(VIEW.shape, np.uint8)
    nowhere, there = nothing > 0, [nothing] * len(own_edges)
    assert (carried_regions(own, TIME, targets(own_edges), there, nowhere, nowhere, CONFIG) == own).all()


def test_what_is_too_fast_for_flow_moves_where_the_next_frames_see_it(own_edges: list[Edge]) -> None:
    block, nothing = square(20, 30, 16), np.zeros(VIEW.shape, np.uint8)
    nowhere = nothing > 0
    there = [nothing] * len(own_edges)
    lost = [replace(edge, weight=edge.weight * ~block.ravel()[edge.pixels]) for edge in own_edges]
    found = carried_regions(nothing, TIME, targets(lost), there, block, nowhere, CONFIG) > 0
    assert found[block].mean() > 0.9 and found[~block].mean() < 0.02
    # flow that finds it standing still has the say, and so have others who see it stand
    assert not carried_regions(nothing, TIME, targets(own_edges), there, block, nowhere, CONFIG).any()
    assert not carried_regions(nothing, TIME, targets(lost), there, block, block, CONFIG).any()


def test_what_two_frames_find_where_it_would_be_is_still(own_edges: list[Edge]) -> None:
    residual = np.where(square(20, 30, 16), 0.5 * CONFIG.still_px, 2.0 * CONFIG.still_px).astype(np.float32)
    residual[40:43, 10:13] = 0.0  # less than the least square
    assert (proven_still(residual, own_edges, CONFIG) == square(20, 30, 16)).all()
    # one frame may err, and so may flow of little weight; unknown is not still
    unsure = [replace(edge, weight=edge.weight * np.float32(0.9 * SURE_WEIGHT)) for edge in own_edges]
    for edges in (own_edges[:1], [own_edges[0], *unsure[1:]]):
        assert not proven_still(residual, edges, CONFIG).any()
    assert not proven_still(np.full_like(residual, np.nan), own_edges, CONFIG).any()


def test_two_blocks_are_two_regions_and_a_speck_is_none() -> None:
    own = (square(10, 10, 12) | square(35, 55, 12) | square(5, 60, 4)).astype(np.uint8)
    labels = moving_regions(own, targets([]), [], CONFIG)
    assert {labels[16, 16], labels[41, 61]} == {1, 2} == set(np.unique(labels)) - {0}
    assert (labels[:9, 56:] == 0).all()


def test_temporal_edges_of_what_moves_lose_their_weight_by_themselves(
    scene: Scene, truth: Float32, edges: list[Edge]
) -> None:
    """Nobody says what moves: the solve sees four edges in time that are wrong about the block and one to
    the other camera that is right."""
    block = square(20, 32, 12)
    seen = with_motion(edges, block, (1.5, -2.5))
    start = np.log(truth) + np.float32(0.03)
    prior = DepthPrior(start, np.full(start.shape, 1.0, np.float32))
    image = neighbour_likeness(60.0 * np.log(truth)[..., None].astype(np.float32), CONFIG.edge_contrast)
    config = replace(CONFIG, smoothness=0.2)
    solved, _ = solve_frame(start, FrameProblem(seen, {}, image, prior, config), 10)
    rho = np.exp(solved).ravel()
    inside = block.ravel()
    for edge in seen:
        residual = edge.terms(rho[edge.pixels]).residual
        trust = confidence(np.abs(residual).sum(axis=1), config.flow_lambda)
        moving, still = np.median(trust[inside[edge.pixels]]), np.median(trust[~inside[edge.pixels]])
        assert still > 0.99
        if edge.same_instant:
            assert moving > 0.99
        else:
            assert moving < 0.3 * still
    # so the other camera alone says how far away the block is
    assert np.median(np.abs(solved - np.log(truth))[block]) < 0.01


def test_edges_with_parallax_tell_most(scene: Scene, truth: Float32) -> None:
    edges = [true_edge(scene, FRAME, (0, time), VIEW) for time in (1, 3, 4)]
    far = true_edge(scene, FRAME, (1, 2), VIEW)
    weak = replace(far, weight=np.full_like(far.weight, 1e-4))
    baselines = [float(np.linalg.norm(edge.jTi[:3, 3])) for edge in (*edges, far)]
    assert max(baselines) == baselines[-1]
    assert most_telling([*edges, far], truth, 1) == [far]
    # hardly trusted, it tells nothing however far apart the views are
    assert weak not in most_telling([*edges, weak], truth, 3)
    assert len(most_telling(edges, truth, 99)) == len(edges)


def test_a_region_is_before_all_around_where_nothing_beside_it_is_as_near() -> None:
    theta = np.full(VIEW.shape, -np.log(3.0), np.float32)
    region, hole, gap = square(20, 30, 16), square(22, 32, 4), square(30, 40, 4)
    theta[region] = -np.log(2.0)
    theta[hole], theta[gap] = -np.log(0.3), -np.log(3.0)
    labels, known = region.astype(np.int32), np.ones(VIEW.shape, bool)
    np.testing.assert_array_equal(before_all_around(theta, labels, known), region & ~gap)
    # the ground at its feet is as near as the thing
    theta[36:, 25:51] = np.where(region, theta, -np.log(1.9))[36:, 25:51]
    np.testing.assert_array_equal(before_all_around(theta, labels, known), hole)
    # unknown depth beside it is no measure
    known[:] = False
    np.testing.assert_array_equal(before_all_around(theta, labels, known), region)
