"""``mvdyn scene``: makes a capture the other verbs take, and names what is wrong with its options."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="the extra scenes is not installed")

from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.cli.main import main

TINY = ["--size", "96x64", "--frames", "2", "--cameras", "3"]


def test_makes_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "clip"
    assert main(["scene", str(out), *TINY, "--overlap", "0.5", "--focal", "90"]) == 0
    said = capsys.readouterr().out
    assert "3 cameras, 2 frames, neighbours share 5" in said and f"capture in {out}" in said
    capture = load_capture(out)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1", "cam2"]
    assert (capture.cameras[0].fx, capture.cameras[0].width, capture.cameras[0].height) == (90.0, 96, 64)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "96by64"], "mvdyn: --size 96by64: write width x height in px"),
        (["--overlap", "2"], "mvdyn: overlap 2.0: must be a number from 0 to 1"),
        (["--cameras", "0"], "mvdyn: cameras 0: must be a whole number"),
    ],
)
def test_bad_options_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["scene", str(tmp_path / "clip"), *options]) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith(message) and "\n" not in error
    assert not (tmp_path / "clip").exists()
