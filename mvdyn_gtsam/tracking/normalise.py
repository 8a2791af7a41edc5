"""The start in units of its own median depth, so that every tolerance of the solvers is free of units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvdyn_gtsam.frontend.start.model import Start, StartFrame


def normalised_start(start: Start) -> tuple[Start, tuple[float, ...]]:
    """The start with every group's median depth 1, and the factor per group back to its unit."""
    units: list[float] = []
    frames = list(start.frames)
    for group in start.groups:
        unit = float(np.median(np.concatenate([f.depth for camera in group for f in start.frames[camera]])))
        units.append(unit)
        for camera in group:
            frames[camera] = tuple(_scaled(frame, 1.0 / unit) for frame in start.frames[camera])
    return replace(start, frames=tuple(frames)), tuple(units)


def _scaled(frame: StartFrame, factor: float) -> StartFrame:
    wTc = np.array(frame.wTc, dtype=np.float64)
    wTc[:3, 3] *= factor
    return replace(frame, wTc=wTc, depth=np.asarray(frame.depth, dtype=np.float64) * factor)
