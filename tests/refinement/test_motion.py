"""What phase 2 begins with where something moves."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.refinement.motion import LEAK_REACH, OWN_SHARE, kept_far_off


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
