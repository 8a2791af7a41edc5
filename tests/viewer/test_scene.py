"""The scale, the paths, up and the views of a group of cameras."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import invert_pose, project, transform_points
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.reconstruction.layout import depth_path, trajectory_path
from mvdyn_gtsam.viewer.pictures import trajectory_lines
from mvdyn_gtsam.viewer.scene import (
    Scene,
    behind_camera,
    first_view,
    read_scene,
    spread_times,
    through_camera,
    upwards,
)
from tests.viewer.results import DEPTH, FRAMES, NO_POSE, make, poses


@pytest.fixture
def result(tmp_path: Path) -> Reconstruction:
    return make(tmp_path / "r")


@pytest.fixture
def scene(result: Reconstruction) -> Scene:
    return read_scene(result, result, ["cam0", "cam1"])


def test_the_unit_is_the_median_depth(scene: Scene) -> None:
    assert scene.depths.median == pytest.approx(DEPTH, rel=0.05)
    assert scene.depths.low < scene.depths.median < scene.depths.high
    np.testing.assert_allclose(
        scene.wTc["cam0"][:, :3, 3], poses(0)[:, :3, 3] / scene.depths.median, atol=1e-12
    )
    np.testing.assert_allclose(scene.wTc["cam0"][:, :3, :3], poses(0)[:, :3, :3], atol=1e-12)


def test_frames_without_a_pose_leave_gaps_and_are_said(
    result: Reconstruction, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        scene = read_scene(result, result, ["cam0", "cam1"])
    assert "cam1: 5 of 6 frames have a pose" in caplog.text and "cam0" not in caplog.text
    assert scene.has_pose("cam0", NO_POSE) and not scene.has_pose("cam1", NO_POSE)
    assert len(trajectory_lines(scene.wTc["cam0"])) == FRAMES - 1
    assert len(trajectory_lines(scene.wTc["cam1"])) == FRAMES - 3  # the segments to and from it


def test_colours_do_not_depend_on_the_group(result: Reconstruction, scene: Scene) -> None:
    alone = read_scene(result, result, ["cam1"])
    assert alone.colours["cam1"] == scene.colours["cam1"] != scene.colours["cam0"]


def test_a_camera_that_is_not_there_yet_is_left_out(
    result: Reconstruction, caplog: pytest.LogCaptureFixture
) -> None:
    trajectory_path(result.folder, "cam1").unlink()
    assert read_scene(result, result, ["cam0", "cam1"]).names == ("cam0",)
    assert "cam1 is not shown" in caplog.text
    trajectory_path(result.folder, "cam0").unlink()
    with pytest.raises(ResultError, match="no frame of cam0, cam1 has a pose"):
        read_scene(result, result, ["cam0", "cam1"])


def test_without_depth_the_cameras_give_the_scale(
    result: Reconstruction, caplog: pytest.LogCaptureFixture
) -> None:
    for camera in result.cameras:
        for time in range(FRAMES):
            depth_path(result.folder, camera, time).unlink()
    scene = read_scene(result, result, ["cam0", "cam1"])
    assert "no depth yet" in caplog.text
    assert scene.depths.median == pytest.approx(1.0 + 0.3 * (FRAMES - 1))


def test_up_is_the_mean_of_the_cameras() -> None:
    tilted = np.tile(np.eye(4), (2, 3, 1, 1))
    tilted[0, :, :3, :3] = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    tilted[1, :, :3, :3] = Rotation.from_euler("x", -30, degrees=True).as_matrix()
    tilted[1, 2] = np.nan
    tilted[0, 2] = np.nan
    np.testing.assert_allclose(upwards(list(tilted)), [0.0, -1.0, 0.0], atol=1e-12)
    opposite = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])
    np.testing.assert_allclose(upwards([opposite]), [0.0, -1.0, 0.0])


def test_the_first_view_has_the_camera_and_what_it_sees_before_it(scene: Scene) -> None:
    view = first_view(scene)
    forward = view.look_at - view.position
    right = np.cross(forward, view.up)
    axes = [right, np.cross(forward, right), forward]
    wTv = np.eye(4)
    wTv[:3, :3] = np.array([axis / np.linalg.norm(axis) for axis in axes]).T
    wTv[:3, 3] = view.position
    wTc = scene.wTc["cam0"][0]
    shown = transform_points(wTc, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    _, z = project(transform_points(invert_pose(wTv), shown), np.eye(3))
    assert (z > 0.5).all()
    assert transform_points(invert_pose(wTc), view.position[None])[0, 1] < 0  # above, for y is down


def test_looking_through_a_camera(scene: Scene) -> None:
    view = through_camera(scene, "cam1", 2)
    assert view is not None
    wTc = scene.wTc["cam1"][2]
    np.testing.assert_allclose(view.position, wTc[:3, 3])
    np.testing.assert_allclose(view.look_at - view.position, wTc[:3, 2])
    np.testing.assert_allclose(view.up, -wTc[:3, 1])
    assert np.tan(view.fov / 2) == pytest.approx(15.0 / 34.0)
    assert through_camera(scene, "cam1", NO_POSE) is None
    assert through_camera(scene, "another", 0) is None
    assert behind_camera(scene, "cam1", 2).position @ wTc[:3, 2] < wTc[:3, 3] @ wTc[:3, 2]


def test_a_damaged_frame_does_not_hide_the_others(
    result: Reconstruction, caplog: pytest.LogCaptureFixture
) -> None:
    depth_path(result.folder, "cam0", 0).write_bytes(b"no image")
    assert read_scene(result, result, ["cam0"]).depths.median == pytest.approx(DEPTH, rel=0.05)
    assert "000000.png: damaged" in caplog.text


def test_spread_times() -> None:
    present = np.ones(100, bool)
    present[:10] = False
    times = spread_times(present, 4)
    assert times[0] == 10 and times[-1] == 99 and len(times) == 4
    assert spread_times(present[:12], 8) == [10, 11]
    assert spread_times(np.zeros(5, bool), 8) == []
