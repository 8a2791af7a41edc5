"""One scale and offset per group, from the start's depths; what cannot be aligned is refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.aligned_prior import AlignedPrior, align_to_start
from mvdyn_gtsam.frontend.depth_priors.predictions import Predictions
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.start.model import Start
from mvdyn_gtsam.progress import NullProgress
from tests.frontend.depth_priors.prior_start import (
    CAMERAS,
    GROUPS,
    HEIGHT,
    TIMES,
    UNITS,
    WIDTH,
    GivenPrior,
    image_of,
    make_start,
    true_depth,
)

GRID = Grid.covering(WIDTH, HEIGHT, 4)


def align(
    folder: Path, answer: Callable[[np.ndarray], Any], start: Start | None = None
) -> tuple[AlignedPrior, GivenPrior]:
    prior = GivenPrior(answer)
    predictions = Predictions(prior, CAMERAS, folder)
    with predictions:
        return align_to_start(predictions, start or make_start(), image_of, NullProgress()), prior


@given(st.floats(0.05, 50.0), st.floats(-1.5, 20.0))
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_group_gets_the_scale_and_offset_of_its_world(
    tmp_path: Path, scale: float, offset: float
) -> None:
    aligned, _ = align(tmp_path, lambda depth: (scale * (depth + offset), None))
    assert [one.group for one in aligned.alignments] == list(GROUPS)
    for one, unit in zip(aligned.alignments, UNITS, strict=True):
        assert one.scale_offset.scale == pytest.approx(unit / scale, rel=1e-3)
        assert one.scale_offset.offset == pytest.approx(-unit * offset, abs=2e-3 * unit * (1 + abs(offset)))
        assert one.error < 1e-3


def test_only_frames_of_the_start_are_asked_for(tmp_path: Path) -> None:
    _, prior = align(tmp_path, lambda depth: (depth, None))
    assert sorted(prior.asked) == sorted((camera.name, time) for camera in CAMERAS for time in TIMES)


def test_a_fifth_of_nonsense_in_the_start_does_not_pull(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    start = make_start()
    frames = tuple(
        tuple(replace(f, depth=np.where(rng.random(f.depth.shape) < 0.2, 30.0, f.depth)) for f in own)
        for own in start.frames
    )
    aligned, _ = align(tmp_path, lambda depth: (0.5 * depth, None), replace(start, frames=frames))
    fit = aligned.alignments[0].scale_offset
    assert (fit.scale, fit.offset) == pytest.approx((2.0, 0.0), abs=0.06)


def test_a_fifth_of_nonsense_in_the_prior_does_not_pull(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)

    def answer(depth: np.ndarray) -> Any:
        return np.where(rng.random(depth.shape) < 0.2, np.float32(8.0), 0.5 * depth), None

    fit = align(tmp_path, answer)[0].alignments[0].scale_offset
    assert (fit.scale, fit.offset) == pytest.approx((2.0, 0.0), abs=0.06)


def test_grid_and_whole_frames_have_the_start_s_unit(tmp_path: Path) -> None:
    def answer(depth: np.ndarray) -> Any:
        depth = 0.4 * depth + 0.3
        depth[:, :10] = np.nan
        return depth, np.full_like(depth, 0.5)

    with Predictions(GivenPrior(answer), CAMERAS, tmp_path) as predictions:
        aligned = align_to_start(predictions, make_start(), image_of, NullProgress())
        for camera, unit in ((1, 1.0), (2, 20.0)):
            dense = aligned.dense(camera, 5, image_of(camera, 5))
            grid = aligned.at_grid(camera, 5, image_of(camera, 5), GRID)
            assert dense is not None and grid is not None
            truth = np.log(unit * true_depth(camera, 5))
            np.testing.assert_allclose(dense[:, 10:], truth[:, 10:], atol=1e-3)
            assert np.isnan(dense[:, :10]).all()
            np.testing.assert_array_equal(grid.log_depth, GRID.sample(dense))
            known = np.isfinite(grid.log_depth)
            np.testing.assert_array_equal(known, GRID.pixels[:, 0] >= 10)
            assert (grid.confidence[known] == 0.5).all()


def test_an_unknown_frame_is_none_for_both(tmp_path: Path) -> None:
    prior = GivenPrior()
    with Predictions(prior, CAMERAS, tmp_path) as predictions:
        aligned = align_to_start(predictions, make_start(), image_of, NullProgress())
        prior.answer = lambda depth: None
        assert aligned.dense(0, 1, image_of(0, 1)) is None
        assert aligned.at_grid(0, 1, image_of(0, 1), GRID) is None


def test_what_an_offset_brings_next_to_the_camera_is_unknown(tmp_path: Path) -> None:
    prior = GivenPrior(lambda depth: (depth + 3.0, None))
    with Predictions(prior, CAMERAS, tmp_path) as predictions:
        aligned = align_to_start(predictions, make_start(), image_of, NullProgress())
        near = np.arange(WIDTH) < 7
        prior.answer = lambda depth: (np.where(near, np.float32(3.01), depth + np.float32(3.0)), None)
        dense = aligned.dense(0, 1, image_of(0, 1))
    assert dense is not None
    np.testing.assert_array_equal(np.isnan(dense), np.broadcast_to(near, dense.shape))


def test_a_made_up_depth_leaves_the_prior_its_shape(tmp_path: Path) -> None:
    start = make_start()
    ones = tuple(replace(frame, depth=np.ones_like(frame.depth)) for frame in start.frames[2])
    aligned, _ = align(
        tmp_path, lambda depth: (5.0 * depth, None), replace(start, frames=(*start.frames[:2], ones))
    )
    fit = aligned.alignments[1].scale_offset
    assert fit.offset == 0.0 and fit.scale * 5.0 * np.median(true_depth(2, 3)) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda depth: (np.full_like(depth, 2.0), None), "constant"),
        (lambda depth: (1.0 / depth, None), "falls"),
        (lambda depth: (np.full_like(depth, np.nan), None), "knows 0 of the 360 points"),
        (lambda depth: None, "knows 0 of the 360 points"),
    ],
)
def test_what_cannot_be_aligned_is_refused_and_names_the_cameras(
    tmp_path: Path, answer: Callable[[np.ndarray], Any], message: str
) -> None:
    with pytest.raises(
        DepthPriorError, match=f"^left, right: the depth prior GivenPrior .*{message}"
    ) as caught:
        align(tmp_path, answer)
    assert "\n" not in str(caught.value)


def test_no_overlap_with_the_start_is_refused(tmp_path: Path) -> None:
    start = make_start()
    far = tuple(replace(frame, pixels=frame.pixels + 100.0) for frame in start.frames[2])
    with pytest.raises(DepthPriorError, match=r"^door: .*knows 0 of the 180 points"):
        align(tmp_path, lambda depth: (depth, None), replace(start, frames=(*start.frames[:2], far)))
