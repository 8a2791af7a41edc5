"""The whole reconstruction: end to end on rendered planes, killed, resumed, run twice."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mvdyn_gtsam.capture import FIRST_FOCAL, load_capture, with_unknown_focal
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.config import Config, load_config
from mvdyn_gtsam.demo import demo_capture
from mvdyn_gtsam.errors import DepthPriorError, ResultError, TrackingError
from mvdyn_gtsam.evaluation import evaluate
from mvdyn_gtsam.frontend.dense_flow import DisFlow, Float32, Image
from mvdyn_gtsam.frontend.depth_priors.depth_prior import NoDepthPrior
from mvdyn_gtsam.frontend.start.model import FoundIntrinsics, Start
from mvdyn_gtsam.geometry import invert_pose, rotation_angle_deg
from mvdyn_gtsam.pipeline import reconstruct
from mvdyn_gtsam.progress import Progress
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.refinement.tasks import TASKS
from tests.tracking.synthetic_scene import Scene, two_cameras

SMALL = (
    "tracking.grid_points=300",
    "tracking.keyframe_px=0.5",
    "graph.long_range_separation=6",
    "frontend.wide_baseline.features=1000",
    "refinement.workers=1",
    "refinement.sweep.levels=40",
)
ALL_STAGES = ["start", "tracking", "refinement"]


def config() -> Config:
    return load_config(None, SMALL)


class GivenStart:
    """An initializer that hands out a start and counts how often it is asked."""

    def __init__(self, start: Start) -> None:
        self.start, self.calls = start, 0

    def __call__(self, capture: Capture, progress: Progress) -> Start:
        self.calls += 1
        return self.start


class StoppedError(Exception):
    """What ends a run in the middle."""


class FlowThatStops(DisFlow):
    """Measures ``count`` directions, then ends the run."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.left = count

    def flow(self, grey_i: Image, grey_j: Image, halved: int = 0) -> Float32:
        self.left -= 1
        if self.left < 0:
            raise StoppedError
        return super().flow(grey_i, grey_j, halved)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(count=6)


@pytest.fixture(scope="module")
def start(scene: Scene) -> GivenStart:
    return GivenStart(scene.start(((0, 1),), times=(0, 3, 5)))


