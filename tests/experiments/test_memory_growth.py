"""Long captures made of short ones, and growth told from size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.memory_growth import folder_mb, forwards_and_backwards, rows, write_long_capture
from experiments.records import ExperimentError
from mvdyn_gtsam.capture import Camera, Capture, load_capture


class NumberedFrames:
    """Frame k has the value k everywhere, 10 more for the second camera."""

    def __init__(self, count: int, offset: int) -> None:
        self.count, self.offset = count, offset

    def __len__(self) -> int:
        return self.count

    def read(self, time: int) -> npt.NDArray[np.uint8]:
        return np.full((24, 32, 3), self.offset + time, np.uint8)


def capture(frames: int, cameras: int = 3) -> Capture:
    return Capture(
        "clip",
        30.0,
        tuple(Camera(f"cam{k}", 32, 24, 30.0, 30.0, 15.5, 11.5) for k in range(cameras)),
        tuple(NumberedFrames(frames, 10 * k) for k in range(cameras)),
    )


@given(st.integers(2, 20), st.integers(1, 100))
def test_playing_moves_by_one_frame_and_reaches_both_ends(available: int, length: int) -> None:
    order = forwards_and_backwards(available, length)
    assert len(order) == length and order[0] == 0
    assert all(abs(b - a) == 1 for a, b in zip(order, order[1:], strict=False))
    assert set(order) == set(range(min(available, length)))


@pytest.mark.parametrize("length", [3, 5, 14])
def test_the_long_capture_is_read_as_played(tmp_path: Path, length: int) -> None:
    write_long_capture(capture(5), 2, length, tmp_path / "long")
    played = load_capture(tmp_path / "long")
    assert [camera.name for camera in played.cameras] == ["cam0", "cam1"]
    assert played.frame_count == length
    for number in range(2):
        seen = [int(played.read(number, time)[0, 0, 0]) - 10 * number for time in range(length)]
        assert seen == forwards_and_backwards(5, length)


def test_too_few_cameras_or_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="1 cameras"):
        write_long_capture(capture(5, cameras=1), 2, 9, tmp_path / "long")
    with pytest.raises(ExperimentError, match="1 frames"):
        forwards_and_backwards(1, 9)


def test_folder_size(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "a").write_bytes(bytes(2**20))
    (tmp_path / "b").write_bytes(bytes(2**19))
    assert folder_mb(tmp_path) == 1.5


def test_growth_is_against_the_length_before() -> None:
    def entry(frames: int, peak: float, result: float, seconds: float) -> dict[str, Any]:
        return {"cameras": 2, "frames": frames, "peak_mb": peak, "libraries_mb": 200.0,
                "result_mb": result, "seconds": seconds}  # fmt: skip

    assert rows([entry(150, 900.0, 100.0, 90.0), entry(300, 960.0, 200.0, 150.0)]) == [
        ["2 x 150", "900", "700", "-", "100", "-", "90", "0.300", "-"],
        ["2 x 300", "960", "760", "60", "200", "100", "150", "0.250", "0.200"],
    ]
