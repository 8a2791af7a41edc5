"""The saved page holds every instant that was asked for, whole or not at all."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser, of the view extra, is not installed")

import msgspec
import zstandard

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.progress import NullProgress
from mvdyn_gtsam.reconstruction.layout import depth_path
from mvdyn_gtsam.viewer.pictures import Choice, Show
from mvdyn_gtsam.viewer.recording import save_html
from mvdyn_gtsam.viewer.views import ResultViews
from tests.viewer.results import NO_POSE, capture, make


def embedded(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    """The recording inside a saved page, and its arrays."""
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', path.read_text())
    assert found is not None
    content = zstandard.ZstdDecompressor().decompress(
        base64.b64decode(found[1])[8:], max_output_size=100_000_000
    )
    size = int.from_bytes(content[:8], "little")
    recording = msgspec.msgpack.decode(content[8 : 8 + size])
    arrays, start = [], 8 + size
    for length in recording["binaryBufferLengths"]:
        start += -start % 8
        arrays.append(content[start : start + length])
        start += length
    return recording, arrays


def clouds(recording: dict[str, Any], name: str) -> list[tuple[float, dict[str, Any]]]:
    return [
        (time, message["props"])
        for time, message in recording["messages"]
        if message["type"] == "PointCloudMessage" and message["name"] == name
    ]


@pytest.fixture
def views(tmp_path: Path) -> ResultViews:
    return ResultViews(make(tmp_path / "r"), capture())


def test_every_instant_is_in_the_page(views: ResultViews, tmp_path: Path) -> None:
    path = tmp_path / "scene.html"
    save_html(views, Choice(points=400), range(0, 6, 2), 0.2, path, NullProgress())
    assert path.read_text().lstrip().lower().startswith("<!doctype html")
    recording, arrays = embedded(path)
    assert recording["durationSeconds"] == pytest.approx(0.6)
    first = clouds(recording, "/cameras/cam0/points")
    assert [time for time, _ in first] == pytest.approx([0.0, 0.2, 0.4])
    for time, props in first:
        points = np.frombuffer(arrays[props["points"]["__binary_index"]], np.float16).reshape(-1, 3)
        colours = np.frombuffer(arrays[props["colors"]["__binary_index"]], np.uint8).reshape(-1, 3)
        assert 0 < len(points) == len(colours) <= 200
        assert (colours[:, 2] == round(10 * time)).all()  # that of its own time
    assert [time for time, _ in clouds(recording, "/cameras/cam1/points")] == pytest.approx([0.0, 0.2])
    gone = [m["name"] for t, m in recording["messages"] if m["type"] == "RemoveSceneNodeMessage" and t > 0.3]
    assert NO_POSE == 4 and {"/cameras/cam1/points", "/cameras/cam1/frustum"} <= set(gone)
    kinds = {message["type"] for _, message in recording["messages"]}
    assert {"LineSegmentsMessage", "CameraFrustumMessage", "SetCameraPositionMessage"} <= kinds


def test_the_still_scene_is_saved_once(views: ResultViews, tmp_path: Path) -> None:
    path = tmp_path / "scene.html"
    save_html(views, Choice(show=Show.GATHERED), range(4), 0.1, path, NullProgress())
    recording, _ = embedded(path)
    assert len(clouds(recording, "/background")) == 1
    assert len(clouds(recording, "/cameras/cam0/points")) == 4


def test_one_instant_stands_still(views: ResultViews, tmp_path: Path) -> None:
    save_html(views, Choice(), range(1), 0.1, tmp_path / "scene.html", NullProgress())
    assert embedded(tmp_path / "scene.html")[0]["durationSeconds"] == 0.0


def test_nothing_is_left_of_a_page_that_fails(views: ResultViews, tmp_path: Path) -> None:
    depth_path(tmp_path / "r", "cam0", 2).write_bytes(b"no image")
    with pytest.raises(ResultError, match="000002.png: damaged"):
        save_html(views, Choice(), range(6), 0.1, tmp_path / "scene.html", NullProgress())
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match="file/scene.html: cannot be written"):
        save_html(views, Choice(), range(1), 0.1, tmp_path / "file" / "scene.html", NullProgress())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "r"]
