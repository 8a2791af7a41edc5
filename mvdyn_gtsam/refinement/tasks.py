"""The refinement's work on single frames, pairs and windows: what the processes run.

Each task reads the workspace and writes its own part of it, so that the result does not depend on how many
processes there are, nor on their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.connections import Pair
from mvdyn_gtsam.refinement.context import CHECK_SPACING, LABELS, STATIC, Context
from mvdyn_gtsam.refinement.edges import Edge, flow_targets, load_edges
from mvdyn_gtsam.refinement.finish import finish_task
from mvdyn_gtsam.refinement.initial import (
    best_candidate,
    failing_regions,
    most_telling,
    static_residual,
)
from mvdyn_gtsam.refinement.measurement import carry_sweep, measure_pair, sweep_frame, sweep_moving
from mvdyn_gtsam.refinement.moving.growth import growth_task
from mvdyn_gtsam.refinement.moving.motion import (
    carry_task,
    free_space_task,
    moving_depth_task,
    observe_task,
    settle_task,
)
from mvdyn_gtsam.refinement.moving.relief import relief_task
from mvdyn_gtsam.refinement.moving.shape import fit_task, shape_task
from mvdyn_gtsam.refinement.other_times import FirstDepth, told_by_other_times
from mvdyn_gtsam.refinement.plain.filling import fill_task, planes_task, surfaces_task
from mvdyn_gtsam.refinement.solve.depth import DepthPrior, FrameProblem, solve_frame
from mvdyn_gtsam.refinement.solve.lattice import neighbour_likeness
from mvdyn_gtsam.refinement.solve.samples import FrameSample

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAMPLE_SPACING = 16
"""Distance of the pixels that phase 1 and the poses see, px of the input."""
FIRST_STEPS = 2
"""Gauss-Newton steps before it is asked what moves."""
GUIDE_STEPS = 2
"""Gauss-Newton steps of the depth that guides the flow between cameras; that flow improves it later."""

FIRST_DEPTH = "depth 0"
"""The array of the first depth solve, from flow within cameras; it guides the flow between them."""


def sweep_task(context: Context, frame: Frame) -> None:
    """Depth of a frame by plane sweep, as if nothing moved."""
    group = context.group_of(frame[0])
    swept = sweep_frame(context.workspace, frame, group, context.poses(), context.config.sweep)
    context.workspace.write("swept", frame, swept)


def carry_sweep_task(context: Context, job: tuple[Frame, Frame]) -> None:
    """Depth of a frame from that of another frame of its camera that was swept: ``(frame, swept)``."""
    frame, swept = job
    context.workspace.write("swept", frame, carry_sweep(context.workspace, frame, swept, context.poses()))


def instant_task(context: Context, frame: Frame) -> None:
    """Depth of what moves in a frame by plane sweep against the other cameras of its instant."""
    group, moves = context.group_of(frame[0]), np.asarray(context.workspace.read(LABELS, frame)) > 0
    swept = context.image("swept", frame)
    if moves.any() and len(group) > 1:
        swept = sweep_moving(context.workspace, frame, group, context.poses(), moves, context.config.sweep)
    context.workspace.write("instant", frame, swept)


def temporal_flow_task(context: Context, pair: Pair) -> None:
    """Flow within a camera, guided by the tracked depth where it is long."""
    _measure(context, pair, "tracked")


def wide_flow_task(context: Context, pair: Pair) -> None:
    """Flow between cameras, guided by the depth solved so far."""
    _measure(context, pair, FIRST_DEPTH)


def _measure(context: Context, pair: Pair, guide: str) -> None:
    i, j = pair
    if context.workspace.has_flow(i, j):
        return
    config = context.config
    measured = measure_pair(
        context.workspace, i, j, context.poses(), context.flow, context.flow_config, config, guide
    )
    context.workspace.write_flow(i, j, measured)


def begin_task(context: Context, frame: Frame) -> None:
    """First depth of a frame as if nothing moved, where that fails, and where flow leads in the frames
    around."""
    workspace, config = context.workspace, context.config
    edges = context.edges(frame, context.poses(), own_camera=True)
    weights = _image_weights(context, frame)
    chosen = best_candidate([context.image("aligned", frame), context.image("swept", frame)], edges, config)
    weak = DepthPrior(np.log(chosen), np.full(chosen.shape, config.prior_sigma**-2, np.float32))
    # of all edges: how far they settle the depth decides what moves
    theta, information = solve_frame(
        np.log(chosen), FrameProblem(edges, {}, weights, weak, config), FIRST_STEPS
    )
    fails = failing_regions(static_residual(np.exp(theta), edges), config)
    reach = max(config.temporal_offsets, default=0)
    near = [edge for edge in edges if abs(edge.j[1] - frame[1]) <= reach]
    context.keep_flow_targets(frame, flow_targets(near, theta.size))
    first = FirstDepth(theta, information, fails, np.zeros_like(fails))
    first = told_by_other_times(context, frame, first)
    workspace.write("first", frame, first.theta)
    workspace.write("information", frame, first.information)
    workspace.write("fails", frame, first.fails)
    workspace.write("held", frame, first.held)


def window_task(context: Context, window: tuple[str, str, int, int, int]) -> None:
    """Depth of all cameras between two times: ``(read from, write to, first, end, steps)``, arrays, times and
    Gauss-Newton steps.

    Frames up to ``overlap`` steps outside are solved too, so that the window's ends see renewed neighbours,
    but are not kept: another window does.
    """
    source, target, first, end, steps = window
    workspace, config = context.workspace, context.config
    wTc = context.poses()
    times = range(max(0, first - config.overlap), min(workspace.frame_count, end + config.overlap))
    renewed: dict[Frame, Float32] = {}
    for group in context.groups:
        for frame in ((camera, time) for time in times for camera in group):
            moves = workspace.read("moving", frame) != STATIC
            sparse = context.edges(frame, wTc, own_camera=False, among=context.raster(frame, CHECK_SPACING))
            telling = most_telling(sparse, context.image(source, frame), config.edges_per_frame)
            edges = _edges_of(context, frame, [edge.j for edge in telling], moves, wTc)
            others = {
                edge.j: renewed[edge.j] if edge.j in renewed else np.log(context.image(source, edge.j))
                for edge in edges
            }
            prior = DepthPrior(context.image("prior", frame), context.image("prior_weight", frame))
            theta, weights = np.log(context.image(source, frame)), _image_weights(context, frame)
            theta, information = solve_frame(
                theta, FrameProblem(edges, others, weights, prior, config), steps
            )
            renewed[frame] = theta
            if first <= frame[1] < end:
                workspace.write(target, frame, np.exp(theta))
                workspace.write("information", frame, information)


def _edges_of(
    context: Context, frame: Frame, neighbours: Sequence[Frame], moves: Mask, wTc: Array
) -> list[Edge]:
    """Edges of a frame to some neighbours, to other instants without the pixels ``(h, w)`` that move."""
    still = np.flatnonzero(~moves) if moves.any() else None
    return [
        edge
        for j in neighbours
        for edge in load_edges(context.workspace, frame, [j], wTc, None if j[1] == frame[1] else still)
    ]


def sample_task(context: Context, job: tuple[str, Frame]) -> FrameSample:
    """A frame's pixels on a coarse raster, with depth of the array named first and flow to all neighbours."""
    depth_name, frame = job
    workspace, wTc = context.workspace, context.poses()
    view, pixels = workspace.views[frame[0]], context.raster(frame, SAMPLE_SPACING)
    moves = (workspace.read("moving", frame) != STATIC).ravel()
    edges = context.edges(frame, wTc, own_camera=False, among=pixels)
    count = len(edges)
    target = np.zeros((count, len(pixels), 2))
    weight = np.zeros((count, len(pixels)))
    there = np.full((count, len(pixels)), np.nan)
    for k, edge in enumerate(edges):
        if not edge.same_instant:
            edge = edge.without(moves)
        rows = np.searchsorted(pixels, edge.pixels)
        target[k, rows] = edge.target
        weight[k, rows] = edge.weight
        seen = edge.nearest >= 0
        there[k, rows[seen]] = context.image(depth_name, edge.j).ravel()[edge.nearest[seen]]
    return FrameSample(
        i=frame,
        neighbours=tuple(edge.j for edge in edges),
        rays=view.rays[pixels].astype(np.float64),
        inverse_depth=context.image(depth_name, frame).ravel()[pixels].astype(np.float64),
        intrinsics=np.array([edge.intrinsics_j for edge in edges]).reshape(count, 3, 3),
        target=target,
        weight=weight,
        inverse_depth_there=there,
    )


