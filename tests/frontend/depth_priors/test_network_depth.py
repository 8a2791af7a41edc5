"""Outputs beyond what small graphs can show: padding, half precision, shapes that do not belong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.frontend.depth_priors.depth_adapter import DepthAdapter, DepthOutput, SizeRule, Validity
from mvdyn_gtsam.frontend.depth_priors.depth_models import DEPTH_ANYTHING_3_METRIC, MOGE_2
from mvdyn_gtsam.frontend.depth_priors.network_depth import network_depth, unit_rays
from mvdyn_gtsam.frontend.depth_priors.network_image import place

K = np.array([[30.0, 0.0, 9.5], [0.0, 30.0, 19.5], [0.0, 0.0, 1.0]])
PLACED = place((20, 40), SizeRule(), (80, 40))
"""The frame is a quarter of what the network sees."""
CANVAS_K = PLACED.intrinsics(K)


def moge_outputs(shift: float, dtype: Any = np.float32) -> dict[str, np.ndarray]:
    """Points on a slanting plane, and nonsense in the padding that the mask does not tell."""
    rays = unit_rays(PLACED.canvas, CANVAS_K)
    z = 2.0 + 0.02 * np.arange(80) + 0.01 * np.arange(40)[:, None]
    points = rays / rays[..., 2:] * z[..., None] - [0.0, 0.0, shift]
    padding = np.ones((40, 80), bool)
    padding[:, 30:50] = False
    points[padding] = np.random.default_rng(0).uniform(-1, 4, (padding.sum(), 3))
    return {
        "points": points[None].astype(dtype),
        "mask": np.ones((1, 40, 80), dtype),
        "metric_scale": np.full(1, 1.5, dtype),
    }


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-4), (np.float16, 0.01)])
def test_padding_says_nothing_of_the_shift(dtype: Any, tolerance: float) -> None:
    depth, _ = network_depth(moge_outputs(0.6, dtype), MOGE_2, PLACED, CANVAS_K)
    assert depth.dtype == np.float32 and np.isnan(depth[:, :30]).all() and np.isnan(depth[:, 50:]).all()
    truth = 1.5 * (2.0 + 0.02 * np.arange(80) + 0.01 * np.arange(40)[:, None])
    np.testing.assert_allclose(depth[:, 30:50], truth[:, 30:50], rtol=tolerance)


def test_a_coarser_output_has_the_rays_of_its_own_pixels() -> None:
    adapter = DepthAdapter(DepthOutput("d", "distance"))
    placement = place((80, 40), SizeRule(), None)
    intrinsics = np.array([[30.0, 0, 39.5], [0, 30.0, 19.5], [0, 0, 1.0]])
    depth, _ = network_depth({"d": np.full((1, 20, 40), 2.0)}, adapter, placement, intrinsics)
    x, y = np.meshgrid((2 * np.arange(40) + 0.5 - 39.5) / 30, (2 * np.arange(20) + 0.5 - 19.5) / 30)
    np.testing.assert_allclose(depth, 2.0 / np.sqrt(1 + x**2 + y**2), rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"points": np.zeros((1, 3, 40, 80))},
            r"points of shape \(1, 3, 40, 80\); it must be \(1, H, W, 3\)",
        ),
        ({"points": np.zeros((2, 40, 80, 3))}, r"points of shape \(2, 40, 80, 3\)"),
        ({"points": np.zeros((1, 40, 80, 3), np.int64)}, "gives no number in points"),
        ({"points": np.full((1, 40, 80, 3), np.inf)}, "gives no number in points"),
        ({"mask": np.ones((1, 20, 40))}, r"gives mask of shape \(20, 40\) for a depth of \(40, 80\)"),
        ({"metric_scale": np.ones(2)}, r"gives metric_scale of shape \(2,\); it must be one number"),
    ],
)
def test_what_is_no_such_output_is_named(changed: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        network_depth({**moge_outputs(0.0), **changed}, MOGE_2, PLACED, CANVAS_K)


def test_points_first_are_told_from_points_last() -> None:
    adapter = replace(MOGE_2, depth=replace(MOGE_2.depth, points_axis="first"))
    with pytest.raises(ValueError, match=r"must be \(1, 3, H, W\)"):
        network_depth(moge_outputs(0.0), adapter, PLACED, CANVAS_K)


def test_sky_and_confidence_that_are_not_finite_are_not_believed() -> None:
    adapter = replace(DEPTH_ANYTHING_3_METRIC, validity=Validity(sky="sky", confidence="sure"))
    depth = np.full((1, 1, 40, 80), 2.0)
    sky = np.where(np.arange(80) < 40, 0.1, np.nan) * np.ones((1, 1, 40, 1))
    found, confidence = network_depth(
        {"depth": depth, "sky": sky, "sure": 1.5 * depth}, adapter, PLACED, CANVAS_K
    )
    np.testing.assert_allclose(found[:, 30:40], 2.0 * 30.0 / 300.0)
    assert np.isnan(found[:, 40:]).all() and confidence is not None and (confidence == 1.0).all()
