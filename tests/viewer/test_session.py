"""The served viewer, without a browser: the page, and the scene as the controls change it."""

from __future__ import annotations

import logging
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser, of the view extra, is not installed")

import viser

from mvdyn_gtsam.reconstruction.layout import depth_path
from mvdyn_gtsam.viewer.pictures import Choice
from mvdyn_gtsam.viewer.server import open_server
from mvdyn_gtsam.viewer.session import Session
from mvdyn_gtsam.viewer.views import ResultViews
from tests.viewer.results import CAMERAS, FRAMES, NO_POSE, capture, make

POINTS = [f"/cameras/{camera.name}/points" for camera in CAMERAS]


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with open_server("127.0.0.1", 0) as server:
        yield server


@pytest.fixture
def session(server: viser.ViserServer, tmp_path: Path) -> Session:
    session = Session(server, ResultViews(make(tmp_path / "r"), capture()), Choice())
    session.step()
    return session


def nodes(session: Session) -> dict[str, Any]:
    return dict(session.stage.nodes)


def turn(handle: Any, value: object) -> None:
    """As somebody at the panel does."""
    handle.value = value


def test_the_page_is_served(server: viser.ViserServer, session: Session) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}") as page:
        assert page.status == 200 and b"viser" in page.read().lower()


def test_what_is_drawn(session: Session) -> None:
    drawn = nodes(session)
    assert set(drawn) == {
        *POINTS,
        "/cameras/cam0/frustum",
        "/cameras/cam1/frustum",
        "/paths/cam0",
        "/paths/cam1",
    }
    assert len(drawn["/cameras/cam0/points"].points) == 32 * 23
    assert drawn["/paths/cam0"].points.shape == (FRAMES - 1, 2, 3)


def test_the_time_slider_moves_cameras_and_points(session: Session) -> None:
    before = nodes(session)
    turn(session.controls.time, 3)
    session.step()
    after = nodes(session)
    assert (
        after["/cameras/cam0/points"].colors[0, 2] == 3 and before["/cameras/cam0/points"].colors[0, 2] == 0
    )
    moved = after["/cameras/cam0/frustum"].position - before["/cameras/cam0/frustum"].position
    scene = session.views.scene(Choice())
    np.testing.assert_allclose(moved, scene.wTc["cam0"][3, :3, 3] - scene.wTc["cam0"][0, :3, 3], atol=1e-6)
    np.testing.assert_allclose(
        after["/cameras/cam0/points"].position, after["/cameras/cam0/frustum"].position
    )


def test_nothing_is_drawn_again_that_is_seen(session: Session) -> None:
    before = nodes(session)["/cameras/cam0/points"]
    session.step()
    assert nodes(session)["/cameras/cam0/points"] is before


def test_a_camera_without_a_pose_is_removed(session: Session) -> None:
    turn(session.controls.time, NO_POSE)
    session.step()
    assert "/cameras/cam1/points" not in nodes(session) and "/cameras/cam0/points" in nodes(session)
    turn(session.controls.time, 0)
    session.step()
    assert "/cameras/cam1/points" in nodes(session)


def test_the_controls(session: Session) -> None:
    controls = session.controls
    turn(controls.confidence, 0.5)
    turn(controls.visible["cam1"], False)
    session.step()
    drawn = nodes(session)
    assert "/cameras/cam1/points" not in drawn and not drawn["/paths/cam1"].visible
    assert len(drawn["/cameras/cam0/points"].points) == 16 * 23
    turn(controls.show, "gathered")
    turn(controls.frustum_size, 0.2)
    session.step()
    drawn = nodes(session)
    assert len(drawn["/background"].points) > 1000 and drawn["/cameras/cam0/frustum"].scale == 0.2
    # Looked through, the camera's own picture stands not in the way.
    turn(controls.through, "cam0")
    turn(controls.show, "all")
    turn(controls.source, "tracked")
    session.step()
    assert "/cameras/cam0/frustum" not in nodes(session) and "/background" not in nodes(session)
    assert controls.read().tracking


def test_time_goes_on_while_playing(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    session.step()
    turn(session.controls.play, True)
    turn(session.controls.rate, 10.0)
    for seconds, time in ((0.05, 0), (0.06, 1), (0.2, 3), (0.3, 0)):
        now[0] += seconds
        session.step()
        assert session.controls.read().time == time
    assert nodes(session)["/cameras/cam0/points"].colors[0, 2] == 0


def test_a_damaged_instant_is_said_and_the_others_are_seen(
    session: Session, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    depth_path(tmp_path / "r", "cam0", 2).write_bytes(b"no image")
    turn(session.controls.time, 2)
    with caplog.at_level(logging.WARNING):
        session.step()
    assert "000002.png: damaged" in caplog.text
    turn(session.controls.time, 3)
    session.step()
    assert nodes(session)["/cameras/cam0/points"].colors[0, 2] == 3


def test_groups_take_turns(server: viser.ViserServer, tmp_path: Path) -> None:
    views = ResultViews(make(tmp_path / "g", groups=(("cam0",), ("cam1",))), capture())
    session = Session(server, views, Choice())
    session.step()
    assert set(nodes(session)) == {"/cameras/cam0/points", "/cameras/cam0/frustum", "/paths/cam0"}
    assert session.controls.group.visible and not session.controls.visible["cam1"].visible
    turn(session.controls.group, "cam1")
    session.step()
    assert set(nodes(session)) == {"/cameras/cam1/points", "/cameras/cam1/frustum", "/paths/cam1"}
    assert session.controls.visible["cam1"].visible
    assert session.controls.through.options == ("no camera", "cam1")


@pytest.mark.parametrize("points", [1, 12_345, 1_000_000])
def test_any_number_of_points_can_be_asked_for(
    points: int, server: viser.ViserServer, tmp_path: Path
) -> None:
    session = Session(server, ResultViews(make(tmp_path / "r"), capture()), Choice(points=points))
    session.step()
    assert session.controls.read().points == points
    assert points == 1 or "/cameras/cam0/points" in nodes(session)


def test_a_result_of_one_frame_can_be_seen(server: viser.ViserServer, tmp_path: Path) -> None:
    views = ResultViews(make(tmp_path / "r"), None)
    views._result.manifest["capture"]["frame_count"] = 1
    for name in ("cam0", "cam1"):
        path = tmp_path / "r" / "trajectories" / f"{name}.txt"
        path.write_text("\n".join(path.read_text().splitlines()[:2]) + "\n")
    session = Session(server, views, Choice(colouring=views.colourings[0]))
    session.step()
    assert "/cameras/cam0/points" in nodes(session) and "/paths/cam0" not in nodes(session)
