"""Time per scalar residual of our flow factors against GTSAM's own C++ projection factor.

Every row of the table linearises the same number of pixel measurements: E x N of them, two scalars each.
GTSAM's ``GenericProjectionFactorCal3_S2`` has one factor a pixel over a pose and a landmark; ours have one
factor a keyframe. The structureless factor also solves and eliminates its N depths, so the native rows are
given with and without the elimination of the landmarks.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from factors.flow import FlowMeasurement, flow_factor
from factors.keys import S, X
from factors.projection import reproject
from factors.structureless import StructurelessMeasurement, structureless_flow_factor

Array = npt.NDArray[np.float64]

INTRINSICS = np.array([400.0, 400.0, 255.5, 191.5])
RUNS_PER_BLOCK = 5


@dataclass(frozen=True)
class Problem:
    """Grid points of one keyframe and noisy flow to its neighbours."""

    rays: Array
    """``(N, 3)``"""
    log_depth: Array
    """``(N,)``"""
    poses: list[gtsam.Pose3]
    """wTi, then the E poses wTj."""
    target: Array
    """``(E, N, 2)``"""

    @property
    def values(self) -> gtsam.Values:
        values = gtsam.Values()
        for time_index, pose in enumerate(self.poses):
            values.insert(X(0, time_index), pose)
        values.insert(S(0, 0), 0.0)
        return values


@dataclass(frozen=True)
class Timing:
    name: str
    scalars: int
    median_s: float
    fastest_s: float


def make_problem(points: int, edges: int, seed: int) -> Problem:
    """Random points 2 to 6 units away, cameras 0.3 units apart, 0.5 px noise and a tenth of outliers."""
    rng = np.random.default_rng(seed)
    rays = np.column_stack(
        [rng.uniform(-0.6, 0.6, points), rng.uniform(-0.45, 0.45, points), np.ones(points)]
    )
    log_depth = np.log(rng.uniform(2.0, 6.0, points))
    wTi = gtsam.Pose3.Expmap(rng.normal(size=6) * 0.3)
    steps = np.column_stack([rng.normal(size=(edges, 3)) * 0.03, rng.normal(size=(edges, 3)) * 0.2])
    wTj = [wTi.compose(gtsam.Pose3.Expmap(step)) for step in steps]
    poses_j = np.stack([pose.matrix() for pose in wTj])
    target = reproject(rays, log_depth, wTi.matrix(), poses_j, np.tile(INTRINSICS, (edges, 1))).pixels
    target = target + 0.5 * rng.normal(size=target.shape)
    target[rng.random(target.shape[:2]) < 0.1] += 10.0
    return Problem(rays, log_depth, [wTi, *wTj], target)


def native_graph(problem: Problem, robust: bool) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """One ``GenericProjectionFactorCal3_S2`` per measurement, landmarks as variables ``l0, l1, ...``."""
    graph, values = gtsam.NonlinearFactorGraph(), problem.values
    w_points = problem.poses[0].transformFrom((problem.rays * np.exp(problem.log_depth)[:, None]).T).T
    for k, point in enumerate(w_points):
        values.insert(gtsam.symbol("l", k), point)
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Unit.Create(2)
    if robust:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), noise)
    calibration = gtsam.Cal3_S2(INTRINSICS[0], INTRINSICS[1], 0.0, INTRINSICS[2], INTRINSICS[3])
    for edge, targets in enumerate(problem.target):
        for k, target in enumerate(targets):
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(
                    target, noise, X(0, edge + 1), gtsam.symbol("l", k), calibration
                )
            )
    return graph, values


def pairwise_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """One pairwise flow factor per edge."""
    graph = gtsam.NonlinearFactorGraph()
    for edge, target in enumerate(problem.target):
        measurement = FlowMeasurement(
            problem.rays, problem.log_depth, INTRINSICS, target, np.ones(len(problem.rays))
        )
        graph.add(flow_factor(measurement, X(0, 0), X(0, edge + 1), S(0, 0)))
    return graph


def structureless_graph(problem: Problem, seed: int) -> gtsam.NonlinearFactorGraph:
    """One structureless factor; the log depths start 10 % off."""
    edges, points = problem.target.shape[:2]
    offset = 0.1 * np.random.default_rng(seed).normal(size=points)
    measurement = StructurelessMeasurement(
        rays=problem.rays,
        initial_log_depth=problem.log_depth + offset,
        prior_log_depth=problem.log_depth,
        prior_sigma=np.full(points, 0.3),
        intrinsics_j=np.tile(INTRINSICS, (edges, 1)),
        target=problem.target,
        weight=np.ones((edges, points)),
    )
    graph = gtsam.NonlinearFactorGraph()
    graph.add(structureless_flow_factor(measurement, X(0, 0), [X(0, e + 1) for e in range(edges)], S(0, 0)))
    return graph


def landmark_ordering(points: int) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for k in range(points):
        ordering.push_back(gtsam.symbol("l", k))
    return ordering


def measure(work: dict[str, Callable[[], object]], scalars: int, repeats: int) -> list[Timing]:
    """Median and fastest of ``repeats`` runs, in alternating blocks so that a busy moment hits every row
    alike.

    The first run of a block only warms the caches: factors of one kind follow each other in a real graph.
    """
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(math.ceil(repeats / RUNS_PER_BLOCK)):
        for name, call in work.items():
            call()
            for _ in range(RUNS_PER_BLOCK):
                start = time.perf_counter()
                call()
                seconds[name].append(time.perf_counter() - start)
    return [Timing(name, scalars, float(np.median(s)), min(s)) for name, s in seconds.items()]


def run(points: int, edges: int, repeats: int, seed: int) -> list[Timing]:
    """All rows of the table."""
    problem = make_problem(points, edges, seed)
    values, ordering = problem.values, landmark_ordering(points)
    native, native_values = native_graph(problem, robust=False)
    robust, _ = native_graph(problem, robust=True)
    pairwise, structureless = pairwise_graph(problem), structureless_graph(problem, seed)
    work: dict[str, Callable[[], object]] = {
        "GTSAM GenericProjectionFactor": lambda: native.linearize(native_values),
        "GTSAM GenericProjectionFactor, Cauchy": lambda: robust.linearize(native_values),
        "GTSAM GenericProjectionFactor, Cauchy, landmarks eliminated": lambda: robust.linearize(
            native_values
        ).eliminatePartialSequential(ordering),
        "pairwise flow factor, Cauchy": lambda: pairwise.linearize(values),
        "structureless flow factor, Cauchy, depths solved and eliminated": lambda: structureless.linearize(
            values
        ),
        "structureless flow factor, Cauchy, error only": lambda: structureless.error(values),
    }
    return measure(work, 2 * points * edges, repeats)


def markdown_table(timings: list[Timing], points: int, edges: int) -> str:
    """The rows as a Markdown table. Cost per scalar and ratio are of the fastest run: the rest is other
    load."""
    lines = [
        f"N = {points} points, E = {edges} edges, {timings[0].scalars} scalar residuals",
        "",
        "| factor | median ms | fastest ms | ns per scalar | against GTSAM |",
        "|---|---:|---:|---:|---:|",
    ]
    for row in timings:
        per_scalar = row.fastest_s / row.scalars * 1e9
        ratio = row.fastest_s / timings[0].fastest_s
        milliseconds = f"{row.median_s * 1e3:.2f} | {row.fastest_s * 1e3:.2f}"
        lines.append(f"| {row.name} | {milliseconds} | {per_scalar:.0f} | {ratio:.2f} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Time, print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=768, help="grid points per keyframe (default: 768)")
    parser.add_argument(
        "--edges", type=int, nargs="+", default=[4, 8, 14], help="edges per keyframe (default: 4 8 14)"
    )
    parser.add_argument("--repeats", type=int, default=50, help="timed runs of each row (default: 50)")
    parser.add_argument("--seed", type=int, default=0, help="of the random scene (default: 0)")
    parser.add_argument("--quick", action="store_true", help="a few points and runs: whether it works at all")
    options = parser.parse_args(arguments)
    if options.quick:
        options.points, options.edges, options.repeats = 48, [2], RUNS_PER_BLOCK
    if min(options.points, options.repeats, *options.edges) < 1:
        parser.error("--points, --edges and --repeats must be at least 1")
    for edges in options.edges:
        timings = run(options.points, edges, options.repeats, options.seed)
        sys.stdout.write(markdown_table(timings, options.points, edges) + "\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
