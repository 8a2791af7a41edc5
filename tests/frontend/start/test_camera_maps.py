"""Which of two maps of a camera is kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start import camera_maps
from mvdyn_gtsam.frontend.start.camera_maps import map_camera
from mvdyn_gtsam.frontend.start.dense_map import DenseMap
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from tests.frontend.start.synthetic_maps import camera_map, cloud, poses, similarity
from tests.tracking.synthetic_scene import two_cameras

CONFIG = WideBaselineConfig(features=200)
FIRST = camera_map(0, cloud(150), poses((0.0, 0.0, 0.0), 4), similarity(1.0, (0.0,) * 3, (0.0,) * 3))
SECOND = replace(FIRST, points=FIRST.points + 1.0)
WITHOUT_DEPTH = replace(FIRST, points=np.zeros((0, 3)))


@pytest.fixture(scope="module")
def capture() -> Capture:
    return two_cameras(moving=(True,)).capture()


def kept(
    monkeypatch: pytest.MonkeyPatch, capture: Capture, second: CameraMap, rigidity: Mapping[str, float]
) -> tuple[CameraMap, DenseMap | None, int]:
    """The map that is kept, and how often one was made; the second is made with followed keypoints."""
    made: list[int] = []

    def build(*arguments: Any, **_: object) -> CameraMap:
        made.append(sum(len(rows) for rows in arguments[4].values()))
        return FIRST if len(made) == 1 else second

    def densify(_: object, own: CameraMap, *__: Any) -> DenseMap:
        return DenseMap(own, (), rigidity["first" if own is FIRST else "second"])

    monkeypatch.setattr(camera_maps, "build_camera_map", build)
    monkeypatch.setattr(camera_maps, "densify_map", densify)
    mapped = map_camera(capture, 0, DisFlow(), CONFIG)
    assert all(count > made[0] + 50 for count in made[1:])
    return mapped.sparse, mapped.dense, len(made)


def test_a_map_that_explains_its_flow_is_made_once(monkeypatch: pytest.MonkeyPatch, capture: Capture) -> None:
    own, _, made = kept(monkeypatch, capture, SECOND, {"first": 0.95, "second": 0.99})
    assert own is FIRST and made == 1


def test_of_two_maps_the_one_that_explains_more_is_kept(
    monkeypatch: pytest.MonkeyPatch, capture: Capture
) -> None:
    own, dense, made = kept(monkeypatch, capture, SECOND, {"first": 0.5, "second": 0.9})
    assert own is SECOND and dense is not None and dense.sparse is SECOND and made == 2
    own, dense, made = kept(monkeypatch, capture, SECOND, {"first": 0.5, "second": 0.4})
    assert own is FIRST and dense is not None and dense.sparse is FIRST and made == 2


def test_a_second_map_without_depth_is_none(monkeypatch: pytest.MonkeyPatch, capture: Capture) -> None:
    own, dense, made = kept(monkeypatch, capture, WITHOUT_DEPTH, {"first": 0.5})
    assert own is FIRST and dense is not None and made == 2


def test_of_several_focal_lengths_the_one_whose_map_explains_most_is_kept(
    monkeypatch: pytest.MonkeyPatch, capture: Capture
) -> None:
    unknown = replace(capture.cameras[0], focal_known=False)
    ends = {900.0: 0.8, 150.0: 0.97, 300.0: 0.85}

    def build(*arguments: Any, **_: object) -> CameraMap:
        return FIRST

    def densify(seen: Capture, own: CameraMap, *_: Any) -> DenseMap:
        return DenseMap(own, (), ends[seen.cameras[0].fx])

    monkeypatch.setattr(
        camera_maps,
        "focal_candidates",
        lambda camera, *_: [replace(camera, fx=focal, fy=focal) for focal in ends],
    )
    monkeypatch.setattr(camera_maps, "build_camera_map", build)
    monkeypatch.setattr(camera_maps, "densify_map", densify)
    unsure = replace(capture, cameras=(unknown,))
    mapped = map_camera(unsure, 0, DisFlow(), CONFIG)
    assert mapped.camera == replace(unknown, fx=150.0, fy=150.0) and mapped.rigidity == 0.97
    monkeypatch.setattr(camera_maps, "build_camera_map", lambda *_, **__: WITHOUT_DEPTH)
    with pytest.raises(TrackingError, match="shows no parallax"):
        map_camera(unsure, 0, DisFlow(), CONFIG)
