from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.baselines import sfm
from mvdyn_gtsam.baselines.masks import find_masks
from mvdyn_gtsam.capture import Capture, load_capture
from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.reconstruction import CaptureInfo, ReconstructionWriter
from mvdyn_gtsam.reconstruction.encoding import decode_mask, encode_mask
from mvdyn_gtsam.reconstruction.layout import motion_path
from tests.baselines.scenes import HEIGHT, WIDTH, write_capture

FRAMES = 6


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("masks") / "clip"
    write_capture(folder, frames=FRAMES, cameras=1)
    return load_capture(folder)


def write(folder: Path, times: range, value: int = 255) -> Path:
    for time in times:
        path = folder / "cam0" / f"{time:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_mask(np.full((HEIGHT, WIDTH), value, np.uint8)))
    return folder


def test_masks_with_the_ground_truth_are_found(capture: Capture, tmp_path: Path) -> None:
    folder = write(tmp_path / "gt" / "dynamic", range(FRAMES))
    assert find_masks(capture, None, tmp_path / "gt") == folder


def test_given_masks_win_over_those_with_the_ground_truth(capture: Capture, tmp_path: Path) -> None:
    write(tmp_path / "gt" / "dynamic", range(FRAMES))
    given = write(tmp_path / "own", range(FRAMES))
    assert find_masks(capture, given, tmp_path / "gt") == given


def test_masks_of_each_fifth_frame_are_not_enough(capture: Capture, tmp_path: Path) -> None:
    write(tmp_path / "gt" / "dynamic", range(0, FRAMES, 5))
    with pytest.raises(BaselineError, match="cam0: has masks of 2 of 6 frames; give --masks") as caught:
        find_masks(capture, None, tmp_path / "gt")
    assert "refined reconstruction" in str(caught.value)


@pytest.mark.parametrize("groundtruth", [True, False])
def test_no_masks_at_all(capture: Capture, tmp_path: Path, groundtruth: bool) -> None:
    with pytest.raises(BaselineError, match="there are no motion masks"):
        find_masks(capture, None, tmp_path / "gt" if groundtruth else None)


def test_our_motion_masks_serve_and_both_their_values_are_moving(capture: Capture, tmp_path: Path) -> None:
    result = tmp_path / "result"
    with ReconstructionWriter.create(result, CaptureInfo.from_capture(capture), {}):
        pass
    with pytest.raises(BaselineError, match="has no motion masks, .*--stage refinement"):
        find_masks(capture, result, None)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :10], mask[:, 10:20] = 255, 128
    for time in range(FRAMES):
        path = motion_path(result, "cam0", time)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_mask(mask))
    folder = find_masks(capture, result, None)
    assert folder == result / "motion"
    sfm.write_masks(capture, folder, tmp_path / "colmap")
    written = decode_mask((tmp_path / "colmap" / "cam0" / "000003.png.png").read_bytes())
    assert written is not None  # COLMAP takes no features where a mask is 0
    assert (written[:, :20] == 0).all() and (written[:, 20:] == 255).all()
