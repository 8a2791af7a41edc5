"""Phase 2's poses on a scene whose flow is exact, and the solve against a general optimiser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import invert_pose, project, rotation_angle_deg, transform_points
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.depth import FLOW_FLOOR_PX, RATIO_FLOOR
from mvdyn_gtsam.refinement.solve.descent import FrameSystem, descend
from mvdyn_gtsam.refinement.solve.poses import (
    PoseProblem,
    PoseState,
    _Direction,
    prior_terms,
    retracted,
    smoothness_terms,
    solve_poses,
)
from mvdyn_gtsam.refinement.solve.reprojection import independent_share
from mvdyn_gtsam.refinement.solve.samples import FrameSample
from tests.refinement.scenes import (
    INTRINSICS,
    Array,
    Scene,
    stream,
    two_cameras,
    with_noise,
    with_outliers,
)

# the tracked poses are not to be believed: what is asked is what the flow says
LOOSE = replace(
    RefinementConfig(),
    prior_rotation_deg=10.0,
    prior_translation=1.0,
    smooth_rotation=0.0,
    smooth_translation=0.0,
)
BOTH = ((0, 1),)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras()


@pytest.fixture(scope="module")
def samples(scene: Scene) -> list[FrameSample]:
    return scene.samples()


def perturbed(wTc: Array, seed: int = 0, degrees: float = 0.3, length: float = 0.02) -> Array:
    """All poses but the first moved at random."""
    sigma = np.repeat([np.radians(degrees), length], 3)
    delta = np.random.default_rng(seed).normal(size=(*wTc.shape[:2], 6)) * sigma
    delta[0, 0] = 0.0
    return retracted(wTc, delta)


def worst_errors(found: Array, truth: Array) -> tuple[float, float]:
    """Largest rotation error in degrees and largest distance."""
    turn = np.swapaxes(found[..., :3, :3], -1, -2) @ truth[..., :3, :3]
    distance = np.linalg.norm(found[..., :3, 3] - truth[..., :3, 3], axis=-1)
    return float(rotation_angle_deg(turn.reshape(-1, 3, 3)).max()), float(distance.max())


@pytest.mark.parametrize("joint", [False, True])
def test_true_poses_cost_nothing_and_stay(scene: Scene, samples: list[FrameSample], joint: bool) -> None:
    config = replace(RefinementConfig(), smooth_rotation=0.0, smooth_translation=0.0, joint=joint)
    cost = PoseProblem(stream(samples), scene.wTc, BOTH, config).evaluate(PoseState(scene.wTc, None)).cost
    assert cost == pytest.approx(0.0, abs=1e-12)
    found = solve_poses(stream(samples), scene.wTc, scene.wTc, BOTH, config)
    np.testing.assert_allclose(found, scene.wTc, atol=1e-9)


def test_perturbed_poses_are_recovered(scene: Scene, samples: list[FrameSample]) -> None:
    start = perturbed(scene.wTc)
    found = solve_poses(stream(samples), start, start, BOTH, LOOSE, iterations=20)
    rotation, distance = worst_errors(found, scene.wTc)
    assert rotation < 1e-3 and distance < 1e-4


def test_the_configured_iterations_are_enough_for_what_tracking_leaves(
    scene: Scene, samples: list[FrameSample]
) -> None:
    start = perturbed(scene.wTc, degrees=0.03, length=0.003)
    config = replace(RefinementConfig(), prior_rotation_deg=0.1, prior_translation=0.003)
    found = solve_poses(stream(with_noise(samples, 0.2)), start, start, BOTH, config)
    before, after = worst_errors(start, scene.wTc), worst_errors(found, scene.wTc)
    assert after[0] < 0.5 * before[0] and after[1] < 0.5 * before[1]


def test_a_fifth_of_wrong_flow_does_not_matter(scene: Scene, samples: list[FrameSample]) -> None:
    start = perturbed(scene.wTc)
    found = solve_poses(stream(with_outliers(samples, 0.2)), start, start, BOTH, LOOSE, iterations=40)
    rotation, distance = worst_errors(found, scene.wTc)
    assert rotation < 0.02 and distance < 2e-3


def test_the_first_frame_and_cameras_of_no_group_are_held(scene: Scene, samples: list[FrameSample]) -> None:
    start = perturbed(scene.wTc)
    found = solve_poses(stream(samples), start, start, [(0,)], LOOSE)
    np.testing.assert_array_equal(found[0, 0], start[0, 0])
    np.testing.assert_array_equal(found[1], start[1])
    assert (np.abs(found[0, 1:] - start[0, 1:]).max(axis=(1, 2)) > 1e-4).all()


def test_each_group_has_its_own_first_frame(scene: Scene) -> None:
    """Cameras that share no world are solved side by side; the scale of each is that of its depth."""
    own = [scene.sample(i, [j for j in scene.pairs()[i] if j[0] == i[0]]) for i in scene.frames]
    start = perturbed(scene.wTc)
    start[1] = perturbed(scene.wTc[::-1], seed=3)[1]
    start[1, 0] = scene.wTc[1, 0]
    found = solve_poses(stream(own), start, start, [(0,), (1,)], LOOSE, iterations=20)
    np.testing.assert_array_equal(found[:, 0], start[:, 0])
    rotation, distance = worst_errors(found, scene.wTc)
    assert rotation < 1e-3 and distance < 1e-4


def test_no_samples_change_nothing(scene: Scene) -> None:
    start = perturbed(scene.wTc)
    found = solve_poses(stream([]), start, scene.wTc, BOTH, RefinementConfig())
    np.testing.assert_array_equal(found, start)


def test_a_tight_prior_outweighs_the_flow(scene: Scene, samples: list[FrameSample]) -> None:
    start = perturbed(scene.wTc)
    tight = replace(LOOSE, prior_rotation_deg=1e-6, prior_translation=1e-8)
    found = solve_poses(stream(samples), start, start, BOTH, tight)
    np.testing.assert_allclose(found, start, atol=1e-6)


def test_density_of_the_samples_does_not_change_the_balance_with_the_prior(scene: Scene) -> None:
    """Four times the pixels at half the distance say the same: the flow's error is shared."""
    start = perturbed(scene.wTc, degrees=0.05, length=0.005)
    config = replace(LOOSE, prior_rotation_deg=0.01, prior_translation=0.0002)
    moved = []
    for spacing in (2, 4, 8):
        found = solve_poses(stream(scene.samples(spacing)), start, start, BOTH, config, iterations=8)
        moved.append(float(np.abs(found - start).max()))
    assert moved == pytest.approx([moved[0]] * 3, rel=0.1)


