"""Cameras without parallax on synthetic keypoints: random points, one random descriptor each, no images."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.config import Config
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, DepthView
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.joint_adjustment import AdjustmentConfig, adjust_maps
from mvdyn_gtsam.frontend.start.model import Start, StartFrame
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.frontend.start.still_cameras import (
    StillConfig,
    match_points,
    place_still_cameras,
    propose_poses,
    solve_still_views,
)
from mvdyn_gtsam.frontend.start.still_view import (
    StillView,
    build_still_view,
    estimate_rotations,
    frames_of_view,
    lone_frames,
    virtual_pinhole,
)
from mvdyn_gtsam.frontend.start.verification import VerificationConfig, verify_seen
from mvdyn_gtsam.frontend.start.wide_baseline import ClassicalInitializer
from mvdyn_gtsam.geometry import (
    Similarity,
    invert_pose,
    pixel_rays,
    project,
    rotation_angle_deg,
    transform_points,
)
from mvdyn_gtsam.tracking.tracker import Tracker

Array = npt.NDArray[np.float64]
CAMERA = Camera("cam", 320, 240, 300.0, 300.0, 159.5, 119.5)


def look_at(centre: Array, target: Array) -> Array:
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    wTc = np.eye(4)
    wTc[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    wTc[:3, 3] = centre
    return wTc


class World:
    """Random points around the origin, each with a random look."""

    def __init__(self, seed: int, count: int = 300) -> None:
        self.random = np.random.default_rng(seed)
        self.points = self.random.uniform(-1.0, 1.0, (count, 3))
        looks = self.random.normal(size=(count, 128))
        self.looks = (looks / np.linalg.norm(looks, axis=1, keepdims=True)).astype(np.float32)

    def seen(self, wTc: Array, camera: Camera = CAMERA, noise_px: float = 0.3) -> tuple[Features, Array]:
        """Keypoints of a frame, in random order, and the rows of the points they show."""
        pixels, _ = project(transform_points(invert_pose(wTc), self.points), camera.intrinsics)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(1)
        rows = self.random.permutation(np.flatnonzero(inside))
        noise = self.random.normal(size=(len(rows), 2)) * noise_px
        return Features(pixels[rows] + noise, self.looks[rows]), rows


def ring(count: int, radius: float = 3.5, step_deg: float = 25.0) -> list[Array]:
    angles = np.radians(step_deg) * np.arange(count)
    return [
        look_at(radius * np.array([np.sin(a), 0.1 * np.sin(3 * a), -np.cos(a)]), np.zeros(3)) for a in angles
    ]


def still_view(index: int, features: Features, camera: Camera = CAMERA) -> StillView:
    shape = (camera.height, camera.width)
    return StillView(
        index, camera, np.zeros(shape, np.uint8), np.ones(shape, bool), features,
        np.array([0, 9]), np.tile(np.eye(3), (2, 1, 1)),
    )  # fmt: skip


def map_of(world: World, index: int, poses: list[Array]) -> CameraMap:
    features, rows = zip(*(world.seen(wTc) for wTc in poses), strict=True)
    return CameraMap(index, np.arange(len(poses)), np.stack(poses), features, rows, world.points)


def relative_error(aTw: Array, bTw: Array, wTa: Array, wTb: Array) -> tuple[float, float]:
    """Rotation error and error of the direction of translation between two cameras, degrees."""
    estimate, truth = aTw @ invert_pose(bTw), invert_pose(wTa) @ wTb
    cosine = estimate[:3, 3] @ truth[:3, 3] / np.linalg.norm(estimate[:3, 3]) / np.linalg.norm(truth[:3, 3])
    angle = float(rotation_angle_deg(estimate[:3, :3].T @ truth[:3, :3]))
    return angle, float(np.degrees(np.arccos(min(cosine, 1.0))))


@pytest.mark.parametrize("count", [2, 4])
def test_still_cameras_are_placed_among_themselves(count: int) -> None:
    world, truth = World(0), ring(count)
    views = [still_view(index, world.seen(wTc)[0]) for index, wTc in enumerate(truth)]
    maps, same_point = solve_still_views(views, StillConfig())
    assert sorted(maps) == list(range(count))
    assert len(same_point) == count * (count - 1) // 2
    for other in range(1, count):
        first, second = invert_pose(maps[0].mTc[0]), invert_pose(maps[other].mTc[0])
        rotation, direction = relative_error(first, second, truth[0], truth[other])
        assert rotation < 0.5 and direction < 1.0


def test_each_still_camera_keeps_its_own_intrinsics() -> None:
    """One focal length for all would turn or shift the cameras visibly."""
    world, truth = World(1), ring(3)
    wide = Camera("wide", 320, 240, 230.0, 230.0, 150.0, 125.0)
    cameras = [CAMERA, Camera("large", 400, 300, 380.0, 375.0, 210.0, 140.0), wide]
    views = [
        still_view(i, world.seen(wTc, camera)[0], camera)
        for i, (wTc, camera) in enumerate(zip(truth, cameras, strict=True))
    ]
    maps, _ = solve_still_views(views, StillConfig())
    assert sorted(maps) == [0, 1, 2]
    for camera_map, view in zip(maps.values(), views, strict=True):
        keypoints = np.flatnonzero(camera_map.point_of_keypoint[0] >= 0)
        points = transform_points(
            invert_pose(camera_map.mTc[0]), camera_map.points[camera_map.point_of_keypoint[0][keypoints]]
        )
        pixels, _ = project(points, view.pinhole.intrinsics)
        assert np.median(np.linalg.norm(pixels - view.features.pixels[keypoints], axis=1)) < 0.6


def test_a_still_camera_of_another_place_is_not_joined() -> None:
    """Its random looks match nothing; the others are placed all the same."""
    world, truth = World(2), ring(3)
    views = [still_view(index, world.seen(wTc)[0]) for index, wTc in enumerate(truth)]
    views.append(still_view(3, World(99).seen(truth[0])[0]))
    maps, _ = solve_still_views(views, StillConfig())
    assert sorted(maps) == [0, 1, 2]


def test_chance_matches_place_nobody(caplog: pytest.LogCaptureFixture) -> None:
    """Same looks at random places: matches abound, geometry explains few of them."""
    world, random = World(3), np.random.default_rng(3)
    views = [still_view(i, Features(random.uniform(0, 240, (300, 2)), world.looks.copy())) for i in range(3)]
    with caplog.at_level(logging.INFO):
        maps, _ = solve_still_views(views, StillConfig())
    assert maps == {}


@pytest.mark.parametrize("wrong_share", [0.0, 0.6])
def test_pose_from_points_of_a_placed_map(wrong_share: float) -> None:
    world = World(4)
    poses = ring(5, step_deg=3.0)
    camera_map = map_of(world, 0, poses)
    wTr = ring(1, radius=4.0)[0] @ np.array([[1, 0, 0, 0.5], [0, 1, 0, 0.2], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    features, _ = world.seen(wTr)
    wrong = world.random.random(len(features.pixels)) < wrong_share
    features.pixels[wrong] = world.random.uniform(0, 240, (int(wrong.sum()), 2))
    view = still_view(1, features)
    # The group's world is not the map's frame: a similarity lies between.
    wSm = Similarity(2.0, Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    seen = match_points(view, [camera_map], [wSm], StillConfig())
    rTw, error = propose_poses(seen, view, StillConfig())[0]
    expected = wSm.transform_poses(wTr)
    assert rotation_angle_deg(rTw[:3, :3] @ expected[:3, :3]) < 0.3
    np.testing.assert_allclose(invert_pose(rTw)[:3, 3], expected[:3, 3], atol=0.05)
    assert (error < 4.0).sum() > 0.9 * (~wrong).sum()


def test_no_pose_from_points_of_another_place() -> None:
    camera_map = map_of(World(5), 0, ring(4, step_deg=3.0))
    view = still_view(1, World(6).seen(ring(1)[0])[0])
    seen = match_points(view, [camera_map], [Similarity.identity()], StillConfig())
    assert propose_poses(seen, view, StillConfig()) == []


def textured_plane(wTc: Array, camera: Camera = CAMERA) -> tuple[npt.NDArray[np.float32], Array]:
    """Image and z-depth of the plane z = 0, painted with noise that does not repeat."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = pixel_rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float), camera.intrinsics)
    depth = -wTc[2, 3] / (rays @ wTc[2, :3])
    where = transform_points(wTc, rays * depth[:, None])
    image = 128.0 + sum(
        25.0 * np.sin(where[:, 0] * a + where[:, 1] * b + c)
        for a, b, c in np.random.default_rng(0).uniform(-12.0, 12.0, (8, 3))
    )
    return image.reshape(rows.shape).astype(np.float32), depth.reshape(rows.shape)


