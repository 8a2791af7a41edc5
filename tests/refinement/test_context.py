"""What tasks read of the images."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.context import smooth_colour
from mvdyn_gtsam.refinement.views import DenseView

VIEW = DenseView.of(Camera("cam0", 32, 24, 30.0, 30.0, 15.5, 11.5), 0.5)


def test_grey_has_no_differences_of_colour() -> None:
    grey = np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)
    found = smooth_colour(grey, VIEW)
    assert (found[..., 1:] == 128).all() and np.ptp(found[..., 0]) > 10
    np.testing.assert_allclose(smooth_colour(np.dstack([grey] * 3), VIEW), found, atol=1)


def test_red_and_blue_differ_from_grey_in_their_own_channel() -> None:
    image = np.full((24, 32, 3), 100, np.uint8)
    image[:, :16, 0], image[:, 16:, 2] = 150, 150
    found = smooth_colour(image, VIEW)
    assert found.shape == (12, 16, 3) and found.dtype == np.uint8
    assert (found[:, :6, 1] > 150).all() and (found[:, 10:, 2] > 150).all()
    assert (found[:, :6, 2] < 128).all() and (found[:, 10:, 1] < 128).all()