@pytest.mark.parametrize("joint", [False, True])
def test_gradient_of_the_cost_against_finite_differences(
    scene: Scene, samples: list[FrameSample], joint: bool
) -> None:
    """In joint mode the gradient left after the elimination is the slope of the cost along a move of one pose
    with every depth going along as its own row of the system says."""
    config = replace(
        RefinementConfig(),
        prior_rotation_deg=0.5,
        prior_translation=0.02,
        smooth_rotation=0.1,
        smooth_translation=0.2,
        joint=joint,
    )
    noisy = with_noise(samples, 0.5)
    problem = PoseProblem(stream(noisy), scene.wTc, BOTH, config)
    rng = np.random.default_rng(5)
    changes = tuple(rng.normal(0.0, 0.02, len(sample.rays)) for sample in noisy) if joint else None
    state = PoseState(perturbed(scene.wTc, seed=2), changes)
    gradient = problem.evaluate(state).gradient
    terms = [problem._linearised(sample, number, state) for number, sample in enumerate(noisy)]
    h = 1e-7
    for frame in range(6):
        for axis in range(6):
            pose_way = np.zeros((6, 6))
            pose_way[frame, axis] = h
            depth_way = None
            if joint:
                depth_way = tuple(
                    -(t.depth_by_pose @ pose_way[t.frames].ravel()) / t.depth_information for t in terms
                )
            way = _Direction(pose_way.reshape(2, 3, 6), depth_way)
            costs = [problem.evaluate(problem.move(state, way, share)).cost for share in (1.0, -1.0)]
            numeric = (costs[0] - costs[1]) / (2 * h)
            assert gradient[frame, axis] == pytest.approx(numeric, rel=1e-3, abs=0.5)


