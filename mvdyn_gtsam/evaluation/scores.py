"""All figures of one reconstruction against ground truth."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.association import CameraMatch, PoseSource, ReconstructionLike, associate
from mvdyn_gtsam.evaluation.depth import DepthScores, depth_scores, median_true_depth
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth, load_groundtruth
from mvdyn_gtsam.evaluation.trajectory import (
    InterCameraErrors,
    TrajectoryErrors,
    inter_camera_errors,
    rmse_or_none,
    trajectory_errors,
)

START_FRAMES = 8
"""``N_init`` of the paper: what the wide-baseline start is judged on."""


@dataclass(frozen=True)
class CameraScores:
    """Figures of one camera, under the Sim(3) of all cameras together."""

    registered: float
    ate_m: float | None
    rte_m: float | None
    rre_deg: float | None
    depth: DepthScores | None


@dataclass(frozen=True)
class PairScores:
    """Relative pose error of two cameras at the same instants, RMSE; None: they never both have a pose."""

    cameras: tuple[str, str]
    instants: int
    trans_m: float | None
    rot_deg: float | None
    start_trans_m: float | None
    start_rot_deg: float | None


@dataclass(frozen=True)
class GroupScores:
    """Figures of cameras connected to each other, under a Sim(3) of their own."""

    cameras: tuple[str, ...]
    ate_m: float | None
    rte_m: float | None
    rre_deg: float | None
    scale: float | None
    problem: str | None
    """Why the figures are missing, else None."""


@dataclass(frozen=True)
class Scores:
    """Every figure of the contract; RMSE in metres and degrees, one Sim(3) over all cameras together.

    The errors are those of the frames that have a pose. Where ``complete`` is False they flatter the method:
    the missing frames are failures, and ``registered`` says how many.
    """

    registered: float
    complete: bool
    frames: int
    ate_m: float
    rte_m: float | None
    rre_deg: float | None
    inter_camera_trans_m: float | None
    inter_camera_rot_deg: float | None
    inter_camera_start_trans_m: float | None
    inter_camera_start_rot_deg: float | None
    median_depth_m: float | None
    """Of the ground truth; the scale that translation errors are judged by."""
    scale: float
    """Metres per unit of the reconstruction."""
    depth: DepthScores | None
    per_camera: Mapping[str, CameraScores]
    per_pair: tuple[PairScores, ...]
    groups: tuple[GroupScores, ...]

    def to_json(self) -> dict[str, Any]:
        """The contract's keys, flat; plain JSON values, None where there is nothing to measure."""
        content = dataclasses.asdict(self)
        content.update(_flat_depth(content.pop("depth")))
        content["per_camera"] = {
            camera: {
                **{key: value for key, value in entry.items() if key != "depth"},
                **_flat_depth(entry["depth"]),
            }
            for camera, entry in content["per_camera"].items()
        }
        return json.loads(json.dumps(_without_nan(content), allow_nan=False))


def evaluate(reconstruction: ReconstructionLike, groundtruth: GroundTruth | str | Path) -> Scores:
    """Score poses and, where both exist, depth.

    Raises EvaluationError when the two cannot be compared: no common camera, no registered frame, or
    positions that define no Sim(3).
    """
    if not isinstance(groundtruth, GroundTruth):
        groundtruth = load_groundtruth(groundtruth)
    matches = associate(reconstruction, groundtruth)
    errors = trajectory_errors(matches.values())
    depth: DepthScores | None = None
    depth_of: Mapping[str, DepthScores] = {}
    if any(groundtruth.depth_frames(camera) for camera in matches):
        depth, depth_of = depth_scores(reconstruction, groundtruth, matches, errors.gSe)
    return _assemble(
        matches,
        errors,
        depth,
        depth_of,
        median_depth=median_true_depth(groundtruth),
        groups=_group_scores(matches, [list(group) for group in reconstruction.groups]),
    )


def evaluate_poses(reconstruction: PoseSource, groundtruth: GroundTruth | str | Path) -> Scores:
    """As :func:`evaluate` for something that has trajectories only (COLMAP, GLOMAP, a TUM file)."""
    if not isinstance(groundtruth, GroundTruth):
        groundtruth = load_groundtruth(groundtruth)
    matches = associate(reconstruction, groundtruth)
    errors = trajectory_errors(matches.values())
    return _assemble(
        matches, errors, None, {}, median_true_depth(groundtruth), groups=_group_scores(matches, [])
    )


