from __future__ import annotations

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from factors.keys import S, X
from factors.priors import pose_prior, scale_prior
from factors.projection import reproject, reproject_with_jacobians
from factors.robust import LossName
from factors.structureless import (
    LOG_DEPTH_RANGE,
    StructurelessMeasurement,
    edge_residuals,
    evaluate,
    linearize,
    solve_log_depths,
    structureless_flow_factor,
)
from tests.factors.synthetic import Scene, make_scene, matrices, measure, numerical_jacobian, perturbed

Array = npt.NDArray[np.float64]
CONVERGED = 200  # steps: enough to solve the log depths to rounding


def _noisy(scene: Scene, rng: np.random.Generator, **changes: object) -> StructurelessMeasurement:
    target = scene.pixels + rng.normal(size=scene.pixels.shape)
    target[rng.random(target.shape[:2]) < 0.1] += 8.0
    start = scene.log_depth + 0.1 * rng.normal(size=len(scene.log_depth))
    fields: dict[str, object] = {"target": target, "initial_log_depth": start, "steps": CONVERGED}
    return measure(scene, **(fields | changes))


def _keys(edges: int) -> tuple[int, list[int], int]:
    return X(0, 0), [X(0, 1 + edge) for edge in range(edges)], S(0, 0)


def _values(poses: list[gtsam.Pose3], log_scale: float) -> gtsam.Values:
    values = gtsam.Values()
    for time, pose in enumerate(poses):
        values.insert(X(0, time), pose)
    values.insert(S(0, 0), log_scale)
    return values


def _factor(measurement: StructurelessMeasurement) -> gtsam.CustomFactor:
    return structureless_flow_factor(measurement, *_keys(len(measurement.weight)))


# --- value


def test_cost_is_zero_at_the_truth_and_depths_are_found() -> None:
    rng = np.random.default_rng(0)
    scene = make_scene(rng, 50, 3)
    start = scene.log_depth + rng.uniform(-0.3, 0.3, 50)
    measurement = measure(scene, initial_log_depth=start, prior_sigma=np.full(50, np.inf), steps=15)
    cost, log_depth = evaluate(measurement, scene.wTi.matrix(), matrices(scene.wTj), 0.0)
    assert cost < 1e-12
    np.testing.assert_allclose(log_depth, scene.log_depth, atol=1e-7)


def test_cost_is_the_sum_of_robust_and_prior_terms() -> None:
    rng = np.random.default_rng(1)
    scene = make_scene(rng, 30, 2)
    weight = rng.uniform(size=(2, 30))
    measurement = _noisy(scene, rng, weight=weight, noise_px=0.5, robust_px=1.5)
    wTi, wTj = scene.wTi.matrix(), matrices(scene.wTj)
    cost, log_depth = evaluate(measurement, wTi, wTj, 0.2)
    pixels = reproject(scene.rays, log_depth, wTi, wTj, scene.intrinsics_j).pixels
    squared = np.sum((pixels - measurement.target) ** 2, axis=2)
    expected = np.sum(weight / 0.25 * (1.5**2 / 2.0) * np.log1p(squared / 1.5**2))
    expected += 0.5 * np.sum(((log_depth - 0.2 - scene.log_depth) / 0.3) ** 2)
    np.testing.assert_allclose(cost, expected, rtol=1e-12)


def test_solved_depths_are_a_minimum_with_the_stated_information() -> None:
    rng = np.random.default_rng(2)
    scene = make_scene(rng, 40, 3)
    measurement = _noisy(scene, rng, loss="none")
    wTi, wTj = scene.wTi.matrix(), matrices(scene.wTj)
    log_depth, information = solve_log_depths(measurement, wTi, wTj, 0.0)
    cost = evaluate(measurement, wTi, wTj, 0.0)[0]
    for offset in (-1e-3, 1e-3):
        moved = replace(measurement, initial_log_depth=log_depth + offset, steps=0)
        # the rise of the cost is half the information times the square of the step, residual curvature aside
        rise = evaluate(moved, wTi, wTj, 0.0)[0] - cost
        np.testing.assert_allclose(rise, 0.5 * information.sum() * offset**2, rtol=0.05)


