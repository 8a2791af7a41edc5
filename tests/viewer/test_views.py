"""Instants on request: what a result offers, what it keeps, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ConfigError, ResultError
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter
from mvdyn_gtsam.reconstruction.layout import depth_path
from mvdyn_gtsam.viewer import views as views_module
from mvdyn_gtsam.viewer.frames import read_frame
from mvdyn_gtsam.viewer.pictures import Choice, Colouring, Picture, Show
from mvdyn_gtsam.viewer.views import ResultViews
from tests.viewer.results import CAMERAS, FPS, FRAMES, NO_POSE, capture, make


@pytest.fixture
def views(tmp_path: Path) -> ResultViews:
    return ResultViews(make(tmp_path / "r"), capture())


def names(picture: Picture) -> list[str]:
    return [camera.camera for camera in picture.cameras]


def test_an_instant(views: ResultViews) -> None:
    picture = views.picture(Choice(time=3, points=200))
    assert names(picture) == ["cam0", "cam1"] and picture.background is None
    assert sum(len(camera.points) for camera in picture.cameras) <= 200
    assert picture.cameras[1].image is not None and picture.cameras[1].image[0, 0, 2] == 103
    assert names(views.picture(Choice(time=NO_POSE))) == ["cam0"]
    assert names(views.picture(Choice(hidden=frozenset(["cam0"])))) == ["cam1"]


def test_tracked_points_in_the_scale_of_the_refined(views: ResultViews) -> None:
    refined = views.picture(Choice()).cameras[0].points.positions[:, 2]
    tracked = views.picture(Choice(tracking=True)).cameras[0].points.positions[:, 2]
    np.testing.assert_allclose(tracked, 2.0 * refined, rtol=1e-3)
    # What moves is known of both.
    assert len(views.picture(Choice(tracking=True, show=Show.MOVING)).cameras[0].points) == 16


def test_the_background_is_gathered_once(views: ResultViews) -> None:
    gathered = views.picture(Choice(show=Show.GATHERED, points=2000))
    assert [len(camera.points) for camera in gathered.cameras] == [16, 16]
    assert gathered.background is not None and len(gathered.background) > 1000
    later = views.picture(Choice(show=Show.GATHERED, points=2000, time=2, frustum_size=0.3))
    assert later.background is gathered.background
    surer = views.picture(Choice(show=Show.GATHERED, points=2000, min_confidence=0.5)).background
    assert surer is not None and len(surer) < len(gathered.background)


def test_few_frames_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[tuple[str, int]] = []

    def counted(*arguments: object) -> object:
        read.append(arguments[3:])  # type: ignore[arg-type]
        return read_frame(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(views_module, "read_frame", counted)
    monkeypatch.setattr(views_module, "KEPT_INSTANTS", 2)
    views = ResultViews(make(tmp_path / "r"), capture())
    for time in (0, 1, 0):
        views.picture(Choice(time=time))
    assert len(read) == 4
    views.picture(Choice(time=0, min_confidence=0.7))  # the same frames, seen otherwise
    assert len(read) == 4
    for time in (2, 1):
        views.picture(Choice(time=time))
    assert read[4:] == [("cam0", 2), ("cam1", 2), ("cam0", 1), ("cam1", 1)]


def test_what_a_tracked_result_offers(tmp_path: Path) -> None:
    views = ResultViews(make(tmp_path / "r", refined=False), None)
    assert views.shows == (Show.ALL,) and not views.has_tracked
    assert views.colourings == (Colouring.DEPTH, Colouring.CAMERA, Colouring.CONFIDENCE)
    with pytest.raises(ConfigError, match="--show gathered: what moves is found by the refinement"):
        views.check(Choice(show=Show.GATHERED))
    with pytest.raises(ConfigError, match="--tracking: .* holds nothing but what tracking said"):
        views.check(Choice(tracking=True))
    assert len(views.picture(Choice(colouring=Colouring.DEPTH)).cameras[0].points) > 0


def test_a_refined_result_offers_all(views: ResultViews, tmp_path: Path) -> None:
    assert views.shows == tuple(Show) and views.has_tracked and views.colourings == tuple(Colouring)
    views.check(Choice(show=Show.GATHERED, tracking=True))
    bare = ResultViews(make(tmp_path / "bare"), None)
    assert Colouring.IMAGE not in bare.colourings and Colouring.MOTION in bare.colourings


def test_groups_are_seen_one_by_one(tmp_path: Path) -> None:
    views = ResultViews(make(tmp_path / "r", groups=(("cam0",), ("cam1",))), capture())
    assert names(views.picture(Choice())) == ["cam0"]
    assert names(views.picture(Choice(group=1))) == ["cam1"]
    with pytest.raises(ConfigError, match="--group 2: .* has groups 0..1"):
        views.check(Choice(group=2))


def test_an_interrupted_result_is_seen_as_far_as_it_goes(tmp_path: Path) -> None:
    result = make(tmp_path / "r", refined=False)
    depth_path(result.folder, "cam1", 5).unlink()
    picture = ResultViews(result, capture()).picture(Choice(time=5))
    assert names(picture) == ["cam0", "cam1"] and len(picture.cameras[1].points) == 0


def test_what_cannot_be_seen(tmp_path: Path) -> None:
    with ReconstructionWriter.create(
        tmp_path / "begun", CaptureInfo("clip", FPS, FRAMES, CAMERAS), {}
    ) as begun:
        pass
    from mvdyn_gtsam.reconstruction import Reconstruction

    with pytest.raises(ResultError, match="no camera has been placed yet"):
        ResultViews(Reconstruction.load(begun.folder), None)
    result = make(tmp_path / "r")
    other = capture()
    with pytest.raises(ResultError, match="was not made from capture"):
        ResultViews(result, Capture("clip", FPS, (replace(CAMERAS[0], width=8),), other.streams[:1]))
    depth_path(result.folder, "cam0", 3).write_bytes(b"no image")
    views = ResultViews(result, other)
    with pytest.raises(ResultError, match="000003.png: damaged"):
        views.picture(Choice(time=3))
    views.picture(Choice(time=2))
