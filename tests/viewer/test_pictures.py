"""Points of an instant lie on their pixels, in their colours, within the budget and the filters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.geometry import project
from mvdyn_gtsam.viewer.frames import LARGEST_RASTER, Frame, raster_step, read_frame
from mvdyn_gtsam.viewer.pictures import (
    Choice,
    Colouring,
    Show,
    camera_picture,
    gathered_points,
    paint,
    thin_out,
)
from mvdyn_gtsam.viewer.scene import Scene, read_scene
from tests.viewer.results import CAMERAS, capture, depth_of, make, motion_at

MANY = 10_000


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    result = make(tmp_path / "r")
    return read_scene(result, result, ["cam0", "cam1"])


def frame_of(tmp_path: Path, camera: str = "cam0", time: int = 2, *, images: bool = True) -> Frame:
    result = make(tmp_path / f"{camera}{time}")
    return read_frame(result, result, capture() if images else None, camera, time)


@pytest.mark.parametrize("number", [0, 1])
def test_points_reproject_to_their_pixels(number: int, scene: Scene, tmp_path: Path) -> None:
    camera = CAMERAS[number]
    shown = camera_picture(scene, frame_of(tmp_path, camera.name), Choice(), MANY)
    assert len(shown.points) == camera.width * (camera.height - 1)  # all but the invalid row
    pixels, z = project(shown.points.positions.astype(np.float64), camera.intrinsics)
    columns, rows = np.rint(pixels).astype(int).T
    np.testing.assert_allclose(pixels, np.column_stack([columns, rows]), atol=1e-3)
    np.testing.assert_allclose(z * scene.depths.median, depth_of(camera)[rows, columns], rtol=1e-3)
    # Red is the column, green the row, blue the camera and time.
    np.testing.assert_array_equal(
        shown.points.colours, np.column_stack([columns, rows, np.full(len(rows), 100 * number + 2)])
    )
    np.testing.assert_array_equal(shown.wTc, scene.wTc[camera.name][2])


def test_half_precision_moves_points_by_less_than_half_a_pixel(scene: Scene, tmp_path: Path) -> None:
    exact = camera_picture(scene, frame_of(tmp_path), Choice(), MANY).points.positions
    sent = exact.astype(np.float16)
    moved = project(sent.astype(np.float64), CAMERAS[0].intrinsics)[0]
    there = project(exact.astype(np.float64), CAMERAS[0].intrinsics)[0]
    assert np.abs(moved - there).max() < 0.1


def test_the_frustum_has_the_field_of_view_of_the_camera(scene: Scene, tmp_path: Path) -> None:
    shown = camera_picture(scene, frame_of(tmp_path, "cam1"), Choice(), MANY)
    assert np.tan(shown.fov / 2) == pytest.approx(15.0 / 34.0)
    assert np.tan(shown.fov / 2) * shown.aspect == pytest.approx(20.0 / 33.0)
    assert shown.image is not None and shown.image.shape == (30, 40, 3)


@pytest.mark.parametrize("budget", [0, 1, 17, 100, 500])
def test_the_budget_is_kept_and_nearly_used(budget: int, scene: Scene, tmp_path: Path) -> None:
    points = camera_picture(scene, frame_of(tmp_path), Choice(), budget).points
    assert 0.9 * budget - 2 <= len(points) <= budget


@given(st.integers(1, 150), st.integers(1, 150), st.integers(0, 5000), st.integers(0, 9))
def test_thinning_keeps_a_part_of_what_was_wanted(rows: int, columns: int, budget: int, seed: int) -> None:
    wanted = np.random.default_rng(seed).random((rows, columns)) < 0.6
    kept = thin_out(wanted, budget)
    assert not (kept & ~wanted).any()
    assert np.count_nonzero(kept) <= budget or np.count_nonzero(wanted) <= budget
    if np.count_nonzero(wanted) <= budget:
        np.testing.assert_array_equal(kept, wanted)


def test_thinning_is_even() -> None:
    kept = thin_out(np.ones((128, 192), bool), 128 * 192 // 16)
    blocks = kept.reshape(16, 8, 24, 8).sum(axis=(1, 3))
    assert blocks.min() >= 3 and blocks.max() <= 5


def test_low_confidence_is_dropped(scene: Scene, tmp_path: Path) -> None:
    frame = frame_of(tmp_path)
    sure = camera_picture(scene, frame, Choice(min_confidence=0.5), MANY).points
    assert len(sure) == 16 * 23
    assert (sure.colours[:, 0] >= 16).all()  # the right half
    assert len(camera_picture(scene, frame, Choice(min_confidence=0.1), MANY).points) == 32 * 23


def test_what_moves_and_what_stands_still_are_all(scene: Scene, tmp_path: Path) -> None:
    frame = frame_of(tmp_path)
    counts = {show: len(camera_picture(scene, frame, Choice(show=show), MANY).points) for show in Show}
    assert counts[Show.MOVING] == counts[Show.GATHERED] == 16  # unconfirmed motion, too
    assert counts[Show.MOVING] + counts[Show.STILL] == counts[Show.ALL]
    moving = camera_picture(scene, frame, Choice(show=Show.MOVING), MANY).points
    assert (motion_at(CAMERAS[0], 2)[moving.colours[:, 1], moving.colours[:, 0]] > 0).all()


def test_a_frame_without_depth_shows_its_camera_alone(scene: Scene, tmp_path: Path) -> None:
    frame = replace(frame_of(tmp_path), depth=None, confidence=None)
    shown = camera_picture(scene, frame, Choice(colouring=Colouring.DEPTH), MANY)
    assert len(shown.points) == 0 and shown.image is frame.image


def test_fewer_points_are_drawn_larger(scene: Scene, tmp_path: Path) -> None:
    frame = frame_of(tmp_path)
    every = camera_picture(scene, frame, Choice(), MANY).points
    some = camera_picture(scene, frame, Choice(), len(every) // 4).points
    assert every.spacing == pytest.approx(1 / 30.0)
    assert some.spacing == pytest.approx(2 * every.spacing, rel=0.1)


def test_colours(scene: Scene, tmp_path: Path) -> None:
    frame = frame_of(tmp_path)
    painted = {colouring: paint(frame, colouring, scene) for colouring in Colouring}
    image, depth, motion = painted[Colouring.IMAGE], painted[Colouring.DEPTH], painted[Colouring.MOTION]
    confidence = painted[Colouring.CONFIDENCE]
    assert image is frame.image and painted[Colouring.CAMERA] is None
    assert depth is not None and motion is not None and confidence is not None
    assert (depth[0] == 0).all()  # invalid
    assert depth[5, 0, 0] > depth[5, 0, 2] and depth[5, -1, 2] > depth[5, -1, 0]  # near yellow, far blue
    assert confidence[5, -1].sum() > confidence[5, 0].sum()
    assert motion[11, 9, 0] > 2 * motion[11, 9, 1] and motion[11, 20, 0] == motion[11, 20, 1]
    assert motion[13, 9, 1] > motion[11, 9, 1]  # unconfirmed: yellow
    # Without a capture, points of an image's colour take their camera's.
    bare = camera_picture(scene, frame_of(tmp_path, time=3, images=False), Choice(), MANY)
    assert bare.image is None and (bare.points.colours == scene.colours["cam0"]).all()


def test_gathered_points_stand_still_in_the_world(scene: Scene, tmp_path: Path) -> None:
    frames = [frame_of(tmp_path, "cam0", time) for time in (0, 5)]
    points = gathered_points(scene, frames, Choice(), MANY)
    still = 32 * 23 - 16
    assert len(points) == 2 * still
    for place, frame in enumerate(frames):
        own = points.positions[place * still : (place + 1) * still].astype(np.float64)
        wTc = scene.wTc["cam0"][frame.time]
        pixels, _ = project((own - wTc[:3, 3]) @ wTc[:3, :3], CAMERAS[0].intrinsics)
        assert np.abs(pixels - np.rint(pixels)).max() < 1e-2
    assert len(gathered_points(scene, [], Choice(), MANY)) == 0
    assert len(gathered_points(scene, frames, Choice(), 50)) <= 100


def test_large_frames_become_small_rasters_of_the_same_camera(tmp_path: Path) -> None:
    assert raster_step(CAMERAS[0]) == 1
    large = Camera("a", 3840, 2160, 1.0, 1.0, 0.0, 0.0)
    step = raster_step(large)
    assert (3840 // step) * (2160 // step) <= LARGEST_RASTER < (3840 // (step - 1)) * (2160 // (step - 1))
