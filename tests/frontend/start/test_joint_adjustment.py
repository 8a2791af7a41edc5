"""Bundle adjustment of placed maps, on maps whose error is known."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.rig import RigConfig, likely_mounts
from mvdyn_gtsam.frontend.start.bundle import Observations
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.joint_adjustment import (
    AdjustmentConfig,
    _choose_points,
    _merge,
    _search,
    adjust_maps,
)
from mvdyn_gtsam.frontend.start.model import StartFrame
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.geometry import Similarity, invert_pose, project, rotation_angle_deg, transform_points
from tests.frontend.start.synthetic_maps import CAMERA, camera_map, cloud, poses, unit_descriptors

Array = npt.NDArray[np.float64]
SCENE = cloud(150)
IDENTITY = Similarity.identity()
TRUTH = (poses((0.0, 0.0, 0.0), 6), poses((0.3, 0.05, -0.05), 6, turn_deg=-12.0))


def drifting(camera: int) -> CameraMap:
    """The camera's map, bent more and more along its path: what a single camera leaves uncertain."""
    exact = camera_map(camera, SCENE, TRUTH[camera], IDENTITY, noise_px=0.3)
    bent = exact.mTc.copy()
    for frame in range(len(bent)):
        turn = Rotation.from_rotvec(np.radians([0.1, 0.25, 0.05]) * frame).as_matrix()
        bent[frame, :3, :3] = bent[frame, :3, :3] @ turn
        bent[frame, :3, 3] += frame * np.array([0.004, -0.002, 0.005])
    random = np.random.default_rng(camera)
    return replace(exact, mTc=bent, points=exact.points * np.exp(0.02 * random.normal(size=(150, 1))))


@pytest.fixture(scope="module")
def maps() -> list[CameraMap]:
    return [drifting(0), drifting(1)]


def common_points(maps: list[CameraMap], count: int) -> npt.NDArray[np.int64]:
    first, second = (np.concatenate(one.point_of_keypoint) for one in maps)
    rows = np.intersect1d(first, second)
    chosen = np.random.default_rng(0).choice(rows, count, replace=False)
    return np.column_stack([chosen, chosen])


@pytest.fixture(scope="module")
def adjusted(maps: list[CameraMap]) -> dict[int, tuple[StartFrame, ...]]:
    group = {0: IDENTITY, 1: IDENTITY}
    pairs = [(0, 1, common_points(maps, 12))]
    return adjust_maps([CAMERA, CAMERA], maps, group, pairs, AdjustmentConfig()).frames


def stacked(frames: dict[int, tuple[StartFrame, ...]]) -> Array:
    return np.stack([frame.wTc for camera in (0, 1) for frame in frames[camera]])


def errors(wTc: Array, truth: Array | None = None) -> tuple[float, float]:
    """Largest errors after one scale about the first camera: position in median depths, rotation in deg."""
    truth = np.concatenate(TRUTH) if truth is None else truth
    own, true = (invert_pose(one[0]) @ one for one in (wTc, truth))
    scale = (own[:, :3, 3] * true[:, :3, 3]).sum() / (own[:, :3, 3] ** 2).sum()
    position = np.linalg.norm(scale * own[:, :3, 3] - true[:, :3, 3], axis=1).max()
    return float(position), float(rotation_angle_deg((invert_pose(true) @ own)[:, :3, :3]).max())


def test_drift_is_taken_out(maps: list[CameraMap], adjusted: dict[int, tuple[StartFrame, ...]]) -> None:
    before = errors(np.concatenate([one.mTc for one in maps]))
    after = errors(stacked(adjusted))
    assert before[0] > 0.015 and before[1] > 1.0
    assert after[0] < 0.003 and after[1] < 0.2


def test_the_first_pose_stays_where_it_is(
    maps: list[CameraMap], adjusted: dict[int, tuple[StartFrame, ...]]
) -> None:
    np.testing.assert_allclose(adjusted[0][0].wTc, maps[0].mTc[0], atol=1e-5)


def test_the_scale_stays_that_of_the_first_map(
    maps: list[CameraMap], adjusted: dict[int, tuple[StartFrame, ...]]
) -> None:
    spread = [
        np.linalg.norm(wTc[:, :3, 3] - wTc[0, :3, 3], axis=1).max()
        for wTc in (np.concatenate([one.mTc for one in maps]), stacked(adjusted))
    ]
    assert spread[1] == pytest.approx(spread[0], rel=0.01)


def test_depths_are_those_of_the_points_seen(
    maps: list[CameraMap], adjusted: dict[int, tuple[StartFrame, ...]]
) -> None:
    for camera in (0, 1):
        for number, frame in enumerate(adjusted[camera]):
            assert frame.time == maps[camera].times[number]
            pixels, depth = project(
                transform_points(invert_pose(TRUTH[camera][number]), SCENE.points), CAMERA.intrinsics
            )
            nearest = np.linalg.norm(frame.pixels[:, None] - pixels, axis=2).argmin(1)
            ratio = frame.depth / depth[nearest]
            assert np.quantile(abs(ratio / np.median(ratio) - 1.0), 0.95) < 0.02
            assert len(frame.depth) > 40


