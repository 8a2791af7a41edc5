"""A keyframe's flow with the shape of its depth held fixed is the sum of the pairwise factors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.flow import flow_factor
from factors.keys import S, X
from factors.structureless import evaluate
from mvdyn_gtsam.tracking.fixed_shape import FixedShapeMeasurement, evaluate_fixed
from mvdyn_gtsam.tracking.keyframe_factor import keyframe_factor

POINTS, EDGES = 40, 3
FRAME, NEIGHBOURS = (0, 0), [(0, 1), (1, 0), (1, 1)]


@pytest.fixture(scope="module")
def measurement() -> FixedShapeMeasurement:
    rng = np.random.default_rng(3)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (POINTS, 2)), np.ones(POINTS)])
    shape = rng.normal(0.0, 0.3, POINTS)
    return FixedShapeMeasurement(
        rays=rays,
        initial_log_depth=shape,
        prior_log_depth=shape,
        prior_sigma=np.full(POINTS, 0.5),
        intrinsics_j=np.tile([200.0, 210.0, 80.0, 60.0], (EDGES, 1)),
        target=rng.uniform(0.0, 160.0, (EDGES, POINTS, 2)),
        weight=rng.uniform(0.1, 1.0, (EDGES, POINTS)),
        robust_px=40.0,
        noise_px=3.0,
        log_shape=shape,
    )


@pytest.fixture(scope="module")
def values() -> gtsam.Values:
    rng = np.random.default_rng(4)
    result = gtsam.Values()
    for frame in (FRAME, *NEIGHBOURS):
        result.insert(X(*frame), gtsam.Pose3.Expmap(rng.normal(0.0, 0.05, 6)))
    result.insert(S(*FRAME), 0.1)
    return result


def ordering() -> gtsam.Ordering:
    result = gtsam.Ordering()
    for frame in (FRAME, *NEIGHBOURS):
        result.push_back(X(*frame))
    result.push_back(S(*FRAME))
    return result


def test_it_is_the_sum_of_the_pairwise_factors(
    measurement: FixedShapeMeasurement, values: gtsam.Values
) -> None:
    own, pairwise = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    own.add(keyframe_factor(FRAME, NEIGHBOURS, {}, lambda: measurement))
    for pair, neighbour in zip(measurement.pairs, NEIGHBOURS, strict=True):
        pairwise.add(flow_factor(pair, X(*FRAME), X(*neighbour), S(*FRAME)))
    assert own.error(values) == pytest.approx(pairwise.error(values), rel=1e-9)
    information, vector = own.linearize(values).hessian(ordering())
    expected_information, expected_vector = pairwise.linearize(values).hessian(ordering())
    scale = np.abs(expected_information).max()
    np.testing.assert_allclose(information, expected_information, atol=1e-8 * scale)
    np.testing.assert_allclose(vector, expected_vector, atol=1e-8 * np.abs(expected_vector).max())


def test_free_depths_fit_better(measurement: FixedShapeMeasurement, values: gtsam.Values) -> None:
    """Were depths free here too, the ablation would compare like with like."""
    wTi = values.atPose3(X(*FRAME)).matrix()
    wTj = np.stack([values.atPose3(X(*frame)).matrix() for frame in NEIGHBOURS])
    free, log_depth = evaluate(measurement, wTi, wTj, 0.1)
    assert np.abs(log_depth - measurement.log_shape - 0.1).max() > 0.05
    assert free < 0.99 * evaluate_fixed(measurement, wTi, wTj, 0.1)


def test_a_known_neighbour_is_a_constant(measurement: FixedShapeMeasurement, values: gtsam.Values) -> None:
    fixed = {frame: values.atPose3(X(*frame)).matrix() for frame in NEIGHBOURS[:1]}
    factor = keyframe_factor(FRAME, NEIGHBOURS, fixed, lambda: measurement)
    whole = keyframe_factor(FRAME, NEIGHBOURS, {}, lambda: measurement)
    assert X(*NEIGHBOURS[0]) not in list(factor.keys())
    assert factor.error(values) == pytest.approx(whole.error(values), rel=1e-12)
