"""The refinement's check of itself: how well flow fits before and after, where nobody knows the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvdyn_gtsam.refinement.finish import FinishedFrame


class SelfCheck:
    """Gathers the residuals of frames: per camera, and per pair of cameras."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._before: dict[tuple[int, int], list[float]] = {}
        self._after: dict[tuple[int, int], list[float]] = {}

    def add(self, frame: FinishedFrame) -> None:
        """Count a frame in."""
        for other, residual in frame.before_px.items():
            self._before.setdefault((frame.frame[0], other), []).append(residual)
        for other, residual in frame.after_px.items():
            self._after.setdefault((frame.frame[0], other), []).append(residual)

    def medians(self) -> list[dict[str, str | float]]:
        """For every camera that flow leads from and to: median residual before and after, px."""
        return [
            {
                "from": self._names[i],
                "to": self._names[j],
                "before_px": float(np.median(self._before[i, j])),
                "after_px": float(np.median(self._after[i, j])),
            }
            for i, j in sorted(self._before.keys() & self._after.keys())
        ]
