"""A depth prior of files: every size of the right shape is read, everything else is one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_files import DepthFiles
from mvdyn_gtsam.frontend.depth_priors.depth_prior import DepthPrior
from tests.frontend.depth_priors.prior_start import CAMERAS, HEIGHT, WIDTH, true_depth

DEPTH = true_depth(0, 0).astype(np.float32)
IMAGE = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for camera in CAMERAS:
        (tmp_path / camera.name).mkdir()
        np.save(tmp_path / camera.name / "000000.npy", DEPTH)
    return tmp_path


def predict(folder: Path, time: int) -> tuple[np.ndarray, np.ndarray | None] | None:
    prior: DepthPrior = DepthFiles(folder, CAMERAS)
    return prior.predict(IMAGE, CAMERAS[0].intrinsics, "left", time)


def test_both_formats_and_any_numbers_are_read(folder: Path) -> None:
    np.savez(folder / "left" / "000001.npz", depth=DEPTH.astype(np.float64), confidence=DEPTH / DEPTH.max())
    np.savez_compressed(folder / "left" / "000002.npz", depth=DEPTH)
    np.save(folder / "left" / "000003.npy", np.rint(1000 * DEPTH).astype(np.uint16))
    for time, unit in ((0, 1.0), (1, 1.0), (2, 1.0), (3, 1000.0)):
        found = predict(folder, time)
        assert found is not None and found[0].dtype == np.float32
        np.testing.assert_allclose(found[0] / unit, DEPTH, rtol=1e-3)
        assert (found[1] is None) == (time != 1)
        if found[1] is not None:
            np.testing.assert_allclose(found[1], DEPTH / DEPTH.max(), rtol=1e-6)


def test_a_frame_without_a_file_is_unknown(folder: Path) -> None:
    assert predict(folder, 5) is None


@pytest.mark.parametrize("size", [(16, 24), (64, 96), (11, 16), (320, 480), (21, 32)])
def test_another_size_is_resized_without_mixing(folder: Path, size: tuple[int, int]) -> None:
    near = np.arange(size[1])[None] < size[1] / 2
    np.save(folder / "left" / "000001.npy", np.broadcast_to(np.where(near, 1.0, 9.0), size))
    found = predict(folder, 1)
    assert found is not None and found[0].shape == (HEIGHT, WIDTH)
    assert set(np.unique(found[0])) == {1.0, 9.0}
    # an edge stays within half a pixel of the coarser of both
    edge = (found[0][0] == 1.0).sum()
    assert abs(edge - WIDTH / 2) <= max(1.0, 0.5 * WIDTH / size[1] + 0.5)


def test_the_name_tells_folders_apart(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    assert DepthFiles(folder.name, CAMERAS).name == DepthFiles(folder, CAMERAS).name
    assert str(folder) in DepthFiles(folder, CAMERAS).name


def _no_folder(folder: Path) -> Path:
    return folder / "nowhere"


def _no_camera(folder: Path) -> Path:
    (folder / "door" / "000000.npy").unlink()
    (folder / "door").rmdir()
    return folder


def _no_frame(folder: Path) -> Path:
    (folder / "door" / "000000.npy").rename(folder / "door" / "depth0.npy")
    return folder


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_no_folder, r"nowhere: no such folder; .*cam0/000012\.npy"),
        (_no_camera, r"door: is missing; .*one folder per camera"),
        (_no_frame, r"door: holds no depth; .*six digits"),
    ],
)
def test_what_is_missing_is_named_at_once(folder: Path, spoil: Callable[[Path], Path], message: str) -> None:
    with pytest.raises(DepthPriorError, match=message):
        DepthFiles(spoil(folder), CAMERAS)


def _write(content: bytes) -> Callable[[Path], None]:
    return lambda path: (path.with_suffix(".npy").write_bytes(content), None)[1]


def _npy(array: np.ndarray) -> Callable[[Path], None]:
    return lambda path: np.save(path.with_suffix(".npy"), array)


def _npz(**arrays: np.ndarray) -> Callable[[Path], None]:
    return lambda path: np.savez(path.with_suffix(".npz"), allow_pickle=False, **arrays)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (_write(b""), r"000001\.npy: cannot be read"),
        (_write(b"no numpy"), r"000001\.npy: cannot be read"),
        (_write(b"PK\x03\x04 no zip"), r"000001\.npy: cannot be read"),
        (_npy(np.full((HEIGHT, WIDTH), None)), r"000001\.npy: cannot be read"),
        (_npy(DEPTH[:, :-4]), r"000001\.npy: is 44x32, and its frame 48x32; .*aspect ratio"),
        (_npy(DEPTH.T), r"000001\.npy: is 32x48"),
        (_npy(DEPTH[None]), r"000001\.npy: depth is float32 of shape \(1, 32, 48\)"),
        (_npy(DEPTH[:0]), r"000001\.npy: depth is float32 of shape \(0, 48\)"),
        (_npy(DEPTH > 3.0), r"000001\.npy: depth is bool"),
        (_npz(metres=DEPTH), r'000001\.npz: has no array "depth"'),
        (_npz(depth=DEPTH, confidence=DEPTH[::2, ::2]), r"confidence of shape \(16, 24\) for a depth of"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line_that_names_it(
    folder: Path, write: Callable[[Path], None], message: str
) -> None:
    write(folder / "left" / "000001")
    with pytest.raises(DepthPriorError, match=message) as caught:
        predict(folder, 1)
    assert "\n" not in str(caught.value) and str(folder / "left") in str(caught.value)
