"""ATE, RTE and RRE (paper, supplement, "Evaluation Metrics"), and the error between cameras."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.alignment import align, evo_module
from mvdyn_gtsam.evaluation.association import CameraMatch
from mvdyn_gtsam.geometry import Similarity, invert_pose, rotation_angle_deg

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of single frames after one Sim(3); NaN or absent where a frame has no pose."""

    gSe: Similarity
    position_m: Mapping[str, Array]
    """Camera -> ``(M,)`` distance to the true position, NaN where missing."""
    relative_translation_m: Mapping[str, Array]
    """Camera -> errors of frame-to-frame motion within that camera."""
    relative_rotation_deg: Mapping[str, Array]

    @property
    def ate_m(self) -> float:
        return rmse(self.position_m.values())

    @property
    def rte_m(self) -> float | None:
        return rmse_or_none(self.relative_translation_m.values())

    @property
    def rre_deg(self) -> float | None:
        return rmse_or_none(self.relative_rotation_deg.values())


def rmse(errors: Iterable[Array]) -> float:
    """Root mean square over the finite entries; NaN when there is none."""
    values = np.concatenate([np.ravel(part) for part in errors] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def rmse_or_none(errors: Iterable[Array]) -> float | None:
    """As :func:`rmse`, None when there is nothing to average."""
    value = rmse(errors)
    return value if np.isfinite(value) else None


def trajectory_errors(matches: Iterable[CameraMatch], gSe: Similarity | None = None) -> TrajectoryErrors:
    """Errors of the given cameras after one Sim(3) over all of them (computed here unless given).

    Raises EvaluationError when no alignment is possible.
    """
    matches = list(matches)
    if gSe is None:
        gSe = alignment_of(matches)
    position, translation, rotation = {}, {}, {}
    for match in matches:
        aligned = gSe.transform_poses(match.estimated)
        position[match.camera] = _absolute_errors(match.truth, aligned)
        translation[match.camera], rotation[match.camera] = _relative_errors(match, aligned)
    return TrajectoryErrors(gSe, position, translation, rotation)


def alignment_of(matches: Iterable[CameraMatch]) -> Similarity:
    """``gSe`` over every registered frame of the given cameras, taken as one path."""
    matches = list(matches)
    if not matches:
        raise EvaluationError("no camera to align")
    found = [match.has_estimate for match in matches]
    return align(
        np.concatenate([match.truth[has] for match, has in zip(matches, found, strict=True)]),
        np.concatenate([match.estimated[has] for match, has in zip(matches, found, strict=True)]),
    )


def _absolute_errors(gTc: Array, aligned: Array) -> Array:
    """``(M,)`` position errors by evo's APE, NaN for missing frames."""
    metrics, trajectory = evo_module("core.metrics"), evo_module("core.trajectory")
    errors = np.full(len(gTc), np.nan)
    has = np.isfinite(aligned).all(axis=(1, 2))
    if has.any():
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data(
            (
                trajectory.PosePath3D(poses_se3=list(gTc[has])),
                trajectory.PosePath3D(poses_se3=list(aligned[has])),
            )
        )
        errors[has] = ape.error
    return errors


def _relative_errors(match: CameraMatch, aligned: Array) -> tuple[Array, Array]:
    """Translation (m) and rotation (deg) errors from each frame to the next: evo's RPE, delta of one frame.

    Steps over a missing frame, over a gap in the ground truth, and from one camera's last frame to the next
    camera's first are left out: none of them is a step that a camera made.
    """
    metrics, trajectory = evo_module("core.metrics"), evo_module("core.trajectory")
    translation, rotation = [np.zeros(0)], [np.zeros(0)]
    for run in _runs(match):
        paths = (
            trajectory.PosePath3D(poses_se3=list(match.truth[run])),
            trajectory.PosePath3D(poses_se3=list(aligned[run])),
        )
        for relation, errors in (
            (metrics.PoseRelation.translation_part, translation),
            (metrics.PoseRelation.rotation_angle_deg, rotation),
        ):
            rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
            rpe.process_data(paths)
            errors.append(np.asarray(rpe.error))
    return np.concatenate(translation), np.concatenate(rotation)


def _runs(match: CameraMatch) -> list[slice]:
    """Stretches of at least two frames that follow each other and all have a pose."""
    steps = np.diff(match.timestamps)
    if len(steps) == 0:
        return []
    has = match.has_estimate
    joined = has[:-1] & has[1:] & (steps <= 1.5 * np.median(steps))
    runs, start = [], 0
    for index, follows in enumerate([*joined, False]):
        if not follows:
            if index > start:
                runs.append(slice(start, index + 1))
            start = index + 1
    return runs


@dataclass(frozen=True)
class InterCameraErrors:
    """Relative pose error between two cameras at the same instants."""

    cameras: tuple[str, str]
    timestamps: Array
    """``(N,)``"""
    translation_m: Array
    """``(N,)`` between true and estimated translation of ``jTi``, the latter scaled by the Sim(3)."""
    rotation_deg: Array
    """``(N,)``"""


def inter_camera_errors(matches: Mapping[str, CameraMatch], scale: float) -> list[InterCameraErrors]:
    """For each pair of cameras, the error of ``jTi`` wherever both have an estimated and a true pose.

    ``scale`` is that of the trajectory's Sim(3), so that the errors are in metres.
    """
    results = []
    for first, second in itertools.combinations(matches.values(), 2):
        i, j = _same_instants(first, second)
        both = first.has_estimate[i] & second.has_estimate[j]
        i, j = i[both], j[both]
        jTi_true = invert_pose(second.truth[j]) @ first.truth[i]
        jTi = invert_pose(second.estimated[j]) @ first.estimated[i]
        rotation = np.swapaxes(jTi_true[:, :3, :3], -1, -2) @ jTi[:, :3, :3]
        results.append(
            InterCameraErrors(
                cameras=(first.camera, second.camera),
                timestamps=first.timestamps[i],
                translation_m=np.linalg.norm(scale * jTi[:, :3, 3] - jTi_true[:, :3, 3], axis=1),
                rotation_deg=rotation_angle_deg(rotation) if len(i) else np.zeros(0),
            )
        )
    return results


def _same_instants(
    first: CameraMatch, second: CameraMatch
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices of the true frames of two cameras taken at the same time (within half an interval)."""
    if len(first.timestamps) == 0 or len(second.timestamps) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    distance = np.abs(first.timestamps[:, None] - second.timestamps[None, :])
    nearest = np.argmin(distance, axis=1)
    steps = np.diff(first.timestamps)
    tolerance = 0.5 * float(np.median(steps)) if len(steps) else 1e-2
    i = np.flatnonzero(distance[np.arange(len(nearest)), nearest] < tolerance)
    return i, nearest[i]
