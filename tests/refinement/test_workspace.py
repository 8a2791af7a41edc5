"""What lies on disk between the steps: flow, images, arrays and the journal."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.frontend.dense_flow import FlowPair
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import STEPS_PER_PX, Workspace

Float32 = npt.NDArray[np.float32]

LARGE = Camera("large", 48, 32, 40.0, 40.0, 23.5, 15.5)
SMALL = Camera("small", 36, 20, 30.0, 30.0, 17.5, 9.5)
SIZES = ((32, 48), (20, 36))
A, B = (0, 3), (1, 3)


def workspace(folder: Path, scale: float = 0.5) -> Workspace:
    views = tuple(DenseView.of(camera, scale) for camera in (LARGE, SMALL))
    made = Workspace(folder / "work", views, 5)
    made.prepare("settings")
    return made


def smooth(shape: tuple[int, int], amplitude: float) -> Float32:
    """Flow linear over the image: its average over a small pixel is its value at the pixel's centre."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    flow = np.stack([x / shape[1] - 0.3, 0.5 - y / shape[0]], axis=-1)
    return (amplitude * flow).astype(np.float32)


def pair(amplitude: float, seed: int = 0) -> FlowPair:
    rng = np.random.default_rng(seed)
    weights = [rng.random(size).astype(np.float32) for size in SIZES]
    return FlowPair(smooth(SIZES[0], amplitude), smooth(SIZES[1], -amplitude), weights[0], weights[1])


def expected(flow: Float32, own: Camera, other: Camera, view: DenseView, view_there: DenseView) -> Float32:
    """Flow in the views' pixels, by the positions: x' = (x + 0.5) s - 0.5."""
    y, x = np.mgrid[: view.shape[0], : view.shape[1]]
    small = np.stack([x, y], axis=-1).astype(np.float64)
    at = (small + 0.5) * [own.width / view.shape[1], own.height / view.shape[0]] - 0.5
    # the flow is linear: sampled at the position in the full image
    slope = np.stack([flow[0, 1] - flow[0, 0], flow[1, 0] - flow[0, 0]], axis=-1).astype(np.float64)
    there = at + flow[0, 0] + at @ slope.T
    scale = [view_there.shape[1] / other.width, view_there.shape[0] / other.height]
    return np.asarray((there + 0.5) * scale - 0.5 - small, np.float32)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.4])
@pytest.mark.parametrize("amplitude", [3.0, 60.0])
def test_flow_comes_back_to_its_quantum(tmp_path: Path, scale: float, amplitude: float) -> None:
    """Both directions, between cameras of different size."""
    kept, flow = workspace(tmp_path, scale), pair(amplitude)
    kept.write_flow(A, B, flow)
    views = kept.views
    forth, back = kept.read_flow(A, B), kept.read_flow(A, B, backward=True)
    assert (forth.i, forth.j, back.i, back.j) == (A, B, B, A)
    quantum = 0.5 / STEPS_PER_PX + 2e-5 * amplitude
    if scale == 0.4:
        # pixels that are averages of parts of pixels: a ramp is a staircase to them
        quantum += 0.05 * amplitude / min(SIZES[1])
    wanted = expected(flow.forward, LARGE, SMALL, views[0], views[1])
    np.testing.assert_allclose(forth.flow.reshape(wanted.shape), wanted, atol=quantum)
    wanted = expected(flow.backward, SMALL, LARGE, views[1], views[0])
    np.testing.assert_allclose(back.flow.reshape(wanted.shape), wanted, atol=quantum)
    for found, weight, view in (
        (forth, flow.forward_weight, views[0]),
        (back, flow.backward_weight, views[1]),
    ):
        assert np.abs(found.weight - np.asarray(view.shrink(weight), np.float32).ravel()).max() < 0.51 / 255.0
        assert found.flow.dtype == found.weight.dtype == np.float32


