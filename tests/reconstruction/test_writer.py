"""The folder that a run leaves: what is written is read back, and a run that stops loses nothing."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction import CaptureInfo, Reconstruction, ReconstructionWriter
from mvdyn_gtsam.reconstruction.encoding import (
    decode_confidence,
    decode_depth,
    encode_confidence,
    encode_depth,
)

CONFIG: dict[str, Any] = {"tracking": {"window": 25}, "refinement": {}}


def capture_info(frame_count: int = 4) -> CaptureInfo:
    cameras = (
        Camera("cam0", 32, 24, 30.0, 31.0, 15.5, 11.5),
        Camera("left phone", 40, 30, 33.0, 34.0, 19.0, 15.0, distortion=(0.1, -0.05, 0.0, 0.0, 0.01)),
    )
    return CaptureInfo("clip", 30.0, frame_count, cameras, (1, 2))


def random_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    wTc = np.tile(np.eye(4), (count, 1, 1))
    wTc[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    wTc[:, :3, 3] = rng.standard_normal((count, 3)) * 10.0 ** rng.uniform(-3, 3)
    return wTc


def write_complete(folder: Path) -> None:
    with ReconstructionWriter.create(folder, capture_info(), CONFIG) as writer:
        for index, camera in enumerate(capture_info().cameras):
            writer.write_trajectory(camera.name, np.arange(4) / 30.0, random_poses(4, index))
            for time in range(4):
                shape = (camera.height, camera.width)
                writer.write_depth(camera.name, time, np.full(shape, 1.0 + time), np.full(shape, 0.5))
        writer.set_groups([["cam0", "left phone"]])
        writer.finish_stage("tracking", 1.5, ["a note"])


def full_disk(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_round_trip(tmp_path: Path) -> None:
    write_complete(tmp_path / "out")
    result = Reconstruction.load(tmp_path / "out")
    assert result.cameras == ["cam0", "left phone"]
    assert (result.frame_count, result.fps, result.status, result.unit) == (4, 30.0, "complete", "arbitrary")
    assert result.groups == [["cam0", "left phone"]]
    assert result.stages == ["tracking"]
    assert result.camera("left phone") == capture_info().cameras[1]
    np.testing.assert_array_equal(result.intrinsics("cam0"), capture_info().cameras[0].intrinsics)
    for index, name in enumerate(result.cameras):
        timestamps, wTc = result.trajectory(name)
        np.testing.assert_array_equal(timestamps, np.arange(4) / 30.0)
        np.testing.assert_allclose(wTc, random_poses(4, index), rtol=1e-14, atol=1e-14)
        depth = result.depth(name, 3)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, 4.0, rtol=1.3e-4)
        np.testing.assert_allclose(result.confidence(name, 3), 0.5, atol=0.5 / 255 + 1e-6)


def test_manifest_states_the_conventions(tmp_path: Path) -> None:
    write_complete(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert "camera-to-world" in manifest["conventions"]["trajectories"]
    assert "OpenCV" in manifest["conventions"]["camera_axes"]
    assert "pixel centres" in manifest["conventions"]["pixels"]
    assert manifest["config"] == CONFIG
    assert manifest["versions"]["gtsam"] != "not installed"
    assert manifest["stages"] == [{"name": "tracking", "seconds": 1.5, "notes": ["a note"]}]


def test_frames_without_a_pose_have_no_line_and_read_as_nan(tmp_path: Path) -> None:
    wTc = random_poses(4, 0)
    wTc[2] = np.nan
    with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
        writer.write_trajectory("cam0", np.arange(4) / 30.0, wTc)
    lines = (tmp_path / "trajectories" / "cam0.txt").read_text().splitlines()
    assert sum(not line.startswith("#") for line in lines) == 3
    _, read = Reconstruction.load(tmp_path).trajectory("cam0")
    assert np.isnan(read[2]).all()
    np.testing.assert_allclose(read[[0, 1, 3]], wTc[[0, 1, 3]], rtol=1e-14, atol=1e-14)


def test_two_writes_of_the_same_poses_are_the_same_bytes(tmp_path: Path) -> None:
    write_complete(tmp_path / "a")
    write_complete(tmp_path / "b")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 1 + 2 + 2 * 8
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@given(st.floats(1e-3, 2.9e3), st.integers(0, 2**32 - 1))
def test_depth_code_keeps_its_promised_precision(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = (scale * rng.uniform(0.5, 1.0, (6, 7))).astype(np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2], depth[0, 3] = np.nan, np.inf, 0.0, -1.0
    png, dropped = encode_depth(depth)
    read = decode_depth(png)
    assert read is not None and dropped == 0
    assert np.isnan(read[0, :4]).all()
    np.testing.assert_allclose(read[1:], depth[1:], rtol=1.3e-4)


def test_depth_outside_the_code_is_counted_and_invalid() -> None:
    png, dropped = encode_depth(np.array([[1e-4, 1.0, 1e4]]))
    read = decode_depth(png)
    assert read is not None and dropped == 2
    assert np.isnan(read[0, [0, 2]]).all() and abs(read[0, 1] - 1.0) < 1.3e-4


def test_confidence_is_clipped_and_nan_is_none() -> None:
    read = decode_confidence(encode_confidence(np.array([[-1.0, 0.25, 2.0, np.nan]])))
    assert read is not None
    np.testing.assert_allclose(read, [[0.0, 0.25, 1.0, 0.0]], atol=0.5 / 255 + 1e-6)


def test_ctrl_c_leaves_a_readable_result(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
            writer.write_trajectory("cam0", np.arange(4) / 30.0, random_poses(4, 0))
            writer.write_depth("cam0", 0, np.ones((24, 32)), np.ones((24, 32)))
            raise KeyboardInterrupt
    result = Reconstruction.load(tmp_path)
    assert result.status == "interrupted"
    assert result.has_depth("cam0", 0) and not result.has_depth("cam0", 1)
    assert np.isfinite(result.trajectory("cam0")[1]).all()
    with pytest.raises(ResultError, match=r"000001\.png: missing \(the run is interrupted\)"):
        result.depth("cam0", 1)
    with pytest.raises(ResultError, match=r"left phone\.txt: missing"):
        result.trajectory("left phone")


def test_a_failing_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG):
            raise RuntimeError
    assert Reconstruction.load(tmp_path).status == "failed"


def test_full_disk_is_one_line_and_keeps_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ResultError) as caught:
        with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
            writer.write_trajectory("cam0", np.arange(4) / 30.0, random_poses(4, 0))
            before = (tmp_path / "trajectories" / "cam0.txt").read_bytes()
            monkeypatch.setattr(Path, "write_bytes", full_disk)
            writer.write_trajectory("cam0", np.arange(4) / 30.0, random_poses(4, 1))
    assert "disk is full" in str(caught.value) and "\n" not in str(caught.value)
    monkeypatch.undo()
    assert (tmp_path / "trajectories" / "cam0.txt").read_bytes() == before
    assert not list(tmp_path.rglob("*.part"))
    assert Reconstruction.load(tmp_path).status == "running"  # the manifest could not be written either


def test_resume_keeps_what_is_there(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
            writer.write_depth("cam0", 0, np.ones((24, 32)), np.ones((24, 32)))
            writer.finish_stage("start", 0.5)
            raise KeyboardInterrupt
    with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG, resume=True) as writer:
        assert writer.has_depth("cam0", 0) and not writer.has_depth("cam0", 1)
        assert writer.stage_finished("start") and not writer.stage_finished("tracking")
        writer.finish_stage("tracking", 2.0)
    result = Reconstruction.load(tmp_path)
    assert (result.status, result.stages) == ("complete", ["start", "tracking"])


def test_resume_starts_where_there_is_nothing(tmp_path: Path) -> None:
    with ReconstructionWriter.create(tmp_path / "new", capture_info(), CONFIG, resume=True):
        pass
    assert Reconstruction.load(tmp_path / "new").status == "complete"


def test_resume_refuses_another_capture(tmp_path: Path) -> None:
    write_complete(tmp_path)
    other = dataclasses.replace(capture_info(), first_frame_crc32=(1, 3))
    with pytest.raises(ResultError, match="another capture"):
        ReconstructionWriter.create(tmp_path, other, CONFIG, resume=True)


def with_unknown(info: CaptureInfo, focal: float) -> CaptureInfo:
    """The first camera's focal length is to be found; ``focal`` is the first guess."""
    first = dataclasses.replace(info.cameras[0], fx=focal, fy=focal, focal_known=False)
    return dataclasses.replace(info, cameras=(first, *info.cameras[1:]))


