"""Predictions are made once, checked, kept on disk and gone afterwards."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.errors import DepthPriorError, ResultError
from mvdyn_gtsam.frontend.depth_priors.predictions import Prediction, Predictions
from tests.frontend.depth_priors.prior_start import CAMERAS, HEIGHT, WIDTH, GivenPrior, image_of, true_depth

Answer = Callable[[np.ndarray], Any]


def get(folder: Path, answer: Answer) -> Prediction | None:
    with Predictions(GivenPrior(answer), CAMERAS, folder) as predictions:
        return predictions.get(1, 4, image_of(1, 4))


@pytest.mark.parametrize("with_confidence", [False, True])
def test_every_frame_is_asked_for_once_and_comes_back_the_same(tmp_path: Path, with_confidence: bool) -> None:
    prior = GivenPrior(lambda depth: (depth, np.full_like(depth, 0.25) if with_confidence else None))
    frames = [(camera, time) for camera in range(3) for time in range(5)]
    with Predictions(prior, CAMERAS, tmp_path / "predictions") as predictions:
        first = [predictions.get(*frame, image_of(*frame)) for frame in frames]
        for frame, before in zip(frames, first, strict=True):
            again = predictions.get(*frame, image_of(*frame))
            assert before is not None and again is not None
            np.testing.assert_array_equal(again.depth, true_depth(*frame).astype(np.float32))
            np.testing.assert_array_equal(again.depth, before.depth)
            assert (again.confidence is None) == (not with_confidence)
            if again.confidence is not None:
                np.testing.assert_array_equal(again.confidence, np.float32(0.25))
    assert len(prior.asked) == len(set(prior.asked)) == len(frames)
    assert not (tmp_path / "predictions").exists()


def test_a_frame_that_the_prior_does_not_know_is_not_asked_for_again(tmp_path: Path) -> None:
    prior = GivenPrior(lambda depth: None)
    with Predictions(prior, CAMERAS, tmp_path / "p") as predictions:
        assert predictions.get(0, 0, image_of(0, 0)) is predictions.get(0, 0, image_of(0, 0)) is None
    assert len(prior.asked) == 1


def test_what_another_run_left_is_not_taken(tmp_path: Path) -> None:
    left = Predictions(GivenPrior(lambda depth: (9 * depth, None)), CAMERAS, tmp_path)
    left.get(1, 4, image_of(1, 4))  # killed: not closed
    assert list(tmp_path.iterdir())
    found = get(tmp_path, lambda depth: (depth, None))
    assert found is not None
    np.testing.assert_array_equal(found.depth, true_depth(1, 4).astype(np.float32))


def test_predictions_are_gone_after_a_failure(tmp_path: Path) -> None:
    with (
        pytest.raises(KeyboardInterrupt),
        Predictions(GivenPrior(), CAMERAS, tmp_path / "p") as predictions,
    ):
        predictions.get(0, 0, image_of(0, 0))
        raise KeyboardInterrupt
    assert not (tmp_path / "p").exists()


def test_unusable_pixels_are_unknown(tmp_path: Path) -> None:
    def answer(depth: np.ndarray) -> Any:
        depth = depth.astype(np.float64)
        depth[0, :6] = [np.nan, np.inf, -np.inf, 0.0, -2.0, 1e300]
        confidence = np.full(depth.shape, 0.5)
        confidence[1, :4] = [np.nan, 0.0, -1.0, 7.0]
        return depth, confidence

    found = get(tmp_path, answer)
    assert found is not None and found.confidence is not None
    unknown = np.zeros((HEIGHT, WIDTH), bool)
    unknown[0, :6] = unknown[1, :3] = True
    np.testing.assert_array_equal(np.isnan(found.depth), unknown)
    assert found.depth.dtype == found.confidence.dtype == np.float32
    assert found.confidence[1, 3] == 1.0 and (found.confidence[~unknown] > 0.0).all()


def test_nothing_usable_is_an_unknown_frame(tmp_path: Path) -> None:
    assert get(tmp_path, lambda depth: (np.full_like(depth, np.nan), None)) is None
    assert get(tmp_path, lambda depth: (-depth, None)) is None
    assert get(tmp_path, lambda depth: (depth, np.zeros_like(depth))) is None


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda depth: (depth[:, 1:], None), r"a depth that is float32 of shape \(32, 47\)"),
        (lambda depth: (depth.T, None), r"shape \(48, 32\); it must be .* of shape \(32, 48\)"),
        (lambda depth: (depth[None], None), r"shape \(1, 32, 48\)"),
        (lambda depth: (depth.astype(np.uint16), None), "a depth that is uint16"),
        (lambda depth: (depth.astype(complex), None), "a depth that is complex128"),
        (lambda depth: (depth.tolist(), None), "a depth that is list"),
        (lambda depth: (depth, depth[1:]), r"a confidence that is float32 of shape \(31, 48\)"),
        (lambda depth: (depth, depth > 0), "a confidence that is bool"),
        (lambda depth: depth, "handed out ndarray; it must be a pair"),
    ],
)
def test_what_is_no_prediction_is_refused_by_frame(tmp_path: Path, answer: Answer, message: str) -> None:
    with pytest.raises(
        DepthPriorError, match=rf"^right frame 4: the depth prior GivenPrior .*{message}"
    ) as caught:
        get(tmp_path, answer)
    assert "\n" not in str(caught.value)


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(ResultError, match=r"1_000004\.npy: .*No space left.*--resume"):
        get(tmp_path / "p", lambda depth: (depth, None))
    assert not (tmp_path / "p").exists()
