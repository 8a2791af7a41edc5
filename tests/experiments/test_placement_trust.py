"""True and false placements are told by their errors, and the page says how far their trust is apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from experiments.placement_trust import JUDGED, is_true, main, render


def tried(trust: float, rotation_deg: float = 0.2, translation: float = 0.01) -> dict[str, Any]:
    return {
        "cameras": ["cam0", "cam1"],
        "points": "own",
        "inliers": 30,
        "support": 20.0,
        "rival": 10.0,
        "rotation_deg": rotation_deg,
        "translation": translation,
        "log_scale": 0.0,
        "verdicts": {name: {"trust": trust} for name in JUDGED},
    }


@pytest.mark.parametrize(
    ("rotation", "translation", "expected"),
    [(0.2, 0.01, True), (4.0, 0.01, None), (0.2, 0.2, None), (9.0, 0.01, False), (0.2, 0.5, False)],
)
def test_what_is_true_and_what_is_false(rotation: float, translation: float, expected: bool | None) -> None:
    assert is_true(tried(0.9, rotation, translation)) is expected
    assert is_true(tried(0.9) | {"log_scale": -0.2}) is None


def test_the_page_counts_those_that_a_threshold_lets_through() -> None:
    entries = [
        {"variant": "one", "tried": [tried(0.9), tried(0.78), tried(0.6, 20.0)]},
        {"variant": "two", "tried": [tried(0.82, 1.0, 0.5), tried(0.5, 4.0)]},
    ]
    page = render(entries)
    assert page.startswith("2 true and 2 false placements of 2 captures.")
    # three of four pairs of a true and a false one are in order
    assert "| 10 looks, 0.3 | 0.750 | 2 / 1 | 2 / 1 | 1 / 1 | 1 / 0 |" in page
    assert "| true | one | cam0-cam1 | own | 30 | 20.0 | 10.0 | 0.2 | 0.01 | 0.78 |" in page
    assert page.index("| false | two |") < page.index("| false | one |")
    assert "nothing to compare" in render(entries[:0])


def test_an_unknown_variant_is_refused(tmp_path: Path) -> None:
    assert main(["--only", "nosuchthing", "--results", str(tmp_path)]) == 1
