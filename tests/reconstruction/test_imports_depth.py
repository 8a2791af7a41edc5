"""Depth of other methods: every file type, any resolution of the same view, and nothing invented at edges."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.export import export_colmap
from mvdyn_gtsam.reconstruction.imports import load_result
from mvdyn_gtsam.reconstruction.imports.depth import read_depth, resize_nearest
from tests.reconstruction.test_export import FRAMES, capture, make
from tests.reconstruction.test_imports import loaded, random_poses, write_npz

HEIGHT, WIDTH = 24, 32


def sample() -> np.ndarray:
    depth = np.random.default_rng(0).uniform(1.0, 5.0, (HEIGHT, WIDTH)).astype(np.float32)
    depth[0, :5] = [0.0, np.nan, np.inf, -1.0, 2.0]
    return depth


def expected() -> np.ndarray:
    depth = sample()
    depth[0, :4] = np.nan
    return depth


def write_depth(path: Path, depth: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, depth)
    elif path.suffix == ".npz":
        np.savez(path, depth=depth[None], confidence=depth)
    elif path.suffix == ".png":
        with np.errstate(invalid="ignore"):
            units = np.rint(np.where(np.isfinite(depth) & (depth > 0), depth, 0.0) / 0.0005)
        assert cv2.imwrite(str(path), units.astype(np.uint16))
    else:
        assert cv2.imwrite(str(path), depth)
    return path


@pytest.mark.parametrize("name", ["000001.npy", "000001.npz", "1.png", "frame_001.tif", "000001.tiff"])
def test_every_file_type_gives_the_same_depth(tmp_path: Path, name: str) -> None:
    write_npz(tmp_path, random_poses())
    (tmp_path / "import.json").write_text('{"depth_scale": 0.0005}')
    write_depth(tmp_path / "depth" / "cam0" / name, sample())
    result = loaded(tmp_path)
    assert [result.has_depth("cam0", time) for time in range(FRAMES)] == [False, True, False]
    assert not result.has_depth("cam1", 1)
    depth = result.depth("cam0", 1)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, expected(), atol=0.00025 if name.endswith("png") else 0.0)
    with pytest.raises(ResultError, match="no depth of frame 0 of cam0"):
        result.depth("cam0", 0)


@given(factor=st.sampled_from([1, 2, 3]), seed=st.integers(0, 100))
def test_smaller_depth_is_repeated_and_larger_is_picked(factor: int, seed: int) -> None:
    path = Path("d.npy")
    small = np.random.default_rng(seed).uniform(1.0, 5.0, (6, 8)).astype(np.float32)
    large = np.repeat(np.repeat(small, factor, axis=0), factor, axis=1)
    np.testing.assert_array_equal(resize_nearest(path, small, 8 * factor, 6 * factor), large)
    # Pixels map as x' = (x + 0.5) s - 0.5, so each small pixel is the middle of its block.
    np.testing.assert_array_equal(resize_nearest(path, large, 8, 6), small)


def test_a_plane_keeps_its_place_when_resized() -> None:
    """Of a ramp, so that a shift by a pixel or half of one shows."""
    ramp = np.tile(np.arange(518, dtype=np.float32), (392, 1))
    resized = resize_nearest(Path("d.npy"), ramp, 512, 384)  # the sides of networks are multiples of 14
    wanted = (np.arange(512) + 0.5) * 518 / 512 - 0.5
    assert np.abs(resized[0] - wanted).max() <= 0.5 + 1e-6


def test_no_depth_is_made_up_between_near_and_far(tmp_path: Path) -> None:
    depth = np.full((12, 16), 1.0, np.float32)
    depth[:, 7:] = 9.0
    depth[3, 3] = np.nan
    resized = read_depth(write_depth(tmp_path / "1.npy", depth), WIDTH, HEIGHT)
    assert set(np.unique(resized[np.isfinite(resized)])) == {1.0, 9.0}
    assert np.isnan(resized).sum() == 4


def test_depth_lies_beside_sparse_of_a_colmap_project(tmp_path: Path) -> None:
    (model,) = export_colmap(make(tmp_path / "ours"), tmp_path / "project")
    write_depth(tmp_path / "project" / "depth" / "cam0" / "0.npy", sample())
    for path in (tmp_path / "project", model):
        np.testing.assert_array_equal(load_result(path, capture()).depth("cam0", 0), expected())


@pytest.mark.parametrize(
    ("name", "depth", "message"),
    [
        ("1.npy", np.ones((24, 24), np.float32), "another aspect ratio"),
        ("1.npy", np.ones((24, 32), np.uint16), "must be floating point"),
        ("1.npy", np.ones((2, 24, 32), np.float32), "must be one image"),
        ("1.tif", np.ones((24, 32), np.uint16), "must be float32"),
    ],
)
def test_images_that_are_no_depth_of_the_frame(
    tmp_path: Path, name: str, depth: np.ndarray, message: str
) -> None:
    with pytest.raises(ResultError, match=message) as caught:
        read_depth(write_depth(tmp_path / name, depth), WIDTH, HEIGHT)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.parametrize("name", ["1.npy", "1.npz", "1.png", "1.tif"])
def test_damaged_files_are_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"nothing of the kind")
    with pytest.raises(ResultError, match=name):
        read_depth(tmp_path / name, WIDTH, HEIGHT, 0.001)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cam0/000001.png", '{"depth_scale": 0.001}'),
        ("cam0/000003.npy", '{"first_frame": 1}'),
        ("cam0/last.npy", "does not tell its frame"),
        ("cam0/000001.exr", "EXR is not read"),
        ("left/000001.npy", "no camera of the capture"),
        ("cam0/1.npy", "keep one"),
    ],
)
def test_files_that_belong_to_no_frame_are_refused_at_once(tmp_path: Path, name: str, message: str) -> None:
    write_npz(tmp_path, random_poses())
    (tmp_path / "depth" / "cam0").mkdir(parents=True)
    (tmp_path / "depth" / "cam0" / "000001.tif").touch()
    path = tmp_path / "depth" / name
    path.parent.mkdir(exist_ok=True)
    path.touch()
    with pytest.raises(ResultError, match=message):
        load_result(tmp_path, capture())


def test_frames_counted_from_one(tmp_path: Path) -> None:
    write_npz(tmp_path, random_poses())
    (tmp_path / "import.json").write_text(json.dumps({"first_frame": 1}))
    write_depth(tmp_path / "depth" / "cam0" / "000003.npy", sample())
    assert loaded(tmp_path).has_depth("cam0", 2)
