"""Errors of a rough start against ground truth: relative poses of cameras at frames near in time."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation import GroundTruth
from mvdyn_gtsam.evaluation.alignment import align
from mvdyn_gtsam.geometry import invert_pose, rotation_angle_deg

Array = npt.NDArray[np.float64]
Frames = Mapping[int, Array]
"""Frame number -> ``wTc (4, 4)`` of one camera."""


@dataclass(frozen=True)
class PairError:
    """Relative pose error of two cameras of one group, RMSE over their frame pairs."""

    cameras: tuple[str, str]
    frame_pairs: int
    rotation_deg: float
    translation_m: float
    worst_rotation_deg: float
    worst_translation_m: float


@dataclass(frozen=True)
class StartScore:
    """What a start is worth on one capture."""

    groups: tuple[tuple[str, ...], ...]
    frames: dict[str, int]
    """Camera -> frames placed."""
    pairs: tuple[PairError, ...]
    apart: tuple[tuple[str, str], ...]
    """Pairs of cameras without a common frame of reference."""
    problem: str | None
    """Why a group has no figures, or why there is no start at all."""


def score_start(
    groups: Sequence[Sequence[str]], estimated: Mapping[str, Frames], truth: Mapping[str, Frames]
) -> StartScore:
    """Errors of the placed frames, group by group.

    ``estimated`` and ``truth``: camera -> frame number -> ``wTc``; frames without a true pose are left out.
    """
    pairs: list[PairError] = []
    problems: list[str] = []
    for group in groups:
        if len(group) < 2:
            continue
        known = {camera: sorted(set(estimated[camera]) & set(truth[camera])) for camera in group}
        try:
            scale = metres_per_unit(known, estimated, truth)
        except EvaluationError as error:
            problems.append(f"{', '.join(group)}: {error}")
            continue
        pairs += [
            pair_error(a, b, estimated, truth, scale)
            for a, b in itertools.combinations(group, 2)
            if known[a] and known[b]
        ]
    group_of = {camera: number for number, group in enumerate(groups) for camera in group}
    apart = tuple(
        (a, b) for a, b in itertools.combinations(truth, 2) if group_of.get(a, -1) != group_of.get(b, -2)
    )
    return StartScore(
        groups=tuple(tuple(group) for group in groups),
        frames={camera: len(estimated.get(camera, {})) for camera in truth},
        pairs=tuple(pairs),
        apart=apart,
        problem="; ".join(problems) or None,
    )


def metres_per_unit(
    known: Mapping[str, Sequence[int]], estimated: Mapping[str, Frames], truth: Mapping[str, Frames]
) -> float:
    """Metres per unit of a group's world, from one Sim(3) over its frames ``known`` (camera -> numbers).

    Raises EvaluationError where these define none.
    """
    keys = [(camera, frame) for camera, frames in known.items() for frame in frames]
    if not keys:
        raise EvaluationError("no placed frame has a true pose")
    gTc = np.stack([truth[camera][frame] for camera, frame in keys])
    eTc = np.stack([estimated[camera][frame] for camera, frame in keys])
    return align(gTc, eTc).scale


def pair_error(
    a: str, b: str, estimated: Mapping[str, Frames], truth: Mapping[str, Frames], scale: float
) -> PairError:
    """Error of ``aTb`` over the frames of either camera, each with the other's nearest in time."""
    frames_a = sorted(set(estimated[a]) & set(truth[a]))
    frames_b = sorted(set(estimated[b]) & set(truth[b]))
    rotations, translations = [], []
    nearest = nearest_pairs(frames_a, frames_b)
    for frame_a, frame_b in nearest:
        aTb = invert_pose(estimated[a][frame_a]) @ estimated[b][frame_b]
        true_aTb = invert_pose(truth[a][frame_a]) @ truth[b][frame_b]
        rotations.append(float(rotation_angle_deg(true_aTb[:3, :3].T @ aTb[:3, :3])))
        translations.append(float(np.linalg.norm(scale * aTb[:3, 3] - true_aTb[:3, 3])))
    return PairError(
        (a, b), len(nearest), _rms(rotations), _rms(translations), max(rotations), max(translations)
    )


def nearest_pairs(frames_a: Sequence[int], frames_b: Sequence[int]) -> list[tuple[int, int]]:
    """Each frame of either camera with the other's nearest in time, every pair once, in order."""
    forward = {(a, min(frames_b, key=lambda b: abs(b - a))) for a in frames_a}
    backward = {(min(frames_a, key=lambda a: abs(a - b)), b) for b in frames_b}
    return sorted(forward | backward)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def true_frames(capture: Capture, groundtruth: GroundTruth) -> dict[str, Frames]:
    """Camera -> frame number -> true ``wTc``, by time stamp within half a frame."""
    truth: dict[str, Frames] = {}
    for camera in capture.cameras:
        times, gTc = groundtruth.trajectories.get(camera.name, (np.zeros(0), np.zeros((0, 4, 4))))
        frames = np.rint((times - capture.start_time) * capture.fps).astype(int)
        truth[camera.name] = {
            int(frame): pose
            for frame, pose in zip(frames, gTc, strict=True)
            if 0 <= frame < capture.frame_count and np.isfinite(pose).all()
        }
    return truth