def test_default_steps_reach_the_converged_cost() -> None:
    rng = np.random.default_rng(3)
    scene = make_scene(rng, 300, 6)
    wTi, wTj = scene.wTi.matrix(), matrices(scene.wTj)
    few = _noisy(scene, np.random.default_rng(4), steps=StructurelessMeasurement.steps)
    many = _noisy(scene, np.random.default_rng(4))
    cost, converged = evaluate(few, wTi, wTj, 0.0)[0], evaluate(many, wTi, wTj, 0.0)[0]
    # observed 1.4e-3: points whose noisy measurements disagree by more than the robust scale are slow
    assert abs(cost - converged) < 5e-3 * converged


# --- linearisation


@pytest.mark.parametrize("loss", ["cauchy", "huber", "none"])
@pytest.mark.parametrize("seed", range(2))
def test_gradient_is_that_of_the_robust_cost(loss: LossName, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = make_scene(rng, 60, 3)
    measurement = _noisy(scene, rng, loss=loss, weight=rng.uniform(size=(3, 60)), robust_px=2.0)
    poses = perturbed(rng, scene.poses, 0.005)

    def cost(delta: Array) -> Array:
        moved = matrices([pose.retract(delta[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)])
        return np.array(evaluate(measurement, moved[0], moved[1:], 0.05 + delta[-1])[0])

    rows = linearize(measurement, poses[0].matrix(), matrices(poses[1:]), 0.05)
    assert rows.shape == (6 * 3 + 2, 6 * 4 + 2)
    gradient = rows[:, :-1].T @ rows[:, -1]
    expected = numerical_jacobian(cost, 25)[0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_many_edges_have_the_gradient_too() -> None:
    """Above ten edges the Gram matrix is summed in pieces."""
    rng = np.random.default_rng(23)
    scene = make_scene(rng, 90, 12)
    measurement = _noisy(scene, rng, loss="none", steps=20)
    poses = perturbed(rng, scene.poses, 0.005)
    direction = rng.normal(size=6 * 13 + 1)

    def cost(length: Array) -> Array:
        delta = length[0] * direction
        moved = matrices([pose.retract(delta[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)])
        return np.array(evaluate(measurement, moved[0], moved[1:], delta[-1])[0])

    rows = linearize(measurement, poses[0].matrix(), matrices(poses[1:]), 0.0)
    gradient = rows[:, :-1].T @ rows[:, -1]
    np.testing.assert_allclose(gradient @ direction, numerical_jacobian(cost, 1, step=1e-6)[0, 0], rtol=1e-5)


def _flow_error(
    ray: Array,
    intrinsics: Array,
    target: Array,
    this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    key_i, key_j, key_depth = this.keys()
    reprojection, derivatives = reproject_with_jacobians(
        ray[None],
        np.array([values.atDouble(key_depth)]),
        values.atPose3(key_i).matrix(),
        values.atPose3(key_j).matrix()[None],
        intrinsics[None],
    )
    if jacobians is not None:
        jacobians[0] = np.asfortranarray(derivatives.wTi[0, 0])
        jacobians[1] = np.asfortranarray(derivatives.wTj[0, 0])
        jacobians[2] = np.asfortranarray(derivatives.log_depth[0, 0][:, None])
    return reprojection.pixels[0, 0] - target


def _depth_prior_error(
    mean: float, this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
) -> Array:
    key_depth, key_scale = this.keys()
    if jacobians is not None:
        jacobians[0], jacobians[1] = np.eye(1, order="F"), -np.eye(1, order="F")
    return np.array([values.atDouble(key_depth) - values.atDouble(key_scale) - mean])


def _explicit_graph(measurement: StructurelessMeasurement, robust: bool) -> gtsam.NonlinearFactorGraph:
    """The same problem with every log depth a variable, gtsam's own robust noise models and one factor a
    pixel."""
    graph = gtsam.NonlinearFactorGraph()
    key_i, keys_j, key_scale = _keys(len(measurement.weight))
    for k, ray in enumerate(measurement.rays):
        key_depth = gtsam.symbol("d", k)
        sigma = float(measurement.prior_sigma[k])
        graph.add(
            gtsam.CustomFactor(
                gtsam.noiseModel.Isotropic.Sigma(1, sigma),
                [key_depth, key_scale],
                partial(_depth_prior_error, measurement.prior_log_depth[k]),
            )
        )
        for edge, key_j in enumerate(keys_j):
            if measurement.weight[edge, k] == 0.0:
                continue
            noise: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Precision(
                2, float(measurement.weight[edge, k])
            )
            if robust:
                cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(measurement.robust_px)
                noise = gtsam.noiseModel.Robust.Create(cauchy, noise)
            error = partial(
                _flow_error, ray, measurement.intrinsics_j[edge], np.array(measurement.target[edge, k])
            )
            graph.add(gtsam.CustomFactor(noise, [key_i, key_j, key_depth], error))
    return graph


@pytest.mark.parametrize("robust", [False, True])
def test_same_as_eliminating_explicit_depths(robust: bool) -> None:
    rng = np.random.default_rng(20)
    scene = make_scene(rng, 25, 3)
    # gtsam robustifies the whitened residual, so weights other than 0 and 1 are compared without robustness
    weight = rng.uniform(size=(3, 25))
    weight = np.where(weight < 0.2, 0.0, 1.0 if robust else weight)
    measurement = _noisy(scene, rng, weight=weight, loss="cauchy" if robust else "none", robust_px=1.5)
    poses = perturbed(rng, scene.poses, 0.01)
    wTi, wTj = poses[0].matrix(), matrices(poses[1:])
    values = _values(poses, 0.1)
    factor = _factor(measurement)
    cost, log_depth = evaluate(measurement, wTi, wTj, 0.1)
    explicit_values = _values(poses, 0.1)
    for k, value in enumerate(log_depth):
        explicit_values.insert(gtsam.symbol("d", k), value)
    graph = _explicit_graph(measurement, robust)

    np.testing.assert_allclose(factor.error(values), cost, rtol=1e-12)
    np.testing.assert_allclose(graph.error(explicit_values), cost, rtol=1e-9)

    key_i, keys_j, key_scale = _keys(3)
    ordering = gtsam.Ordering()
    for key in [*(gtsam.symbol("d", k) for k in range(25)), key_i, *keys_j, key_scale]:
        ordering.push_back(key)
    hessian, information_vector = graph.linearize(explicit_values).hessian(ordering)
    gain = np.linalg.solve(hessian[:25, :25], np.column_stack([hessian[:25, 25:], information_vector[:25]]))
    expected = hessian[25:, 25:] - hessian[25:, :25] @ gain[:, :-1]
    expected_vector = information_vector[25:] - hessian[25:, :25] @ gain[:, -1]

    jacobian, rhs = factor.linearize(values).jacobian()
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(jacobian.T @ jacobian - expected) / scale).max() < 1e-9
    np.testing.assert_allclose(
        jacobian.T @ rhs, expected_vector, rtol=1e-8, atol=1e-9 * np.abs(expected_vector).max()
    )


def test_error_agrees_with_and_without_jacobians() -> None:
    rng = np.random.default_rng(21)
    scene = make_scene(rng, 100, 4)
    factor = _factor(_noisy(scene, rng, steps=4))
    values = _values(perturbed(rng, scene.poses, 0.02), 0.1)
    rhs = factor.linearize(values).jacobian()[1]
    np.testing.assert_allclose(0.5 * rhs @ rhs, factor.error(values), rtol=1e-10)
    np.testing.assert_allclose(factor.unwhitenedError(values), -rhs, rtol=1e-10)


@pytest.mark.parametrize("steps", [2, 4])
def test_depths_solved_before_give_the_same_rows(steps: int) -> None:
    rng = np.random.default_rng(3)
    scene = make_scene(rng, 60, 3)
    measurement = _noisy(scene, rng, steps=steps)
    poses = matrices(perturbed(rng, scene.poses, 0.02))
    _, solved = evaluate(measurement, poses[0], poses[1:], 0.1)
    np.testing.assert_array_equal(
        linearize(measurement, poses[0], poses[1:], 0.1, solved),
        linearize(measurement, poses[0], poses[1:], 0.1),
    )


def test_fixed_scale_leaves_out_its_column() -> None:
    rng = np.random.default_rng(22)
    scene = make_scene(rng, 40, 2)
    measurement = _noisy(scene, rng)
    values = _values(perturbed(rng, scene.poses, 0.01), 0.1)
    key_i, keys_j, _ = _keys(2)
    fixed = structureless_flow_factor(measurement, key_i, keys_j, None, log_scale=0.1)
    jacobian, rhs = fixed.linearize(values).jacobian()
    full_jacobian, full_rhs = _factor(measurement).linearize(values).jacobian()
    np.testing.assert_array_equal(jacobian, full_jacobian[:, :-1])
    np.testing.assert_array_equal(rhs, full_rhs)


# --- optimisation


def _ring(rng: np.random.Generator) -> tuple[gtsam.NonlinearFactorGraph, list[gtsam.Pose3], list[float]]:
    """Four keyframes, each measured against the three others, noise-free; depths start 10 % off, scales 20
    %."""
    base = make_scene(rng, 4, 3)
    poses = base.poses
    intrinsics = np.vstack([base.intrinsics_j, base.intrinsics_j[:1]])
    graph = gtsam.NonlinearFactorGraph()
    scales = []
    for i, wTi in enumerate(poses):
        others = [j for j in range(4) if j != i]
        rays = np.column_stack([rng.uniform(-0.6, 0.6, (150, 2)), np.ones(150)])
        log_depth = np.log(rng.uniform(2.0, 6.0, 150))
        pixels = reproject(
            rays, log_depth, wTi.matrix(), matrices([poses[j] for j in others]), intrinsics[others]
        ).pixels
        scales.append(float(rng.uniform(-0.2, 0.2)))
        measurement = StructurelessMeasurement(
            rays=rays,
            initial_log_depth=log_depth + 0.1 * rng.normal(size=150),
            prior_log_depth=log_depth - scales[-1],
            prior_sigma=np.full(150, 0.3),
            intrinsics_j=intrinsics[others],
            target=pixels,
            weight=np.ones((3, 150)),
        )
        graph.add(structureless_flow_factor(measurement, X(0, i), [X(0, j) for j in others], S(0, i)))
    graph.add(pose_prior(X(0, 0), poses[0].matrix(), 1e-4, 1e-4))
    graph.add(scale_prior(S(0, 0), scales[0], 1e-3))
    return graph, poses, scales


def _start(rng: np.random.Generator, poses: list[gtsam.Pose3]) -> gtsam.Values:
    values = gtsam.Values()
    for time, pose in enumerate([poses[0], *perturbed(rng, poses[1:], 0.03)]):
        values.insert(X(0, time), pose)
        values.insert(S(0, time), 0.0)
    return values


def _assert_recovered(result: gtsam.Values, poses: list[gtsam.Pose3], scales: list[float]) -> None:
    for time, (pose, scale) in enumerate(zip(poses, scales, strict=True)):
        np.testing.assert_allclose(result.atPose3(X(0, time)).matrix(), pose.matrix(), atol=1e-5)
        np.testing.assert_allclose(result.atDouble(S(0, time)), scale, atol=1e-5)


@pytest.mark.parametrize("solver", ["MULTIFRONTAL_QR", "SEQUENTIAL_CHOLESKY"])
def test_levenberg_marquardt_recovers_the_poses(solver: str) -> None:
    rng = np.random.default_rng(30)
    graph, poses, scales = _ring(rng)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType(solver)
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    result = gtsam.LevenbergMarquardtOptimizer(graph, _start(rng, poses), parameters).optimize()
    _assert_recovered(result, poses, scales)


def test_isam2_recovers_the_poses() -> None:
    rng = np.random.default_rng(31)
    graph, poses, scales = _ring(rng)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.setRelinearizeThreshold(1e-9)
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, _start(rng, poses))
    for _ in range(25):
        isam.update()
    _assert_recovered(isam.calculateEstimate(), poses, scales)


def test_isam2_takes_a_replaced_factor() -> None:
    """A keyframe that gains edges: its factor is removed and a larger one added."""
    rng = np.random.default_rng(32)
    graph, poses, scales = _ring(rng)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.setRelinearizeThreshold(1e-9)
    isam = gtsam.ISAM2(parameters)
    scene = make_scene(rng, 60, 3)
    wrong = structureless_flow_factor(measure(scene), X(0, 0), [X(0, 1), X(0, 2), X(0, 3)], S(0, 0))
    first = gtsam.NonlinearFactorGraph()
    first.add(wrong)
    for index in range(1, graph.size()):
        first.add(graph.at(index))
    result = isam.update(first, _start(rng, poses))
    replacement = gtsam.NonlinearFactorGraph()
    replacement.add(graph.at(0))
    isam.update(replacement, gtsam.Values(), [result.getNewFactorsIndices()[0]])
    for _ in range(40):
        isam.update()
    _assert_recovered(isam.calculateEstimate(), poses, scales)


# --- bad and missing data


def test_missing_measurements_change_nothing() -> None:
    rng = np.random.default_rng(40)
    scene = make_scene(rng, 30, 2)
    weight, target = np.ones((2, 30)), scene.pixels.copy()
    weight[0, :7], target[0, :7] = 0.0, 1e6
    nan_weight, nan_target = np.ones((2, 30)), scene.pixels.copy()
    nan_weight[0, :3], nan_target[0, 3:7, 1] = np.nan, np.nan
    poses = perturbed(rng, scene.poses, 0.01)
    wTi, wTj = poses[0].matrix(), matrices(poses[1:])
    expected = linearize(measure(scene, weight=weight, target=target), wTi, wTj, 0.0)
    actual = linearize(measure(scene, weight=nan_weight, target=nan_target), wTi, wTj, 0.0)
    np.testing.assert_array_equal(actual, expected)


def test_points_without_prior_or_measurement_are_harmless() -> None:
    rng = np.random.default_rng(41)
    scene = make_scene(rng, 30, 2)
    weight, sigma, prior = np.ones((2, 30)), np.full(30, 0.3), scene.log_depth.copy()
    # the last two have a prior, which says nothing once their depth is eliminated
    weight[:, :7], sigma[:3], prior[3:5] = 0.0, np.inf, np.nan
    measurement = measure(scene, weight=weight, prior_sigma=sigma, prior_log_depth=prior)
    poses = perturbed(rng, scene.poses, 0.01)
    wTi, wTj = poses[0].matrix(), matrices(poses[1:])
    log_depth, information = solve_log_depths(measurement, wTi, wTj, 0.0)
    np.testing.assert_array_equal(log_depth[:5], scene.log_depth[:5])
    assert not information[:5].any() and (information[5:] > 0.0).all()
    keep = slice(7, None)
    smaller = measure(
        Scene(
            scene.rays[keep],
            scene.log_depth[keep],
            scene.wTi,
            scene.wTj,
            scene.intrinsics_j,
            scene.pixels[:, keep],
        )
    )
    expected, actual = linearize(smaller, wTi, wTj, 0.0), linearize(measurement, wTi, wTj, 0.0)
    np.testing.assert_allclose(
        actual.T @ actual, expected.T @ expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max() ** 2
    )


def test_an_edge_without_any_measurement_gives_zero_columns() -> None:
    scene = make_scene(np.random.default_rng(42), 30, 3)
    weight = np.ones((3, 30))
    weight[1] = 0.0
    rows = linearize(measure(scene, weight=weight), scene.wTi.matrix(), matrices(scene.wTj), 0.1)
    assert np.isfinite(rows).all()
    assert not rows[:, 12:18].any()
    assert rows[:, 6:12].any()


def test_points_behind_a_camera_cost_and_do_not_pull() -> None:
    rng = np.random.default_rng(43)
    scene = make_scene(rng, 30, 2)
    measurement = measure(scene)
    behind = scene.wTj[0].compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, np.pi, 0.0), np.zeros(3)))
    wTj = matrices([behind, scene.wTj[1]])
    rows = linearize(measurement, scene.wTi.matrix(), wTj, 0.0)
    assert np.isfinite(rows).all()
    assert not rows[:, 6:12].any()
    assert 0.5 * rows[-1, -1] ** 2 > 30 * 5.0
    residuals = edge_residuals(measurement, scene.wTi.matrix(), wTj, 0.0)
    assert residuals.inlier_fraction.tolist() == [0.0, 1.0]
    assert np.isinf(residuals.norms_px[0]).all()


