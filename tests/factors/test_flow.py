from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.flow import FlowMeasurement, evaluate_flow, flow_factor, linearize_flow
from factors.keys import S, X
from factors.priors import pose_prior, scale_prior
from factors.projection import reproject_with_jacobians
from factors.robust import LossName
from tests.factors.synthetic import Scene, make_scene, numerical_jacobian, perturbed

KEY_I, KEY_J, KEY_S = X(0, 0), X(1, 0), S(0, 0)


def _measure(scene: Scene, **changes: object) -> FlowMeasurement:
    fields: dict[str, object] = {
        "rays": scene.rays,
        "log_depth": scene.log_depth,
        "intrinsics_j": scene.intrinsics_j[0],
        "target": scene.pixels[0],
        "weight": np.ones(len(scene.rays)),
    }
    return FlowMeasurement(**(fields | changes))  # type: ignore[arg-type]


def _values(wTi: gtsam.Pose3, wTj: gtsam.Pose3, log_scale: float) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(KEY_I, wTi)
    values.insert(KEY_J, wTj)
    values.insert(KEY_S, log_scale)
    return values


def test_cost_is_zero_at_the_truth_and_known_next_to_it() -> None:
    scene = make_scene(np.random.default_rng(0), 30, 1)
    wTi, wTj = scene.wTi.matrix(), scene.wTj[0].matrix()
    assert evaluate_flow(_measure(scene), wTi, wTj, 0.0) < 1e-20
    shifted = _measure(scene, target=scene.pixels[0] + [3.0, 4.0], robust_px=2.0, noise_px=0.5)
    expected = 30 / 0.5**2 * (2.0**2 / 2.0) * np.log1p(25.0 / 4.0)
    np.testing.assert_allclose(evaluate_flow(shifted, wTi, wTj, 0.0), expected)
    np.testing.assert_allclose(evaluate_flow(_measure(scene), wTi, wTj, 0.1) > 1.0, True)


@pytest.mark.parametrize("seed", range(3))
def test_compressed_rows_have_the_gram_of_all_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = make_scene(rng, 40, 1)
    weight = rng.uniform(size=40)
    wTi, wTj = (pose.matrix() for pose in perturbed(rng, scene.poses, 0.02))
    measurement = _measure(scene, weight=weight, noise_px=0.5, loss="none")
    reprojection, jacobians = reproject_with_jacobians(
        scene.rays, scene.log_depth + 0.1, wTi, wTj[None], scene.intrinsics_j
    )
    root_weight = np.repeat(np.sqrt(weight) / 0.5, 2)[:, None]
    rows = root_weight * np.column_stack(
        [
            jacobians.wTi[0].reshape(80, 6),
            jacobians.wTj[0].reshape(80, 6),
            jacobians.log_depth[0].ravel(),
            (reprojection.pixels[0] - scene.pixels[0]).ravel(),
        ]
    )
    compressed = linearize_flow(measurement, wTi, wTj, 0.1)
    assert compressed.shape == (8, 14)
    expected = rows.T @ rows
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(compressed.T @ compressed - expected) / scale).max() < 1e-10


