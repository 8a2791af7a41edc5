"""Depth brought back up to the input along the edges of the image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.finish import upsample
from mvdyn_gtsam.refinement.views import DenseView

CONTRAST = 5.0


def textured(shape: tuple[int, int]) -> npt.NDArray[np.uint8]:
    return np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)


@pytest.mark.parametrize("small", [(24, 32), (12, 16), (19, 27)])
def test_constant_depth_stays_constant_whatever_the_image(small: tuple[int, int]) -> None:
    found = upsample(np.full(small, 0.37, np.float32), textured((48, 64)), CONTRAST)
    assert found.shape == (48, 64)
    np.testing.assert_allclose(found, 0.37, rtol=1e-5)


def test_at_the_size_of_the_input_nothing_changes() -> None:
    inverse_depth = np.random.default_rng(4).uniform(0.1, 1.0, (20, 30)).astype(np.float32)
    np.testing.assert_array_equal(upsample(inverse_depth, textured((20, 30)), CONTRAST), inverse_depth)


@pytest.mark.parametrize("small", [(24, 32), (12, 16)])
def test_on_a_plain_image_it_is_linear_in_the_logarithm(small: tuple[int, int]) -> None:
    view = DenseView.of(Camera("c", 64, 48, 50.0, 50.0, 31.5, 23.5), small[0] / 48)
    y, x = np.mgrid[:48, :64]
    theta = (-1.0 + 0.01 * x - 0.02 * y).astype(np.float32)
    shrunk = np.asarray(view.shrink(theta), np.float32)
    found = np.log(upsample(np.exp(shrunk), np.full((48, 64), 90, np.uint8), CONTRAST))
    np.testing.assert_allclose(found[4:-4, 4:-4], theta[4:-4, 4:-4], atol=1e-4)


@pytest.mark.parametrize("column", [30, 31, 32, 33])
def test_depth_changes_where_the_image_does(column: int) -> None:
    """The image's edge lies anywhere within the pixels of the small view, and the depth's with it."""
    stride = 4
    grey = np.full((48, 64), 60, np.uint8)
    grey[:, column:] = 160
    truth = np.where(np.arange(64) < column, 0.2, 0.5)
    # a pixel of the small view takes the depth of most of it
    centres = np.arange(16) * stride + 1.5
    small = np.tile(np.where(centres < column - 0.5, 0.2, 0.5), (12, 1)).astype(np.float32)
    found = upsample(small, grey, CONTRAST)
    linear = np.exp(
        np.interp((np.arange(64) + 0.5) / stride - 0.5, np.arange(16), np.log(small[0].astype(np.float64)))
    )
    wrong = np.abs(np.log(found / truth)) > 0.1
    wrong_linear = np.abs(np.log(linear / truth)) > 0.1
    # one on each side, whose luminance is itself between the two
    assert wrong[24].sum() <= 2 < wrong_linear.sum()
    assert found.min() >= 0.2 * (1.0 - 1e-5) and found.max() <= 0.5 * (1.0 + 1e-5)
