"""``mvdyn view``: what it prints, writes and refuses."""

from __future__ import annotations

import importlib.util
import socket
from pathlib import Path
from typing import Any

import pytest

from mvdyn_gtsam.cli.main import main
from mvdyn_gtsam.cli.view import SHOWS
from tests.viewer.results import make, write_capture

needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="viser, of the view extra, is not installed"
)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error of ``mvdyn view ARGUMENTS``."""
    code = main(["view", *(str(argument) for argument in arguments)])
    output = capsys.readouterr()
    return code, output.out, " ".join(output.err.split())


@pytest.fixture
def result(tmp_path: Path) -> Path:
    return make(tmp_path / "r").folder


@needs_viser
def test_a_page_is_saved(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "scene.html"
    code, out, err = run(capsys, result, "--save", page, "--every", 4, "--show", "gathered")
    assert code == 0 and page.stat().st_size > 500_000
    assert out.startswith(f"{page}: 2 instants, ") and out.endswith(" MB; open it with a browser\n")
    assert "colours tell depth" in err and "saving 2/2" in err
    before = page.read_bytes()
    (result / "depth" / "cam0" / "000000.png").write_bytes(b"")
    code, _, err = run(capsys, result, "--save", page)
    assert code == 1 and "000000.png: damaged" in err and page.read_bytes() == before


@needs_viser
def test_the_capture_is_found_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = write_capture(tmp_path / "clip")
    result = make(tmp_path / "r", source=clip).folder
    words = ["--save", tmp_path / "scene.html", "--every", 6]
    code, _, err = run(capsys, result, *words)
    assert code == 0 and "colours tell depth" not in err
    (clip / "cam1" / "000005.png").unlink()
    code, _, err = run(capsys, result, *words)
    assert code == 0 and "was not made from capture 'clip'" in err and "colours tell depth" in err
    clip.rename(tmp_path / "moved")
    code, _, err = run(capsys, result, *words)
    assert code == 0 and "colours tell depth" in err
    code, _, err = run(capsys, result, "--capture", tmp_path / "moved", *words)
    assert code == 1 and "was not made from capture 'clip'" in err


@needs_viser
def test_it_serves_until_ctrl_c(
    result: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mvdyn_gtsam.viewer.session import Session

    drawn: list[set[str]] = []

    def interrupted(session: Session) -> None:
        session.step()
        drawn.append(set(session.stage.nodes))
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "run", interrupted)
    code, out, _ = run(capsys, result, "--port", 0)
    assert code == 0 and "/cameras/cam0/points" in drawn[0]
    where, afar, how, end = out.splitlines()
    assert where.startswith("viewer: http://127.0.0.1:") and not where.endswith(":0")
    assert afar.startswith("from another machine: ssh -L ") and how == "Ctrl-C ends it"
    assert end == "the viewer has ended"


@needs_viser
def test_groups_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = make(tmp_path / "r", groups=(("cam0",), ("cam1",))).folder
    words = [result, "--save", tmp_path / "scene.html", "--every", 6]
    code, _, err = run(capsys, *words, "--group", 1)
    assert code == 0 and "shown is 1 of 0: cam0; 1: cam1" in err
    code, _, err = run(capsys, *words, "--group", 2)
    assert code == 1 and "--group 2: " in err


@needs_viser
def test_a_camera_in_no_group_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = make(tmp_path / "r", groups=(("cam0",),)).folder
    code, _, err = run(capsys, result, "--save", tmp_path / "scene.html", "--every", 6)
    assert code == 0 and "cam1 could not be placed and is not shown" in err and "cam0" not in err


@needs_viser
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}/none"], "none: no such folder; make a reconstruction with: mvdyn reconstruct"),
        (["{tmp}"], "not a reconstruction (no manifest.json)"),
        (["{result}", "--capture", "{tmp}/gone"], "gone: there is no such file"),
        (["{result}", "--every", "2"], "--every: says what --save writes"),
        (
            ["{result}", "--save", "{tmp}/scene.png"],
            "scene.png: the file is for a browser; end its name in .html",
        ),
        (["{result}", "--save", "{tmp}/s.html", "--every", "0"], "--every 0: must be at least 1"),
        (["{result}", "--points", "0"], "--points 0: must be at least 1"),
        (["{result}", "--min-confidence", "2"], "--min-confidence 2.0: must be between 0 and 1"),
        (["{result}", "--port", "99999"], "--port 99999: ports are 0 to 65535"),
    ],
)
def test_what_cannot_be_is_one_line(
    arguments: list[str], message: str, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, *(word.format(tmp=tmp_path, result=result) for word in arguments))
    assert code == 1 and out == "" and message in err and err.count("mvdyn: ") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


@needs_viser
def test_a_port_in_use(result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, out, err = run(capsys, result, "--port", port)
    assert code == 1 and out == "" and f"mvdyn: --port {port}: is in use on 127.0.0.1" in err


def test_without_viser(
    result: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find: Any = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else find(name))
    code, _, err = run(capsys, result)
    assert code == 1 and err == "mvdyn: the viewer needs viser: pip install 'mvdyn_gtsam[view]'"


def test_the_help_offers_what_there_is() -> None:
    from mvdyn_gtsam.viewer.pictures import Show

    assert tuple(Show) == SHOWS