@pytest.mark.parametrize("loss", ["cauchy", "huber", "none"])
def test_gradient_is_that_of_the_robust_cost(loss: LossName) -> None:
    rng = np.random.default_rng(3)
    scene = make_scene(rng, 40, 1)
    wTi, wTj = perturbed(rng, scene.poses, 0.01)
    measurement = _measure(scene, weight=rng.uniform(size=40), loss=loss, robust_px=2.0)

    def cost(delta: np.ndarray) -> np.ndarray:
        moved_i, moved_j = wTi.retract(delta[:6]).matrix(), wTj.retract(delta[6:12]).matrix()
        return np.array(evaluate_flow(measurement, moved_i, moved_j, 0.1 + delta[12]))

    rows = linearize_flow(measurement, wTi.matrix(), wTj.matrix(), 0.1)
    gradient = rows[:, :-1].T @ rows[:, -1]
    expected = numerical_jacobian(cost, 13)[0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_hessian_is_that_of_native_projection_factors() -> None:
    rng = np.random.default_rng(6)
    scene = make_scene(rng, 25, 1)
    wTj = perturbed(rng, scene.wTj, 0.005)[0]
    w_points = scene.wTi.transformFrom((scene.rays * np.exp(scene.log_depth)[:, None]).T).T
    fx, fy, cx, cy = scene.intrinsics_j[0]
    calibration = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    # gtsam whitens before it robustifies; unit noise makes both the same
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.5), gtsam.noiseModel.Unit.Create(2)
    )
    values = _values(scene.wTi, wTj, 0.0)
    expected, cost = np.zeros((6, 6)), 0.0
    for k, point in enumerate(w_points):
        values.insert(k, point)
        native = gtsam.GenericProjectionFactorCal3_S2(scene.pixels[0, k], noise, KEY_J, k, calibration)
        by_pose = native.linearize(values).jacobian()[0]
        by_pose = by_pose[:, 3:] if native.linearize(values).keys()[0] == k else by_pose[:, :6]
        expected += by_pose.T @ by_pose
        cost += native.error(values)
    factor = flow_factor(_measure(scene, robust_px=1.5), KEY_I, KEY_J, KEY_S)
    jacobian = factor.linearize(values).jacobian()[0]
    actual = jacobian[:, 6:12].T @ jacobian[:, 6:12]
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(factor.error(values), cost, rtol=1e-9)


def test_error_agrees_with_and_without_jacobians() -> None:
    rng = np.random.default_rng(8)
    scene = make_scene(rng, 30, 1)
    factor = flow_factor(_measure(scene), KEY_I, KEY_J, KEY_S)
    wTi, wTj = perturbed(rng, scene.poses, 0.02)
    values = _values(wTi, wTj, 0.2)
    rhs = factor.linearize(values).jacobian()[1]
    np.testing.assert_allclose(0.5 * rhs @ rhs, factor.error(values), rtol=1e-10)
    np.testing.assert_allclose(factor.unwhitenedError(values), -rhs, rtol=1e-10)


def test_optimisation_recovers_pose_and_scale() -> None:
    rng = np.random.default_rng(9)
    scene = make_scene(rng, 200, 1)
    # the stored depth is half the true one, and the translation is known only through the scale of frame j's
    # motion
    graph = gtsam.NonlinearFactorGraph()
    graph.add(flow_factor(_measure(scene, log_depth=scene.log_depth - 0.7), KEY_I, KEY_J, KEY_S))
    graph.add(pose_prior(KEY_I, scene.wTi.matrix(), 1e-4, 1e-4))
    graph.add(scale_prior(KEY_S, 0.7, 1e-4))
    start = _values(scene.wTi, perturbed(rng, scene.wTj, 0.03)[0], 0.6)
    result = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    np.testing.assert_allclose(result.atPose3(KEY_J).matrix(), scene.wTj[0].matrix(), atol=1e-6)
    np.testing.assert_allclose(result.atDouble(KEY_S), 0.7, atol=1e-6)


def test_missing_measurement_changes_nothing_and_arrays_are_copies() -> None:
    rng = np.random.default_rng(10)
    scene = make_scene(rng, 20, 1)
    wTi, wTj = (pose.matrix() for pose in perturbed(rng, scene.poses, 0.02))
    weight, target, log_depth = np.ones(20), scene.pixels[0].copy(), scene.log_depth.copy()
    weight[:5] = 0.0
    expected = evaluate_flow(_measure(scene, weight=weight), wTi, wTj, 0.0)
    nan_weight, nan_target, nan_depth = np.ones(20), target.copy(), log_depth.copy()
    nan_weight[0], nan_target[1:3, 0], nan_depth[3:5] = np.nan, np.nan, np.nan
    measurement = _measure(scene, weight=nan_weight, target=nan_target, log_depth=nan_depth)
    nan_target += 100.0
    assert evaluate_flow(measurement, wTi, wTj, 0.0) == expected
    with pytest.raises(ValueError, match="read-only"):
        measurement.target[0] = 0.0


def test_wrong_shapes_are_refused() -> None:
    scene = make_scene(np.random.default_rng(0), 4, 1)
    with pytest.raises(ValueError, match=r"target must have shape \(4, 2\)"):
        _measure(scene, target=scene.pixels)
    with pytest.raises(ValueError, match="negative"):
        _measure(scene, weight=-np.ones(4))
