from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mvdyn_gtsam.baselines.settings import BaselineSettings, Request
from mvdyn_gtsam.baselines.shared import Phases, SharedCost, shared_folder
from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.reconstruction import CaptureInfo

INFO = CaptureInfo("clip", 10.0, 5, (Camera("cam0", 8, 6, 5.0, 5.0, 3.5, 2.5),), (17,))


def request(**settings: Any) -> Request:
    return Request(Path("clip"), "colmap", Path("out"), BaselineSettings(**settings))


def folder(asked: Request, info: CaptureInfo = INFO, version: str = "4.2.1") -> Path:
    return shared_folder(Path("db"), asked, info, version)


def test_both_mappers_share_and_nothing_else_does(tmp_path: Path) -> None:
    first = folder(request())
    assert folder(replace(request(), method="glomap", out=Path("elsewhere"), truncate=True)) == first
    camera = replace(INFO.cameras[0], fx=6.0)
    others = [
        folder(request(pairing="exhaustive")),
        folder(request(inter_window=4)),
        folder(request(), replace(INFO, frame_count=4)),
        folder(request(), replace(INFO, cameras=(camera,))),
        folder(request(), replace(INFO, cameras=(replace(INFO.cameras[0], focal_known=False),))),
        folder(request(), replace(INFO, first_frame_crc32=(18,))),
        folder(request(), version="4.3"),
        folder(replace(request(), capture=Path("other"))),
        folder(request(masks=tmp_path)),
    ]
    assert len({first, *others}) == 1 + len(others)


def test_masks_that_changed_are_not_taken_for_the_old_ones(tmp_path: Path) -> None:
    mask = tmp_path / "cam0" / "000000.png"
    mask.parent.mkdir()
    mask.write_bytes(b"old")
    before = folder(request(masks=tmp_path))
    assert folder(request(masks=tmp_path)) == before
    os.utime(mask, ns=(1, 1))
    assert folder(request(masks=tmp_path)) != before


def test_costs_are_of_the_phases_that_were_run() -> None:
    phases = Phases()
    assert phases.run("features", lambda: sum(range(200_000))) == 19999900000
    cost = phases.cost()
    assert set(cost.seconds) == {"features"} and cost.seconds["features"] > 0.0
    assert cost.cpu_seconds > 0.0 and cost.peak_mb > 5.0
    assert SharedCost.from_json(cost.to_json()) == cost
    with pytest.raises(KeyError):
        SharedCost.from_json({"seconds": {}})
