"""Which other times a frame is compared with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.refinement.neighbours import middles, swept_times, times_in_view
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

FRAMES, DEPTH, FOCAL, WIDTH = 40, 2.0, 30.0, 32
OFFSETS, SHARED = (4, 16), 0.6


@pytest.fixture
def wall(tmp_path: Path) -> Workspace:
    """One camera before a wall."""
    view = DenseView.of(Camera("c", WIDTH, 24, FOCAL, FOCAL, 15.5, 11.5), 1.0)
    made = Workspace(tmp_path, (view,), FRAMES)
    made.prepare("settings")
    made.create("tracked")
    for time in range(FRAMES):
        made.write("tracked", (0, time), np.full(view.shape, 1.0 / DEPTH, np.float32))
    return made


def moving(px_per_frame: float) -> np.ndarray:
    """Poses ``(1, FRAMES, 4, 4)`` from which the wall passes by at that speed."""
    wTc = np.tile(np.eye(4), (1, FRAMES, 1, 1))
    wTc[0, :, 0, 3] = px_per_frame * DEPTH / FOCAL * np.arange(FRAMES)
    return wTc


def test_a_slow_camera_is_compared_at_the_distances_asked_for(wall: Workspace) -> None:
    assert times_in_view(wall, (0, 20), moving(0.1), OFFSETS, SHARED) == [4, 16, 24, 36]


def test_a_fast_one_nearer_where_enough_is_shared(wall: Workspace) -> None:
    # 2 px per frame: 4 frames share three quarters of the view, 16 and 8 less than half
    assert times_in_view(wall, (0, 20), moving(2.0), OFFSETS, SHARED) == [16, 24]
    # 40 % are gone after 12.8 px: 2 frames
    assert times_in_view(wall, (0, 20), moving(5.0), OFFSETS, SHARED) == [18, 22]


def test_the_fastest_is_compared_with_its_neighbours(wall: Workspace) -> None:
    assert times_in_view(wall, (0, 20), moving(100.0), OFFSETS, SHARED) == [19, 21]


def test_at_the_ends_of_the_video_only_what_there_is(wall: Workspace) -> None:
    assert times_in_view(wall, (0, 0), moving(0.1), OFFSETS, SHARED) == [4, 16]
    assert times_in_view(wall, (0, FRAMES - 3), moving(0.1), OFFSETS, SHARED) == [21, 33, 39]


def test_slow_frames_share_the_depth_of_one_in_their_middle(wall: Workspace) -> None:
    # 0.2 of 32 px per frame: three frames are 0.6 px, 0.02 of the width
    served = swept_times(wall, 0, moving(0.2), 0.02)
    assert served[:14] == [3] * 7 + [10] * 7
    assert served == swept_times(wall, 0, moving(-0.2), 0.02)


def test_fast_ones_are_all_swept(wall: Workspace) -> None:
    assert swept_times(wall, 0, moving(1.0), 0.02) == list(range(FRAMES))
    assert swept_times(wall, 0, moving(0.2), 0.0) == list(range(FRAMES))


def test_a_camera_that_turns_round_is_fast(wall: Workspace) -> None:
    """Points behind it count as far away."""
    wTc = moving(0.0)
    wTc[0, 20:, 0, 0] = wTc[0, 20:, 2, 2] = -1.0
    served = swept_times(wall, 0, wTc, 0.02)
    assert max(served[:20]) < 20 <= min(served[20:])


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40), st.floats(0.0, 1.0))
def test_nobody_is_farther_from_the_middle_than_allowed(steps: list[float], reach: float) -> None:
    way = np.cumsum(steps)
    found = middles(way, reach)
    assert len(found) == len(way)
    assert all(abs(way[i] - way[middle]) <= reach + 1e-9 for i, middle in enumerate(found))
    assert all(found[middle] == middle for middle in found)
    assert found == sorted(found)
