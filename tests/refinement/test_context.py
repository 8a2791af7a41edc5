"""What tasks read of the images."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.context import colour_differences
from mvdyn_gtsam.refinement.views import DenseView

VIEW = DenseView.of(Camera("cam0", 32, 24, 30.0, 30.0, 15.5, 11.5), 0.5)


def test_grey_has_no_differences_of_colour() -> None:
    grey = np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)
    assert (colour_differences(grey, VIEW) == 128).all()
    assert (colour_differences(np.dstack([grey] * 3), VIEW) == 128).all()


def test_red_and_blue_differ_from_grey_in_their_own_channel() -> None:
    image = np.full((24, 32, 3), 100, np.uint8)
    image[:, :16, 0], image[:, 16:, 2] = 150, 150
    found = colour_differences(image, VIEW)
    assert found.shape == (12, 16, 2) and found.dtype == np.uint8
    assert (found[:, :6, 0] > 150).all() and (found[:, 10:, 1] > 150).all()
    assert (found[:, :6, 1] < 128).all() and (found[:, 10:, 0] < 128).all()