@pytest.fixture(scope="module")
def result(scene: Scene, start: GivenStart, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    out = tmp_path_factory.mktemp("pipeline") / "out"
    return reconstruct(scene.capture(), out, config(), initializer=start)


def all_poses(result: Reconstruction) -> np.ndarray:
    return np.stack([result.trajectory(name)[1] for name in result.cameras])


def assert_right(result: Reconstruction, scene: Scene, position: float, rotation: float) -> None:
    """Every frame has a pose and a depth; RMS position and largest rotation error (deg) are within bounds."""
    wTc = all_poses(result)
    assert np.isfinite(wTc).all() and wTc.shape == scene.wTc.shape
    own, true = (invert_pose(poses[0, 0]) @ poses for poses in (wTc, scene.wTc))
    a, b = own[..., :3, 3], true[..., :3, 3]
    scale = (a * b).sum() / (a * a).sum()
    assert np.sqrt(((scale * a - b) ** 2).sum(-1).mean()) < position
    assert rotation_angle_deg((invert_pose(true) @ own)[..., :3, :3]).max() < rotation
    for camera, name in enumerate(result.cameras):
        for number, truth in enumerate(scene.depths[camera]):
            depth, confidence = result.depth(name, number), result.confidence(name, number)
            assert depth.shape == confidence.shape == truth.shape
            ratio = (scale * depth / truth)[confidence > np.median(confidence)]
            assert np.isfinite(ratio).mean() > 0.9
            assert np.nanmedian(np.abs(ratio - 1.0)) < 0.05


def stages(out: Path) -> dict[str, Mapping[str, Any]]:
    return {stage["name"]: stage for stage in json.loads((out / "manifest.json").read_text())["stages"]}


def test_every_frame_gets_a_pose_and_a_depth(result: Reconstruction, scene: Scene) -> None:
    assert_right(result, scene, position=0.01, rotation=0.1)


def test_the_manifest_tells_what_was_done(result: Reconstruction) -> None:
    assert list(stages(result.folder)) == ALL_STAGES
    assert result.manifest["status"] == "complete"
    assert result.manifest["groups"] == [["cam0", "cam1"]]
    assert result.manifest["unit"] == "arbitrary"
    assert result.manifest["config"]["tracking"]["grid_points"] == 300


def test_diagnostics_are_there(result: Reconstruction) -> None:
    folder = result.folder / "diagnostics"
    keyframes = json.loads((folder / "keyframes.json").read_text())
    assert {name: (times[0], times[-1]) for name, times in keyframes.items()} == {
        "cam0": (0, 5),
        "cam1": (0, 5),
    }
    edges = json.loads((folder / "edges_per_step.json").read_text())
    assert {kind: len(counts) for kind, counts in edges.items()} == dict.fromkeys(
        ("temporal", "spatial", "spatio_temporal"), 6
    )
    assert result.arrays("covariance")["covariance"].shape == (2, 6, 6, 6)


def test_a_stopped_run_continues_without_a_new_start(
    result: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path
) -> None:
    again = GivenStart(start.start)
    with pytest.raises(StoppedError):
        reconstruct(scene.capture(), tmp_path, config(), initializer=again, flow=FlowThatStops(16))
    assert list(stages(tmp_path)) == ["start"]
    stopped = Reconstruction.load(tmp_path)
    assert stopped.manifest["status"] == "failed"
    # what was tracked by then can be read, and what was not is no pose
    known = np.isfinite(stopped.trajectory(stopped.cameras[0])[1][:, 0, 0])
    assert known[0] and not known[-1]
    finished = reconstruct(scene.capture(), tmp_path, config(), initializer=again, resume=True)
    assert again.calls == 1
    assert finished.manifest["status"] == "complete"
    assert list(stages(tmp_path)) == ALL_STAGES
    np.testing.assert_allclose(all_poses(finished), all_poses(result), atol=1e-9, rtol=0)


def test_a_focal_length_is_found_once_and_used_by_all_stages(
    result: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path
) -> None:
    capture = scene.capture()
    known = capture.cameras
    guessed = tuple(replace(c, fx=0.5 * c.fx, fy=0.5 * c.fx, cx=c.cx - 3.0, focal_known=False) for c in known)
    intrinsics = {index: FoundIntrinsics(c.fx, c.cx, c.cy, 0.3) for index, c in enumerate(known)}
    found = GivenStart(replace(start.start, intrinsics=intrinsics))
    unknown = replace(capture, cameras=guessed)
    with pytest.raises(StoppedError):
        reconstruct(unknown, tmp_path, config(), initializer=found, flow=FlowThatStops(16))
    finished = reconstruct(unknown, tmp_path, config(), initializer=found, resume=True)
    assert found.calls == 1
    # the guess, half of the truth, decides nothing
    np.testing.assert_allclose(all_poses(finished), all_poses(result), atol=1e-9, rtol=0)
    np.testing.assert_array_equal(finished.depth("cam1", 3), result.depth("cam1", 3))
    for index, name in enumerate(finished.cameras):
        for one in (finished, finished.tracked()):
            np.testing.assert_array_equal(one.intrinsics(name), known[index].intrinsics)
    (note, _) = finished.manifest["notes"]
    assert note.startswith(
        f"cam0: focal length found in its video, {known[0].fx:.1f} px, give or take 0.3; principal point ("
    )


def test_resuming_goes_on_with_the_settings_it_began_with(
    result: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def stop(*_: object) -> None:
        raise StoppedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, "wide flow", stop)
        with pytest.raises(StoppedError):
            reconstruct(scene.capture(), tmp_path, config(), initializer=start)
    before = (tmp_path / "manifest.json").read_bytes()
    with pytest.raises(ResultError, match=r"tracking\.grid_points=300, not 200; leave that out"):
        other: dict[str, Any] = {"tracking": {"grid_points": 200}}
        reconstruct(scene.capture(), tmp_path, other, initializer=start, resume=True)
    assert (tmp_path / "manifest.json").read_bytes() == before
    # the refinement is not finished: it is done with what is asked for now, from its beginning
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, "sweep", stop)
        with pytest.raises(StoppedError):
            other = {"refinement": {"sweep": {"levels": 20}}}
            reconstruct(scene.capture(), tmp_path, other, initializer=start, resume=True)
    assert "the refinement begins anew, its settings are others: refinement.sweep.levels" in caplog.text
    caplog.clear()
    finished = reconstruct(scene.capture(), tmp_path, initializer=start, resume=True)
    made = dict(finished.manifest["config"])
    assert made["refinement"]["sweep"]["levels"] == 20 and "begins anew" not in caplog.text
    made["refinement"] = result.manifest["config"]["refinement"]
    assert made == result.manifest["config"]
    np.testing.assert_array_equal(all_poses(finished.tracked()), all_poses(result.tracked()))


