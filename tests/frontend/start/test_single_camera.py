"""Each camera alone: which frames, and the map that the real structure from motion makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.frontend.start.features import Features, extract_features
from mvdyn_gtsam.frontend.start.single_camera import (
    CameraMap,
    _median_triangulation_angle_deg,
    build_camera_map,
    choose_frames,
    match_neighbours,
)
from mvdyn_gtsam.geometry import invert_pose, project, rotation_angle_deg, transform_points
from tests.frontend.textures import texture
from tests.tracking.synthetic_scene import Frames, Scene, two_cameras


def panning(shifts: list[int], width: int = 256, height: int = 192) -> Capture:
    """A window that slides over one texture; ``shifts`` are its positions, px."""
    wide = np.repeat(texture((height, width + max(shifts) + 1))[..., None], 3, axis=2)
    images = [np.ascontiguousarray(wide[:, shift : shift + width]) for shift in shifts]
    camera = Camera("pan", width, height, 200.0, 200.0, (width - 1) / 2, (height - 1) / 2)
    return Capture("pan", 30.0, (camera,), (Frames(images),))


def test_a_still_camera_gives_its_first_and_last_frame() -> None:
    frames, travelled = choose_frames(panning([0] * 6), 0, step=0.03, maximum=40)
    assert frames.tolist() == [0, 5]
    assert travelled < 0.005


def test_frames_are_spaced_by_motion_not_by_time() -> None:
    # Fast for five frames, still for five, slow for ten: 8, 0 and 2 px per frame, of 256.
    shifts = np.concatenate([[0], 8 * np.arange(1, 6), [40] * 5, 40 + 2 * np.arange(1, 11)]).tolist()
    frames, travelled = choose_frames(panning(shifts), 0, step=15.0 / 256, maximum=40)
    assert travelled == pytest.approx(60 / 256, rel=0.05)
    assert frames[0] == 0 and frames[-1] == 20
    moved = np.diff(np.array(shifts)[frames])
    assert (moved[:-1] >= 14).all() and (moved[:-1] <= 24).all()


def test_long_ways_take_wider_steps() -> None:
    frames, _ = choose_frames(panning(list(range(0, 90, 3))), 0, step=0.001, maximum=6)
    assert 5 <= len(frames) <= 7
    assert np.ptp(np.diff(frames)[:-1]) <= 1


def map_of_two_views(angle_deg: float, parallel: int = 0) -> CameraMap:
    """Three points that two frames see under ``angle_deg``, and ``parallel`` more that one frame sees."""
    half = np.tan(np.radians(angle_deg / 2))
    mTc = np.tile(np.eye(4), (2, 1, 1))
    mTc[:, 0, 3] = -half, half
    rows = (np.arange(3 + parallel), np.arange(3))
    features = tuple(Features(np.zeros((len(own), 2)), np.zeros((len(own), 128), np.float32)) for own in rows)
    points = np.tile([0.0, 0.0, 1.0], (3 + parallel, 1))
    return CameraMap(0, np.array([0, 5]), mTc, features, rows, points)


def test_slow_or_short_videos_get_narrower_steps() -> None:
    slow = panning(list(range(0, 90, 3)))
    few, _ = choose_frames(slow, 0, step=0.15, maximum=40)
    more, _ = choose_frames(slow, 0, step=0.15, maximum=40, minimum=8)
    assert len(few) < 5 and 7 <= len(more) <= 9
    # nothing moves: noise is not to be divided into steps
    still, _ = choose_frames(panning([0] * 6), 0, step=0.15, maximum=40, minimum=8)
    assert still.tolist() == [0, 5]


@pytest.mark.parametrize("angle", [0.5, 2.0, 30.0])
def test_triangulation_angle(angle: float) -> None:
    assert _median_triangulation_angle_deg(map_of_two_views(angle)) == pytest.approx(angle, rel=1e-6)
    assert _median_triangulation_angle_deg(map_of_two_views(angle, parallel=2)) == pytest.approx(angle)
    assert _median_triangulation_angle_deg(map_of_two_views(angle, parallel=4)) == 0.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras()


def maps_of(scene: Scene, minimum_angle_deg: float = 1.0) -> list[CameraMap]:
    features = [[extract_features(image, 1000, 0.01) for image in track] for track in scene.images]
    times = [np.arange(len(track)) for track in scene.images]
    return [
        build_camera_map(
            index,
            camera,
            times[index],
            features[index],
            match_neighbours(features[index], 4, 0.8),
            minimum_angle_deg=minimum_angle_deg,
        )
        for index, camera in enumerate(scene.cameras)
    ]


@pytest.mark.slow
def test_maps_of_moving_cameras_are_right(scene: Scene) -> None:
    for camera, built in enumerate(maps_of(scene)):
        assert built.has_depth and built.camera == camera
        assert built.times.tolist() == list(range(9))
        truth = scene.wTc[camera]
        own, true = (invert_pose(wTc[0]) @ wTc for wTc in (built.mTc, truth))
        assert rotation_angle_deg((invert_pose(true) @ own)[:, :3, :3]).max() < 0.3
        scale = (own[:, :3, 3] * true[:, :3, 3]).sum() / (own[:, :3, 3] ** 2).sum()
        assert np.linalg.norm(scale * own[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.03  # of 0.5 travelled
        depths = []
        for frame, rows in enumerate(built.point_of_keypoint):
            points = transform_points(invert_pose(built.mTc[frame]), built.points[rows[rows >= 0]])
            pixels, depth = project(points, scene.cameras[camera].intrinsics)
            error = np.linalg.norm(pixels - built.features[frame].pixels[rows >= 0], axis=1)
            assert np.median(error) < 0.5
            x, y = np.rint(built.features[frame].pixels[rows >= 0]).astype(int).T
            depths.append(scale * depth / scene.depths[camera][frame][y, x])
        assert np.median(np.abs(np.concatenate(depths) - 1.0)) < 0.05
        own_depth = [
            transform_points(invert_pose(pose), built.points[rows[rows >= 0]])[:, 2]
            for pose, rows in zip(built.mTc, built.point_of_keypoint, strict=True)
        ]
        assert np.median(np.concatenate(own_depth)) == pytest.approx(1.0)


@pytest.mark.slow
def test_too_little_parallax_is_no_map(scene: Scene) -> None:
    first = Scene(scene.cameras[:1], scene.wTc[:1], scene.images[:1], scene.depths[:1])
    (built,) = maps_of(first, minimum_angle_deg=20.0)
    assert not built.has_depth
    assert built.times.tolist() == [0]
    assert (built.point_of_keypoint[0] == -1).all()


def test_two_frames_or_no_matches_are_no_map() -> None:
    rng = np.random.default_rng(0)

    def noise() -> Features:
        descriptors = rng.normal(size=(50, 128)).astype(np.float32)
        return Features(
            rng.uniform(0, 100, (50, 2)), descriptors / np.linalg.norm(descriptors, axis=1)[:, None]
        )

    camera = panning([0, 1]).cameras[0]
    same = noise()
    maps = [
        build_camera_map(
            index, camera, times, features, match_neighbours(features, 4, 0.8), minimum_angle_deg=1.0
        )
        for index, (times, features) in enumerate(
            [(np.array([0, 9]), [same, same]), (np.arange(4), [noise() for _ in range(4)])]
        )
    ]
    assert [one.has_depth for one in maps] == [False, False]
    assert [one.camera for one in maps] == [0, 1]
