"""Phase 1 on a scene whose flow is exact: the affine error of every frame's depth is found and undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.descent import FrameSystem, descend
from mvdyn_gtsam.refinement.solve.reprojection import independent_share, reprojection_terms, robust
from mvdyn_gtsam.refinement.solve.samples import FrameSample
from mvdyn_gtsam.refinement.solve.scale import Scales, _ScaleProblem, solve_scales
from tests.refinement.scenes import Array, Scene, stream, two_cameras, with_noise, with_outliers

CONFIG = RefinementConfig()
RNG = np.random.default_rng(4)
SCALE = RNG.uniform(0.8, 1.25, (2, 3))
OFFSET = RNG.uniform(-0.3, 0.3, (2, 3))


def held_wrongly(frame: Frame, depth: Array) -> Array:
    """Depth that ``SCALE`` and ``OFFSET`` bring back to the truth."""
    return np.asarray((depth - OFFSET[frame]) / SCALE[frame])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras()


@pytest.fixture(scope="module")
def samples(scene: Scene) -> list[FrameSample]:
    return scene.samples(depth_of=held_wrongly)


def test_wrong_scales_and_offsets_are_recovered(scene: Scene, samples: list[FrameSample]) -> None:
    found = solve_scales(stream(samples), scene.wTc, CONFIG, iterations=15)
    np.testing.assert_allclose(found.scale, SCALE, atol=2e-3)
    np.testing.assert_allclose(found.offset, OFFSET, atol=5e-3)


def test_the_configured_iterations_are_enough(scene: Scene, samples: list[FrameSample]) -> None:
    found = solve_scales(stream(samples), scene.wTc, CONFIG)
    corrected = found.scale * 4.0 + found.offset
    np.testing.assert_allclose(corrected, SCALE * 4.0 + OFFSET, rtol=0.01)


def test_true_depth_is_left_as_it_is(scene: Scene) -> None:
    found = solve_scales(stream(scene.samples()), scene.wTc, CONFIG)
    np.testing.assert_allclose(found.scale, 1.0, atol=1e-9)
    np.testing.assert_allclose(found.offset, 0.0, atol=1e-9)


def test_a_fifth_of_wrong_flow_does_not_matter(scene: Scene, samples: list[FrameSample]) -> None:
    found = solve_scales(stream(with_outliers(samples, 0.2)), scene.wTc, CONFIG, iterations=30)
    np.testing.assert_allclose(found.scale, SCALE, atol=0.01)
    np.testing.assert_allclose(found.offset, OFFSET, atol=0.03)


def test_noise_of_the_flow_averages_out(scene: Scene, samples: list[FrameSample]) -> None:
    found = solve_scales(stream(with_noise(samples, 0.3)), scene.wTc, CONFIG, iterations=15)
    corrected = found.scale * 4.0 + found.offset
    np.testing.assert_allclose(corrected, SCALE * 4.0 + OFFSET, rtol=0.01)


def test_frames_without_evidence_keep_their_depth(scene: Scene, samples: list[FrameSample]) -> None:
    blind: Frame = (1, 2)
    kept = []
    for sample in samples:
        if sample.i == blind:
            continue
        weight = sample.weight.copy()
        weight[[k for k, j in enumerate(sample.neighbours) if j == blind]] = 0.0
        kept.append(replace(sample, weight=weight))
    found = solve_scales(stream(kept), scene.wTc, CONFIG, iterations=15)
    assert found.scale[blind] == 1.0 and found.offset[blind] == 0.0
    seen = np.ones((2, 3), bool)
    seen[blind] = False
    np.testing.assert_allclose(found.scale[seen], SCALE[seen], atol=5e-3)


def test_unknown_flow_and_depth_count_for_nothing(scene: Scene, samples: list[FrameSample]) -> None:
    def poisoned(sample: FrameSample) -> FrameSample:
        depth, target, there = (
            sample.inverse_depth.copy(),
            sample.target.copy(),
            sample.inverse_depth_there.copy(),
        )
        depth[::7] = np.nan
        target[sample.weight == 0.0] = np.nan
        there[:, ::5] = np.nan
        return replace(sample, inverse_depth=depth, target=target, inverse_depth_there=there)

    found = solve_scales(stream([poisoned(s) for s in samples]), scene.wTc, CONFIG, iterations=15)
    np.testing.assert_allclose(found.scale, SCALE, atol=2e-3)
    np.testing.assert_allclose(found.offset, OFFSET, atol=5e-3)


def test_no_samples_at_all_change_nothing(scene: Scene) -> None:
    found = solve_scales(stream([]), scene.wTc, CONFIG)
    np.testing.assert_array_equal(found.scale, np.ones((2, 3)))
    np.testing.assert_array_equal(found.offset, np.zeros((2, 3)))


def test_frames_without_parallax_keep_their_depth() -> None:
    """Cameras that only turn say nothing about depth, and disparity alone must not shrink the world."""
    scene = two_cameras()
    turning = scene.wTc.copy()
    turning[..., :3, 3] = turning[0, 0, :3, 3]
    found = solve_scales(stream(Scene(turning).samples()), turning, CONFIG)
    np.testing.assert_allclose(found.scale, 1.0, atol=1e-6)


def test_the_prior_holds_the_offset_of_a_frame_without_depth_range(scene: Scene) -> None:
    """Less than two per cent of depth range: scale and offset look alike, and the scale takes it."""

    def shallow(sample: FrameSample) -> FrameSample:
        flat = np.abs(1.0 / sample.inverse_depth * 1.2 - 8.0) < 0.06
        return replace(sample, weight=sample.weight * flat)

    samples = [shallow(s) for s in scene.samples(spacing=4, depth_of=lambda _, depth: depth / 1.2)]
    config = replace(CONFIG, disparity_weight=0.0)
    found = solve_scales(stream(samples), scene.wTc, config, iterations=15)
    bearing = [s.i for s in samples if s.weight.sum() > 50]
    assert len(bearing) >= 2
    for frame in bearing:
        corrected = found.scale[frame] * 8.0 / 1.2 + found.offset[frame]
        assert corrected == pytest.approx(8.0, rel=0.01)
        assert abs(found.offset[frame]) < 0.2 * abs(found.scale[frame] - 1.0) * 8.0


def test_depth_stays_positive(scene: Scene) -> None:
    """Most pixels ask for an offset of -3; a few are held nearer than that and stay before the camera."""

    def with_near_pixels(sample: FrameSample) -> FrameSample:
        depth = sample.inverse_depth.copy()
        depth[::40] = 1.0 / 0.5
        return replace(sample, inverse_depth=depth)

    samples = [with_near_pixels(s) for s in scene.samples(depth_of=lambda _, depth: depth + 3.0)]
    for iterations in range(1, 8):
        found = solve_scales(stream(samples), scene.wTc, CONFIG, iterations)
        for sample in samples:
            corrected = found.scale[sample.i] / sample.inverse_depth + found.offset[sample.i]
            assert (corrected > 0.0).all()
    assert (found.scale < 0.8).all() and (found.offset < 0.0).all()


def test_it_does_not_pay_to_go_behind_a_camera(scene: Scene) -> None:
    sample = scene.sample((0, 0), [(0, 1)])
    behind, ahead = np.eye(4), np.eye(4)
    behind[2, 3], ahead[0, 3] = -100.0, 0.5
    costs = [
        reprojection_terms(sample, sample.inverse_depth, sample.inverse_depth_there, jTi[None], CONFIG).cost
        for jTi in (behind, ahead)
    ]
    assert costs[0] == pytest.approx(sample.weight.sum() * CONFIG.flow_lambda * (1.0 + np.log(20.0)))
    assert costs[0] > costs[1]


def test_gradient_against_finite_differences(scene: Scene, samples: list[FrameSample]) -> None:
    problem = _ScaleProblem(stream(with_noise(samples, 0.5)), scene.wTc, CONFIG)
    rng = np.random.default_rng(1)
    at = Scales(rng.uniform(0.9, 1.1, (2, 3)), rng.uniform(-0.1, 0.1, (2, 3)))
    gradient = problem.evaluate(at).gradient.reshape(2, 3, 2)
    h = 1e-6
    for frame in scene.frames:
        unit = np.zeros((2, 3))
        unit[frame] = h
        by_scale = [problem.evaluate(Scales(at.scale * np.exp(s * unit), at.offset)).cost for s in (1, -1)]
        by_offset = [problem.evaluate(Scales(at.scale, at.offset + s * unit)).cost for s in (1, -1)]
        numeric = [(up - down) / (2 * h) for up, down in (by_scale, by_offset)]
        np.testing.assert_allclose(gradient[frame], numeric, rtol=1e-4, atol=1e-2)


def test_cost_falls_with_every_iteration(scene: Scene, samples: list[FrameSample]) -> None:
    problem = _ScaleProblem(stream(with_outliers(samples, 0.3)), scene.wTc, CONFIG)
    state = Scales(np.ones((2, 3)), np.zeros((2, 3)))
    costs = [problem.evaluate(state).cost]
    for _ in range(6):
        state = descend(state, problem.evaluate, problem.direction, problem.move, 1)
        costs.append(problem.evaluate(state).cost)
    assert all(after <= before for before, after in zip(costs, costs[1:], strict=False))
    assert costs[-1] < 0.6 * costs[0]


def test_samples_are_streamed_once_per_iteration(scene: Scene, samples: list[FrameSample]) -> None:
    passes = []

    def counted() -> list[FrameSample]:
        passes.append(1)
        return samples

    solve_scales(counted, scene.wTc, CONFIG, iterations=3)
    assert len(passes) == 4


def test_robust_cost_is_the_papers_with_the_best_confidence() -> None:
    residual = np.array([[3.0, -1.0], [0.2, 0.3]])
    cost, information = robust(residual.T, np.array([1.0, 2.0]), 1e-9, 1.0)
    assert cost == pytest.approx((4.0 * 0.25 + np.log(4.0)) + 2.0 * 0.5)
    np.testing.assert_allclose(information.T, [[0.25 / 3.0, 0.25], [2.0 / 0.2, 2.0 / 0.3]])


@pytest.mark.parametrize(("spacing", "expected"), [(2, 1.0 / 16.0), (4, 0.25), (8, 1.0), (16, 1.0)])
def test_pixels_closer_than_a_patch_share_their_say(scene: Scene, spacing: int, expected: float) -> None:
    sample = scene.sample((0, 0), [(0, 1)], spacing)
    assert independent_share(sample) == pytest.approx(expected, rel=0.15)


def test_dense_and_sparse_samples_weigh_about_the_same(scene: Scene) -> None:
    costs = []
    for spacing in (2, 4, 8):
        samples = scene.samples(spacing, lambda _, depth: depth * 1.1)
        identity = Scales(np.ones((2, 3)), np.zeros((2, 3)))
        costs.append(_ScaleProblem(stream(samples), scene.wTc, CONFIG).evaluate(identity).cost)
    assert costs == pytest.approx([costs[0]] * 3, rel=0.2)


def test_system_solves_what_a_dense_solver_solves() -> None:
    rng = np.random.default_rng(0)
    system, width, frames = FrameSystem(4, 3), 3, 4
    dense, right = np.zeros((12, 12)), np.zeros(12)
    terms: list[list[int]] = [[0], [1], [2], [3], [0, 1], [2, 1], [3, 0, 2], [3, 3]]
    for term in terms:
        root = rng.normal(size=(20, width * len(term)))
        gradient = rng.normal(size=width * len(term))
        system.add(term, root.T @ root, gradient, 1.0)
        chosen = np.concatenate([np.eye(12)[width * frame : width * (frame + 1)] for frame in term])
        dense += chosen.T @ root.T @ root @ chosen
        right += chosen.T @ gradient
    assert system.cost == 8.0
    free = np.array([True, False, True, True])
    moving = np.repeat(free, width)
    expected = np.zeros(frames * width)
    expected[moving] = np.linalg.solve(dense[np.ix_(moving, moving)], -right[moving])
    np.testing.assert_allclose(system.step(free).ravel(), expected, atol=1e-10)


def test_descent_halves_the_step_until_the_cost_falls_or_gives_up() -> None:
    def evaluate(x: float) -> FrameSystem:
        system = FrameSystem(1, 1)
        system.cost = abs(x)
        return system

    def move(x: float, way: float, share: float) -> float:
        return x + share * way

    # 1 - 5 and 1 - 5 / 2 lie farther out than 1, 1 - 5 / 4 does not
    assert descend(1.0, evaluate, lambda x, _: -5.0, move, 1) == pytest.approx(-0.25)
    assert descend(1.0, evaluate, lambda x, _: 5.0, move, 3) == 1.0