def test_joint_step_solves_poses_and_depths_at_once(scene: Scene, samples: list[FrameSample]) -> None:
    """Of a small scene against the whole system with nothing eliminated."""
    noisy = with_noise([s for s in scene.samples(spacing=24) if s.i[1] == 0], 0.5)
    config = replace(LOOSE, joint=True)
    problem = PoseProblem(stream(noisy), scene.wTc, BOTH, config)
    state = PoseState(scene.wTc, None)
    way = problem.direction(state, problem.evaluate(state))
    poses_only = PoseProblem(stream(noisy), scene.wTc, BOTH, replace(config, joint=False))
    system = poses_only.evaluate(state)
    assert way.depth is not None
    offsets = 36 + np.cumsum([0] + [len(sample.rays) for sample in noisy])
    matrix, right = np.zeros((offsets[-1], offsets[-1])), np.zeros(offsets[-1])
    matrix[:36, :36], right[:36] = _dense(system), system.gradient.ravel()
    for number, sample in enumerate(noisy):
        terms, rows = problem._linearised(sample, number, state), np.arange(*offsets[number : number + 2])
        share = independent_share(sample)
        columns = np.concatenate([np.arange(6) + 6 * frame for frame in terms.frames])
        matrix[np.ix_(rows, columns)] = share * terms.depth_by_pose
        matrix[np.ix_(columns, rows)] = share * terms.depth_by_pose.T
        matrix[rows, rows] = share * terms.depth_information
        right[rows] = share * terms.depth_gradient
    expected = np.linalg.solve(matrix[6:, 6:], -right[6:])
    found = np.concatenate([way.poses.ravel()[6:], *way.depth])
    np.testing.assert_allclose(found, expected, atol=1e-8)


def _dense(system: FrameSystem) -> Array:
    """The matrix of a system of six frames, by what its step makes of unit gradients."""
    gradient, inverse = system.gradient, np.zeros((36, 36))
    for column in range(36):
        system.gradient = -np.eye(36)[column].reshape(6, 6)
        inverse[:, column] = system.step(np.ones(6, bool)).ravel()
    system.gradient = gradient
    return np.asarray(np.linalg.inv(inverse))


@pytest.mark.parametrize("joint", [False, True])
def test_unknown_flow_and_depth_count_for_nothing(
    scene: Scene, samples: list[FrameSample], joint: bool
) -> None:
    def poisoned(sample: FrameSample) -> FrameSample:
        depth, target = sample.inverse_depth.copy(), sample.target.copy()
        depth[::7] = np.nan
        target[sample.weight == 0.0] = np.nan
        return replace(sample, inverse_depth=depth, target=target)

    def left_out(sample: FrameSample) -> FrameSample:
        weight = sample.weight.copy()
        weight[:, ::7] = 0.0
        return replace(sample, weight=weight)

    start = perturbed(scene.wTc)
    config = replace(LOOSE, joint=joint)
    found, expected = (
        solve_poses(stream([change(s) for s in samples]), start, start, BOTH, config)
        for change in (poisoned, left_out)
    )
    # only the median depth, which the prior is measured in, has seen the pixels left out
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("joint", [False, True])
def test_cost_never_rises(scene: Scene, samples: list[FrameSample], joint: bool) -> None:
    """Even from far off and with much wrong flow."""
    far = perturbed(scene.wTc, degrees=3.0, length=0.2)
    config = replace(LOOSE, joint=joint)
    problem = PoseProblem(stream(with_outliers(samples, 0.3)), far, BOTH, config)
    state = PoseState(far, None)
    costs = [problem.evaluate(state).cost]
    for _ in range(8):
        state = descend(state, problem.evaluate, problem.direction, problem.move, 1)
        costs.append(problem.evaluate(state).cost)
    assert all(after <= before for before, after in zip(costs, costs[1:], strict=False))
    assert costs[-1] < 0.9 * costs[0]


