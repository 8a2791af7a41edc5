"""The picture of the viewer: taken by a browser, or one line why not."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="viser, of the view extra, is not installed")

from experiments import viewer_picture
from mvdyn_gtsam.capture import write_capture
from tests.viewer.results import capture, make

BROWSER = """#!/bin/sh
for word in "$@"; do case "$word" in
  --screenshot=*) target="${word#--screenshot=}" ;;
  file://*) grep -q __VISER_EMBED_DATA__ "${word#file://}" || exit 1 ;;
esac; done
cp "$(dirname "$0")/taken.png" "$target"
"""


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    result = make(tmp_path / "r")
    write_capture(capture(), tmp_path / "c")
    return [str(tmp_path / "c"), str(result.folder), "--frame", "3", "--out", str(tmp_path / "viewer.jpg")]


def test_the_page_is_photographed(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    browser = tmp_path / "bin" / "browser"
    browser.parent.mkdir()
    browser.write_text(BROWSER)
    browser.chmod(browser.stat().st_mode | stat.S_IXUSR)
    cv2.imwrite(str(browser.parent / "taken.png"), np.full((640, 1000, 3), 200, np.uint8))
    monkeypatch.setenv("PATH", f"{browser.parent}{os.pathsep}{os.environ['PATH']}")
    assert viewer_picture.main([*words, "--browser", "browser"]) == 0
    taken = cv2.imread(str(tmp_path / "viewer.jpg"))
    assert taken is not None and taken.shape == (640, 1000, 3)


@pytest.mark.parametrize(("browser", "message"), [("no-browser", "is not installed"), ("true", "no picture")])
def test_without_a_browser(
    browser: str, message: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert viewer_picture.main([*words, "--browser", browser]) == 1
    assert message in capsys.readouterr().err and not (tmp_path / "viewer.jpg").exists()