def test_resuming_what_is_finished_computes_nothing(
    result: Reconstruction, scene: Scene, start: GivenStart
) -> None:
    before = (result.folder / "manifest.json").stat().st_mtime_ns, start.calls
    asked = GivenStart(start.start)
    again = reconstruct(
        scene.capture(), result.folder, config(), initializer=asked, flow=FlowThatStops(0), resume=True
    )
    assert asked.calls == 0 and start.calls == before[1]
    np.testing.assert_array_equal(all_poses(again), all_poses(result))


def test_the_tracking_is_kept_beside_the_refinement(result: Reconstruction, scene: Scene) -> None:
    tracked = result.tracked()
    assert tracked.stages == ["start", "tracking"]
    assert_right(tracked, scene, position=0.01, rotation=0.1)
    # what was refined is another depth, and nothing is left of the work
    assert not np.array_equal(tracked.depth("cam0", 2), result.depth("cam0", 2))
    assert not (result.folder / "refinement").exists()
    with pytest.raises(ResultError, match="--stage refinement"):
        tracked.motion("cam0", 2)


def test_the_refinement_fits_the_flow_better_and_finds_no_motion_in_a_static_scene(
    result: Reconstruction,
) -> None:
    for pair in result.diagnostics("residual_px"):
        assert pair["after_px"] <= 1.05 * pair["before_px"], pair
    assert max((result.motion(name, 3) > 0).mean() for name in result.cameras) < 0.02


def depth_error(result: Reconstruction, scene: Scene) -> float:
    """Relative error that a tenth of all depths exceed, after one scale for all: where surfaces end."""
    ratios = [
        (result.depth(name, number) / truth).ravel()
        for camera, name in enumerate(result.cameras)
        for number, truth in enumerate(scene.depths[camera])
    ]
    ratio = np.concatenate(ratios)
    return float(np.nanquantile(np.abs(ratio / np.nanmedian(ratio) - 1.0), 0.9))


def test_the_refinement_improves_the_depth(result: Reconstruction, scene: Scene) -> None:
    assert depth_error(result, scene) < 0.95 * depth_error(result.tracked(), scene)


