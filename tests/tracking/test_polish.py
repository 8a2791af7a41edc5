"""Marginal covariances: the dense inverse against GTSAM's marginals."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.tracking import polish
from tests.tracking.synthetic_scene import two_cameras
from tests.tracking.test_tracker import track


def test_the_dense_inverse_gives_the_marginals_of_the_bayes_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, _, _ = track(two_cameras(), ((0, 1),))
    state = tracker.state
    arguments = state.keyframes, state.views, state.tracking, state.priors
    dense = polish.marginal_covariances(*arguments)
    monkeypatch.setattr(polish, "LARGEST_INVERSE", 0)
    tree = polish.marginal_covariances(*arguments)
    assert dense.keys() == tree.keys() and len(dense) >= 6
    for frame, covariance in dense.items():
        spread = np.sqrt(np.diagonal(tree[frame]))
        np.testing.assert_allclose(covariance, tree[frame], atol=1e-3 * np.outer(spread, spread).max())
        np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), spread, rtol=1e-3)
