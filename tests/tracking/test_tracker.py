"""The tracker on a tiny scene of textured planes, where the truth is known exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from mvdyn_gtsam.config import Config, load_config
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.dense_flow import DisFlow
from mvdyn_gtsam.frontend.start.model import Start, StartFrame
from mvdyn_gtsam.geometry import invert_pose, rotation_angle_deg
from mvdyn_gtsam.graph.connections import EdgeKind
from mvdyn_gtsam.tracking.model import StepReport, TrackingResult
from mvdyn_gtsam.tracking.tracker import Tracker
from tests.tracking.synthetic_scene import Scene, two_cameras

Tracked = tuple[Tracker, list[StepReport], TrackingResult]
SMALL = (
    "tracking.grid_points=300",
    "tracking.keyframe_px=0.5",
    "graph.long_range_separation=6",
    "frontend.flow.finest_scale=0",
    # The starts of these scenes are rough, and are said to be.
    "tracking.start_rotation_deg=0.25",
    "tracking.start_translation=0.01",
)


def track(
    scene: Scene,
    groups: tuple[tuple[int, ...], ...],
    overrides: Sequence[str] = (),
    start: Start | None = None,
) -> Tracked:
    config = load_config(None, [*SMALL, *overrides])
    tracker = Tracker(scene.cameras, start or scene.start(groups), DisFlow(config.frontend.flow), config)
    reports = [
        tracker.step(time, [images[time] for images in scene.images]) for time in range(scene.wTc.shape[1])
    ]
    return tracker, reports, tracker.finish()


def errors(wTc: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """RMS position error after one scale about the first camera centre, and largest rotation error, deg."""
    anchored, true = (invert_pose(p[0, 0]) @ p for p in (wTc, truth))
    a, b = anchored[..., :3, 3], true[..., :3, 3]
    scale = (a * b).sum() / (a * a).sum()
    position = np.sqrt(((scale * a - b) ** 2).sum(-1).mean())
    rotation = rotation_angle_deg((invert_pose(true) @ anchored)[..., :3, :3]).max()
    return float(position), float(rotation)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras()


@pytest.fixture(scope="module")
def short_scene() -> Scene:
    return two_cameras(count=5)


@pytest.fixture(scope="module")
def tracked(scene: Scene) -> Tracked:
    return track(scene, ((0, 1),))


def test_poses_are_recovered_better_than_the_start(scene: Scene, tracked: Tracked) -> None:
    _, _, result = tracked
    position, rotation = errors(result.wTc, scene.wTc)
    start = scene.start(((0, 1),))
    given = np.stack([[f.wTc for f in frames] for frames in start.frames])
    start_position, start_rotation = errors(given, scene.wTc[:, [0, 4, 8]])
    assert position < 0.004 < start_position  # of 5 units of depth
    assert rotation < 0.05 < start_rotation


def test_every_frame_has_a_pose_and_a_covariance(tracked: Tracked) -> None:
    _, reports, result = tracked
    assert np.isfinite(result.wTc).all()
    assert np.isfinite(result.covariance).all()
    assert (np.linalg.eigvalsh(result.covariance) > -1e-12).all()
    assert all(np.isfinite(report.wTc).all() for report in reports)


def test_first_and_last_frames_are_keyframes(tracked: Tracked) -> None:
    _, _, result = tracked
    assert all(times[0] == 0 and times[-1] == 8 for times in result.keyframe_times)


def test_both_kinds_of_edges_are_made_and_fit(tracked: Tracked) -> None:
    _, _, result = tracked
    kinds = {edge.kind for edge in result.edges}
    assert EdgeKind.TEMPORAL in kinds
    assert kinds & {EdgeKind.SPATIAL, EdgeKind.SPATIO_TEMPORAL}
    assert np.median([edge.median_px for edge in result.edges]) < 0.3
    assert len(result.counts) == 9
    assert result.counts[-1].temporal > result.counts[1].temporal


def test_depth_of_every_frame_is_right(scene: Scene, tracked: Tracked) -> None:
    tracker, _, result = tracked
    ratios = []
    seen = set()
    for depth in tracker.frame_depths():
        seen.add((depth.camera, depth.time))
        truth = result.grids[depth.camera].sample(scene.depths[depth.camera][depth.time])
        certain = depth.information > np.median(depth.information)
        ratios.append(np.exp(depth.log_depth)[certain] / truth[certain])
    assert seen == {(camera, time) for camera in range(2) for time in range(9)}
    ratio = np.concatenate(ratios)
    assert np.median(abs(ratio / np.median(ratio) - 1)) < 0.02


def test_threads_change_nothing(short_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        # guided, so that flow depends on the poses found before it
        guided = ("tracking.guided_px=0.0",)
        start = short_scene.start(((0, 1),), times=(0, 4))
        results.append(track(short_scene, ((0, 1),), guided, start)[2])
    np.testing.assert_allclose(results[1].wTc, results[0].wTc, atol=1e-9, rtol=0)


def test_twice_gives_the_same(short_scene: Scene) -> None:
    start = short_scene.start(((0, 1),), times=(0, 4))
    _, _, result = track(short_scene, ((0, 1),), start=start)
    _, _, again = track(short_scene, ((0, 1),), start=start)
    np.testing.assert_allclose(again.wTc, result.wTc, atol=1e-9, rtol=0)


def test_the_unit_of_the_start_is_kept(short_scene: Scene) -> None:
    scene, small = short_scene, short_scene.start(((0, 1),), times=(0, 4))
    shrink = np.array([[1, 1, 1, 0.01]] * 3 + [[1, 1, 1, 1]])
    frames = tuple(
        tuple(StartFrame(f.time, f.wTc * shrink, f.pixels, 0.01 * f.depth) for f in track_)
        for track_ in small.frames
    )
    first = track(scene, ((0, 1),), ("tracking.polish_rounds=0",), start=small)[2]
    second = track(scene, ((0, 1),), ("tracking.polish_rounds=0",), start=Start(small.groups, frames))[2]
    np.testing.assert_allclose(second.wTc[..., :3, 3], 0.01 * first.wTc[..., :3, 3], atol=1e-7)
    np.testing.assert_allclose(second.log_depth[0], first.log_depth[0] + np.log(0.01), atol=1e-4)


def test_cameras_of_different_groups_get_no_edges_between_them(scene: Scene) -> None:
    _, _, result = track(scene, ((0,), (1,)), ("tracking.polish_rounds=1",))
    assert all(edge.i[0] == edge.j[0] for edge in result.edges)
    for camera in range(2):
        position, rotation = errors(result.wTc[camera : camera + 1], scene.wTc[camera : camera + 1])
        assert position < 0.01
        assert rotation < 0.3  # one camera alone over a tenth of its depth


def test_a_static_camera_keeps_its_pose_and_finite_depth() -> None:
    scene = two_cameras(count=6, moving=(False, True))
    tracker, reports, result = track(scene, ((0, 1),), start=scene.start(((0, 1),), times=(0, 5)))
    assert result.keyframe_times[0] == (0, 5)
    moved = np.linalg.norm(result.wTc[0, :, :3, 3] - result.wTc[0, 0, :3, 3], axis=1)
    assert moved.max() < 0.01
    assert rotation_angle_deg(result.wTc[0, 0, :3, :3].T @ result.wTc[0, :, :3, :3]).max() < 0.05
    depth = np.exp(result.log_depth[0])
    assert (depth > 1.0).all() and (depth < 15.0).all()


def test_one_camera_alone_works() -> None:
    scene = two_cameras(count=6, moving=(True,))
    _, _, result = track(scene, ((0,),), start=scene.start(((0,),), times=(0, 5)))
    position, rotation = errors(result.wTc, scene.wTc)
    assert position < 0.01
    assert rotation < 0.1


def test_frames_out_of_order_or_of_the_wrong_size_are_refused(scene: Scene) -> None:
    tracker = Tracker(scene.cameras, scene.start(((0, 1),)), DisFlow(), Config())
    images = [track_[0] for track_ in scene.images]
    with pytest.raises(TrackingError, match="in order"):
        tracker.step(1, images)
    with pytest.raises(TrackingError, match="cam1.*100x120"):
        tracker.step(0, [images[0], images[1][:, :100]])
    with pytest.raises(TrackingError, match="1 frames for 2 cameras"):
        tracker.step(0, images[:1])
    with pytest.raises(TrackingError, match="never called"):
        tracker.finish()


def test_a_start_that_does_not_fit_is_refused(scene: Scene) -> None:
    start = scene.start(((0,), (0, 1)))
    with pytest.raises(TrackingError, match="groups"):
        Tracker(scene.cameras, start, DisFlow(), Config())
