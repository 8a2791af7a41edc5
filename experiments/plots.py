"""Drawings that the pages of several experiments share: bars side by side, and figures over a number."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Entries = Sequence[Mapping[str, Any]]
Value = Callable[[Mapping[str, Any]], float | None]
"""Of one entry; None draws nothing."""

BARS_WIDTH = 0.8


def scores_value(key: str, factor: float = 1.0) -> Value:
    """``factor`` times that figure of an entry's ``scores``."""

    def value(entry: Mapping[str, Any]) -> float | None:
        found = (entry.get("scores") or {}).get(key)
        return None if found is None else factor * float(found)

    return value


def bars(axes: Axes, entries: Entries, group: str, series: str, value: Value, label: str) -> None:
    """A cluster of bars per ``entry[group]``, one bar per ``entry[series]``; a cross where there is none.

    On a logarithmic scale where the figures differ by more than a factor of 30.
    """
    groups = list(dict.fromkeys(str(entry[group]) for entry in entries))
    names = list(dict.fromkeys(str(entry[series]) for entry in entries))
    found = {(str(entry[group]), str(entry[series])): value(entry) for entry in entries}
    heights = [height for height in found.values() if height is not None and height > 0.0]
    if heights and max(heights) > 30.0 * min(heights):
        axes.set_yscale("log")
    width = BARS_WIDTH / max(1, len(names))
    for number, name in enumerate(names):
        places = [place - 0.5 * BARS_WIDTH + (number + 0.5) * width for place in range(len(groups))]
        measured = [found.get((each, name)) for each in groups]
        axes.bar(places, [math.nan if height is None else height for height in measured], width, label=name)
        missing = [
            place
            for place, each, height in zip(places, groups, measured, strict=True)
            if height is None and (each, name) in found
        ]
        # At the foot of the plot whatever its scale: a failed run must not look like a small error.
        axes.plot(missing, [0.02] * len(missing), "kx", transform=axes.get_xaxis_transform())
    axes.set_xticks(range(len(groups)), groups, rotation=20, ha="right")
    axes.set_ylabel(label)
    axes.grid(axis="y", alpha=0.3)
    if len(names) > 1:
        axes.legend(fontsize="small")


def lines(axes: Axes, entries: Entries, over: Value, series: Mapping[str, Value], x: str, y: str) -> None:
    """One line per item of ``series`` over ``over``, from zero upwards."""
    for name, value in series.items():
        points = sorted(
            (place, height)
            for entry in entries
            if (place := over(entry)) is not None and (height := value(entry)) is not None
        )
        if points:
            axes.plot(*zip(*points, strict=True), marker="o", label=name)
    # What was measured, and no number between.
    axes.set_xticks(sorted({place for entry in entries if (place := over(entry)) is not None}))
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    if len(series) > 1 and axes.lines:
        axes.legend(fontsize="small")