def test_no_flow_between_equal_cameras_is_none_on_disk(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    nothing, sure = np.zeros((32, 48, 2), np.float32), np.ones((32, 48), np.float32)
    kept.write_flow((0, 1), (0, 3), FlowPair(nothing, nothing, sure, sure))
    found = kept.read_flow((0, 1), (0, 3))
    assert (found.flow == 0.0).all() and (found.weight == 1.0).all()


def test_flow_beyond_512_px_is_kept_more_coarsely_not_wrapped(tmp_path: Path) -> None:
    kept = workspace(tmp_path, 1.0)
    flow = pair(3000.0)
    kept.write_flow(A, B, flow)
    found = kept.read_flow(A, B)
    wanted = expected(flow.forward, LARGE, SMALL, *kept.views)
    largest = float(np.abs(wanted).max())
    assert largest > 1024.0
    np.testing.assert_allclose(found.flow.reshape(wanted.shape), wanted, atol=0.55 * largest / 32000.0 + 1e-3)


def test_only_the_measured_order_is_there(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    assert not kept.has_flow(A, B)
    kept.write_flow(A, B, pair(1.0))
    assert kept.has_flow(A, B) and not kept.has_flow(B, A) and not kept.has_flow(A, (1, 4))


def test_a_flow_half_written_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = workspace(tmp_path)

    shrunk, directions = kept._shrunk, []

    def killed(i: Frame, j: Frame, flow: Float32, weight: Float32) -> tuple[Float32, Float32]:
        directions.append((i, j))
        if len(directions) == 2:
            raise KeyboardInterrupt
        return shrunk(i, j, flow, weight)

    with monkeypatch.context() as patched:
        patched.setattr(kept, "_shrunk", killed)
        with pytest.raises(KeyboardInterrupt):
            kept.write_flow(A, B, pair(1.0))
    assert not kept.has_flow(A, B)
    kept.write_flow(A, B, pair(1.0))
    assert kept.has_flow(A, B) and kept.read_flow(A, B).flow.shape == (16 * 24, 2)


def test_images_of_an_array_are_kept_apart(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    kept.create("depth")
    kept.create("grey", np.uint8, full_size=True)
    kept.create("colour", np.uint8, channels=(2,))
    image, grey = smooth((16, 24), 1.0)[..., 0], np.full((20, 36), 7, np.uint8)
    kept.write("depth", (0, 2), image)
    kept.write("grey", (1, 4), grey)
    kept.write("colour", (1, 3), np.arange(360).reshape(10, 18, 2) % 256)
    np.testing.assert_array_equal(kept.read("colour", (1, 3)).ravel(), np.arange(360) % 256)
    np.testing.assert_array_equal(kept.read("depth", (0, 2)), image)
    np.testing.assert_array_equal(kept.read("grey", (1, 4)), grey)
    for name, frame, shape in (
        ("depth", (0, 1), (16, 24)),
        ("depth", (1, 2), (10, 18)),
        ("grey", A, (32, 48)),
        ("colour", (1, 4), (10, 18, 2)),
    ):
        other = kept.read(name, frame)
        assert other.shape == shape and (other == 0).all()


def test_making_an_array_again_keeps_it(tmp_path: Path) -> None:
    """A step that a killed run began is begun again over what it had."""
    kept = workspace(tmp_path)
    kept.create("depth")
    kept.write("depth", (0, 2), np.ones((16, 24), np.float32))
    kept.create("depth")
    assert (kept.read("depth", (0, 2)) == 1.0).all()


def test_an_array_is_made_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = workspace(tmp_path)
    kept.create("depth")
    assert (kept.folder / "depth_0.npy").stat().st_size > 5 * 16 * 24 * 4
    assert (np.load(kept.folder / "depth_0.npy") == 0.0).all()

    def full(file: io.BufferedWriter, header: dict[str, object]) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array_header_1_0", full)
    with pytest.raises(ResultError, match=r"swept_0.npy: cannot be written \(No space left"):
        kept.create("swept")
    assert not (kept.folder / "swept_0.npy").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a disk that is always full")
def test_an_image_that_the_disk_cannot_hold_is_told(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    kept.create("depth")
    image, path = kept.read("depth", (0, 2)), kept.folder / "depth_0.npy"
    path.unlink()
    path.symlink_to("/dev/full")
    with pytest.raises(ResultError, match=r"depth_0.npy: cannot be written \(No space left"):
        kept.write("depth", (0, 2), image)


def test_what_is_read_is_a_copy(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    kept.create("depth")
    image = np.asarray(kept.read("depth", (0, 2)), np.float32)
    image += np.float32(1.0)
    assert (kept.read("depth", (0, 2)) == 0.0).all()


def test_arrays_are_replaced_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = workspace(tmp_path)
    kept.write_array("poses", np.eye(4))
    kept.write_array("poses", 2.0 * np.eye(4))
    np.testing.assert_array_equal(kept.read_array("poses"), 2.0 * np.eye(4))

    def full(file: Path, array: npt.NDArray[np.float64]) -> None:
        file.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(ResultError, match=r"poses.npy: cannot be written \(No space left on device\)"):
        kept.write_array("poses", np.zeros((4, 4)))
    np.testing.assert_array_equal(kept.read_array("poses"), 2.0 * np.eye(4))


def test_an_array_is_read_anew_once_another_process_wrote_it(tmp_path: Path) -> None:
    kept, other = workspace(tmp_path), workspace(tmp_path)
    kept.write_array("poses", np.eye(4))
    read = kept.read_array("poses")
    assert kept.read_array("poses") is read and not read.flags.writeable
    other.write_array("poses", 2.0 * np.eye(4))
    np.testing.assert_array_equal(kept.read_array("poses"), 2.0 * np.eye(4))


def test_finished_steps_are_known_to_the_next_run(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    assert kept.finished() == []
    kept.finish("images")
    kept.finish("depth 0")
    assert workspace(tmp_path).finished() == ["images", "depth 0"]


def test_a_journal_half_written_loses_no_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = workspace(tmp_path)
    kept.finish("images")
    kept.write_flow(A, B, pair(1.0))

    def full(self: Path, text: str) -> int:
        self.write_bytes(text[:3].encode())
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full)
        with pytest.raises(ResultError, match=r"journal.json: cannot be written \(No space left"):
            kept.finish("sweep")
    resumed = workspace(tmp_path)
    assert resumed.finished() == ["images"] and resumed.has_flow(A, B)
    resumed.finish("sweep")
    assert resumed.finished() == ["images", "sweep"]


def test_other_settings_begin_anew(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    kept.finish("images")
    kept.write_flow(A, B, pair(1.0))
    kept.prepare("other settings")
    assert kept.finished() == [] and not kept.has_flow(A, B)


def test_nothing_stays_when_it_is_removed(tmp_path: Path) -> None:
    kept = workspace(tmp_path)
    kept.write_flow(A, B, pair(1.0))
    kept.remove()
    assert not kept.folder.exists()
    kept.remove()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    views = (DenseView.of(LARGE, 0.5),)
    with pytest.raises(ResultError, match=r"file/work: cannot be made"):
        Workspace(tmp_path / "file" / "work", views, 1).prepare("settings")
