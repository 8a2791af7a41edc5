from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture import convert_multicamvideo, load_capture, load_multicamvideo, multicamvideo_poses
from mvdyn_gtsam.errors import CaptureError
from mvdyn_gtsam.geometry import invert_pose
from tests.capture.media import write_video

Array = npt.NDArray[np.float64]
COUNT = 5


def unreal_text(wTc: Array) -> str:
    """``wTc`` (OpenCV axes, right-handed world, metres) the way the dataset writes it.

    Unreal's world is ours seen in a mirror (y flipped); its camera axes are forward, right, up.
    """
    right, down, forward = (np.diag([1.0, -1.0, 1.0]) @ wTc[:3, :3]).T
    position = 100.0 * np.diag([1.0, -1.0, 1.0]) @ wTc[:3, 3]
    rows = [[*forward, 0], [*right, 0], [*-down, 0], [*position, 1]]
    return "".join("[" + " ".join(f"{value:.6g}" for value in row) + "] " for row in rows)


def random_poses(seed: int, count: int = COUNT) -> Array:
    rng = np.random.default_rng(seed)
    wTc = np.tile(np.eye(4), (count, 1, 1))
    wTc[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    wTc[:, :3, 3] = rng.uniform(-5, 5, (count, 3))
    return wTc


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "f24_aperture5" / "scene1"
    content: dict[str, dict[str, str]] = {f"frame{time}": {} for time in range(COUNT)}
    for number in (1, 2):
        write_video(folder / "videos" / f"cam{number:02d}.mp4", COUNT, fps=15.0, size=(128, 128))
        for time, wTc in enumerate(random_poses(number)):
            content[f"frame{time}"][f"cam{number:02d}"] = unreal_text(wTc)
    (folder / "cameras").mkdir()
    (folder / "cameras" / "camera_extrinsics.json").write_text(json.dumps(content))
    return folder


def test_poses_are_proper_and_right(scene: Path) -> None:
    wTc = multicamvideo_poses(scene, "cam02")
    np.testing.assert_allclose(np.linalg.det(wTc[:, :3, :3]), 1.0, atol=1e-12)
    np.testing.assert_allclose(wTc, random_poses(2), atol=2e-5)


def test_relative_poses_are_those_of_the_official_conversion(scene: Path) -> None:
    content = json.loads((scene / "cameras" / "camera_extrinsics.json").read_text())

    def official(time: int) -> Array:
        rows = content[f"frame{time}"]["cam01"].replace("]", "").split("[")[1:]
        matrix = np.array([row.split() for row in rows], dtype=float).T[:, [1, 2, 0, 3]]
        matrix[:3, 1] *= -1
        matrix[:3, 3] /= 100
        return matrix

    assert np.linalg.det(official(0)[:3, :3]) == pytest.approx(-1.0, abs=1e-4)
    wTc = multicamvideo_poses(scene, "cam01")
    for time in range(1, COUNT):
        np.testing.assert_allclose(
            invert_pose(wTc[0]) @ wTc[time], np.linalg.inv(official(0)) @ official(time), atol=1e-4
        )


def test_pan_right_and_zoom_in_move_as_named() -> None:
    # From the dataset's example file (field notes): panning right turns the optical axis towards image right.
    still = "[1 0 0 0] [0 1 0 0] [0 0 1 0] [0 0 0 1] "
    c, s = np.cos(0.1), np.sin(0.1)
    panned = f"[{c} {s} 0 0] [{-s} {c} 0 0] [0 0 1 0] [200 0 0 1] "
    first, second = (_parse(text) for text in (still, panned))
    relative = invert_pose(first) @ second
    np.testing.assert_allclose(relative[:3, 3], [0, 0, 2.0], atol=1e-9)
    assert relative[0, 2] == pytest.approx(s) and relative[2, 2] == pytest.approx(c)


def _parse(text: str) -> Array:
    from mvdyn_gtsam.capture.multicamvideo import _pose

    return _pose({"frame0": {"cam01": text}}, "frame0", "cam01", Path("x.json"))


def test_crop_resize_and_focal_length(scene: Path) -> None:
    capture = load_multicamvideo(scene)
    assert capture.fps == 15.0
    camera = capture.cameras[0]
    # At any square resolution the dataset's numbers hold: f24 gives 517.2 px at 512x384.
    assert camera.fx == camera.fy == pytest.approx(24 / 23.76 * 512)
    assert (camera.cx, camera.cy) == (255.5, 191.5)
    assert capture.read(1, 3).shape == (384, 512, 3)
    assert load_multicamvideo(scene, cameras=["cam02"], focal_mm=50).cameras[0].fx == pytest.approx(
        50 / 23.76 * 512
    )


def test_conversion_writes_a_capture_with_ground_truth(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    convert_multicamvideo(scene, out, cameras=["cam02", "cam01"])
    capture = load_capture(out)
    original = load_multicamvideo(scene, cameras=["cam02", "cam01"])
    assert [camera.name for camera in capture.cameras] == ["cam02", "cam01"]
    assert np.array_equal(capture.read(0, 4), original.read(0, 4))
    assert capture.cameras == original.cameras
    rows = np.loadtxt(out / "groundtruth" / "cam02.txt")
    np.testing.assert_allclose(rows[:, 0], np.arange(COUNT) / 15.0, atol=1e-8)
    np.testing.assert_allclose(rows[:, 1:4], random_poses(2)[:, :3, 3], atol=2e-5)
    np.testing.assert_allclose(
        Rotation.from_quat(rows[:, 4:]).as_matrix(), random_poses(2)[:, :3, :3], atol=2e-5
    )


def test_unknown_focal_length_and_cameras_are_named(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="there is no camera cam09; choose among cam01, cam02"):
        load_multicamvideo(scene, cameras=["cam09"])
    with pytest.raises(CaptureError, match="focal_mm is 0"):
        load_multicamvideo(scene, focal_mm=0.0)
    bare = scene.rename(tmp_path / "scene1")
    with pytest.raises(CaptureError, match="give focal_mm"):
        load_multicamvideo(bare)
    with pytest.raises(CaptureError, match=r"there are no \*.mp4"):
        load_multicamvideo(tmp_path)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("[1 0 0 0] [0 1 0 0] [0 0 1 0]", "must be four rows of four numbers"),
        (None, "must be four rows of four numbers"),
        ("[0 0 0 0] [0 1 0 0] [0 0 1 0] [0 0 0 1]", "is not a rotation"),
        ("[1 0 0 0] [0 1 0 0] [0 0 -1 0] [0 0 0 1]", "is not a rotation"),
    ],
)
def test_bad_matrices_are_named(scene: Path, entry: str | None, message: str) -> None:
    path = scene / "cameras" / "camera_extrinsics.json"
    content = json.loads(path.read_text())
    content["frame3"]["cam01"] = entry
    path.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=rf"camera_extrinsics\.json: frame3, cam01: {message}"):
        multicamvideo_poses(scene, "cam01")


def test_missing_frames_and_files_are_named(scene: Path, tmp_path: Path) -> None:
    path = scene / "cameras" / "camera_extrinsics.json"
    content = json.loads(path.read_text())
    del content["frame2"]
    path.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="frame2 has no entry cam01"):
        multicamvideo_poses(scene, "cam01")
    del content["frame4"], content["frame3"]
    path.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="camera cam01 has 5 frames but 2 poses"):
        convert_multicamvideo(scene, tmp_path / "out")
    path.write_text("{")
    with pytest.raises(CaptureError, match="not valid JSON"):
        multicamvideo_poses(scene, "cam01")
