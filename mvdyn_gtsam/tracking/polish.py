"""The global polish: all keyframes at once, with long-range edges whose flow is measured anew."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from types import MappingProxyType

import gtsam
import numpy as np
import numpy.typing as npt

from factors.keys import S, X
from factors.measurement import StructurelessMeasurement
from factors.projection import reproject
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.frontend.rig import Pair, add_mounts
from mvdyn_gtsam.tracking.keyframe_factor import keyframe_factor
from mvdyn_gtsam.tracking.model import Keyframe, View, measurement_of
from mvdyn_gtsam.tracking.normal_equations import descend
from mvdyn_gtsam.tracking.window import Priors, solve_depth, useful_neighbours

logger = logging.getLogger(__name__)

Mounts = Mapping[Pair, npt.NDArray[np.float64]]
"""Relative poses ``aTb`` of cameras mounted on one another."""
NO_MOUNTS: Mounts = MappingProxyType({})

SHORT_RUN = 3
"""Levenberg-Marquardt iterations between two searches along the way."""
LONGEST_SEARCH = 5
"""Doublings of a search."""
KEPT_BYTES = 64 * 2**20
"""Memory for measurements that are kept between linearisations; those beyond are built each time."""
BYTES_PER_MEASUREMENT = 40
"""Of one point and edge in double precision: target, weight, information, and what they are made of."""
LARGE = 800
"""Variables from which one sparse matrix is solved faster than GTSAM eliminates them one by one."""
ROUGH = 10.0
"""Times the tolerance with which a solve ends that more measuring follows: flow is measured anew only where
its prediction has moved by ``remeasure_px``."""
DAMPING = 1e-6
"""That Levenberg-Marquardt begins with."""


@dataclass(frozen=True)
class PolishSolve:
    """What one solve did."""

    error_before: float
    error_after: float
    iterations: int


def solve_all(
    keyframes: list[Keyframe],
    views: tuple[View, ...],
    config: TrackingConfig,
    priors: Priors,
    thin: bool = False,
    robust_px: float | None = None,
    mounts: Mounts = NO_MOUNTS,
) -> PolishSolve:
    """Levenberg-Marquardt over poses and depth scales of all ``keyframes``; they are updated in place.

    ``thin`` uses every second grid point and ends early: enough between two rounds of measuring. ``mounts``
    are held, their relative poses being solved for.
    """
    if thin:
        config = replace(config, polish_tolerance=ROUGH * config.polish_tolerance)
    graph, values = build_graph(keyframes, views, config, priors, thin, robust_px, mounts)
    before = graph.error(values)
    result, after, iterations = minimise(graph, values, before, config)
    take_solution(result, keyframes, views, config)
    solve = PolishSolve(before, after, iterations)
    logger.debug("polish: %.1f -> %.1f in %d iterations", *vars(solve).values())
    return solve


def take_solution(
    solution: gtsam.Values, keyframes: list[Keyframe], views: tuple[View, ...], config: TrackingConfig
) -> None:
    """Write a solution into ``keyframes``, and solve their depths at it."""
    for keyframe in keyframes:
        keyframe.wTc = solution.atPose3(X(*keyframe.frame)).matrix()
        keyframe.log_scale = solution.atDouble(S(*keyframe.frame))
    frames = {keyframe.frame: keyframe for keyframe in keyframes}
    for keyframe in keyframes:
        solve_depth(keyframe, frames, views, config)


def minimise(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, error: float, config: TrackingConfig
) -> tuple[gtsam.Values, float, int]:
    """Levenberg-Marquardt in short runs, each followed by a search further along the way it went.

    Re-weighting makes long valleys of a robust cost slow to follow; the search costs no linearisation.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    # multifrontal Cholesky calls compressed factors indeterminate where sequential solves them
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    parameters.setOrderingType("COLAMD")
    parameters.setMaxIterations(SHORT_RUN)
    parameters.setRelativeErrorTol(config.polish_tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setlambdaInitial(DAMPING)
    iterations = 0
    while iterations < config.polish_iterations:
        if values.size() > LARGE:
            reached, reached_error = descend(
                graph, values, error, DAMPING, SHORT_RUN, config.polish_tolerance
            )
        else:
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
            reached, reached_error = optimizer.optimize(), optimizer.error()
        iterations += SHORT_RUN
        way = values.localCoordinates(reached)
        reached, reached_error = _search_on(graph, reached, reached_error, way)
        converged = error - reached_error < config.polish_tolerance * error
        values, error = reached, reached_error
        if converged:
            break
    return values, error, iterations


def _search_on(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, error: float, way: gtsam.VectorValues
) -> tuple[gtsam.Values, float]:
    """Go on along ``way`` in doubling steps for as long as the error falls."""
    for _ in range(LONGEST_SEARCH):
        candidate = values.retract(way)
        candidate_error = graph.error(candidate)
        if not candidate_error < error:
            break
        values, error = candidate, candidate_error
        way = way.add(way)
    return values, error


def total_cost(keyframes: list[Keyframe], views: tuple[View, ...], config: TrackingConfig) -> float:
    """Robust cost of all flow at the current poses, with the window's wider loss."""
    graph, values = build_graph(
        keyframes, views, config, lambda _: [], thin=True, robust_px=config.window_robust_px
    )
    return float(graph.error(values))


def estimate_noise(keyframes: list[Keyframe], views: tuple[View, ...], config: TrackingConfig) -> None:
    """Set every keyframe's ``noise_ratio`` from the weighted median of its residuals at the current poses."""
    frames = {keyframe.frame: keyframe for keyframe in keyframes}
    for keyframe in keyframes:
        neighbours = [frame for frame in useful_neighbours(keyframe) if frame in frames]
        if not neighbours:
            continue
        view = views[keyframe.camera]
        intrinsics = np.stack([views[camera].intrinsics for camera, _ in neighbours])
        wTj = np.stack([frames[frame].wTc for frame in neighbours])
        seen = reproject(view.rays, keyframe.log_depth, keyframe.wTc, wTj, intrinsics)
        target = np.stack([keyframe.flows[frame].target for frame in neighbours])
        weight = np.stack([keyframe.flows[frame].weight for frame in neighbours])
        residual = np.linalg.norm(seen.pixels - target, axis=2)
        noise = config.noise_per_residual * _weighted_median(residual.ravel(), weight.ravel())
        keyframe.noise_ratio = float(np.clip(noise, config.noise_px, config.max_noise_px)) / config.noise_px


def _weighted_median(values: npt.NDArray[np.float64], weight: npt.NDArray[np.float32]) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weight[order], dtype=np.float64)
    return float(values[order[np.searchsorted(cumulative, 0.5 * cumulative[-1])]])


