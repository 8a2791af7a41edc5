"""Which estimated frame belongs to which true frame: by time, camera by camera."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]


class PoseSource(Protocol):
    """What the trajectory metrics need of a reconstruction."""

    @property
    def cameras(self) -> Sequence[str]: ...

    def trajectory(self, camera: str) -> tuple[Array, Array]:
        """Timestamps ``(T,)`` and ``wTc`` ``(T, 4, 4)``, NaN for frames without a pose."""
        ...


class ReconstructionLike(PoseSource, Protocol):
    """What all metrics need of a reconstruction."""

    @property
    def groups(self) -> Sequence[Sequence[str]]:
        """Cameras connected to each other; nothing at all counts as one group of all."""
        ...

    def has_depth(self, camera: str, time: int) -> bool: ...

    def depth(self, camera: str, time: int) -> npt.NDArray[np.float32]:
        """z-depth ``(H, W) float32``, NaN = invalid."""
        ...

    def intrinsics(self, camera: str) -> Array:
        """``(3, 3)``"""
        ...


@dataclass(frozen=True)
class CameraMatch:
    """The frames of one camera that have a true pose, in time order; M of them."""

    camera: str
    frame_count: int
    """All frames of the camera, with or without a true pose."""
    estimated_frame_count: int
    """Frames that the reconstruction knows, with or without a pose."""
    registered_count: int
    """Frames with an estimated pose."""
    frames: npt.NDArray[np.int64]
    """``(M,)`` frame number of the reconstruction, -1 where it has no such frame."""
    timestamps: Array
    """``(M,)`` seconds, of the ground truth."""
    estimated: Array
    """``(M, 4, 4)`` eTc in the reconstruction's world, NaN where missing."""
    truth: Array
    """``(M, 4, 4)`` gTc in the world of the ground truth."""

    @property
    def has_estimate(self) -> npt.NDArray[np.bool_]:
        """``(M,)``"""
        return np.asarray(np.isfinite(self.estimated).all(axis=(1, 2)))


def associate(reconstruction: PoseSource, groundtruth: GroundTruth) -> dict[str, CameraMatch]:
    """Match every camera that the ground truth knows; one the reconstruction lacks has no estimate at all.

    A true frame belongs to the nearest estimated one within half a frame interval.
    Raises EvaluationError when not one camera is in both.
    """
    known = set(reconstruction.cameras)
    if not known & set(groundtruth.cameras):
        raise EvaluationError(
            f"{groundtruth.folder}: knows cameras {groundtruth.cameras}, the reconstruction {sorted(known)};"
            " none is in both"
        )
    for camera in sorted(known - set(groundtruth.cameras)):
        logger.warning("%s: no true trajectory in %s, left out of the scores", camera, groundtruth.folder)
    matches = {}
    for camera, (true_times, gTc) in groundtruth.trajectories.items():
        finite = np.isfinite(gTc).all(axis=(1, 2))
        true_times, gTc = true_times[finite], gTc[finite]
        times, eTc = (
            reconstruction.trajectory(camera) if camera in known else (np.zeros(0), np.zeros((0, 4, 4)))
        )
        frames = _nearest(true_times, np.asarray(times, dtype=np.float64))
        estimated = np.full((len(true_times), 4, 4), np.nan)
        estimated[frames >= 0] = np.asarray(eTc, dtype=np.float64)[frames[frames >= 0]]
        matches[camera] = CameraMatch(
            camera=camera,
            frame_count=len(times) + int(np.count_nonzero(frames < 0)),
            estimated_frame_count=len(times),
            registered_count=int(np.isfinite(eTc).all(axis=(1, 2)).sum()),
            frames=frames,
            timestamps=true_times,
            estimated=estimated,
            truth=gTc,
        )
    return matches


def _nearest(wanted: Array, available: Array) -> npt.NDArray[np.int64]:
    """Index into ``available`` of the entry within half an interval of each wanted time, else -1."""
    if len(available) == 0 or len(wanted) == 0:
        return np.full(len(wanted), -1, dtype=np.int64)
    order = np.argsort(available, kind="stable")
    ascending = available[order]
    position = np.clip(np.searchsorted(ascending, wanted), 0, len(ascending) - 1)
    before = np.clip(position - 1, 0, None)
    closer = np.abs(ascending[before] - wanted) < np.abs(ascending[position] - wanted)
    position = np.where(closer, before, position)
    tolerance = 0.5 * np.median(np.diff(ascending)) if len(ascending) > 1 else 0.5 * _interval(wanted)
    close = np.abs(ascending[position] - wanted) <= tolerance
    return np.where(close, order[position], -1).astype(np.int64)


def _interval(times: Array) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.02
