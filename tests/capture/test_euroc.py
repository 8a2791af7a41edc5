from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.capture import load_euroc
from mvdyn_gtsam.errors import CaptureError
from tests.capture.media import frame_number, write_images

START = 1403636579763555584
STEP = 50_000_000

SENSOR = """# General sensor definitions.
sensor_type: camera
comment: VI-Sensor
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [60.0, 61.0, 31.0, 24.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""


def write_camera(root: Path, name: str, instants: Sequence[int], sensor: str = SENSOR) -> Path:
    camera = root / "mav0" / name
    write_images(camera / "data", instants)
    rows = [f"{START + STEP * k},{k:06d}.png" for k in instants]
    (camera / "data.csv").write_text("\r\n".join(["#timestamp [ns],filename", *rows, ""]))
    (camera / "sensor.yaml").write_text(sensor)
    return camera


def test_cameras_load_with_their_sensors(tmp_path: Path) -> None:
    undistorted = SENSOR.replace("[-0.28, 0.07, 0.0002, 0.00002]", "[0, 0, 0, 0]")
    for name in ("cam0", "cam1", "cam10", "cam2"):
        write_camera(tmp_path, name, range(6), undistorted if name == "cam0" else SENSOR)
    capture = load_euroc(tmp_path)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1", "cam2", "cam10"]
    assert capture.fps == pytest.approx(20.0)
    camera = capture.cameras[1]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 61.0, 31.0, 24.0)
    assert camera.distortion == (-0.28, 0.07, 0.0002, 0.00002)
    assert [frame_number(capture.read(0, t)) for t in range(6)] == list(range(6))
    assert not np.array_equal(capture.read(0, 5), capture.read(1, 5))
    assert [c.name for c in load_euroc(tmp_path / "mav0", cameras=["cam2", "cam0"]).cameras] == [
        "cam2",
        "cam0",
    ]


def test_missing_instants_are_refused_or_left_out_together(tmp_path: Path) -> None:
    undistorted = SENSOR.replace("[-0.28, 0.07, 0.0002, 0.00002]", "[0, 0, 0, 0]")
    write_camera(tmp_path, "cam0", range(8), undistorted)
    write_camera(tmp_path, "cam1", [0, 1, 2, 4, 5, 6, 7], undistorted)
    with pytest.raises(
        CaptureError, match=rf"camera cam1 is short: .* 1 of 8 instants, first at {START + 3 * STEP}"
    ):
        load_euroc(tmp_path)
    capture = load_euroc(tmp_path, truncate=True)
    for camera in range(2):
        assert [frame_number(capture.read(camera, t)) for t in range(7)] == [0, 1, 2, 4, 5, 6, 7]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radial-tangential", "equidistant", r"sensor\.yaml: distortion_model 'equidistant' is not read"),
        ("pinhole", "omni", "camera_model 'omni' is not read"),
        ("intrinsics: [60.0, ", "intrinsics: [", "must be a list of 4 numbers"),
        ("resolution", "resolutions", '"resolution" must be a list of 2 numbers, not None'),
        ("resolution: [64, 48]", "resolution: [752, 480]", "frames are 64x48, but camera cam0"),
        ("rate_hz: 20", "rate_hz: [", "not valid YAML"),
        (SENSOR, "just words", "must hold the keys"),
    ],
)
def test_bad_sensors_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_camera(tmp_path, "cam0", range(3), SENSOR.replace(old, new))
    with pytest.raises(CaptureError, match=message):
        load_euroc(tmp_path)


def test_bad_tables_are_named(tmp_path: Path) -> None:
    camera = write_camera(tmp_path, "cam0", range(3))
    (camera / "data" / "000001.png").unlink()
    with pytest.raises(CaptureError, match=r"000001\.png: cannot be read"):
        load_euroc(tmp_path)
    (camera / "data.csv").write_text("#timestamp [ns],filename\n12 000.png\n")
    with pytest.raises(CaptureError, match=r"data\.csv: line 2"):
        load_euroc(tmp_path)
    (camera / "data.csv").write_text("#timestamp [ns],filename\n")
    with pytest.raises(CaptureError, match=r"data\.csv: lists no images"):
        load_euroc(tmp_path)


def test_unknown_camera_and_empty_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"no mav0/cam\*/sensor.yaml here"):
        load_euroc(tmp_path)
    write_camera(tmp_path, "cam0", range(3))
    with pytest.raises(CaptureError, match="there is no camera cam7; choose among cam0"):
        load_euroc(tmp_path, cameras=["cam7"])
