"""Bars and lines show what was measured, and mark what failed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.container import BarContainer
from matplotlib.figure import Figure

from experiments.plots import bars, lines, scores_value


def value(entry: Mapping[str, Any]) -> float | None:
    return entry["value"]


def entry(capture: str, method: str, number: float | None) -> dict[str, Any]:
    return {"capture": capture, "method": method, "value": number}


def test_bars_stand_side_by_side_and_failures_are_crosses() -> None:
    axes = Figure().subplots()
    entries = [entry("a", "x", 1.0), entry("a", "y", 2.0), entry("b", "x", None)]
    bars(axes, entries, "capture", "method", value, "label")
    containers = [container for container in axes.containers if isinstance(container, BarContainer)]
    heights = [[bar.get_height() for bar in container] for container in containers]
    assert heights[0][0] == 1.0 and math.isnan(heights[0][1])
    assert heights[1][0] == 2.0 and math.isnan(heights[1][1])
    edges = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in (containers[0][0], containers[1][0])]
    assert edges[0][1] <= edges[1][0] + 1e-9
    crosses = np.concatenate([np.atleast_1d(np.asarray(line.get_xdata(), float)) for line in axes.lines])
    # b, x failed; b, y was never run and has no cross.
    assert len(crosses) == 1 and 0.6 < crosses[0] < 1.0
    assert axes.get_yscale() == "linear"


def test_a_wide_range_is_logarithmic() -> None:
    axes = Figure().subplots()
    bars(axes, [entry("a", "x", 0.001), entry("b", "x", 1.0)], "capture", "method", value, "label")
    assert axes.get_yscale() == "log"


def test_lines_are_in_order_and_leave_out_what_is_missing() -> None:
    axes = Figure().subplots()
    entries: list[dict[str, Any]] = [{"n": 300, "s": 3.0}, {"n": 100, "s": 1.0}, {"n": 200, "s": None}]
    lines(axes, entries, lambda entry: entry["n"], {"s": lambda entry: entry["s"]}, "n", "s")
    [line] = axes.lines
    assert np.asarray(line.get_xdata()).tolist() == [100, 300]
    assert np.asarray(line.get_ydata()).tolist() == [1.0, 3.0]


def test_scores_of_a_failed_run_have_no_value() -> None:
    assert scores_value("ate_m", 1e3)({"scores": {"ate_m": 0.002}}) == 2.0
    assert scores_value("ate_m")({"scores": None}) is None
    assert scores_value("m_d")({"scores": {"m_d": None}}) is None
