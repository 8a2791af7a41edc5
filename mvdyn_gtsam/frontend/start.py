"""What the wide-baseline start hands to the tracker: groups of cameras and a sparse skeleton of frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class StartFrame:
    """One frame of the skeleton: where its camera was, and the sparse depths it saw."""

    time: int
    wTc: npt.NDArray[np.float64]
    """``(4, 4)`` in the world frame of the camera's group."""
    pixels: npt.NDArray[np.float64]
    """``(M, 2)`` px."""
    depth: npt.NDArray[np.float64]
    """``(M,)`` z-depth at ``pixels``, in the unit of the group's world."""


@dataclass(frozen=True)
class Start:
    """Rough poses over the whole video, good to about half a degree and a few percent of the depth."""

    groups: tuple[tuple[int, ...], ...]
    """Camera indices that share a world frame; every camera is in exactly one group."""
    frames: tuple[tuple[StartFrame, ...], ...]
    """Per camera, in time order, at least one."""
