"""Every export is read back by its own conventions and re-projected: points must land on their pixels."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import backproject, transform_points
from mvdyn_gtsam.reconstruction import CaptureInfo, Reconstruction, ReconstructionWriter
from mvdyn_gtsam.reconstruction.export import export_colmap, export_nerfstudio, export_ply, export_tum
from mvdyn_gtsam.reconstruction.files import read_tum

CAMERAS = (Camera("cam0", 32, 24, 30.0, 31.0, 15.0, 11.5), Camera("cam1", 40, 30, 33.0, 34.0, 19.0, 15.5))
FRAMES = 3


class Noise:
    """A stream of smooth random images, different for every camera and time."""

    def __init__(self, camera: Camera, seed: int) -> None:
        self.camera, self.seed = camera, seed

    def __len__(self) -> int:
        return FRAMES

    def read(self, time: int) -> np.ndarray:
        rng = np.random.default_rng([self.seed, time])
        small = rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)
        return cv2.resize(small, (self.camera.width, self.camera.height), interpolation=cv2.INTER_LINEAR)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    wTc = np.eye(4)
    wTc[:3, :3] = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    wTc[:3, 3] = rng.standard_normal(3)
    return wTc


def make(
    folder: Path, seed: int = 0, groups: tuple[tuple[str, ...], ...] = (("cam0", "cam1"),)
) -> Reconstruction:
    rng = np.random.default_rng(seed)
    info = CaptureInfo("clip", 10.0, FRAMES, CAMERAS)
    with ReconstructionWriter.create(folder, info, {}) as writer:
        writer.set_groups(groups)
        for camera in CAMERAS:
            wTc = np.stack([random_pose(rng) for _ in range(FRAMES)])
            writer.write_trajectory(camera.name, np.arange(FRAMES) / 10.0, wTc)
            for time in range(FRAMES):
                depth = rng.uniform(1.0, 5.0, (camera.height, camera.width))
                depth[0] = np.nan
                confidence = np.ones(depth.shape)
                confidence[1] = 0.1
                writer.write_depth(camera.name, time, depth, confidence)
    return Reconstruction.load(folder)


def capture() -> Capture:
    return Capture("clip", 10.0, CAMERAS, tuple(Noise(camera, i) for i, camera in enumerate(CAMERAS)))


def world_points(result: Reconstruction, camera: str, time: int, pixels: np.ndarray) -> np.ndarray:
    """World points of integer pixels ``(N, 2)``, straight from the contract."""
    z = result.depth(camera, time)[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    rays = backproject(pixels.astype(float), z, result.intrinsics(camera))
    return transform_points(result.trajectory(camera)[1][time], rays)


def read_colmap(
    model: Path,
) -> tuple[dict[int, np.ndarray], dict[str, tuple[Any, ...]], dict[int, np.ndarray]]:
    """Cameras ``id -> (fx, fy, cx, cy)``, images ``name -> (cRw, c_t_w, camera id, points2D)``, points."""
    cameras = {}
    for line in (model / "cameras.txt").read_text().splitlines():
        words = line.split()
        assert words[1] == "PINHOLE"
        cameras[int(words[0])] = np.array(words[4:], float)
    images = {}
    lines = [line for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    for head, body in zip(lines[::2], lines[1::2], strict=True):
        words = head.split()
        qw, qx, qy, qz = map(float, words[1:5])
        rotation = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
        observed = np.array(body.split(), float).reshape(-1, 3)
        images[words[9]] = (rotation, np.array(words[5:8], float), int(words[8]), observed)
    points = {}
    for line in (model / "points3D.txt").read_text().splitlines():
        if not line.startswith("#"):
            words = line.split()
            points[int(words[0])] = np.array(words[1:7], float)
    return cameras, images, points


@pytest.mark.parametrize("seed", [0, 1])
def test_colmap_points_land_on_their_pixels(tmp_path: Path, seed: int) -> None:
    result = make(tmp_path / "out", seed)
    (model,) = export_colmap(result, tmp_path / "colmap", capture=capture(), stride=4)
    cameras, images, points = read_colmap(model)
    assert set(images) == {f"cam{c}/{t:06d}.jpg" for c in range(2) for t in range(FRAMES)}
    for name, (cRw, translation, camera_id, observed) in images.items():
        camera, time = name.split("/")[0], int(name.split("/")[1][:6])
        assert len(observed) > 30
        fx, fy, cx, cy = cameras[camera_id]
        known = world_points(result, camera, time, np.rint(observed[:, :2] - 0.5).astype(int))
        stored = np.stack([points[int(i)][:3] for i in observed[:, 2]])
        np.testing.assert_allclose(stored, known, atol=1e-9)
        x, y, z = (stored @ cRw.T + translation).T
        np.testing.assert_allclose(
            np.column_stack([fx * x / z + cx, fy * y / z + cy]), observed[:, :2], atol=1e-6
        )
        image: Any = cv2.imread(str(tmp_path / "colmap" / "images" / name))
        assert image.shape[:2] == (result.camera(camera).height, result.camera(camera).width)
        # Colours follow the image at the pixel (COLMAP's x, y truncated is the pixel's index).
        rows, columns = observed[:, 1].astype(int), observed[:, 0].astype(int)
        stored_rgb = np.stack([points[int(i)][3:] for i in observed[:, 2]])
        assert np.abs(image[rows, columns, ::-1].astype(float) - stored_rgb).mean() < 8.0


def test_pycolmap_reads_the_model_and_agrees(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    (model,) = export_colmap(make(tmp_path / "out"), tmp_path / "colmap", stride=4)
    script = (
        "import sys, pycolmap\n"
        "r = pycolmap.Reconstruction(sys.argv[1])\n"
        "r.update_point_3d_errors()\n"
        "print(r.num_reg_images(), r.num_points3D() > 100, r.compute_mean_reprojection_error() < 1e-6)\n"
    )
    # In a process of its own: pycolmap and OpenCV carry two copies of zlib.
    done = subprocess.run(
        [sys.executable, "-c", script, str(model)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.split() == [str(2 * FRAMES), "True", "True"], done.stderr


def test_nerfstudio_points_land_on_their_pixels(tmp_path: Path) -> None:
    result = make(tmp_path / "out")
    (path,) = export_nerfstudio(result, tmp_path / "ns", capture=capture())
    frames = json.loads(path.read_text())["frames"]
    assert len({(frame["camera"], frame["time"]) for frame in frames}) == 2 * FRAMES
    assert sorted({frame["time"] for frame in frames}) == [0.0, 0.5, 1.0]
    pixels = np.array([[3, 5], [20, 17], [31, 23]])
    for frame in frames:
        assert (path.parent / frame["file_path"]).is_file()
        time = round(frame["timestamp"] * 10.0)
        known = world_points(result, frame["camera"], time, pixels)
        # OpenGL camera: looks along -z, y up; nerfstudio's pixel centres at +0.5.
        x, y, z = transform_points(np.linalg.inv(frame["transform_matrix"]), known).T
        assert (z < 0).all()
        projected = np.column_stack(
            [frame["fl_x"] * x / -z + frame["cx"], -frame["fl_y"] * y / -z + frame["cy"]]
        )
        np.testing.assert_allclose(projected, pixels + 0.5, atol=1e-6)
    assert (path.parent / "points.ply").is_file()


def read_ply(path: Path) -> np.ndarray:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = {"float": "<f4", "uchar": "u1"}
    properties = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    vertices = np.frombuffer(body, np.dtype([(name, kinds[kind]) for kind, name in properties]))
    assert f"element vertex {len(vertices)}\n" in header.decode()
    return vertices


def test_ply_holds_the_confident_points_of_the_instant(tmp_path: Path) -> None:
    result = make(tmp_path / "out")
    (path,) = export_ply(result, tmp_path / "cloud.ply", times=[1], capture=capture(), stride=1)
    vertices = read_ply(path)
    pixels = {
        c.name: np.stack(np.meshgrid(np.arange(c.width), np.arange(2, c.height)), -1).reshape(-1, 2)
        for c in CAMERAS
    }
    known = np.concatenate([world_points(result, name, 1, pixels[name]) for name in result.cameras])
    assert len(vertices) == len(known)  # rows 0 (invalid) and 1 (not confident) are left out
    np.testing.assert_allclose(np.column_stack([vertices[k] for k in "xyz"]), known, rtol=1e-5, atol=1e-5)
    colours = np.concatenate([capture().read(i, 1)[2:].reshape(-1, 3) for i in range(2)])
    np.testing.assert_array_equal(np.column_stack([vertices[k] for k in ("red", "green", "blue")]), colours)


@given(seed=st.integers(0, 1000))
def test_tum_gives_back_the_same_doubles(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    folder = tmp_path_factory.mktemp("tum")
    result = make(folder / "out", seed)
    for path in export_tum(result, folder / "tum"):
        timestamps, wTc = result.trajectory(path.stem)
        read_times, read_poses = read_tum(path)
        np.testing.assert_array_equal(read_times, timestamps)
        np.testing.assert_allclose(read_poses, wTc, rtol=1e-14, atol=1e-14)


def test_groups_are_never_mixed(tmp_path: Path) -> None:
    result = make(tmp_path / "out", groups=(("cam0",), ("cam1",)))
    assert [p.name for p in export_colmap(result, tmp_path / "c")] == ["0", "1"]
    assert "cam1/" not in (tmp_path / "c" / "sparse" / "0" / "images.txt").read_text()
    assert [p.parent.name for p in export_nerfstudio(result, tmp_path / "n")] == ["group0", "group1"]
    assert [p.parent.name for p in export_tum(result, tmp_path / "t")] == ["group0", "group1"]
    assert [p.name for p in export_ply(result, tmp_path / "p.ply")] == ["p_group0.ply", "p_group1.ply"]


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no camera has been placed"):
        export_tum(make(tmp_path / "a", groups=()), tmp_path / "t")
    result = make(tmp_path / "b")
    with pytest.raises(ResultError, match="no frame 7"):
        export_ply(result, tmp_path / "p.ply", times=[7])
    with pytest.raises(ResultError, match="lower --min-confidence"):
        export_ply(result, tmp_path / "p.ply", min_confidence=1.1)
    other = Capture("other", 10.0, CAMERAS[:1], (Noise(CAMERAS[0], 0),))
    with pytest.raises(ResultError, match="was not made from capture 'other'"):
        export_colmap(result, tmp_path / "c", capture=other)
