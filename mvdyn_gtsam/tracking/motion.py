"""Pose of one frame from others whose pose and depth are known: prediction, PnP and motion-only solves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import interpolate_pose, invert_pose, transform_points

Array = npt.NDArray[np.float64]

MOST = 0.7
"""Share of inliers below which a pose is in doubt."""
NEARLY_ALL = 0.8
"""Share of inliers from which no other pose can do better: of 94 on hololens_office_2seg every prediction led
to the same."""


@dataclass(frozen=True)
class PoseFit:
    """A pose, how well it fits, and its information."""

    wTc: Array
    """``(4, 4)``"""
    cost: float
    """Mean robust cost per unit of measurement weight."""
    inlier_fraction: float
    """Weighted share of residuals below twice the robust scale."""
    information: Array
    """``(6, 6)``"""


@dataclass(frozen=True)
class Correspondences:
    """World points and where they are seen in one frame."""

    w_points: Array
    """``(M, 3)``"""
    target: Array
    """``(M, 2)`` px"""
    weight: Array
    """``(M,)`` in [0, 1]."""

    @staticmethod
    def join(parts: Sequence[Correspondences]) -> Correspondences:
        return Correspondences(
            np.concatenate([part.w_points for part in parts]),
            np.concatenate([part.target for part in parts]),
            np.concatenate([part.weight for part in parts]),
        )


def predict_pose(times: Sequence[int], wTc: Sequence[Array], time: int) -> Array:
    """Pose at ``time`` of a camera known at ascending ``times``: interpolated, else constant velocity.

    One known pose is repeated.
    """
    if len(times) == 1:
        return np.array(wTc[0])
    after = int(np.searchsorted(times, time))
    if after < len(times) and times[after] == time:
        return np.array(wTc[after])
    first = min(max(after - 1, 0), len(times) - 2)
    fraction = (time - times[first]) / (times[first + 1] - times[first])
    return interpolate_pose(wTc[first], wTc[first + 1], fraction)


def refine_pose(
    seen: Correspondences, intrinsics: Array, wTc: Array, robust_px: float, iterations: int = 12
) -> PoseFit:
    """Levenberg-Marquardt on the six degrees of freedom of one frame, Cauchy loss; ``intrinsics (4,)``.

    Points with weight zero are left out. Without any, the pose is returned as given with infinite cost.
    """
    used = seen.weight > 0.0
    w_points, target, weight = seen.w_points[used], seen.target[used], seen.weight[used]
    if not len(weight):
        return PoseFit(np.array(wTc), np.inf, 0.0, np.zeros((6, 6)))
    total = weight.sum()
    cost, gradient, hessian, squared = _system(w_points, target, weight, intrinsics, wTc, robust_px)
    damping = 1e-4
    for _ in range(iterations):
        damped = hessian + damping * np.diag(np.diagonal(hessian) + 1e-9)
        step = np.asarray(np.linalg.solve(damped, -gradient), np.float64)
        candidate = _retract(wTc, step)
        system = _system(w_points, target, weight, intrinsics, candidate, robust_px)
        if system[0] <= cost:
            improvement = cost - system[0]
            wTc, (cost, gradient, hessian, squared) = candidate, system
            damping = max(damping * 0.1, 1e-9)
            if improvement < 1e-9 * cost:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    inliers = weight[squared < (2.0 * robust_px) ** 2].sum() / total
    return PoseFit(wTc, float(cost / total), float(inliers), hessian)


def pnp_pose(seen: Correspondences, intrinsics: Array, threshold_px: float) -> Array | None:
    """Pose by PnP in RANSAC, or None where it finds none. Deterministic."""
    good = seen.weight > 0.3
    if good.sum() < 12:
        return None
    matrix = np.array(
        [[intrinsics[0], 0.0, intrinsics[2]], [0.0, intrinsics[1], intrinsics[3]], [0.0, 0.0, 1.0]]
    )
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        seen.w_points[good],
        np.ascontiguousarray(seen.target[good], dtype=np.float64),
        matrix,
        None,
        iterationsCount=200,
        reprojectionError=threshold_px,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found:
        return None
    cTw = np.eye(4)
    cTw[:3, :3] = Rotation.from_rotvec(rotation.ravel()).as_matrix()
    cTw[:3, 3] = translation.ravel()
    return invert_pose(cTw) if np.isfinite(cTw).all() else None


def locate(
    seen: Correspondences, intrinsics: Array, predictions: Sequence[Array], robust_px: float
) -> PoseFit:
    """Best pose from several predictions, the first of which that explains nearly all of the measurement
    suffices; PnP joins them where none explains most of it."""
    fits: list[PoseFit] = []
    for wTc in predictions:
        fits.append(refine_pose(seen, intrinsics, wTc, robust_px))
        if fits[-1].inlier_fraction > NEARLY_ALL:
            return fits[-1]
    if max(fit.inlier_fraction for fit in fits) < MOST:
        unguided = pnp_pose(seen, intrinsics, 4.0 * robust_px)
        if unguided is not None:
            fits.append(refine_pose(seen, intrinsics, unguided, robust_px))
    return min(fits, key=lambda fit: fit.cost)


def world_points(rays: Array, log_depth: Array, wTc: Array) -> Array:
    """``(N, 3)`` of rays ``(N, 3)`` with z = 1 and log z-depths ``(N,)``."""
    return transform_points(wTc, rays * np.exp(log_depth)[:, None])


def _retract(wTc: Array, step: Array) -> Array:
    """First order in the translation, exact in the rotation: enough for an iterated solve."""
    result = np.eye(4)
    result[:3, :3] = wTc[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
    result[:3, 3] = wTc[:3, 3] + wTc[:3, :3] @ step[3:]
    return result


def _system(
    w_points: Array, target: Array, weight: Array, intrinsics: Array, wTc: Array, robust_px: float
) -> tuple[float, Array, Array, Array]:
    """Robust cost, gradient ``(6,)``, Gauss-Newton Hessian ``(6, 6)`` and squared residuals ``(M,)``."""
    points = (w_points - wTc[:3, 3]) @ wTc[:3, :3]
    z = points[:, 2]
    seen = z > 1e-6
    inverse = np.where(seen, 1.0 / np.where(seen, z, 1.0), 0.0)
    x, y = points[:, 0] * inverse, points[:, 1] * inverse
    fx, fy, cx, cy = intrinsics
    residual_x, residual_y = fx * x + cx - target[:, 0], fy * y + cy - target[:, 1]
    squared = np.where(seen, residual_x**2 + residual_y**2, 1e6)
    scale = robust_px**2
    cost = float((weight * 0.5 * scale * np.log1p(squared / scale)).sum())
    robust = weight * scale / (scale + squared) * seen
    zero = np.zeros_like(x)
    # a right perturbation moves the point by -omega x p - v
    by_x = fx * np.stack([x * y, -(1 + x * x), y, -inverse, zero, x * inverse])
    by_y = fy * np.stack([1 + y * y, -x * y, -x, zero, -inverse, y * inverse])
    gradient = by_x @ (robust * residual_x) + by_y @ (robust * residual_y)
    hessian = (by_x * robust) @ by_x.T + (by_y * robust) @ by_y.T
    return cost, gradient, hessian, squared