def test_depths_that_want_to_leave_are_held_at_the_limit_and_count_as_known() -> None:
    rng = np.random.default_rng(44)
    scene = make_scene(rng, 30, 2)
    start = scene.log_depth.copy()
    start[:10] += LOG_DEPTH_RANGE + 0.5
    sigma = np.where(np.arange(30) < 10, 0.01, 0.3)
    wide = measure(scene, initial_log_depth=start, prior_sigma=sigma, loss="none", steps=30)
    wTj = matrices(scene.wTj)
    log_depth, _ = solve_log_depths(wide, scene.wTi.matrix(), wTj, 0.0)
    np.testing.assert_allclose(log_depth[:10], start[:10] - LOG_DEPTH_RANGE)

    def cost(delta: Array) -> Array:
        return np.array(evaluate(wide, scene.wTi.retract(delta[:6]).matrix(), wTj, delta[6])[0])

    rows = linearize(wide, scene.wTi.matrix(), wTj, 0.0)
    gradient = (rows[:, :-1].T @ rows[:, -1])[[0, 1, 2, 3, 4, 5, -1]]
    expected = numerical_jacobian(cost, 7)[0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_edge_residuals_tell_the_bad_edge() -> None:
    rng = np.random.default_rng(45)
    scene = make_scene(rng, 50, 3)
    target, weight = scene.pixels.copy(), np.ones((3, 50))
    target[1] += [6.0, 0.0]
    weight[2, 10:] = 0.0
    residuals = edge_residuals(
        measure(scene, target=target, weight=weight, prior_sigma=np.full(50, 1e-3)),
        scene.wTi.matrix(),
        matrices(scene.wTj),
        0.0,
    )
    assert residuals.count.tolist() == [50, 50, 10]
    np.testing.assert_allclose(residuals.rms_px, [0.0, 6.0, 0.0], atol=0.3)
    np.testing.assert_allclose(residuals.median_px, [0.0, 6.0, 0.0], atol=0.3)
    assert residuals.inlier_fraction.tolist() == [1.0, 0.0, 1.0]
    assert np.isnan(residuals.norms_px[2, 10:]).all()


def test_later_changes_to_the_arrays_do_not_reach_the_factor() -> None:
    rng = np.random.default_rng(46)
    scene = make_scene(rng, 30, 2)
    names = (
        "rays",
        "initial_log_depth",
        "prior_log_depth",
        "prior_sigma",
        "intrinsics_j",
        "target",
        "weight",
    )
    arrays = {name: np.array(getattr(measure(scene), name)) for name in names}
    measurement = StructurelessMeasurement(**arrays)  # type: ignore[arg-type]
    factor = _factor(measurement)
    values = _values(perturbed(rng, scene.poses, 0.01), 0.1)
    before = factor.error(values)
    for name in names:
        arrays[name] += 0.5
        with pytest.raises(ValueError, match="read-only"):
            getattr(measurement, name)[...] = 0.0
    assert factor.error(values) == before > 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight": np.ones((2, 9))}, r"weight must have shape \(2, 10\)"),
        ({"weight": -np.ones((2, 10))}, "negative"),
        ({"initial_log_depth": np.full(10, np.nan)}, "initial_log_depth must be finite"),
        ({"prior_sigma": np.zeros(10)}, "sigma must be positive"),
        ({"noise_px": 0.0}, "noise_px"),
        ({"intrinsics_j": np.ones((1, 4))}, "intrinsics_j must have shape"),
        ({"intrinsics_j": np.full((2, 4), np.nan)}, "intrinsics_j must be finite"),
        ({"rays": np.full((10, 3), np.inf)}, "rays must be finite"),
    ],
)
def test_bad_measurements_are_refused(change: dict[str, object], message: str) -> None:
    scene = make_scene(np.random.default_rng(47), 10, 2)
    with pytest.raises(ValueError, match=message):
        measure(scene, **change)


def test_bad_keys_are_refused() -> None:
    measurement = measure(make_scene(np.random.default_rng(48), 10, 2))
    with pytest.raises(ValueError, match="2 edges but 1"):
        structureless_flow_factor(measurement, X(0, 0), [X(0, 1)], S(0, 0))
    with pytest.raises(ValueError, match="must be different"):
        structureless_flow_factor(measurement, X(0, 0), [X(0, 1), X(0, 1)], S(0, 0))
