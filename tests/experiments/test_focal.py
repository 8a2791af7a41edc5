"""Found focal lengths are judged by the truth, wrong minima by whether they would be believed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.focal import (
    GIVEN,
    GUESSES,
    camera_entry,
    cropped,
    field_of_view_deg,
    guessed,
    main,
    render,
    wrong_over_right,
)
from mvdyn_gtsam.capture.model import FIRST_FOCAL, Camera, Capture
from mvdyn_gtsam.frontend.start.focal import FocalMinima
from mvdyn_gtsam.frontend.start.model import FoundIntrinsics, Start, StartFrame
from mvdyn_gtsam.geometry import project
from tests.tracking.synthetic_scene import two_cameras

CAMERA = Camera("cam0", 500, 400, 399.0, 401.0, 250.0, 199.0)


def minima(focal: list[float], fitting: list[int]) -> FocalMinima:
    return FocalMinima(np.array(GUESSES) * 500.0, np.array(focal), np.array(fitting))


EXPLAINED = {401.0: 0.97, 620.0: 0.91}
RIGHT = minima([401.0, 403.0, 400.0, 620.0, np.nan], [900, 890, 880, 630, 0])


def start(focal: float, deviation: float) -> Start:
    frame = StartFrame(0, np.eye(4), np.zeros((0, 2)), np.zeros(0))
    return Start(((0,),), ((frame, frame),), intrinsics={0: FoundIntrinsics(focal, 253.0, 203.0, deviation)})


def entry(**changes: Any) -> dict[str, Any]:
    content = {
        "capture": "clip",
        "crop": 1.0,
        "principal_point": "centre",
        "start_seconds": 12.0,
        "problem": None,
        "cameras": [camera_entry(CAMERA, RIGHT, EXPLAINED, start(402.0, 1.0), 0)],
        "tracking": None,
        "commit": "abc",
    }
    return {**content, **changes}


@pytest.fixture(scope="module")
def capture() -> Capture:
    return two_cameras().capture()


def test_a_crop_shows_a_point_where_its_camera_projects_it(capture: Capture) -> None:
    part = cropped(capture, 0.5)
    assert cropped(capture, 1.0) is capture
    for index, (whole, camera) in enumerate(zip(capture.cameras, part.cameras, strict=True)):
        assert (camera.width, camera.height) == (whole.width // 2, whole.height // 2)
        assert (camera.fx, camera.fy) == (whole.fx, whole.fy)
        point = np.array([[0.03, -0.02, 1.0]])
        wide, narrow = (project(point, one.intrinsics)[0][0] for one in (whole, camera))
        shift = np.rint(wide - narrow).astype(int)
        np.testing.assert_allclose(wide - narrow, shift, atol=1e-9)
        image = part.read(index, 1)
        assert image.shape == (camera.height, camera.width, 3)
        left, top = shift
        whole_image = capture.read(index, 1)
        expected = whole_image[top : top + camera.height, left : left + camera.width]
        np.testing.assert_array_equal(image, expected)


def test_the_guess_holds_nothing_of_the_truth(capture: Capture) -> None:
    for camera in guessed(capture, "centre").cameras:
        assert camera.fx == camera.fy == FIRST_FOCAL * max(camera.width, camera.height)
        assert (camera.cx, camera.cy) == ((camera.width - 1) / 2, (camera.height - 1) / 2)
        assert not camera.focal_known
    part = cropped(capture, 0.7)
    for camera, true in zip(guessed(part, GIVEN).cameras, part.cameras, strict=True):
        assert (camera.cx, camera.cy) == (true.cx, true.cy) and not camera.focal_known


@pytest.mark.parametrize(
    ("focal", "fitting", "expected"),
    [
        ([401.0, 620.0, 395.0, 300.0, 401.0], [800, 600, 1000, 700, 800], 0.7),
        ([401.0, 620.0, 401.0, 401.0, np.nan], [800, 1000, 800, 800, 0], 1.25),
        ([401.0, 401.0, 411.9, 388.1, 401.0], [800, 800, 800, 800, 800], 0.0),
        ([600.0, 600.0, np.nan, 600.0, 600.0], [800, 800, 0, 800, 800], np.inf),
        ([np.nan] * 5, [0] * 5, None),
    ],
)
def test_the_best_wrong_minimum_is_compared_with_the_best_right_one(
    focal: list[float], fitting: list[int], expected: float | None
) -> None:
    ratio = wrong_over_right(camera_entry(CAMERA, minima(focal, fitting), {}, None, 0))
    assert ratio == (None if expected is None else pytest.approx(expected))


def test_the_page_has_errors_and_minima_of_every_camera() -> None:
    text = render([entry()])
    assert field_of_view_deg(entry()["cameras"][0]) == pytest.approx(64.01, abs=0.01)
    assert "| clip | cam0 | 2 | 64.0 | 400.0 | 401.0 | 0.25 | 402.0 | 1.00 | 0.25 | 0.50 | 5.0 | 12 |" in text
    ends = r"401.0 (900) | 403.0 (890) | 400.0 (880) | 620.0 (630) \* | -"
    assert f"| clip | cam0 | 400.0 | {ends} | 0.70 | 0.970 | 0.910 |" in text
    assert "Commit abc." in text and "ATE" not in text
    none_wrong = [camera_entry(CAMERA, minima([401.0] * 5, [9] * 5), {401.0: 0.98}, start(402.0, 1.0), 0)]
    assert "| none wrong | 0.980 | - |" in render(
        [entry(cameras=none_wrong, crop=0.5, principal_point=GIVEN)]
    )
    none_right = [camera_entry(CAMERA, minima([601.0] * 5, [9] * 5), {601.0: 0.8}, start(402.0, np.inf), 0)]
    assert "| no right one | - | 0.800 |" in render([entry(cameras=none_right)])


def test_what_a_camera_tells_alone_is_what_explains_most() -> None:
    camera = camera_entry(CAMERA, RIGHT, {620.0: 0.9, 401.0: 0.96}, None, 0)
    assert camera["alone_px"] == 401.0
    assert camera_entry(CAMERA, RIGHT, {}, None, 0)["alone_px"] is None


def test_a_capture_cropped_or_told_its_principal_point_says_so() -> None:
    text = render([entry(crop=0.5), entry(principal_point=GIVEN)])
    assert "| clip, crop 0.5 | cam0 |" in text and "| clip, principal point given | cam0 |" in text


def scores(ate_m: float) -> dict[str, Any]:
    return {"ate_m": ate_m, "rte_m": 0.001, "inter_camera_trans_m": 0.002, "inter_camera_rot_deg": 0.1}


def test_poses_with_found_and_with_given_intrinsics_stand_one_above_the_other() -> None:
    tracking = {
        name: {"problem": None, "registered": 1.0, "scores": scores(ate)}
        for name, ate in (("found", 0.004), ("given", 0.003))
    }
    text = render([entry(tracking=tracking)])
    found = text.index("| clip | found intrinsics | 100.0 | 4.0 | 1.00 | 2.0 | 0.100 |")
    assert found < text.index("| clip | given intrinsics | 100.0 | 3.0 | 1.00 | 2.0 | 0.100 |")


def test_a_refused_start_is_a_row_and_its_reason_is_said_once() -> None:
    failed = {"problem": "cam0: stands still", "registered": 0.0, "scores": None}
    given = {"problem": None, "registered": 1.0, "scores": scores(0.003)}
    unknown = camera_entry(CAMERA, RIGHT, EXPLAINED, None, 0)
    refused = entry(
        problem="cam0: stands still",
        cameras=[unknown],
        start_seconds=None,
        tracking={"found": failed, "given": given},
    )
    text = render([refused])
    assert "| clip | cam0 | - | 64.0 | 400.0 | 401.0 | 0.25 | refused | - | - | - | - | - |" in text
    assert text.count("stands still") == 1 and "* clip: cam0: stands still" in text
    assert "| clip | found intrinsics (failed) | 0.0 | - |" in text
    assert "| clip | given intrinsics | 100.0 | 3.0 |" in text


@pytest.mark.parametrize("share", ["0", "1.2"])
def test_a_crop_that_is_none_is_refused(
    share: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path), "--crop", share, "--results", str(tmp_path / "results")]) == 1
    assert "--crop" in capsys.readouterr().err and not (tmp_path / "results").exists()
