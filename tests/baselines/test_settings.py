from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mvdyn_gtsam.baselines.settings import BASELINES, BaselineSettings, Request
from mvdyn_gtsam.errors import BaselineError


def test_a_request_survives_the_way_to_the_worker() -> None:
    settings = BaselineSettings(
        inter_window=3, pairing="retrieval", masks=Path("masks"), descriptor=Path("m.onnx"), num_threads=2
    )
    request = Request(Path("capture"), "glomap", Path("out"), settings, database=Path("db"), truncate=True)
    assert Request.from_json(request.to_json()) == request
    unknown = replace(request, truncate=False, estimate_focal=True)
    assert Request.from_json(unknown.to_json()) == unknown


def test_an_unknown_method_is_refused() -> None:
    values = Request(Path("capture"), "glomap", Path("out"), BaselineSettings()).to_json()
    with pytest.raises(BaselineError, match="'bundler' is none of colmap, glomap"):
        Request.from_json({**values, "method": "bundler"})


def test_every_row_of_the_paper_and_the_control_have_a_name() -> None:
    assert {(one.method, one.pairing, one.masked) for one in BASELINES.values()} == {
        (method, pairing, masked)
        for method in ("colmap", "glomap")
        for pairing, masked in (
            ("window", False),
            ("window", True),
            ("retrieval", False),
            ("exhaustive", False),
        )
    }
    for name, one in BASELINES.items():
        assert name.startswith(one.method)
        assert name.endswith("-masks") == one.masked
        assert one.pairing == "window" or name.endswith(f"-{one.pairing}")
