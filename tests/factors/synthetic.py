"""A small synthetic scene for the factor tests: grid points of one frame seen from frames around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from factors.projection import reproject
from factors.structureless import StructurelessMeasurement

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    rays: Array
    """``(N, 3)``"""
    log_depth: Array
    """``(N,)``"""
    wTi: gtsam.Pose3
    wTj: list[gtsam.Pose3]
    intrinsics_j: Array
    """``(E, 4)``"""
    pixels: Array
    """``(E, N, 2)`` noise-free."""

    @property
    def poses(self) -> list[gtsam.Pose3]:
        return [self.wTi, *self.wTj]


def make_scene(rng: np.random.Generator, points: int, edges: int) -> Scene:
    rays = np.column_stack([rng.uniform(-0.6, 0.6, (points, 2)), np.ones(points)])
    log_depth = np.log(rng.uniform(2.0, 6.0, points))
    wTi = gtsam.Pose3.Expmap(rng.normal(size=6) * 0.5)
    wTj = [
        wTi.compose(gtsam.Pose3.Expmap(np.r_[rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.3]))
        for _ in range(edges)
    ]
    # every camera has its own intrinsics, with fx != fy, so that a mix-up shows
    intrinsics = np.array([400.0, 390.0, 255.5, 191.5]) + rng.uniform(-20.0, 20.0, (edges, 4))
    pixels = reproject(rays, log_depth, wTi.matrix(), matrices(wTj), intrinsics).pixels
    return Scene(rays, log_depth, wTi, wTj, intrinsics, pixels)


def measure(scene: Scene, **changes: object) -> StructurelessMeasurement:
    """Structureless measurement of the noise-free scene, with fields replaced by ``changes``."""
    points, edges = len(scene.rays), len(scene.wTj)
    fields: dict[str, object] = {
        "rays": scene.rays,
        "initial_log_depth": scene.log_depth,
        "prior_log_depth": scene.log_depth,
        "prior_sigma": np.full(points, 0.3),
        "intrinsics_j": scene.intrinsics_j,
        "target": scene.pixels,
        "weight": np.ones((edges, points)),
    }
    return StructurelessMeasurement(**(fields | changes))  # type: ignore[arg-type]


def matrices(poses: list[gtsam.Pose3]) -> Array:
    """``(E, 4, 4)``"""
    return np.stack([pose.matrix() for pose in poses])


def perturbed(rng: np.random.Generator, poses: list[gtsam.Pose3], size: float) -> list[gtsam.Pose3]:
    return [pose.retract(rng.normal(size=6) * size) for pose in poses]


def numerical_jacobian(function: Callable[[Array], Array], size: int, step: float = 1e-5) -> Array:
    """Central differences at zero of ``function((size,)) -> (M,)``: ``(M, size)``."""
    columns = []
    for k in range(size):
        delta = np.zeros(size)
        delta[k] = step
        columns.append((np.atleast_1d(function(delta)) - np.atleast_1d(function(-delta))) / (2.0 * step))
    return np.stack(columns, axis=-1)