def test_focal_lengths_that_are_found_are_the_cameras(tmp_path: Path) -> None:
    info = with_unknown(capture_info(), 24.0)
    with ReconstructionWriter.create(tmp_path, info, CONFIG) as writer:
        assert writer.cameras == info.cameras
        with pytest.raises(ValueError, match="unknown camera 'cam7'"):
            writer.set_found_intrinsics({"cam7": info.cameras[0]}, {})
        found = dataclasses.replace(info.cameras[0], fx=30.5, fy=30.75, cx=15.25, cy=11.75)
        writer.set_found_intrinsics({"cam0": found}, {"cam0": 0.2})
        assert writer.cameras == (found, info.cameras[1])
    result = Reconstruction.load(tmp_path)
    assert result.camera("cam0") == found
    assert result.camera("left phone") == info.cameras[1]
    assert result.intrinsics("cam0")[[0, 1, 0], [0, 1, 2]].tolist() == [30.5, 30.75, 15.25]
    entry = {"fx": 30.5, "fy": 30.75, "cx": 15.25, "cy": 11.75, "deviation": 0.2}
    assert result.manifest["found_intrinsics"] == {"cam0": entry}
    # the guess stays beside it, so that a resumed run knows its capture
    with ReconstructionWriter.create(tmp_path, info, CONFIG, resume=True) as writer:
        assert writer.cameras[0].fx == 30.5


