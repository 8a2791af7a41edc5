"""One Sim(3) from the reconstruction's world to that of the ground truth, through evo."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.geometry import Similarity

Array = npt.NDArray[np.float64]

_COLLINEAR = 1e-10
"""Second over first singular value of the covariance: width 1e-5 of the length, below any measurement."""


def evo_module(name: str) -> Any:
    """``evo.<name>``; evo is GPL-3.0 and therefore an extra.

    Raises EvaluationError when it is not installed.
    """
    try:
        return importlib.import_module(f"evo.{name}")
    except ImportError as error:
        raise EvaluationError("evaluation needs evo: pip install mvdyn_gtsam[eval]") from error


def align(gTc: Array, eTc: Array) -> Similarity:
    """``gSe`` that brings estimated poses ``(N, 4, 4)`` of all cameras together onto the true ones.

    Umeyama on the positions (https://doi.org/10.1109/34.88573) as evo does it. Where all positions lie on a
    line the turn about that line is not theirs to tell, and is taken from the orientations; the position
    error is the same for every such turn. Raises EvaluationError when the positions coincide.
    """
    trajectory = evo_module("core.trajectory")
    if len(gTc) == 0:
        raise EvaluationError("no frame has both an estimated and a true pose; nothing can be aligned")
    g_center, g_spread = _center_and_spread(gTc)
    e_center, e_spread = _center_and_spread(eTc)
    # Below rounding of the coordinates themselves there is no position to align.
    if g_spread <= 1e-9 * max(1.0, float(np.abs(g_center).max())):
        raise EvaluationError(
            "all true positions coincide (one camera that stands still?): no Sim(3) is defined"
        )
    if e_spread <= 1e-12 * max(1e-30, float(np.abs(e_center).max())) or e_spread == 0.0:
        raise EvaluationError(
            "all estimated positions coincide: no Sim(3) is defined, the trajectory is a failure"
        )
    g_unit, e_unit = _normalised(gTc, g_center, g_spread), _normalised(eTc, e_center, e_spread)
    covariance = g_unit[:, :3, 3].T @ e_unit[:, :3, 3] / len(g_unit)
    singular = np.linalg.svd(covariance, compute_uv=False)
    if singular[1] > _COLLINEAR * singular[0] and singular[0] > np.finfo(np.float64).eps:
        path = trajectory.PosePath3D(poses_se3=list(e_unit))
        rotation, translation, scale = path.align(
            trajectory.PosePath3D(poses_se3=list(g_unit)), correct_scale=True
        )
    else:
        rotation, translation, scale = _align_on_a_line(g_unit, e_unit)
    scale_total = float(scale) * g_spread / e_spread
    return Similarity(
        scale_total,
        np.asarray(rotation),
        g_spread * np.asarray(translation) + g_center - scale_total * (np.asarray(rotation) @ e_center),
    )


def _center_and_spread(aTc: Array) -> tuple[Array, float]:
    center = aTc[:, :3, 3].mean(axis=0)
    return center, float(np.sqrt(((aTc[:, :3, 3] - center) ** 2).sum(axis=1).mean()))


def _normalised(aTc: Array, center: Array, spread: float) -> Array:
    """Poses with positions of mean 0 and RMS 1: evo's test of rank is absolute and would depend on units."""
    result = aTc.copy()
    result[:, :3, 3] = (aTc[:, :3, 3] - center) / spread
    return result


def _align_on_a_line(g_unit: Array, e_unit: Array) -> tuple[Array, Array, float]:
    """Umeyama's solution for covariance of rank 1, its free turn chosen to agree with the orientations."""
    covariance = g_unit[:, :3, 3].T @ e_unit[:, :3, 3] / len(g_unit)
    u, singular, vt = np.linalg.svd(covariance)
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ handed @ vt
    axis = u[:, 0]
    # max over the angle of sum_k trace(gRc_k^T Rot(axis, angle) rotation eRc_k), in closed form.
    moment = np.einsum("ij,kjl,kml->im", rotation, e_unit[:, :3, :3], g_unit[:, :3, :3])
    cosine = np.trace(moment) - axis @ moment @ axis
    sine = axis @ np.array(
        [moment[1, 2] - moment[2, 1], moment[2, 0] - moment[0, 2], moment[0, 1] - moment[1, 0]]
    )
    turn = Rotation.from_rotvec(np.arctan2(sine, cosine) * axis).as_matrix()
    return turn @ rotation, np.zeros(3), float(singular[0])