def _assemble(
    matches: Mapping[str, CameraMatch],
    errors: TrajectoryErrors,
    depth: DepthScores | None,
    depth_of: Mapping[str, DepthScores],
    median_depth: float | None,
    groups: tuple[GroupScores, ...],
) -> Scores:
    frames = sum(match.frame_count for match in matches.values())
    found = sum(match.registered_count for match in matches.values())
    start_times = _start_times(matches)
    pairs = inter_camera_errors(matches, errors.gSe.scale)
    starts = [pair.timestamps[:, None] - start_times[None, :] for pair in pairs]
    at_start = [(np.abs(offset) < 1e-6).any(axis=1) for offset in starts]
    return Scores(
        registered=found / frames,
        complete=found == frames,
        frames=frames,
        ate_m=errors.ate_m,
        rte_m=errors.rte_m,
        rre_deg=errors.rre_deg,
        inter_camera_trans_m=rmse_or_none(pair.translation_m for pair in pairs),
        inter_camera_rot_deg=rmse_or_none(pair.rotation_deg for pair in pairs),
        inter_camera_start_trans_m=rmse_or_none(
            pair.translation_m[mask] for pair, mask in zip(pairs, at_start, strict=True)
        ),
        inter_camera_start_rot_deg=rmse_or_none(
            pair.rotation_deg[mask] for pair, mask in zip(pairs, at_start, strict=True)
        ),
        median_depth_m=median_depth,
        scale=errors.gSe.scale,
        depth=depth,
        per_camera={
            camera: CameraScores(
                registered=match.registered_count / match.frame_count if match.frame_count else 0.0,
                ate_m=rmse_or_none([errors.position_m[camera]]),
                rte_m=rmse_or_none([errors.relative_translation_m[camera]]),
                rre_deg=rmse_or_none([errors.relative_rotation_deg[camera]]),
                depth=depth_of.get(camera),
            )
            for camera, match in matches.items()
        },
        per_pair=tuple(_pair_scores(pair, mask) for pair, mask in zip(pairs, at_start, strict=True)),
        groups=groups,
    )


def _start_times(matches: Mapping[str, CameraMatch]) -> np.ndarray:
    """True timestamps of each camera's first :data:`START_FRAMES` frames, all cameras together."""
    parts = [
        match.timestamps[(match.frames >= 0) & (match.frames < START_FRAMES)] for match in matches.values()
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


def _pair_scores(pair: InterCameraErrors, at_start: np.ndarray) -> PairScores:
    return PairScores(
        cameras=pair.cameras,
        instants=len(pair.timestamps),
        trans_m=rmse_or_none([pair.translation_m]),
        rot_deg=rmse_or_none([pair.rotation_deg]),
        start_trans_m=rmse_or_none([pair.translation_m[at_start]]),
        start_rot_deg=rmse_or_none([pair.rotation_deg[at_start]]),
    )


def _group_scores(matches: Mapping[str, CameraMatch], groups: list[list[str]]) -> tuple[GroupScores, ...]:
    grouped = {camera for group in groups for camera in group}
    everything = (
        groups + [[camera] for camera in matches if camera not in grouped] if groups else [list(matches)]
    )
    scores = []
    for group in everything:
        members = [matches[camera] for camera in group if camera in matches]
        try:
            errors = trajectory_errors(members)
        except EvaluationError as error:
            # One camera that stands still has no Sim(3) of its own; the other groups still have.
            scores.append(GroupScores(tuple(group), None, None, None, None, str(error)))
            continue
        scores.append(
            GroupScores(
                tuple(group), errors.ate_m, errors.rte_m, errors.rre_deg, errors.gSe.scale, problem=None
            )
        )
    return tuple(scores)


def _flat_depth(depth: dict[str, Any] | None) -> dict[str, Any]:
    names = [entry.name for entry in dataclasses.fields(DepthScores)]
    values = depth or {}
    renamed = {"frames": "depth_frames", "frames_without_estimate": "depth_frames_without_estimate"}
    renamed["coverage"] = "depth_coverage"
    return {renamed.get(name, name): values.get(name) for name in names}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
