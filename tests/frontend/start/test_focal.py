"""Focal lengths out of a camera's own video, and which of several minima is believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.start import focal
from mvdyn_gtsam.frontend.start.features import extract_features
from mvdyn_gtsam.frontend.start.focal import MOST_DEVIATION, doubts, focal_candidates, found_intrinsics
from mvdyn_gtsam.frontend.start.joint_adjustment import Adjusted
from mvdyn_gtsam.frontend.start.model import FoundIntrinsics
from mvdyn_gtsam.frontend.start.single_camera import match_neighbours
from tests.frontend.start.synthetic_maps import CAMERA
from tests.tracking.synthetic_scene import two_cameras

UNKNOWN = replace(CAMERA, fx=384.0, fy=384.0, focal_known=False)
VIEW = extract_features(np.random.default_rng(0).integers(0, 255, (96, 128, 3)).astype(np.uint8), 50, 0.01)
PAIRS = {(0, 1): np.column_stack([np.arange(20), np.arange(20)])}


def answer(monkeypatch: pytest.MonkeyPatch, ended: list[float], fitting: list[int]) -> list[Any]:
    """Let structure from motion end there; what it is asked comes to lie in the list."""
    asked: list[Any] = []

    def solve(whose: str, problem: Mapping[str, Any]) -> dict[str, Any]:
        asked.append((whose, problem))
        return {"focal": np.array(ended), "fitting": np.array(fitting)}

    monkeypatch.setattr(focal, "structure_from_motion", solve)
    return asked


def test_every_focal_length_that_sightings_fit_is_a_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answer(monkeypatch, [577.0, 430.2, np.nan, 431.0, 700.0], [800, 1200, 9000, 1190, 3])
    candidates = focal_candidates(UNKNOWN, [VIEW, VIEW], PAIRS)
    # 431 is 430.2 again, and 700 fits nothing
    assert candidates == [replace(UNKNOWN, fx=focal, fy=focal) for focal in (430.2, 577.0)]
    ((whose, problem),) = asked
    assert whose == CAMERA.name
    # the camera's own guess, then those that reach the common fields of view
    guesses = problem["focal_guesses"]
    assert guesses[0] == 384.0
    assert (np.diff(np.sort(guesses)) < 0.45 * np.sort(guesses)[:-1]).all()


def test_a_video_that_makes_no_map_is_one_line_with_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    answer(monkeypatch, [np.nan] * 5, [0] * 5)
    for pairs in (PAIRS, {}):
        with pytest.raises(TrackingError, match="cam: its video does not tell its focal length.*give its"):
            focal_candidates(UNKNOWN, [VIEW, VIEW], pairs)


def test_what_the_images_leave_open_is_refused() -> None:
    def adjusted(deviation: float) -> Adjusted:
        return Adjusted({}, (CAMERA, UNKNOWN), {1: deviation}, {})

    assert found_intrinsics(adjusted(2.0)) == {1: FoundIntrinsics(384.0, CAMERA.cx, CAMERA.cy, 2.0)}
    for deviation in (1.1 * MOST_DEVIATION * 384.0, np.inf, np.nan):
        with pytest.raises(TrackingError, match="384 px fits best"):
            found_intrinsics(adjusted(deviation))


def test_given_focal_lengths_that_the_images_contradict_are_doubted() -> None:
    def lines(focal: float, deviation: float) -> list[str]:
        told = {0: FoundIntrinsics(focal, CAMERA.cx, CAMERA.cy, deviation)}
        return doubts([CAMERA, UNKNOWN], Adjusted({}, (CAMERA, UNKNOWN), {}, told))

    assert lines(430.0, 0.5) == []
    # half a percent is what found ones err by, and 3 % is nothing where they may err by 2
    assert lines(432.0, 0.1) == lines(443.0, 8.6) == []
    (line,) = lines(412.0, 1.5)
    assert "cam: its intrinsics say a focal length of 430.0 px, and its images 412.0" in line
    assert "--estimate-focal" in line


@pytest.mark.slow
def test_the_focal_length_of_a_moving_camera_is_found() -> None:
    scene = two_cameras()
    for camera, images in zip(scene.cameras, scene.images, strict=True):
        features = [extract_features(image, 1000, 0.01) for image in images]
        side = max(camera.width, camera.height)
        unknown = replace(camera, fx=0.75 * side, fy=0.75 * side, focal_known=False)
        found, *_ = focal_candidates(unknown, features, match_neighbours(features, 4, 0.8))
        assert found.fx == pytest.approx(camera.fx, rel=0.03)