def test_resume_refuses_other_focal_lengths_to_be_found(tmp_path: Path) -> None:
    write_complete(tmp_path)
    unknown = with_unknown(capture_info(), 30.0)
    with pytest.raises(ResultError, match="give or leave out --estimate-focal as then"):
        ReconstructionWriter.create(tmp_path, unknown, CONFIG, resume=True)


def test_what_older_versions_wrote_goes_on(tmp_path: Path) -> None:
    write_complete(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert all("focal_known" not in camera for camera in manifest["capture"]["cameras"])
    assert "found_intrinsics" not in manifest
    with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG, resume=True) as writer:
        assert writer.cameras == capture_info().cameras


def test_resume_notes_where_the_capture_is_now(tmp_path: Path) -> None:
    for place in ("before", "after", None):
        info = dataclasses.replace(capture_info(), source=place)
        with ReconstructionWriter.create(tmp_path, info, CONFIG, resume=True):
            pass
        found = Reconstruction.load(tmp_path).capture_source
        assert found == (None if place is None else Path(place))


def test_resume_keeps_finished_depth_and_notes_the_settings_of_what_comes(tmp_path: Path) -> None:
    write_complete(tmp_path)
    now = {"tracking": {"window": 25, "new": 1}, "refinement": {"iterations": 3}}
    with ReconstructionWriter.create(tmp_path, capture_info(), now, resume=True) as writer:
        assert writer.has_depth("cam0", 3)
    assert Reconstruction.load(tmp_path).manifest["config"] == now


@pytest.mark.parametrize(
    ("now", "kept"),
    [
        ({**CONFIG, "refinement": {"iterations": 3}}, True),
        ({**CONFIG, "tracking": {"window": 9}}, False),
        ({**CONFIG, "graph": {"new": 1}}, False),
    ],
)
def test_depth_of_an_unfinished_tracking_stays_only_with_its_settings(
    tmp_path: Path, now: dict[str, Any], kept: bool
) -> None:
    with pytest.raises(KeyboardInterrupt):
        with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
            writer.write_depth("cam0", 0, np.ones((24, 32)), np.ones((24, 32)))
            writer.write_arrays("start", {"a": np.ones(1)})
            writer.finish_stage("start", 0.5)
            raise KeyboardInterrupt
    with ReconstructionWriter.create(tmp_path, capture_info(), now, resume=True) as writer:
        assert writer.has_depth("cam0", 0) is kept
        assert (tmp_path / "confidence").exists() is kept
        assert writer.stage_finished("start") and writer.read_arrays("start")["a"] == 1.0


def test_overwrite_removes_what_was_there(tmp_path: Path) -> None:
    write_complete(tmp_path)
    (tmp_path / "mine.txt").write_text("kept")
    with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG, overwrite=True) as writer:
        assert not writer.has_depth("cam0", 0)
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_a_folder_that_is_not_ours_is_refused(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_text("x")
    with pytest.raises(ResultError, match="not empty and not a reconstruction"):
        ReconstructionWriter.create(tmp_path, capture_info(), CONFIG, overwrite=True)
    with pytest.raises(ResultError, match="is a file"):
        ReconstructionWriter.create(tmp_path / "photo.jpg", capture_info(), CONFIG)
    write_complete(tmp_path / "ours")
    with pytest.raises(ResultError, match="--resume to continue it or --overwrite"):
        ReconstructionWriter.create(tmp_path / "ours", capture_info(), CONFIG)


def test_a_camera_name_that_leaves_the_folder_is_refused(tmp_path: Path) -> None:
    camera = dataclasses.replace(capture_info().cameras[0], name="../cam0")
    with pytest.raises(ResultError, match="cannot be a file name"):
        ReconstructionWriter.create(tmp_path, CaptureInfo("clip", 30.0, 4, (camera,)), CONFIG)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "cannot be read"),
        ("{", "cannot be read"),
        ("[]", "not the manifest of a reconstruction"),
        ('{"format": "mvdyn-reconstruction", "schema": 99}', "schema 99"),
        ('{"format": "mvdyn-reconstruction", "schema": 1}', '"status" is missing'),
    ],
)
def test_a_corrupt_manifest_is_one_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(ResultError, match=message) as caught:
        Reconstruction.load(tmp_path)
    assert "manifest.json" in str(caught.value) and "\n" not in str(caught.value)


