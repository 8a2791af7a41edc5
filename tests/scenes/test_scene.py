"""Generated scenes: their ground truth agrees with itself, with the pictures and with what was asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the extra scenes is not installed")

from mvdyn_gtsam.capture import load_capture, open_capture
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth, load_groundtruth
from mvdyn_gtsam.geometry import backproject, invert_pose, project, transform_points
from mvdyn_gtsam.scenes import Scene, SceneSettings, make_scene
from mvdyn_gtsam.scenes.rig import solve_angle
from mvdyn_gtsam.scenes.writer import DEPTH_SCALE

TINY = SceneSettings(cameras=2, frames=3, width=96, height=64, motion=0.8, fps=10.0, seed=3)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield make_scene(replace(TINY, noise=0.0), tmp_path_factory.mktemp("scene") / "clip")


class Clip:
    """What a reader of the folder alone knows."""

    def __init__(self, folder: Path) -> None:
        self.capture = load_capture(folder)
        self.truth: GroundTruth = load_groundtruth(folder / "groundtruth")
        self.folder = folder

    def wTc(self, camera: int, time: int) -> Any:
        return self.truth.trajectories[f"cam{camera}"][1][time]

    def depth(self, camera: int, time: int) -> Any:
        return self.truth.depth(f"cam{camera}", time).astype(np.float64)

    def moving(self, camera: int, time: int) -> Any:
        return self.truth.moving(f"cam{camera}", time)

    def flow(self, camera: int, time: int) -> Any:
        content = np.load(self.folder / "groundtruth" / "flow" / f"cam{camera}" / f"{time:06d}.npz")
        return content["flow"], content["visible"]

    def pixels(self) -> Any:
        camera = self.capture.cameras[0]
        grid = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
        return np.stack(grid, axis=-1).reshape(-1, 2)

    def moved(self, camera: int, time: int, to_camera: int, to_time: int) -> tuple[Any, Any]:
        """Pixels and depths of a frame's points, as if nothing moved, in another frame."""
        K = self.capture.cameras[camera].intrinsics
        points = backproject(self.pixels(), self.depth(camera, time).ravel(), K)
        jTi = invert_pose(self.wTc(to_camera, to_time)) @ self.wTc(camera, time)
        return project(transform_points(jTi, points), K)


def depth_error(clip: Clip, pixels: Any, depth: Any, to_camera: int, to_time: int, kept: Any) -> Any:
    """|depth - that interpolated in the target|, m, where the target has no edge around the pixel."""
    target = clip.depth(to_camera, to_time)
    height, width = target.shape
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= 1) & (pixels <= [width - 2, height - 2]), axis=1) & kept
    x, y = pixels[inside].T
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    corners = np.stack([target[row + i, column + j] for i in (0, 1) for j in (0, 1)])
    # Inverse depth is linear in the image on a plane, and at a corner or an edge it is not.
    weights = np.stack([(1 - (y - row)) * (1 - (x - column)), (1 - (y - row)) * (x - column)])
    weights = np.concatenate([weights, [(y - row) * (1 - (x - column)), (y - row) * (x - column)]])
    flat = np.ptp(corners, axis=0) < 0.03 * corners.mean(axis=0)
    interpolated = 1.0 / np.sum(weights / corners, axis=0)
    return np.abs(interpolated - depth[inside])[flat]


def test_depth_agrees_between_cameras_at_one_instant_whether_it_moves_or_not(clip: Path) -> None:
    made = Clip(clip)
    for time in range(3):
        pixels, depth = made.moved(0, time, 1, time)
        # On a ball interpolation is worse than on a wall. The rest is hidden from the other camera.
        for part, tolerance in ((made.moving(0, time), 0.01), (~made.moving(0, time), 0.003)):
            error = depth_error(made, pixels, depth, 1, time, part.ravel())
            assert len(error) > 50
            assert np.mean(error < tolerance) > 0.75


def test_depth_of_what_stands_still_agrees_between_instants(clip: Path) -> None:
    made = Clip(clip)
    pixels, depth = made.moved(0, 0, 0, 2)
    still = ~made.moving(0, 0).ravel()
    error = depth_error(made, pixels, depth, 0, 2, still)
    assert len(error) > 2000 and np.mean(error < 0.003) > 0.9


def test_the_mask_is_what_the_flow_of_the_camera_does_not_explain(clip: Path) -> None:
    made = Clip(clip)
    for camera in (0, 1):
        pixels, _ = made.moved(camera, 0, camera, 1)
        flow, _ = made.flow(camera, 0)
        apart = np.linalg.norm((pixels - made.pixels()).reshape(flow.shape) - flow, axis=2)
        moving = made.moving(camera, 0)
        assert 0.02 < moving.mean() < 0.8
        assert apart[~moving].max() < 0.01  # px; depth on disk is rounded to 0.2 mm
        assert np.mean(apart[moving] > 0.05) > 0.95