def _image_weights(context: Context, frame: Frame) -> tuple[Float32, Float32]:
    return neighbour_likeness(context.colour(frame), context.config.edge_contrast)


def run_task(context: Context, task: str, job: object) -> object:
    """One task by name: functions travel to other processes as names."""
    return TASKS[task](context, job)  # type: ignore[operator]


TASKS = {
    "sweep": sweep_task,
    "carry sweep": carry_sweep_task,
    "temporal flow": temporal_flow_task,
    "wide flow": wide_flow_task,
    "begin": begin_task,
    "free space": free_space_task,
    "carry": carry_task,
    "settle": settle_task,
    "instant": instant_task,
    "observe": observe_task,
    "growth": growth_task,
    "moving depth": moving_depth_task,
    "fit": fit_task,
    "shape": shape_task,
    "relief": relief_task,
    "window": window_task,
    "surfaces": surfaces_task,
    "planes": planes_task,
    "plain regions": fill_task,
    "sample": sample_task,
    "finish": finish_task,
}


def windows(
    source: str, target: str, frame_count: int, length: int, steps: int
) -> Sequence[tuple[str, str, int, int, int]]:
    """Jobs of ``window_task`` that cover all times, of ``length`` or a little less: all alike, so that no
    process waits for the last."""
    bounds = np.linspace(0, frame_count, -(-frame_count // length) + 1).round().astype(int).tolist()
    return [(source, target, first, end, steps) for first, end in pairwise(bounds)]