def plane_view(wTc: Array) -> DepthView:
    image, depth = textured_plane(wTc)
    grid = Grid.covering(CAMERA.width, CAMERA.height, 4)
    return DepthView(
        0, wTc, CAMERA.intrinsics, grid, grid.sample(depth.astype(np.float32)).astype(float), image
    )


def test_warping_into_a_still_camera_tells_true_from_false() -> None:
    views = [plane_view(wTc) for wTc in ring(3, step_deg=4.0)]
    wTr = ring(3, step_deg=-10.0)[1]
    image, _ = textured_plane(wTr)
    config = VerificationConfig()

    def trust(wTr: Array) -> float:
        verdict = verify_seen(
            views, Similarity.identity(), image, CAMERA.intrinsics, invert_pose(wTr), config
        )
        return verdict.trust

    turned = wTr.copy()
    turned[:3, :3] = wTr[:3, :3] @ Rotation.from_rotvec([0.0, 0.15, 0.0]).as_matrix()
    assert trust(wTr) > 0.95
    assert trust(turned) < StillConfig().minimum_trust


def test_nothing_is_placed_by_points_without_dense_support() -> None:
    """Perfect matches, but the still camera's image shows nothing of what the map saw: no placement."""
    world = World(7)
    poses = ring(4, step_deg=4.0)
    camera_map = map_of(world, 0, poses)
    image = np.random.default_rng(1).integers(0, 255, (CAMERA.height, CAMERA.width)).astype(np.uint8)
    view = still_view(1, world.seen(ring(2)[1])[0])
    view = StillView(1, CAMERA, image, view.seen, view.features, view.times, view.rRc)
    dense = {0: DenseMap(camera_map, tuple(plane_view(wTc) for wTc in poses), 1.0)}
    groups = [{0: Similarity.identity()}]
    placed = place_still_cameras(
        [CAMERA, CAMERA], dense, groups, {1: view}, StillConfig(), VerificationConfig()
    )
    assert placed.maps == {} and [sorted(g) for g in placed.groups] == [[0]]