def test_a_manifest_with_wrong_cameras_or_groups_is_refused(tmp_path: Path) -> None:
    write_complete(tmp_path)
    path = tmp_path / "manifest.json"
    good = json.loads(path.read_text())
    path.write_text(json.dumps({**good, "groups": [["cam7"]]}))
    with pytest.raises(ResultError, match="unknown camera 'cam7'"):
        Reconstruction.load(tmp_path)
    path.write_text(json.dumps({**good, "capture": {**good["capture"], "cameras": [{"name": "cam0"}]}}))
    with pytest.raises(ResultError, match="cameras that cannot be read"):
        Reconstruction.load(tmp_path)


def test_missing_and_damaged_files_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no such folder"):
        Reconstruction.load(tmp_path / "nothing")
    with pytest.raises(ResultError, match="not a reconstruction"):
        Reconstruction.load(tmp_path)
    write_complete(tmp_path)
    result = Reconstruction.load(tmp_path)
    depth = tmp_path / "depth" / "cam0" / "000001.png"
    depth.write_bytes(depth.read_bytes()[:40])
    with pytest.raises(ResultError, match=r"000001\.png: damaged"):
        result.depth("cam0", 1)
    trajectory = tmp_path / "trajectories" / "cam0.txt"
    trajectory.write_text("0.0 1 2 3\n")
    with pytest.raises(ResultError, match="line 1 is not"):
        result.trajectory("cam0")
    trajectory.write_text("7.0 1 2 3 0 0 0 1\n")
    with pytest.raises(ResultError, match="timestamp 7 s is not that of a frame"):
        result.trajectory("cam0")
    with pytest.raises(ResultError, match="no camera 'cam9'"):
        result.depth("cam9", 0)
    with pytest.raises(ResultError, match="no frame 4"):
        result.depth("cam0", 4)


def test_writer_refuses_what_does_not_fit(tmp_path: Path) -> None:
    writer = ReconstructionWriter.create(tmp_path, capture_info(), CONFIG)
    with pytest.raises(ValueError, match="for 4 frames"):
        writer.write_trajectory("cam0", np.arange(3) / 30.0, random_poses(3, 0))
    with pytest.raises(ValueError, match="cam0: depth"):
        writer.write_depth("cam0", 0, np.ones((32, 24)), np.ones((32, 24)))
    with pytest.raises(ValueError, match="unknown camera"):
        writer.set_groups([["cam0", "cam9"]])


def test_arrays_and_diagnostics(tmp_path: Path) -> None:
    with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
        writer.write_arrays("covariances", {"cam0": np.eye(6)[None]})
        writer.set_diagnostics("edges", {"temporal": [1, 2], "spatial": [0, 3]})
    result = Reconstruction.load(tmp_path)
    np.testing.assert_array_equal(result.arrays("covariances")["cam0"], np.eye(6)[None])
    assert result.diagnostics("edges") == {"temporal": [1, 2], "spatial": [0, 3]}
    with pytest.raises(ResultError, match=r"nothing\.npz: missing"):
        result.arrays("nothing")
    (tmp_path / "diagnostics" / "covariances.npz").write_bytes(b"PK")
    with pytest.raises(ResultError, match=r"covariances\.npz: damaged"):
        result.arrays("covariances")


def test_missing_arrays_are_one_line_with_the_fix(tmp_path: Path) -> None:
    with ReconstructionWriter.create(tmp_path, capture_info(), CONFIG) as writer:
        with pytest.raises(ResultError, match=r"connections\.npz: is missing.*--overwrite"):
            writer.read_arrays("connections")
        writer.write_arrays("connections", {"frames": np.arange(4)})
        np.testing.assert_array_equal(writer.read_arrays("connections")["frames"], np.arange(4))
