"""Levenberg-Marquardt on one sparse matrix against GTSAM's own."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.keys import X
from mvdyn_gtsam.tracking import polish
from mvdyn_gtsam.tracking.normal_equations import NormalEquations, descend
from tests.tracking.synthetic_scene import two_cameras
from tests.tracking.test_tracker import track


def chain() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Ten poses held together by odometry, a loop and the first pose; far from where they belong."""
    random = np.random.default_rng(0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph.add(gtsam.PriorFactorPose3(X(0, 0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    step = gtsam.Pose3.Expmap(np.array([0.1, 0.3, -0.1, 1.0, 0.2, 0.0]))
    for time in range(9):
        graph.add(gtsam.BetweenFactorPose3(X(0, time), X(0, time + 1), step, noise))
    graph.add(gtsam.BetweenFactorPose3(X(0, 0), X(0, 9), gtsam.Pose3(), noise))
    for time in range(10):
        values.insert(X(0, time), gtsam.Pose3.Expmap(0.5 * random.normal(size=6)))
    return graph, values


def test_undamped_step_is_that_of_gtsam() -> None:
    graph, values = chain()
    found = NormalEquations.of(graph, values, list(values.keys())).step(0.0)
    true = graph.linearize(values).optimize()
    for key in values.keys():
        np.testing.assert_allclose(found.at(key), true.at(key), atol=1e-6)


def test_it_comes_to_the_minimum_that_gtsam_finds() -> None:
    graph, values = chain()
    true = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    start = graph.error(values)
    reached, error = descend(graph, values, start, 1e-6, 100, 1e-9)
    assert graph.error(true) < 0.1 * start
    np.testing.assert_allclose(error, graph.error(reached), rtol=1e-12)
    np.testing.assert_allclose(error, graph.error(true), rtol=1e-4)


def test_a_polish_of_many_keyframes_ends_where_one_of_few_does(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, _, _ = track(two_cameras(), ((0, 1),))
    state = tracker.state
    graph, values = polish.build_graph(state.keyframes, state.views, state.tracking, state.priors)
    random = np.random.default_rng(0)
    for keyframe in state.keyframes[1:]:
        key = X(*keyframe.frame)
        values.update(key, values.atPose3(key).retract(1e-3 * random.normal(size=6)))
    before = graph.error(values)
    _, few, _ = polish.minimise(graph, values, before, state.tracking)
    monkeypatch.setattr(polish, "LARGE", 0)
    _, many, _ = polish.minimise(graph, values, before, state.tracking)
    assert few < 0.5 * before
    np.testing.assert_allclose(many, few, rtol=1e-3)