def test_a_refinement_stopped_half_way_leaves_the_tracking_and_continues(
    result: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise StoppedError

    monkeypatch.setitem(TASKS, "wide flow", stop)
    with pytest.raises(StoppedError):
        reconstruct(scene.capture(), tmp_path, config(), initializer=start)
    assert list(stages(tmp_path)) == ["start", "tracking"]
    stopped = Reconstruction.load(tmp_path)
    np.testing.assert_array_equal(stopped.depth("cam1", 4), result.tracked().depth("cam1", 4))
    monkeypatch.undo()
    # what was done is not done again
    monkeypatch.setitem(TASKS, "sweep", stop)
    finished = reconstruct(scene.capture(), tmp_path, config(), initializer=start, resume=True)
    assert list(stages(tmp_path)) == ALL_STAGES
    np.testing.assert_allclose(all_poses(finished), all_poses(result), atol=1e-9, rtol=0)
    np.testing.assert_allclose(finished.depth("cam1", 4), result.depth("cam1", 4), rtol=1e-6)


def test_processes_change_nothing(
    result: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path
) -> None:
    two = load_config(None, [*SMALL, "refinement.workers=2"])
    other = reconstruct(scene.capture(), tmp_path / "out", two, initializer=start)
    np.testing.assert_array_equal(other.depth("cam0", 3), result.depth("cam0", 3))
    np.testing.assert_array_equal(all_poses(other), all_poses(result))


def test_cameras_that_nothing_connects_are_said_to_be_apart(tmp_path: Path) -> None:
    scene = two_cameras(count=4)
    apart = GivenStart(scene.start(((0,), (1,)), times=(0, 3)))
    result = reconstruct(scene.capture(), tmp_path / "out", config(), initializer=apart)
    assert result.groups == [["cam0"], ["cam1"]]
    assert any("no view connects" in note and "cam0; cam1" in note for note in result.manifest["notes"])
    assert np.isfinite(all_poses(result)).all()


def test_an_unknown_stage_is_refused_before_anything_is_written(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'polish'"):
        reconstruct(scene.capture(), tmp_path / "out", stage="polish")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_classical_start_leads_nearly_as_far(tmp_path: Path) -> None:
    scene = two_cameras()
    result = reconstruct(scene.capture(), tmp_path / "out", config())
    assert result.groups == [["cam0", "cam1"]]
    # Two planes leave turning and shifting a camera alike: 0.08 degrees from the true start, 0.18 from this.
    assert_right(result, scene, position=0.01, rotation=0.25)


@pytest.fixture(scope="module")
def short_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every third frame of the bundled clip, as images at half its size."""
    folder = tmp_path_factory.mktemp("short_demo")
    clip = load_capture(demo_capture())
    entries = []
    for index, camera in enumerate(clip.cameras):
        (folder / camera.name).mkdir()
        for number, frame in enumerate(range(0, clip.frame_count, 3)):
            small = cv2.resize(clip.read(index, frame), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            path = folder / camera.name / f"{number:03d}.png"
            assert cv2.imwrite(str(path), cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
        centre = {"cx": (camera.cx + 0.5) / 2 - 0.5, "cy": (camera.cy + 0.5) / 2 - 0.5}
        size = {"width": camera.width // 2, "height": camera.height // 2}
        focal = {"fx": camera.fx / 2, "fy": camera.fy / 2}
        source = {"name": camera.name, "source": f"{camera.name}/*.png"}
        entries.append({**source, **size, **focal, **centre})
    content = {"name": "short demo", "fps": clip.fps / 3, "cameras": entries}
    (folder / "capture.json").write_text(json.dumps(content))
    return folder


def without_focal(capture: Capture) -> Capture:
    """Guesses in the place of its focal lengths."""
    guessed = tuple(
        replace(camera, fx=FIRST_FOCAL * camera.width, fy=FIRST_FOCAL * camera.width)
        for camera in capture.cameras
    )
    return with_unknown_focal(replace(capture, cameras=guessed))


@pytest.mark.slow
def test_the_classical_start_finds_focal_lengths(short_demo: Path, tmp_path: Path) -> None:
    capture = load_capture(short_demo)
    result = reconstruct(without_focal(capture), tmp_path / "out", stage="tracking")
    assert result.groups == [["cam0", "cam1"]]
    for camera in capture.cameras:
        assert result.camera(camera.name).fx == pytest.approx(camera.fx, rel=0.02)
        assert abs(FIRST_FOCAL * camera.width / camera.fx - 1.0) > 0.02
    truth = tmp_path / "groundtruth"
    truth.mkdir()
    for path in (demo_capture() / "groundtruth").glob("*.txt"):
        shutil.copy(path, truth)
    scores = evaluate(result, truth)
    # 10 mm with the true focal lengths, too, at this size
    assert scores.registered == 1.0 and scores.ate_m < 0.015


@pytest.mark.slow
def test_a_focal_length_that_the_videos_leave_open_ends_the_run_in_one_line(tmp_path: Path) -> None:
    # two cameras that hardly turn
    with pytest.raises(TrackingError, match="cam0: its video does not tell its focal length") as raised:
        reconstruct(without_focal(two_cameras().capture()), tmp_path / "out", config())
    assert "\n" not in str(raised.value)
    assert stages(tmp_path / "out") == {}


def mvdyn(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "mvdyn_gtsam", "reconstruct", *(str(one) for one in arguments)]


def kill_after_the_start(command: list[str], out: Path) -> None:
    """Run until the manifest names the start as finished, then kill without warning."""
    # A group of its own, so that no worker process survives the kill.
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    try:
        while "start" not in (stages(out) if (out / "manifest.json").is_file() else {}):
            assert process.poll() is None, "the run ended before it could be killed"
            time.sleep(0.05)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    assert process.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_a_killed_run_is_resumed_and_runs_repeat_exactly(short_demo: Path, tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(mvdyn(short_demo, "--out", whole), check=True, capture_output=True)
    kill_after_the_start(mvdyn(short_demo, "--out", killed), killed)
    before = stages(killed)
    assert list(before) == ["start"]
    assert Reconstruction.load(killed).manifest["status"] == "running"
    refused = subprocess.run(mvdyn(short_demo, "--out", killed), capture_output=True, text=True)
    assert refused.returncode == 1 and "--resume" in refused.stderr
    subprocess.run(mvdyn(short_demo, "--out", killed, "--resume"), check=True, capture_output=True)
    assert stages(killed)["start"] == before["start"]  # its seconds too: it was not done again
    first, second = Reconstruction.load(whole), Reconstruction.load(killed)
    assert second.manifest["status"] == "complete"
    assert first.groups == second.groups == [["cam0", "cam1"]]
    assert np.isfinite(all_poses(first)).all()
    np.testing.assert_allclose(all_poses(second), all_poses(first), atol=1e-9, rtol=0)
    for name in first.cameras:
        for number in (0, first.frame_count - 1):
            np.testing.assert_allclose(second.depth(name, number), first.depth(name, number), rtol=1e-6)


class TruePrior:
    """The true depth in another unit, shifted; counts what it is asked for."""

    name = "TruePrior"

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.asked: list[tuple[str, int]] = []

    def predict(
        self, image: np.ndarray, intrinsics: np.ndarray, camera: str, time: int
    ) -> tuple[np.ndarray, None]:
        index = [one.name for one in self.scene.cameras].index(camera)
        np.testing.assert_array_equal(image, self.scene.images[index][time])
        self.asked.append((camera, time))
        return (0.4 * self.scene.depths[index][time] + 0.3).astype(np.float32), None


@pytest.fixture(scope="module")
def prior(scene: Scene) -> TruePrior:
    return TruePrior(scene)


@pytest.fixture(scope="module")
def with_prior(
    scene: Scene, start: GivenStart, prior: TruePrior, tmp_path_factory: pytest.TempPathFactory
) -> Reconstruction:
    out = tmp_path_factory.mktemp("pipeline") / "prior"
    return reconstruct(scene.capture(), out, config(), stage="tracking", initializer=start, depth_prior=prior)


def test_a_depth_prior_gives_better_depth_and_is_asked_once_per_frame(
    result: Reconstruction, with_prior: Reconstruction, scene: Scene, prior: TruePrior
) -> None:
    assert_right(with_prior, scene, position=0.01, rotation=0.1)
    assert depth_error(with_prior, scene) < 0.7 * depth_error(result.tracked(), scene)
    assert sorted(prior.asked) == [(name, time) for name in ("cam0", "cam1") for time in range(6)]


def test_the_result_tells_of_the_prior_and_keeps_no_prediction(
    result: Reconstruction, with_prior: Reconstruction
) -> None:
    assert with_prior.manifest["depth_prior"] == "TruePrior"
    assert result.manifest["depth_prior"] is None
    (fit,) = with_prior.diagnostics("depth_prior")
    assert fit["cameras"] == ["cam0", "cam1"]
    assert (fit["scale"], fit["offset"]) == (pytest.approx(2.5, rel=0.05), pytest.approx(-0.75, abs=0.2))
    assert {path.name for path in with_prior.folder.iterdir()} == {
        *("manifest.json", "trajectories", "depth", "confidence", "diagnostics")
    }


def test_no_prior_changes_nothing(
    result: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path
) -> None:
    none = reconstruct(
        scene.capture(), tmp_path / "out", config(), stage="tracking", initializer=start,
        depth_prior=NoDepthPrior(),
    )  # fmt: skip
    np.testing.assert_array_equal(all_poses(none), all_poses(result.tracked()))
    np.testing.assert_array_equal(none.depth("cam1", 2), result.tracked().depth("cam1", 2))
    assert none.manifest["depth_prior"] is None


def test_a_stopped_run_goes_on_with_its_prior_and_not_without(
    with_prior: Reconstruction, scene: Scene, start: GivenStart, tmp_path: Path
) -> None:
    capture = scene.capture()
    with pytest.raises(StoppedError):
        reconstruct(
            capture,
            tmp_path,
            config(),
            initializer=start,
            flow=FlowThatStops(16),
            depth_prior=TruePrior(scene),
        )
    assert not (tmp_path / "predictions").exists()
    with pytest.raises(ResultError, match="began with the depth prior TruePrior; give it again"):
        reconstruct(capture, tmp_path, config(), initializer=start, resume=True)
    finished = reconstruct(
        capture, tmp_path, stage="tracking", initializer=start, resume=True, depth_prior=TruePrior(scene)
    )
    np.testing.assert_array_equal(all_poses(finished), all_poses(with_prior))
    np.testing.assert_array_equal(finished.depth("cam0", 3), with_prior.depth("cam0", 3))


def test_a_prior_that_fits_no_scale_ends_the_run_in_one_line(
    scene: Scene, start: GivenStart, tmp_path: Path
) -> None:
    class Constant(TruePrior):
        def predict(
            self, image: np.ndarray, intrinsics: np.ndarray, camera: str, time: int
        ) -> tuple[np.ndarray, None]:
            return np.full(image.shape[:2], 2.0), None

    with pytest.raises(DepthPriorError, match="^cam0, cam1: .* cannot be aligned to the start: .* constant"):
        reconstruct(scene.capture(), tmp_path, config(), initializer=start, depth_prior=Constant(scene))
    assert Reconstruction.load(tmp_path).status == "failed" and not (tmp_path / "predictions").exists()
