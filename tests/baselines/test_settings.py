from __future__ import annotations

from pathlib import Path

import pytest

from mvdyn_gtsam.baselines.settings import BaselineSettings, Request
from mvdyn_gtsam.errors import BaselineError


def test_a_request_survives_the_way_to_the_worker() -> None:
    settings = BaselineSettings(inter_window=3, pairing="exhaustive", masks=Path("masks"), num_threads=2)
    request = Request(Path("capture"), "glomap", Path("out"), settings, database=Path("db"), truncate=True)
    assert Request.from_json(request.to_json()) == request


def test_an_unknown_method_is_refused() -> None:
    values = Request(Path("capture"), "glomap", Path("out"), BaselineSettings()).to_json()
    with pytest.raises(BaselineError, match="'bundler' is none of colmap, glomap"):
        Request.from_json({**values, "method": "bundler"})