def test_one_camera_alone_is_adjusted_too(maps: list[CameraMap]) -> None:
    frames = adjust_maps([CAMERA], maps[:1], {0: IDENTITY}, [], AdjustmentConfig()).frames
    wTc = np.stack([frame.wTc for frame in frames[0]])
    own, true = (invert_pose(one[0]) @ one for one in (wTc, TRUTH[0]))
    assert rotation_angle_deg((invert_pose(true) @ own)[:, :3, :3]).max() < 0.3


def test_images_tell_the_focal_lengths_whether_they_are_known_or_not() -> None:
    wrong = replace(CAMERA, fx=1.04 * CAMERA.fx, fy=1.04 * CAMERA.fy)
    oblong = replace(wrong, fy=1.02 * CAMERA.fy)
    unknown = replace(wrong, focal_known=False)
    maps = [camera_map(camera, SCENE, turned(TRUTH[camera]), IDENTITY, noise_px=0.3) for camera in (0, 1)]
    group = {0: IDENTITY, 1: IDENTITY}
    pairs = [(0, 1, common_points(maps, 60))]
    config = AdjustmentConfig(maximum_iterations=100, relative_tolerance=1e-5)
    known = adjust_maps([wrong, wrong], maps, group, pairs, config, ask_focal=True)
    # what is known is kept, and doubted
    assert known.cameras == (wrong, wrong) and known.focal_deviation == {}
    for told in known.told_focal.values():
        assert abs(told.focal / CAMERA.fx - 1.0) < 0.01 < wrong.fx / CAMERA.fx - 1.0
        assert abs(told.focal - CAMERA.fx) < 3.0 * told.deviation
    assert len(known.told_focal) == 2
    assert adjust_maps([wrong, wrong], maps, group, pairs, config).told_focal == {}
    mixed = adjust_maps([oblong, unknown], maps, group, pairs, config, ask_focal=True)
    assert mixed.told_focal == {} and mixed.cameras[0] == oblong
    assert list(mixed.focal_deviation) == [1]
    found = adjust_maps([CAMERA, unknown], maps, group, pairs, config)
    assert found.cameras[0] == CAMERA
    assert abs(found.cameras[1].fx / CAMERA.fx - 1.0) < 0.005
    # poses come with the focal length
    position, rotation = errors(stacked(found.frames), np.concatenate([turned(own) for own in TRUTH]))
    assert position < 0.003 and rotation < 0.2


def turned(wTc: Array) -> Array:
    """A camera that looks around as it goes: otherwise its focal length stays open."""
    result = wTc.copy()
    for frame, pose in enumerate(result):
        turn = Rotation.from_rotvec([0.06 * np.sin(2.0 * frame), 0.05 * np.cos(frame), 0.1 * np.sin(frame)])
        pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
    return result


def every_sighting(maps: list[CameraMap]) -> Observations:
    """Every keypoint of every frame, as a sighting of the true point."""
    rows = [
        np.column_stack([seen, np.full((len(seen), 2), [one.camera, frame]), one.features[frame].pixels])
        for one in maps
        for frame, seen in enumerate(one.point_of_keypoint)
    ]
    table = np.concatenate(rows)
    index = table[:, :3].astype(np.int64)
    return Observations(index[:, 0], index[:, 1], index[:, 2], table[:, 3:], SCENE.points)


def only(one: Observations, kept: npt.NDArray[np.bool_]) -> Observations:
    return Observations(one.landmark[kept], one.camera[kept], one.frame[kept], one.pixel[kept], one.points)


def test_search_finds_the_sightings_that_were_missed_and_no_others() -> None:
    exact = [camera_map(camera, SCENE, TRUTH[camera], IDENTITY, noise_px=0.5) for camera in (0, 1)]
    everything = every_sighting(exact)
    # A third of the sightings is unknown; of ten landmarks camera 1 has none at all.
    known = (np.arange(len(everything.landmark)) % 3 != 0) & ~(
        (everything.camera == 1) & (everything.landmark < 10)
    )
    given = only(everything, known)
    wTc = {(camera, frame): TRUTH[camera][frame] for camera in (0, 1) for frame in range(6)}
    found = _search([CAMERA, CAMERA], exact, wTc, given, 5.0, 0.85)

    def labels(observations: Observations) -> set[tuple[int, ...]]:
        columns = np.column_stack([observations.landmark, observations.camera, observations.frame])
        return set(map(tuple, columns.tolist()))

    true = {(*label, *pixel) for label, pixel in zip(
        zip(everything.landmark, everything.camera, everything.frame, strict=True),
        map(tuple, everything.pixel), strict=True,
    )}  # fmt: skip
    for label, pixel in zip(
        zip(found.landmark, found.camera, found.frame, strict=True), found.pixel, strict=True
    ):
        assert (*label, *pixel) in true
    assert labels(given) < labels(found)
    missed = labels(everything) - labels(given)
    assert len(labels(found) & missed) > 0.95 * len(missed)
    assert len(found.landmark) == len(labels(found))  # no landmark twice in a frame