def turning(angles_deg: list[float]) -> Array:
    return Rotation.from_euler("y", np.array(angles_deg)[:, None], degrees=True).as_matrix()


def frames_of_turn(world: World, wRc: Array) -> list[Features]:
    poses = np.tile(np.eye(4), (len(wRc), 1, 1))
    poses[:, :3, :3] = wRc
    poses[:, :3, 3] = [0.0, 0.0, -3.5]
    return [world.seen(wTc)[0] for wTc in poses]


def test_rotations_of_a_turning_camera() -> None:
    wRc = turning([-16.0, -8.0, 0.0, 8.0, 16.0])
    rRc = estimate_rotations(frames_of_turn(World(8, 900), wRc), CAMERA.intrinsics)
    assert rRc is not None
    error = rotation_angle_deg(np.swapaxes(rRc[2].T @ rRc, 1, 2) @ (wRc[2].T @ wRc))
    assert error.max() < 0.1


def test_a_still_camera_has_no_rotation_at_all() -> None:
    rRc = estimate_rotations(frames_of_turn(World(9), turning([0.0] * 4)), CAMERA.intrinsics)
    assert rRc is not None
    assert (rRc == np.eye(3)).all()


def test_a_camera_that_moves_is_no_still_view() -> None:
    world = World(10)
    assert (
        estimate_rotations([world.seen(wTc)[0] for wTc in ring(4, step_deg=12.0)], CAMERA.intrinsics) is None
    )


def test_the_joined_image_holds_every_frame() -> None:
    rRc = turning([-15.0, 0.0, 15.0])
    pinhole = virtual_pinhole(CAMERA, rRc)
    corners = np.array([[0.0, 0.0], [319.0, 0.0], [0.0, 239.0], [319.0, 239.0]])
    for R in rRc:
        pixels, _ = project(pixel_rays(corners, CAMERA.intrinsics) @ R.T, pinhole.intrinsics)
        assert (pixels >= -1e-3).all() and (pixels <= [pinhole.width - 0.99, pinhole.height - 0.99]).all()
    assert virtual_pinhole(CAMERA, turning([-89.0, 0.0, 89.0])).width <= 3 * CAMERA.width


