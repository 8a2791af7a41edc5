"""The structureless flow factor of a keyframe where some neighbours are known and not variables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import S, X
from factors.measurement import StructurelessMeasurement
from factors.structureless import evaluate, linearize
from mvdyn_gtsam.graph.connections import Frame

Array = npt.NDArray[np.float64]


def keyframe_factor(
    frame: Frame,
    neighbours: list[Frame],
    fixed: Mapping[Frame, Array],
    measure: Callable[[], StructurelessMeasurement],
) -> gtsam.CustomFactor:
    """Factor over ``X(frame)``, ``X`` of neighbours not ``fixed`` (poses ``(4, 4)``), ``S(frame)``.

    ``measure`` builds the measurement, the same every time: called at each linearisation, it spares keeping
    the measurements of all keyframes in double precision at once.
    """
    free = [index for index, neighbour in enumerate(neighbours) if neighbour not in fixed]
    poses = np.stack([fixed.get(neighbour, np.eye(4)) for neighbour in neighbours])
    keys = [X(*frame), *(X(*neighbours[index]) for index in free), S(*frame)]
    error = partial(_error, measure, poses, free)
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * len(neighbours) + 2), keys, error)


def _error(
    measure: Callable[[], StructurelessMeasurement],
    fixed_poses: Array,
    free: list[int],
    this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    keys = this.keys()
    wTi = values.atPose3(keys[0]).matrix()
    wTj = fixed_poses.copy()
    for index, key in zip(free, keys[1:-1], strict=True):
        wTj[index] = values.atPose3(key).matrix()
    log_scale = values.atDouble(keys[-1])
    if jacobians is None:
        error = np.zeros(6 * len(wTj) + 2)
        error[-1] = np.sqrt(2.0 * evaluate(measure(), wTi, wTj, log_scale)[0])
        return error
    rows = linearize(measure(), wTi, wTj, log_scale)
    jacobians[0] = np.asfortranarray(rows[:, :6])
    for position, index in enumerate(free):
        jacobians[position + 1] = np.asfortranarray(rows[:, 6 * index + 6 : 6 * index + 12])
    jacobians[len(free) + 1] = np.asfortranarray(rows[:, -2:-1])
    error = np.ascontiguousarray(rows[:, -1])
    return error