def test_flow_follows_the_bodies_by_their_own_motion() -> None:
    scene = Scene.build(TINY)
    K = TINY.intrinsics
    from mvdyn_gtsam.scenes.render import Renderer

    renderer = Renderer(scene.mesh, TINY)
    here, there = scene.views(0)[0], scene.views(1)[0]
    truth = renderer.truth(here)
    flow = renderer.flow(truth, here, there)
    for number, body in enumerate(scene.bodies):
        if body.motion is None or not (seen := truth.body == number).any():
            continue
        in_world = transform_points(here.wTc, truth.points[seen])
        in_body = transform_points(invert_pose(body.motion(0.0)), in_world)
        later = transform_points(body.motion(1.0 / TINY.fps), in_body)
        expected, _ = project(transform_points(invert_pose(there.wTc), later), K)
        row, column = np.nonzero(seen)
        np.testing.assert_allclose(flow.flow[seen] + np.stack([column, row], axis=1), expected, atol=1e-4)
        # In its own frame every point is on the surface, so its frame is where the picture has it.
        corners = np.concatenate([patch.points.reshape(-1, 3) for patch in body.patches])
        assert np.all(in_body > corners.min(axis=0) - 1e-6) and np.all(in_body < corners.max(axis=0) + 1e-6)


def test_a_ball_rolls_without_slipping() -> None:
    from mvdyn_gtsam.scenes.motion import Orbit, Rolling

    ball = Rolling(Orbit((1.0, 2.0), 0.4, -0.7, 0.3), 0.25)
    step = 1e-6
    here, later = ball(0.5), ball(0.5 + step)
    touching = np.array([*here[:2, 3], 0.0])
    velocity = (transform_points(later @ invert_pose(here), touching[None])[0] - touching) / step
    np.testing.assert_allclose(velocity, 0.0, atol=1e-5)


def test_pictures_follow_the_flow(tmp_path: Path) -> None:
    """Colours belong to surface points: the next frame, warped back, fits best by the true flow."""
    import cv2

    settings = replace(TINY, width=256, height=192, frames=2, noise=0.0, fps=30.0)
    made = Clip(make_scene(settings, tmp_path / "clip"))
    flow, visible = made.flow(0, 0)
    here, there = (made.capture.read(0, time).astype(np.float32) for time in (0, 1))
    grid = made.pixels().reshape(192, 256, 2)
    target = (grid + flow).astype(np.float32)
    for part in (visible & made.moving(0, 0), visible & ~made.moving(0, 0)):
        differences = []
        for shift in ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)):
            x, y = np.moveaxis(target + np.array(shift, dtype=np.float32), -1, 0)
            differences.append(np.abs(cv2.remap(there, x, y, cv2.INTER_LINEAR) - here)[part].mean())
        assert all(differences[0] < 0.96 * difference for difference in differences[1:]), differences
    assert visible.mean() > 0.8 and not visible.all()


def test_what_is_hidden_in_the_next_frame_is_told(clip: Path) -> None:
    made = Clip(clip)
    flow, visible = made.flow(0, 0)
    target = (made.pixels() + flow.reshape(-1, 2)).reshape(flow.shape)
    inside = np.all((target >= -0.5) & (target <= [95.5, 63.5]), axis=2)
    assert not visible[~inside].any()
    hidden = inside & ~visible
    assert 0 < hidden.sum() < 0.2 * hidden.size


def test_a_room_has_no_holes_and_a_yard_has_a_sky(tmp_path: Path, clip: Path) -> None:
    assert all(np.isfinite(Clip(clip).depth(camera, time)).all() for camera in (0, 1) for time in range(3))
    yard = Clip(make_scene(replace(TINY, place="yard"), tmp_path / "yard"))
    sky = ~np.isfinite(yard.depth(0, 0))
    flow, visible = yard.flow(0, 0)
    assert 0.02 < sky.mean() < 0.6
    np.testing.assert_array_equal(~np.isfinite(flow[..., 0]), sky)
    assert not visible[sky].any() and not yard.moving(0, 0)[sky].any()
    assert json.loads((tmp_path / "yard" / "capture.json").read_text())["depth_scale"] == DEPTH_SCALE["yard"]


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("form", ["png", "mp4"])
def test_the_same_settings_give_the_same_bytes(tmp_path: Path, form: str) -> None:
    settings = replace(TINY, format=form, exposure=0.2)
    first, second = (files_of(make_scene(settings, tmp_path / name / "clip")) for name in ("a", "b"))
    assert first == second
    other = files_of(make_scene(replace(settings, seed=4), tmp_path / "c" / "clip"))
    assert other["groundtruth/depth/cam0/000000.png"] != first["groundtruth/depth/cam0/000000.png"]


