"""Marginal covariances against GTSAM's, and cameras mounted on one another."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.keys import X
from mvdyn_gtsam.geometry import invert_pose, rotation_angle_deg
from mvdyn_gtsam.tracking import covariance, polish
from mvdyn_gtsam.tracking.covariance import marginal_covariances
from mvdyn_gtsam.tracking.state import TrackState
from tests.tracking.synthetic_scene import rig, two_cameras
from tests.tracking.test_tracker import errors, track


def test_both_inverses_give_the_marginals_of_the_bayes_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, _, _ = track(two_cameras(), ((0, 1),))
    state = tracker.state
    assert state.mounts == {}  # they move on their own
    _compare_covariances(state, monkeypatch)


def _compare_covariances(state: TrackState, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = state.keyframes, state.views, state.tracking, state.priors, state.mounts
    graph, values = polish.build_graph(
        state.keyframes, state.views, state.tracking, state.priors, mounts=state.mounts
    )
    tree = gtsam.Marginals(graph, values)
    dense = marginal_covariances(*arguments)
    monkeypatch.setattr(covariance, "LARGEST_INVERSE", 0)
    blocks = marginal_covariances(*arguments)
    assert dense.keys() == blocks.keys() and len(dense) >= 6
    for found in (dense, blocks):
        for frame, block in found.items():
            true = tree.marginalCovariance(X(*frame))
            spread = np.sqrt(np.diagonal(true))
            np.testing.assert_allclose(block, true, atol=1e-3 * np.outer(spread, spread).max())
            np.testing.assert_allclose(np.sqrt(np.diagonal(block)), spread, rtol=1e-3)


def test_cameras_mounted_on_one_another_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = rig()
    tracker, _, result = track(scene, ((0, 1),))
    assert list(tracker.state.mounts) == [(0, 1)]
    at_keyframes = [time for time in result.keyframe_times[0] if time in result.keyframe_times[1]]
    assert len(at_keyframes) >= 5
    aTb = (invert_pose(result.wTc[0]) @ result.wTc[1])[at_keyframes]
    spread = np.linalg.norm(aTb[:, :3, 3] - aTb[:, :3, 3].mean(0), axis=1).max()
    assert spread < 2e-3 * np.linalg.norm(aTb[0, :3, 3])
    assert rotation_angle_deg(aTb[0, :3, :3].T @ aTb[:, :3, :3]).max() < 0.02
    position, rotation = errors(result.wTc, scene.wTc)
    assert position < 0.01 and rotation < 0.2
    _compare_covariances(tracker.state, monkeypatch)


def test_cameras_of_different_groups_are_never_held() -> None:
    tracker, _, _ = track(rig(), ((0,), (1,)))
    assert tracker.state.mounts == {}