def test_frames_of_a_turning_view_see_the_same_points() -> None:
    rRc = turning([-12.0, 0.0, 12.0])
    pinhole = virtual_pinhole(CAMERA, rRc)
    view = StillView(
        0, pinhole, np.zeros((2, 2), np.uint8), np.ones((2, 2), bool),
        Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32)), np.array([0, 4, 9]), rRc,
    )  # fmt: skip
    world, wTr = World(11), ring(1)[0]
    pixels, depth = project(transform_points(invert_pose(wTr), world.points), pinhole.intrinsics)
    frames = frames_of_view(view, CAMERA, StartFrame(0, wTr, pixels, depth))
    assert [frame.time for frame in frames] == [0, 4, 9]
    for frame in frames:
        assert len(frame.depth) > 50
        world_points = transform_points(
            frame.wTc, pixel_rays(frame.pixels, CAMERA.intrinsics) * frame.depth[:, None]
        )
        nearest = np.linalg.norm(world_points[:, None] - world.points[None], axis=2).min(1)
        assert nearest.max() < 1e-9


def test_joint_adjustment_moves_a_badly_placed_camera() -> None:
    """The farthest camera may not be held in place to fix the scale."""
    world, poses = World(12), ring(4, step_deg=3.0)
    moving = map_of(world, 0, poses)
    wTr = ring(3)[2]
    features, rows = world.seen(wTr, noise_px=0.1)
    still = CameraMap(1, np.array([0]), np.eye(4)[None], (features,), (np.arange(len(rows)),),
                      transform_points(invert_pose(wTr), world.points[rows]))  # fmt: skip
    off = wTr.copy()
    off[:3, 3] += [0.05, -0.03, 0.04]
    group = {0: Similarity.identity(), 1: Similarity(1.0, off[:3, :3], off[:3, 3])}
    pairs = np.column_stack([rows, np.arange(len(rows))])
    adjusted = adjust_maps([CAMERA, CAMERA], [moving, still], group, [(0, 1, pairs)], AdjustmentConfig())
    frames = adjusted.frames
    angle, direction = relative_error(
        invert_pose(frames[0][0].wTc), invert_pose(frames[1][0].wTc), poses[0], wTr
    )
    assert angle < 0.2 and direction < 0.2


class Held:
    """A video of one image."""

    def __init__(self, image: npt.NDArray[np.uint8], count: int) -> None:
        self.image, self.count = image, count

    def __len__(self) -> int:
        return self.count

    def read(self, time: int) -> npt.NDArray[np.uint8]:
        return self.image


def noise_image(seed: int) -> npt.NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(0, 255, (24, 32)).astype(np.uint8)
    return np.repeat(np.kron(coarse, np.ones((10, 10), np.uint8))[..., None], 3, 2)


def test_cameras_nothing_connects_are_tracked_in_worlds_of_their_own() -> None:
    """No camera has depth and no two share a view: a trajectory for each all the same, and a note."""
    capture = Capture("held", 30.0, (CAMERA, CAMERA), (Held(noise_image(0), 4), Held(noise_image(1), 4)))
    start = ClassicalInitializer(DisFlow())(capture)
    assert start.groups == ((0,), (1,)) and len(start.notes) == 2
    tracker = Tracker(capture.cameras, start, DisFlow(), Config(), read=capture.read)
    for time in range(capture.frame_count):
        tracker.step(time, [capture.read(camera, time) for camera in range(2)])
    wTc = tracker.finish().wTc
    np.testing.assert_allclose(wTc, np.broadcast_to(np.eye(4), wTc.shape), atol=1e-3)


def test_a_held_image_stands_still() -> None:
    capture = Capture("held", 30.0, (CAMERA,), (Held(noise_image(2), 5),))
    view = build_still_view(capture, 0, np.array([0, 2, 4]), features=500, contrast=0.01)
    assert view is not None and not view.turns
    assert view.pinhole == CAMERA
    assert (view.image == noise_image(2)[..., 0]).all()


def test_lone_frames_keep_a_turn() -> None:
    view = StillView(
        0, CAMERA, np.zeros((2, 2), np.uint8), np.ones((2, 2), bool),
        Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32)), np.array([0, 9]), turning([-5.0, 5.0]),
    )  # fmt: skip
    first, last = lone_frames(CAMERA, 10, view)
    assert (first.wTc == np.eye(4)).all() or np.allclose(first.wTc, np.eye(4))
    assert rotation_angle_deg(last.wTc[:3, :3]) == pytest.approx(10.0)
    start = Start(((0,),), (lone_frames(CAMERA, 10, None),))
    assert [frame.time for frame in start.frames[0]] == [0, 9]


def test_bad_config_is_refused() -> None:
    with pytest.raises(ConfigError):
        StillConfig(minimum_inliers=3)