def _by_definition(
    samples: Sequence[FrameSample], wTc: Array, prior: Array, depth: float, config: RefinementConfig
) -> Array:
    """Residuals whose half squared sum is the cost where no confidence has fallen, written down anew."""

    def absolute(residual: Array, floor: float) -> Array:
        """Signed square root of twice the rounded absolute value."""
        size = np.abs(residual)
        huber = np.where(size < floor, size**2 / (2 * floor), size - floor / 2)
        return np.asarray(np.sign(residual) * np.sqrt(2 * huber))

    found = []
    for sample in samples:
        share = independent_share(sample)
        for k, j in enumerate(sample.neighbours):
            use = sample.weight[k] > 0
            points = sample.rays[use] / sample.inverse_depth[use, None]
            there = transform_points(invert_pose(wTc[j]) @ wTc[sample.i], points)
            flow = project(there, INTRINSICS)[0] - sample.target[k][use]
            ratio = -np.log(sample.inverse_depth_there[k][use] * there[:, 2])
            scale = np.sqrt(share * sample.weight[k][use])
            found.append(
                (np.sqrt(config.flow_weight) * scale[:, None] * absolute(flow, FLOW_FLOOR_PX)).ravel()
            )
            found.append(np.sqrt(config.disparity_weight) * scale * absolute(ratio, RATIO_FLOOR))
    sigma_rotation = np.radians(config.prior_rotation_deg)
    sigma_translation = config.prior_translation * depth
    for camera in range(wTc.shape[0]):
        for time in range(wTc.shape[1]):
            turn = prior[camera, time, :3, :3].T @ wTc[camera, time, :3, :3]
            found.append(Rotation.from_matrix(turn).as_rotvec() / sigma_rotation)
            found.append((wTc[camera, time, :3, 3] - prior[camera, time, :3, 3]) / sigma_translation)
        for time in range(wTc.shape[1] - 1):
            turn = wTc[camera, time, :3, :3].T @ wTc[camera, time + 1, :3, :3]
            way = wTc[camera, time, :3, 3] - wTc[camera, time + 1, :3, 3]
            found.append(np.sqrt(config.smooth_rotation) / sigma_rotation * (turn - np.eye(3)).ravel())
            found.append(np.sqrt(config.smooth_translation) / sigma_translation * way)
    return np.concatenate(found)


