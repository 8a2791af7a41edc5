from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mvdyn_gtsam.capture import open_capture
from mvdyn_gtsam.errors import CaptureError
from tests.capture import test_euroc, test_folder_per_camera
from tests.capture.media import camera_entry, write_capture_json, write_video
from tests.capture.test_multicamvideo import scene

__all__ = ["scene"]


def test_every_layout_is_recognised(tmp_path: Path, scene: Path) -> None:
    write_video(tmp_path / "plain" / "cam0.mp4", 3)
    write_capture_json(tmp_path / "plain", camera_entry("only", "cam0.mp4"))
    test_euroc.write_camera(tmp_path / "euroc", "cam0", range(3))
    test_folder_per_camera.write_camera(tmp_path / "folders" / "left")
    names = {
        tmp_path / "plain": ["only"],
        tmp_path / "plain" / "capture.json": ["only"],
        tmp_path / "euroc": ["cam0"],
        tmp_path / "euroc" / "mav0": ["cam0"],
        tmp_path / "folders": ["left"],
        scene: ["cam01", "cam02"],
    }
    for path, expected in names.items():
        assert [camera.name for camera in open_capture(path).cameras] == expected
    assert len(open_capture(scene, cameras=["cam02"], focal_mm=18).cameras) == 1
    assert open_capture(tmp_path / "folders", fps=10.0).fps == 10.0


def test_a_misfit_lists_the_layouts(tmp_path: Path) -> None:
    with pytest.raises(CaptureError) as caught:
        open_capture(tmp_path)
    for words in ("capture.json", "EuRoC", "MultiCamVideo", "intrinsics.txt"):
        assert words in str(caught.value)


def test_single_files_and_missing_paths_are_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="nowhere: there is no such file or folder"):
        open_capture(tmp_path / "nowhere")
    video = write_video(tmp_path / "cam0.mp4", 3)
    with pytest.raises(
        CaptureError, match="is a single file; give each video with --camera.* --estimate-focal"
    ):
        open_capture(video)


@pytest.mark.parametrize("option", [{"fps": 10.0}, {"focal_mm": 24.0}, {"cameras": ["only"]}])
def test_options_without_meaning_are_refused(tmp_path: Path, option: dict[str, Any]) -> None:
    write_video(tmp_path / "cam0.mp4", 3)
    write_capture_json(tmp_path, camera_entry("only", "cam0.mp4"))
    with pytest.raises(CaptureError, match=f"{next(iter(option))} has no meaning"):
        open_capture(tmp_path, **option)