def test_frames_are_read_back_as_they_were_made(tmp_path: Path) -> None:
    settings = replace(TINY, cameras=1, every=2, format="mp4", width=128, height=96)
    folder = make_scene(settings, tmp_path / "clip")
    capture = open_capture(folder)
    assert (capture.frame_count, capture.fps) == (3, 10.0)
    camera = capture.cameras[0]
    assert (camera.fx, camera.cx, camera.cy) == (0.8 * 128, 63.5, 47.5)
    lossless = open_capture(make_scene(replace(settings, format="png"), tmp_path / "png"))
    difference = capture.read(0, 2).astype(float) - lossless.read(0, 2)
    assert 0.0 < np.abs(difference).mean() < 12.0
    truth = load_groundtruth(folder / "groundtruth")
    assert truth.depth_frames("cam0") == [0, 2]
    assert len(list((folder / "groundtruth" / "flow" / "cam0").iterdir())) == 1  # frame 2 is the last
    assert json.loads((folder / "scene.json").read_text())["overlap"] is None


def test_overlap_is_what_was_asked_for() -> None:
    angles = []
    for wanted in (0.2, 0.5, 0.8):
        scene = Scene.build(replace(TINY, cameras=3, overlap=wanted, camera_motion=0.1, texture=0.0))
        assert abs(scene.overlaps().mean() - wanted) < 0.03
        angles.append(scene.angle)
    assert angles[0] > angles[1] > angles[2] > 0.0
    # Axes that cross farther ahead put the cameras farther apart.
    near, far = (
        np.linalg.norm(
            np.subtract(
                *Scene.build(replace(TINY, meet=meet, camera_motion=0.0, texture=0.0)).wTc(0)[:, :3, 3]
            )
        )
        for meet in (0.6, 1.2)
    )
    assert far > 1.3 * near


def test_each_knob_turns_what_it_says(tmp_path: Path) -> None:
    def made(name: str, **changes: Any) -> tuple[Any, dict[str, Any]]:
        folder = make_scene(replace(TINY, frames=1, cameras=1, noise=0.0, **changes), tmp_path / name)
        content: dict[str, Any] = json.loads((folder / "scene.json").read_text())
        return load_capture(folder).read(0, 0).astype(float), content

    plain, _ = made("plain", texture=0.0)
    rich, _ = made("rich", texture=1.0)
    roughness = [np.median(np.abs(np.diff(image, axis=1)).sum(axis=2)) for image in (plain, rich)]
    assert roughness[1] > 4.0 * max(roughness[0], 1.0)
    papered, _ = made("papered", texture=1.0, repeat=1.0)
    assert not np.array_equal(papered, rich)
    noisy = load_capture(make_scene(replace(TINY, frames=1, cameras=1, noise=0.05), tmp_path / "noisy"))
    clean, content = made("clean")
    assert abs(np.std(noisy.read(0, 0) - clean) - 0.05 * 255) < 2.0
    still, nothing = made("still", motion=0.0)
    assert nothing["moving"] == 0.0 < content["moving"] and nothing["moving_bodies"] == []


def test_exposure_drifts_within_its_bounds() -> None:
    scene = Scene.build(replace(TINY, cameras=1, texture=0.0, exposure=0.3))
    gains = np.array([scene.gain(0, time) for time in range(100)])
    assert gains.min() >= 0.7 and gains.max() <= 1.3 and np.ptp(gains) > 0.5


def test_a_scene_is_made_once_and_never_in_place_of_something_else(clip: Path, tmp_path: Path) -> None:
    settings = replace(TINY, noise=0.0)
    before = (clip / "scene.json").stat().st_mtime_ns
    assert make_scene(settings, clip) == clip
    assert (clip / "scene.json").stat().st_mtime_ns == before
    with pytest.raises(ConfigError, match="holds something else"):
        make_scene(replace(settings, seed=9), clip)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep me")
    with pytest.raises(ConfigError, match="holds something else"):
        make_scene(settings, tmp_path / "mine")
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep me"


def test_an_interrupted_scene_leaves_nothing_behind(tmp_path: Path) -> None:
    class Stop:
        def update(self, stage: str, done: int, total: int, note: str = "") -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_scene(TINY, tmp_path / "clip", Stop())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": 0}, "cameras 0: must be a whole number from 1 to 64"),
        ({"frames": 2.5}, "frames 2.5: must be a whole number"),
        ({"overlap": 1.2}, "overlap 1.2: must be a number from 0 to 1"),
        ({"noise": float("nan")}, "noise nan: must be a number"),
        ({"texture": "rich"}, "texture rich: must be a number"),
        ({"place": "moon"}, "place 'moon': must be one of room, yard"),
        ({"format": "mp4", "width": 97}, "size 97x64: a video needs an even width and height"),
    ],
)
def test_bad_settings_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(TINY, **change)


def test_without_the_ray_caster_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(ConfigError, match=r"pip install 'mvdyn_gtsam\[scenes\]'"):
        solve_angle(TINY)
