"""The flow factor of a keyframe where some neighbours are known and not variables.

It is the structureless one, or, for a ``FixedShapeMeasurement``, the sum of pairwise ones.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import partial

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import S, X
from factors.measurement import StructurelessMeasurement
from factors.structureless import evaluate, linearize
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.tracking.fixed_shape import FixedShapeMeasurement, evaluate_fixed, linearize_fixed

Array = npt.NDArray[np.float64]

REMEMBERED = 3
"""States whose solution a factor remembers: the current one and what a search along a line tried."""


def keyframe_factor(
    frame: Frame,
    neighbours: list[Frame],
    fixed: Mapping[Frame, Array],
    measure: Callable[[], StructurelessMeasurement],
) -> gtsam.CustomFactor:
    """Factor over ``X(frame)``, ``X`` of neighbours not ``fixed`` (poses ``(4, 4)``), ``S(frame)``.

    ``measure`` builds the measurement, the same every time: called at each evaluation, it can spare keeping
    the measurements of all keyframes in double precision at once.
    """
    free = [index for index, neighbour in enumerate(neighbours) if neighbour not in fixed]
    poses = np.stack([fixed.get(neighbour, np.eye(4)) for neighbour in neighbours])
    keys = [X(*frame), *(X(*neighbours[index]) for index in free), S(*frame)]
    error = partial(_error, measure, poses, free, OrderedDict())
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * len(neighbours) + 2), keys, error)


def _error(
    measure: Callable[[], StructurelessMeasurement],
    fixed_poses: Array,
    free: list[int],
    solved: OrderedDict[bytes, tuple[float, Array]],
    this: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[Array] | None,
) -> Array:
    """``solved`` remembers cost and log depths of the last poses: optimisers first ask what poses cost and
    then linearise there, and begin where they ended before."""
    keys = this.keys()
    wTi = values.atPose3(keys[0]).matrix()
    wTj = fixed_poses.copy()
    for index, key in zip(free, keys[1:-1], strict=True):
        wTj[index] = values.atPose3(key).matrix()
    log_scale = values.atDouble(keys[-1])
    state = wTi.tobytes() + wTj.tobytes() + struct.pack("d", log_scale)
    known = solved.get(state)
    if jacobians is None:
        if known is None:
            known = solved[state] = _evaluate(measure(), wTi, wTj, log_scale)
            if len(solved) > REMEMBERED:
                solved.popitem(last=False)
        error = np.zeros(6 * len(wTj) + 2)
        error[-1] = np.sqrt(2.0 * known[0])
        return error
    rows = _linearize(measure(), wTi, wTj, log_scale, None if known is None else known[1])
    jacobians[0] = np.asfortranarray(rows[:, :6])
    for position, index in enumerate(free):
        jacobians[position + 1] = np.asfortranarray(rows[:, 6 * index + 6 : 6 * index + 12])
    jacobians[len(free) + 1] = np.asfortranarray(rows[:, -2:-1])
    error = np.ascontiguousarray(rows[:, -1])
    return error


def _evaluate(
    measurement: StructurelessMeasurement, wTi: Array, wTj: Array, log_scale: float
) -> tuple[float, Array]:
    """Cost and log depths."""
    if isinstance(measurement, FixedShapeMeasurement):
        return evaluate_fixed(measurement, wTi, wTj, log_scale), measurement.log_shape + log_scale
    return evaluate(measurement, wTi, wTj, log_scale)


def _linearize(
    measurement: StructurelessMeasurement, wTi: Array, wTj: Array, log_scale: float, solved: Array | None
) -> Array:
    if isinstance(measurement, FixedShapeMeasurement):
        return linearize_fixed(measurement, wTi, wTj, log_scale)
    return linearize(measurement, wTi, wTj, log_scale, solved)