def test_search_refuses_what_is_far_or_looks_different() -> None:
    exact = camera_map(0, SCENE, TRUTH[0], IDENTITY)
    everything = every_sighting([exact])
    known = everything.frame < 5
    given = only(everything, known)
    wTc = {(0, frame): TRUTH[0][frame] for frame in range(6)}
    last = exact.features[5]
    impostors = unit_descriptors(np.random.default_rng(9), len(last.pixels))
    for features in (
        Features(last.pixels, impostors),  # at the place, of another look
        Features(last.pixels + [9.0, 0.0], last.descriptors),  # of the look, off the place
    ):
        changed = replace(exact, features=(*exact.features[:5], features))
        found = _search([CAMERA], [changed], wTc, given, 5.0, 0.85)
        assert len(found.landmark) == len(given.landmark)


def test_merging_follows_chains_and_keeps_the_lowest() -> None:
    pairs = [np.array([[0, 3], [3, 4]]), np.array([[5, 2]])]
    assert _merge(7, pairs).tolist() == [0, 1, 2, 0, 0, 2, 6]
    assert _merge(3, []).tolist() == [0, 1, 2]


def test_shared_points_all_enter_and_the_best_seen_of_one_camera() -> None:
    sightings: dict[int, list[int]] = defaultdict(list)
    sightings |= {0: [0, 1], 1: [0, 0, 0], 2: [0, 0, 0, 0], 3: [0, 0], 4: [1, 1, 1]}
    landmark = np.array([point for point, cameras in sightings.items() for _ in cameras])
    camera = np.array([one for cameras in sightings.values() for one in cameras])
    keep = _choose_points(landmark, camera, 6, per_camera=1)
    assert keep.tolist() == [True, False, True, False, True, False]


def test_nonsense_is_refused() -> None:
    with pytest.raises(ConfigError, match="search_px"):
        AdjustmentConfig(search_px=(5.0, 0.0))


def adjusted_pair(wTa: Array, wTb: Array, rig: RigConfig) -> Array:
    """``aTb (K, 4, 4)`` after adjustment of two cameras whose maps' scales drift apart."""
    maps = []
    for camera, truth in enumerate((wTa, wTb)):
        exact = camera_map(camera, SCENE, truth, IDENTITY, noise_px=0.3)
        growing = exact.mTc.copy()
        growing[:, :3, 3] *= np.linspace(0.98, 1.02, len(growing))[:, None]
        maps.append(replace(exact, mTc=growing))
    group = {0: IDENTITY, 1: IDENTITY}
    pairs = [(0, 1, common_points(maps, 12))]
    frames = adjust_maps([CAMERA, CAMERA], maps, group, pairs, AdjustmentConfig(rig=rig)).frames
    a, b = (np.stack([frame.wTc for frame in frames[camera]]) for camera in (0, 1))
    return invert_pose(a) @ b


def spread(aTb: Array) -> float:
    return float(np.linalg.norm(aTb[:, :3, 3] - aTb[:, :3, 3].mean(axis=0), axis=1).max())


def test_cameras_mounted_on_one_another_are_held() -> None:
    mount = invert_pose(TRUTH[0][0]) @ TRUTH[1][0]
    held = adjusted_pair(TRUTH[0], TRUTH[0] @ mount, RigConfig())
    free = adjusted_pair(TRUTH[0], TRUTH[0] @ mount, RigConfig(rotation_deg=0.0))
    assert spread(held) < 1e-4 < spread(free)
    distance = np.linalg.norm(held[:, :3, 3], axis=1).mean()
    assert distance == pytest.approx(np.linalg.norm(mount[:3, 3]), rel=0.03)


def test_cameras_that_slide_apart_are_not_held() -> None:
    """They keep their rotation and nearly their distance: only the images tell."""
    aTb = np.tile(invert_pose(TRUTH[0][0]) @ TRUTH[1][0], (6, 1, 1))
    aTb[:, :3, 3] *= np.linspace(0.95, 1.05, 6)[:, None]
    poses = {(0, time): pose for time, pose in enumerate(TRUTH[0])}
    poses |= {(1, time): pose for time, pose in enumerate(TRUTH[0] @ aTb)}
    assert likely_mounts(poses, RigConfig())
    found = adjusted_pair(TRUTH[0], TRUTH[0] @ aTb, RigConfig())
    assert spread(found) == pytest.approx(spread(aTb), rel=0.2)
