"""Results of other methods: our own exports come back the same, and each convention is re-projected."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture import with_unknown_focal
from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import invert_pose, project, transform_points
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.reconstruction.export import export_colmap, export_nerfstudio, export_tum
from mvdyn_gtsam.reconstruction.imports import ImportedResult, load_result
from mvdyn_gtsam.reconstruction.imports.load import find_layout
from tests.reconstruction.test_export import CAMERAS, FRAMES, capture, make, random_pose, world_points

PIXELS = np.array([[3, 5], [20, 17], [31, 23]])
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def random_poses(seed: int = 3, count: int = FRAMES) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {camera.name: np.stack([random_pose(rng) for _ in range(count)]) for camera in CAMERAS}


def assert_same_scene(imported: ImportedResult | Reconstruction, known: Reconstruction) -> None:
    """World points of the known scene land on the pixels they came from."""
    assert imported.cameras == known.cameras
    for camera in known.cameras:
        timestamps, wTc = imported.trajectory(camera)
        np.testing.assert_array_equal(timestamps, known.timestamps)
        for time in range(FRAMES):
            points = world_points(known, camera, time, PIXELS)
            seen = transform_points(invert_pose(wTc[time]), points)
            pixels, _ = project(seen, imported.intrinsics(camera))
            np.testing.assert_allclose(pixels, PIXELS, atol=1e-6)


def write_npz(folder: Path, poses: Mapping[str, Any], **more: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "poses.npz", **poses, **more)
    return folder


def write_tum(folder: Path, poses: Mapping[str, np.ndarray], timestamps: np.ndarray) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for camera, wTc in poses.items():
        quaternions = Rotation.from_matrix(wTc[:, :3, :3]).as_quat()
        np.savetxt(folder / f"{camera}.txt", np.column_stack([timestamps, wTc[:, :3, 3], quaternions]))
    return folder


def write_transforms(folder: Path, frames: list[dict[str, Any]], **more: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps({**more, "frames": frames}))
    return folder


def loaded(path: Path, clip: Capture | None = None) -> ImportedResult:
    result = load_result(path, clip or capture())
    assert isinstance(result, ImportedResult)
    return result


@pytest.mark.parametrize("layout", ["tum", "nerfstudio", "colmap", "ours"])
def test_what_our_exporters_write_comes_back_the_same(tmp_path: Path, layout: str) -> None:
    known = make(tmp_path / "ours")
    if layout == "tum":
        export_tum(known, tmp_path / layout)
    elif layout == "nerfstudio":
        export_nerfstudio(known, tmp_path / layout)
    elif layout == "colmap":
        export_colmap(known, tmp_path / layout)
    result = load_result(tmp_path / layout, capture())
    assert_same_scene(result, known)
    if isinstance(result, ImportedResult):
        assert result.layout == layout
        for camera in CAMERAS:  # the half pixel of COLMAP and nerfstudio is taken off again
            np.testing.assert_allclose(result.intrinsics(camera.name), camera.intrinsics, atol=1e-9)


def test_a_binary_model_is_read_as_the_text_one(tmp_path: Path) -> None:
    known = make(tmp_path / "ours")
    (model,) = export_colmap(known, tmp_path / "text")
    (tmp_path / "binary").mkdir()
    script = "import sys, pycolmap; pycolmap.Reconstruction(sys.argv[1]).write_binary(sys.argv[2])"
    subprocess.run([sys.executable, "-c", script, str(model), str(tmp_path / "binary")], check=True)
    assert not list((tmp_path / "binary").glob("*.txt"))
    assert_same_scene(load_result(tmp_path / "binary", capture()), known)


def test_intrinsics_of_another_resolution_are_brought_to_that_of_the_frames(tmp_path: Path) -> None:
    known = make(tmp_path / "ours")
    (model,) = export_colmap(known, tmp_path / "colmap")
    lines = []
    for line in (model / "cameras.txt").read_text().splitlines():
        words = line.split()
        numbers = [2.0 * float(word) for word in words[2:]]  # COLMAP's coordinates scale without an offset
        lines.append(
            " ".join([*words[:2], *(f"{n:.0f}" for n in numbers[:2]), *(f"{n!r}" for n in numbers[2:])])
        )
    (model / "cameras.txt").write_text("\n".join(lines) + "\n")
    assert_same_scene(load_result(tmp_path / "colmap", capture()), known)


def test_the_models_of_a_colmap_project_are_found(tmp_path: Path) -> None:
    for name in ("0", "1"):
        (tmp_path / "sparse" / name).mkdir(parents=True)
        for file in ("cameras.bin", "images.bin"):
            (tmp_path / "sparse" / "0" / file).touch()
    for path in (tmp_path, tmp_path / "sparse", tmp_path / "sparse" / "0"):
        assert find_layout(path, capture()) == ("colmap", tmp_path / "sparse" / "0")
    for file in ("cameras.txt", "images.txt"):
        (tmp_path / "sparse" / "1" / file).touch()
    with pytest.raises(ResultError, match="several results .sparse/0, sparse/1.; give the path of one"):
        load_result(tmp_path, capture())


def test_colmap_images_that_are_missing_are_frames_without_a_pose(tmp_path: Path) -> None:
    known = make(tmp_path / "ours")
    (model,) = export_colmap(known, tmp_path / "colmap", times=[0, 2])
    result = loaded(model)
    assert np.isfinite(result.trajectory("cam1")[1]).all(axis=(1, 2)).tolist() == [True, False, True]


def test_a_damaged_colmap_model_is_one_line(tmp_path: Path) -> None:
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.bin").write_bytes(b"\x03")
    with pytest.raises(ResultError, match="cannot be read as a COLMAP model") as caught:
        load_result(tmp_path, capture())
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@given(seed=st.integers(0, 1000), convention=st.sampled_from([None, "wTc", "cTw"]))
def test_npz_of_either_convention(
    tmp_path_factory: pytest.TempPathFactory, seed: int, convention: str | None
) -> None:
    folder = tmp_path_factory.mktemp("npz")
    poses = random_poses(seed)
    point = np.array([[0.3, -0.2, 4.0]])
    stored = {c: invert_pose(p) if convention == "cTw" else p for c, p in poses.items()}
    more = {} if convention is None else {"convention": convention}
    write_npz(folder, {c: p[:, :3].astype(np.float32) for c, p in stored.items()}, **more)
    result = loaded(folder)
    for camera, wTc in poses.items():
        for time in range(FRAMES):
            world = transform_points(wTc[time], point)
            back = transform_points(invert_pose(result.trajectory(camera)[1][time]), world)
            np.testing.assert_allclose(back, point, atol=1e-4)
        # As exact rotations, though single precision was read: evo refuses others.
        rotation = result.trajectory(camera)[1][:, :3, :3]
        np.testing.assert_allclose(
            np.swapaxes(rotation, 1, 2) @ rotation, np.tile(np.eye(3), (3, 1, 1)), atol=1e-12
        )


def test_options_beside_the_poses_state_the_conventions(tmp_path: Path) -> None:
    poses = random_poses()
    cTw_opengl = {camera: invert_pose(wTc @ OPENGL) for camera, wTc in poses.items()}
    folder = write_tum(tmp_path / "m", cTw_opengl, np.arange(1, FRAMES + 1))
    options = {"convention": "cTw", "axes": "opengl", "timestamps": "frames", "first_frame": 1}
    (folder / "import.json").write_text(json.dumps(options))
    result = loaded(folder)
    for camera, wTc in poses.items():
        np.testing.assert_allclose(result.trajectory(camera)[1], wTc, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"conventoin": "cTw"}, "'conventoin' is none of the keys convention"),
        ({"axes": "blender"}, "opencv or opengl"),
        ({"depth_scale": 0}, "depth_scale"),
        ({"depth_scale": "1 mm"}, "depth_scale"),
        ({"first_frame": 0.5}, "first_frame"),
        ([], "none of the keys"),
    ],
)
def test_options_that_do_not_exist_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    write_npz(tmp_path, random_poses())
    (tmp_path / "import.json").write_text(json.dumps(content))
    with pytest.raises(ResultError, match=message):
        load_result(tmp_path, capture())


def test_tum_frames_without_a_line_or_of_nan_have_no_pose(tmp_path: Path) -> None:
    poses = random_poses()
    folder = write_tum(tmp_path / "m", {c: p[1:] for c, p in poses.items()}, np.array([0.1, 0.2]))
    (folder / "cam1.txt").write_text("0.0 nan nan nan nan nan nan nan\n0.1003 1 2 3 0 0 0 1\n")
    result = loaded(folder)
    np.testing.assert_allclose(result.trajectory("cam0")[1][1:], poses["cam0"][1:], atol=1e-12)
    assert np.isnan(result.trajectory("cam0")[1][0]).all()
    assert np.isfinite(result.trajectory("cam1")[1]).all(axis=(1, 2)).tolist() == [False, True, False]
    (folder / "cam1.txt").write_text("# this method lost the camera\n")
    assert np.isnan(loaded(folder).trajectory("cam1")[1]).all()


def test_tum_times_are_those_of_a_capture_that_starts_later(tmp_path: Path) -> None:
    poses = random_poses()
    folder = write_tum(tmp_path / "m", poses, 7.0 + np.arange(FRAMES) / 10.0)
    result = loaded(folder, replace(capture(), start_time=7.0))
    np.testing.assert_allclose(result.trajectory("cam0")[1], poses["cam0"], atol=1e-12)
    np.testing.assert_allclose(result.trajectory("cam0")[0], [7.0, 7.1, 7.2])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("0.0 1 2 3 0 0 0\n", "7 numbers a line"),
        ("0.0 1 2 3 0 0 0 x\n", "no trajectory of lines"),
        ("0.0 1 2 3 0 0 0 2\n", "unit length"),
        ("0.0 1 nan 3 0 0 0 1\n", "NaN"),
        ("0.05 1 2 3 0 0 0 1\n", "timestamp 0.05 is not that of one of the 3 frames"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n", '{"timestamps": "frames"}'),
        ("0.1 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0 1\n", "occurs twice"),
    ],
)
def test_tum_lines_that_are_no_pose_of_a_frame(tmp_path: Path, lines: str, message: str) -> None:
    folder = write_tum(tmp_path / "m", random_poses(), np.arange(FRAMES) / 10.0)
    (folder / "cam1.txt").write_text(lines)
    with pytest.raises(ResultError, match=message) as caught:
        load_result(folder, capture())
    assert "cam1.txt" in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_tum_file_is_named(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "m", random_poses(), np.arange(FRAMES) / 10.0)
    (folder / "cam1.txt").unlink()
    with pytest.raises(ResultError, match="cam1.txt: missing"):
        load_result(folder, capture())


def bad_npz(kind: str) -> dict[str, np.ndarray]:
    poses = random_poses()
    if kind == "short":
        poses["cam1"] = poses["cam1"][:2]
    elif kind == "missing":
        del poses["cam1"]
    elif kind == "unknown":
        poses["left"] = poses["cam1"]
    elif kind == "nan":
        poses["cam1"][1, 0, 3] = np.nan
    elif kind == "infinite":
        poses["cam1"][1, 0, 3] = np.inf
    elif kind == "scaled":
        poses["cam1"][1, :3, :3] *= 2.0
    elif kind == "skewed":
        poses["cam1"][1, 0, 0] += 0.1
    elif kind == "reflected":
        poses["cam1"][1, :3, 0] *= -1.0
    elif kind == "transposed":
        poses["cam1"] = np.swapaxes(poses["cam1"], 1, 2)
    elif kind == "vectors":
        poses["cam1"] = np.zeros((FRAMES, 7))
    elif kind == "empty":
        poses = {camera: np.full((FRAMES, 4, 4), np.nan) for camera in poses}
    return poses


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("short", "cam1 has 2 poses, the capture 3 frames; put NaN"),
        ("missing", "holds cam0, the capture has cameras cam0, cam1"),
        ("unknown", "holds cam0, cam1, left"),
        ("nan", "cam1, pose 1: holds NaN"),
        ("infinite", "cam1, pose 1: holds NaN or infinity"),
        ("scaled", "cam1, pose 1: not rigid: the rotation is scaled by 2"),
        ("skewed", "cam1, pose 1: not rigid"),
        ("reflected", "reflection"),
        ("transposed", "transposed"),
        ("vectors", r"shape \(3, 7\)"),
        ("empty", "holds no pose of any frame"),
    ],
)
def test_matrices_that_are_no_poses(tmp_path: Path, kind: str, message: str) -> None:
    write_npz(tmp_path, bad_npz(kind))
    with pytest.raises(ResultError, match=message) as caught:
        load_result(tmp_path / "poses.npz", capture())
    assert "poses.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_a_convention_said_twice_must_agree(tmp_path: Path) -> None:
    write_npz(tmp_path, random_poses(), convention="cTw")
    (tmp_path / "import.json").write_text('{"convention": "wTc"}')
    with pytest.raises(ResultError, match="keep one"):
        load_result(tmp_path, capture())
    write_npz(tmp_path, random_poses(), convention="c2w")
    with pytest.raises(ResultError, match="must be wTc or cTw"):
        load_result(tmp_path, capture())


@pytest.mark.parametrize(
    "pattern", ["images/{}/{:06d}.png", "./{}/frame_{:05d}.jpg", "{}_{:d}.png", "a\\{}\\{}.png"]
)
def test_names_tell_camera_and_frame(tmp_path: Path, pattern: str) -> None:
    poses = random_poses()
    frames = [
        {"file_path": pattern.format(camera, time), "transform_matrix": (wTc[time] @ OPENGL).tolist()}
        for camera, wTc in poses.items()
        for time in range(FRAMES)
    ]
    result = loaded(write_transforms(tmp_path, frames))
    for camera, wTc in poses.items():
        np.testing.assert_allclose(result.trajectory(camera)[1], wTc, atol=1e-12)
    # Without intrinsics in the file, those of the capture.
    np.testing.assert_array_equal(result.intrinsics("cam1"), CAMERAS[1].intrinsics)
    # but first guesses are none
    guessed = replace(result, capture=with_unknown_focal(result.capture))
    with pytest.raises(ResultError, match="does not state the intrinsics of cam1"):
        guessed.intrinsics("cam1")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["images/cam2/000001.png"], "does not tell camera and frame"),
        (["cam0/first.png"], "does not tell camera and frame"),
        (["cam00001.png"], "does not tell camera and frame"),
        (["cam0/000003.png"], '{"first_frame": 1}'),
        (["cam0/000001.png", "cam0/000001.jpg"], "occurs twice"),
    ],
)
def test_names_that_do_not(tmp_path: Path, names: list[str], message: str) -> None:
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    with pytest.raises(ResultError, match=message):
        load_result(write_transforms(tmp_path, frames), capture())


@pytest.mark.parametrize("content", ["{", "[]", '{"frames": [{"file_path": "cam0/0.png"}]}'])
def test_a_transforms_file_that_is_none(tmp_path: Path, content: str) -> None:
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(ResultError, match="transforms.json: no transforms.json with frames"):
        load_result(tmp_path, capture())


def test_unknown_and_ambiguous_layouts(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no such file"):
        load_result(tmp_path / "nothing", capture())
    (tmp_path / "empty").mkdir()
    with pytest.raises(ResultError, match="no result of cameras cam0, cam1 is recognised"):
        load_result(tmp_path / "empty", capture())
    (tmp_path / "poses.pkl").touch()
    with pytest.raises(ResultError, match="give a folder, a transforms.json or a .npz"):
        load_result(tmp_path / "poses.pkl", capture())
    both = write_npz(tmp_path / "both", random_poses())
    write_tum(both, random_poses(), np.arange(FRAMES) / 10.0)
    with pytest.raises(ResultError, match="several results .*poses.npz"):
        load_result(both, capture())
    assert loaded(both / "poses.npz").layout == "npz"


def test_a_reconstruction_of_another_capture_is_refused(tmp_path: Path) -> None:
    make(tmp_path / "ours")
    fewer = Capture("other", 10.0, CAMERAS[:1], capture().streams[:1])
    with pytest.raises(ResultError, match="give a result of this capture"):
        load_result(tmp_path / "ours", fewer)
    shutil.rmtree(tmp_path / "ours" / "trajectories")
    assert load_result(tmp_path / "ours", capture()).cameras == ["cam0", "cam1"]