def build_graph(
    keyframes: list[Keyframe],
    views: tuple[View, ...],
    config: TrackingConfig,
    priors: Priors,
    thin: bool = False,
    robust_px: float | None = None,
    mounts: Mounts = NO_MOUNTS,
    room: int = KEPT_BYTES,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """One structureless factor per keyframe over all it was measured against, the priors and the mounts.

    Measurements are kept within ``room`` bytes.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    members = {keyframe.frame for keyframe in keyframes}
    for keyframe in keyframes:
        values.insert(X(*keyframe.frame), gtsam.Pose3(keyframe.wTc))
        values.insert(S(*keyframe.frame), keyframe.log_scale)
        for prior in priors(keyframe):
            graph.add(prior)
        neighbours = [frame for frame in useful_neighbours(keyframe) if frame in members]
        if neighbours:
            snapshot = replace(keyframe, flows=dict(keyframe.flows))
            measure: Callable[[], StructurelessMeasurement] = partial(
                measurement_of,
                snapshot,
                neighbours,
                views,
                config,
                thin=thin,
                robust_px=robust_px,
                measured=True,
            )
            size = BYTES_PER_MEASUREMENT * len(neighbours) * len(keyframe.log_depth) // (2 if thin else 1)
            if size <= room:
                room -= size
                measure = cache(measure)
            graph.add(keyframe_factor(keyframe.frame, neighbours, {}, measure))
    add_mounts(graph, values, mounts, [(keyframe.frame, X(*keyframe.frame)) for keyframe in keyframes])
    return graph, values
