"""Sizes by every rule, and the way of planes and edges back from a network's size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.frontend.depth_priors.depth_adapter import ImageInput, SizeRule
from mvdyn_gtsam.frontend.depth_priors.network_image import Placement, network_image, place
from mvdyn_gtsam.geometry import project


@pytest.mark.parametrize(
    ("frame", "rule", "fixed", "inner", "canvas"),
    [
        ((512, 384), SizeRule(short_side=518, multiple=14), None, (686, 518), (686, 518)),
        ((1920, 1080), SizeRule(short_side=518, multiple=14), None, (924, 518), (924, 518)),
        ((1080, 1920), SizeRule(long_side=504, multiple=14), None, (280, 504), (280, 504)),
        ((512, 384), SizeRule(pixels=(1, 352800)), None, (512, 384), (512, 384)),
        ((1920, 1080), SizeRule(pixels=(1, 352800)), None, (792, 445), (792, 445)),
        ((64, 48), SizeRule(pixels=(200_000, 600_000), multiple=14), None, (518, 392), (518, 392)),
        ((512, 384), SizeRule(), None, (512, 384), (512, 384)),
        ((9, 9), SizeRule(multiple=14), None, (14, 14), (14, 14)),
        ((512, 384), SizeRule(short_side=518), (630, 462), (616, 462), (630, 462)),
        ((384, 512), SizeRule(), (630, 462), (346, 462), (630, 462)),
        ((1920, 1080), SizeRule(fixed="stretch"), (518, 518), (518, 518), (518, 518)),
    ],
)
def test_the_size_follows_the_rule(
    frame: tuple[int, int],
    rule: SizeRule,
    fixed: tuple[int, int] | None,
    inner: tuple[int, int],
    canvas: tuple[int, int],
) -> None:
    assert place(frame, rule, fixed) == Placement(frame, inner, canvas)


def test_padding_is_around_and_the_image_in_the_middle() -> None:
    image = np.full((10, 20, 3), (255, 0, 51), np.uint8)
    rule = ImageInput(mean=(0.485, 0.456, 0.406), std=(0.5, 0.25, 0.2))
    seen = network_image(image, rule, place((20, 10), SizeRule(), (20, 16)))
    assert seen.shape == (1, 3, 16, 20) and seen.dtype == np.float32
    assert (seen[:, :, :3] == 0.0).all() and (seen[:, :, 13:] == 0.0).all()
    colour = (np.array([1.0, 0.0, 0.2]) - [0.485, 0.456, 0.406]) / [0.5, 0.25, 0.2]
    np.testing.assert_allclose(
        seen[0, :, 3:13], np.broadcast_to(colour[:, None, None], (3, 10, 20)), rtol=1e-5
    )
    five = network_image(
        image, ImageInput(rank=5, channels="BGR", maximum=255.0), place((20, 10), SizeRule(), None)
    )
    np.testing.assert_allclose(five[0, 0, :, 0, 0], [51.0, 0.0, 255.0], rtol=1e-6)


sizes = st.tuples(st.integers(8, 60), st.integers(8, 60))


@given(
    sizes, sizes, st.sampled_from(["pad", "stretch"]), st.sampled_from([1.0, 0.5, 2.0]), st.integers(0, 99)
)
def test_a_plane_comes_back_as_it_was(
    frame: tuple[int, int], fixed: tuple[int, int], fit: str, finer: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    placement = place(frame, SizeRule(fixed=fit), fixed)  # type: ignore[arg-type]
    intrinsics = np.array([[40.0, 0.0, 17.0], [0.0, 44.0, 21.0], [0.0, 0.0, 1.0]])
    slope = rng.uniform(-0.005, 0.005, 2)

    def inverse(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Of a plane, from pixels of the frame."""
        return 0.5 + slope[0] * (x - frame[0] / 2) / 4 + slope[1] * (y - frame[1] / 2) / 4

    width, height = (max(2, round(side * finer)) for side in fixed)
    x, y = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
    x, y = (
        (a + 0.5) * whole / part - 0.5 for a, whole, part in ((x, fixed[0], width), (y, fixed[1], height))
    )
    left, top = placement.offset
    x = (x - left + 0.5) * frame[0] / placement.inner[0] - 0.5
    y = (y - top + 0.5) * frame[1] / placement.inner[1] - 0.5
    back = placement.depth((1.0 / inverse(x, y)).astype(np.float32))
    truth = 1.0 / inverse(*np.meshgrid(np.arange(frame[0]), np.arange(frame[1])))
    assert back.shape == truth.shape
    # beyond the outermost pixel of the network nothing is known but that pixel
    np.testing.assert_allclose(back, truth, rtol=0.2)
    margin = [int(np.ceil(1.5 * max(1.0, frame[a] / (placement.inner[a] * min(finer, 1.0))))) for a in (0, 1)]
    inner = slice(margin[1], frame[1] - margin[1]), slice(margin[0], frame[0] - margin[0])
    np.testing.assert_allclose(back[inner], truth[inner], rtol=1e-4)
    # and a point is seen where the intrinsics of the canvas say
    point = np.array([[0.3, -0.2, 2.0]])
    (there,), _ = project(point, placement.intrinsics(intrinsics))
    (here,), _ = project(point, intrinsics)
    expected = [(here[a] + 0.5) * placement.inner[a] / frame[a] - 0.5 + placement.offset[a] for a in (0, 1)]
    np.testing.assert_allclose(there, expected)


def test_surfaces_are_not_mixed_and_the_unknown_stays_unknown() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] = 5.0
    depth[2, 1] = np.nan
    back = place((32, 24), SizeRule(), (8, 6)).depth(depth)
    assert set(np.unique(back[np.isfinite(back)].round(5))) == {2.0, 5.0}
    np.testing.assert_allclose(back[20], np.where(np.arange(32) < 16, 2.0, 5.0), rtol=1e-6)
    np.testing.assert_array_equal(np.argwhere(np.isnan(back)).min(0), [8, 4])
    np.testing.assert_array_equal(np.argwhere(np.isnan(back)).max(0), [11, 7])


def test_the_same_size_changes_nothing() -> None:
    depth = np.random.default_rng(0).uniform(1, 9, (24, 32)).astype(np.float32)
    placement = place((32, 24), SizeRule(), None)
    np.testing.assert_array_equal(placement.depth(depth), depth)
    np.testing.assert_array_equal(placement.intrinsics(np.eye(3)), np.eye(3))