def test_against_a_general_optimiser() -> None:
    """Same cost, same poses as ``scipy.optimize.least_squares`` with numerical derivatives."""
    scene = two_cameras(times=2)
    config = replace(
        RefinementConfig(),
        prior_rotation_deg=0.2,
        prior_translation=0.01,
        flow_lambda=1e6,
        disparity_lambda=1e6,
    )
    samples = with_noise(scene.samples(spacing=16), 0.3)
    start = perturbed(scene.wTc, degrees=0.1, length=0.01)
    medians = [1.0 / np.median(sample.inverse_depth) for sample in samples]
    depth = float(np.median(medians))

    def residuals(x: Array) -> Array:
        delta = np.concatenate([np.zeros(6), x]).reshape(2, 2, 6)
        return _by_definition(samples, retracted(start, delta), start, depth, config)

    problem = PoseProblem(stream(samples), start, BOTH, config)
    at_start = problem.evaluate(PoseState(start, None)).cost
    assert at_start == pytest.approx(0.5 * float(np.sum(residuals(np.zeros(18)) ** 2)))
    optimum = least_squares(residuals, np.zeros(18), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = solve_poses(stream(samples), start, start, BOTH, config, iterations=100)
    assert problem.evaluate(PoseState(found, None)).cost == pytest.approx(optimum.cost, rel=1e-6)
    expected = retracted(start, np.concatenate([np.zeros(6), optimum.x]).reshape(2, 2, 6))
    rotation, distance = worst_errors(found, expected)
    assert rotation < 2e-4 and distance < 2e-5


def test_joint_mode_recovers_poses_from_wrong_depths(scene: Scene) -> None:
    """Depths and poses wrong at once: with depth held fixed the error stays, solved together it goes."""

    def wavy(frame: Frame, depth: Array) -> Array:
        return np.asarray(depth * (1.0 + 0.05 * np.sin(17.0 * depth + frame[0] + 2 * frame[1])))

    config = replace(LOOSE, joint=True, disparity_weight=0.0, prior_rotation_deg=1.0, prior_translation=0.01)
    samples = scene.samples(depth_of=wavy)
    start = perturbed(scene.wTc, degrees=0.1, length=0.005)
    joint = solve_poses(stream(samples), start, start, BOTH, config, iterations=30)
    fixed = solve_poses(stream(samples), start, start, BOTH, replace(config, joint=False), iterations=30)
    truth = scene.wTc
    assert _shape_error(joint, truth) < 1e-3
    assert _shape_error(joint, truth) < 0.3 * _shape_error(fixed, truth)


def _shape_error(found: Array, truth: Array) -> float:
    """Largest distance of positions after the best scale about the first frame."""
    a = (found[..., :3, 3] - found[0, 0, :3, 3]).reshape(-1, 3)
    b = (truth[..., :3, 3] - truth[0, 0, :3, 3]).reshape(-1, 3)
    return float(np.linalg.norm(a * (a * b).sum() / (a * a).sum() - b, axis=1).max())


vectors = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6).map(np.array)


@given(vectors)
def test_retraction_is_the_exponential_of_the_paper(delta: Array) -> None:
    generator = np.zeros((4, 4))
    x, y, z = delta[:3]
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = delta[3:]
    wTc = two_cameras().wTc[1, 2]
    np.testing.assert_allclose(retracted(wTc, delta), wTc @ expm(generator), atol=1e-12)


@given(vectors, vectors)
def test_derivatives_of_the_pose_terms(first: Array, second: Array) -> None:
    wTa, wTb = (retracted(np.eye(4), delta) for delta in (first, second))
    _, by_prior = prior_terms(wTa, wTb)
    _, by_both = smoothness_terms(wTa, wTb)
    h = 1e-6
    for axis in range(6):
        step = h * np.eye(6)[axis]
        up, down = (prior_terms(wTa, retracted(wTb, s * step))[0] for s in (1, -1))
        np.testing.assert_allclose(by_prior[:, axis], (up - down) / (2 * h), atol=1e-6)
        up, down = (smoothness_terms(retracted(wTa, s * step), wTb)[0] for s in (1, -1))
        np.testing.assert_allclose(by_both[:, axis], (up - down) / (2 * h), atol=1e-6)
        up, down = (smoothness_terms(wTa, retracted(wTb, s * step))[0] for s in (1, -1))
        np.testing.assert_allclose(by_both[:, 6 + axis], (up - down) / (2 * h), atol=1e-6)


def test_smoothness_pulls_neighbouring_frames_together(scene: Scene, samples: list[FrameSample]) -> None:
    silent = [replace(sample, weight=np.zeros_like(sample.weight)) for sample in samples]
    config = replace(RefinementConfig(), smooth_rotation=1.0, smooth_translation=1.0)
    found = solve_poses(stream(silent), scene.wTc, scene.wTc, BOTH, config)

    def way(wTc: Array) -> float:
        return float(np.linalg.norm(np.diff(wTc[..., :3, 3], axis=1), axis=-1).sum())

    assert way(found) < 0.8 * way(scene.wTc)
