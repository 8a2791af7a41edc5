"""What a capture is once it has been checked: cameras, and frames decoded on demand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

FIRST_FOCAL = 0.75
"""Focal length that is guessed where none is given, as a share of the longer image side: about that of a
phone's main camera while it films video. Source: choice; 26 mm on 36 mm wide film, cropped a little."""


@dataclass(frozen=True)
class Camera:
    """One moving device, pinhole after undistortion; pixel centres at integer coordinates."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """OpenCV order k1, k2, p1, p2, k3; frames are handed out undistorted with the same intrinsics."""
    time_offset: float = 0.0
    """Seconds to add to this camera's own clock to get the common clock."""
    focal_known: bool = True
    """Where False, fx and fy are a first guess, equal, and the start finds the focal length in the video;
    such a camera has no distortion, which could not be taken out of its frames."""

    @property
    def intrinsics(self) -> npt.NDArray[np.float64]:
        """``(3, 3)`` pinhole matrix at the input resolution."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class FrameStream(Protocol):
    """Frames of one camera, decoded when asked for; cheap in order, correct in any order."""

    def __len__(self) -> int: ...

    def read(self, time: int) -> npt.NDArray[np.uint8]:
        """Frame ``time`` as ``(H, W, 3) uint8`` RGB, undistorted."""
        ...


@dataclass(frozen=True)
class Capture:
    """Time-synchronised streams that passed every check of the loader: one length, one clock."""

    name: str
    fps: float
    cameras: tuple[Camera, ...]
    streams: tuple[FrameStream, ...]
    start_time: float = 0.0
    """Seconds on the common clock of frame 0; not zero only where time offsets trimmed the start."""
    source: Path | None = None
    """The one file or folder that it was read from; None where there is none."""

    @property
    def frame_count(self) -> int:
        """Frames per camera, the same for all."""
        return len(self.streams[0])

    @property
    def timestamps(self) -> npt.NDArray[np.float64]:
        """``(T,)`` seconds on the common clock."""
        return self.start_time + np.arange(self.frame_count) / self.fps

    def read(self, camera: int, time: int) -> npt.NDArray[np.uint8]:
        """Frame ``time`` of camera number ``camera`` as ``(H, W, 3) uint8`` RGB, undistorted."""
        return self.streams[camera].read(time)
