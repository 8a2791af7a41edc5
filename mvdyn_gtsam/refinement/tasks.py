"""The refinement's work on single frames, pairs and windows: what the processes run.

Each task reads the workspace and writes its own part of it, so that the result does not depend on how many
processes there are, nor on their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.connections import Pair
from mvdyn_gtsam.refinement.context import LABELS, MOVING, STATIC, UNEXPLAINED, Context
from mvdyn_gtsam.refinement.depth import DepthPrior, FrameProblem, solve_frame
from mvdyn_gtsam.refinement.edges import SURE_WEIGHT, Edge, flow_targets, load_edges
from mvdyn_gtsam.refinement.growth import growth_task
from mvdyn_gtsam.refinement.initial import (
    best_candidate,
    failing_regions,
    most_telling,
    static_residual,
)
from mvdyn_gtsam.refinement.lattice import neighbour_likeness
from mvdyn_gtsam.refinement.measurement import carry_sweep, measure_pair, sweep_frame, sweep_moving
from mvdyn_gtsam.refinement.motion import (
    carry_task,
    free_space_task,
    moving_depth_task,
    observe_task,
    settle_task,
)
from mvdyn_gtsam.refinement.moving_shape import fit_task, shape_task
from mvdyn_gtsam.refinement.other_times import FirstDepth, told_by_other_times
from mvdyn_gtsam.refinement.planes import (
    PlainRegion,
    fill_plain,
    plain_regions,
    planes_in_world,
    rim_planes,
    surfaces,
)
from mvdyn_gtsam.refinement.relief import relief_task
from mvdyn_gtsam.refinement.samples import FrameSample

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAMPLE_SPACING = 16
"""Distance of the pixels that phase 1 and the poses see, px of the input."""
CHECK_SPACING = 8
"""Distance of the pixels that choose edges and whose residuals are compared, px of the input."""
FIRST_STEPS = 2
"""Gauss-Newton steps before it is asked what moves."""
GUIDE_STEPS = 2
"""Gauss-Newton steps of the depth that guides the flow between cameras; that flow improves it later."""

FIRST_DEPTH = "depth 0"
"""The array of the first depth solve, from flow within cameras; it guides the flow between them."""

AXES = "axes"
"""The list ``(N, 4)`` of the directions of all scenes: the first camera of its group, and unit vectors in its
world."""
PLANES = "planes"
"""The list ``(N, 7)`` of all planes of plain regions: camera, time, and ``planes_in_world``."""


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


def surfaces_task(context: Context, job: tuple[str, Frame]) -> Array:
    """Unit normals in the world and shares ``(N, 4)`` of a frame's largest well seen surfaces: ``(read from,
    frame)``."""
    name, frame = job
    trust = _still_trust(context, frame)
    rays, config = context.workspace.views[frame[0]].rays, context.config.plain
    found = surfaces(np.log(context.image(name, frame)), trust, rays, config, seed=frame)
    normals = found[:, :3] / np.linalg.norm(found[:, :3], axis=1, keepdims=True)
    return np.column_stack([normals @ context.poses()[frame][:3, :3].T, found[:, 3]])


def planes_task(context: Context, job: tuple[str, Frame]) -> Array:
    """Planes ``(N, 5)`` in the world that the rims of a frame's plain regions fit: ``(read from, frame)``."""
    name, frame = job
    found, _ = _plain_regions(context, name, frame)
    axes, config = _axes_seen(context, frame), context.config.plain
    rims = [rim_planes(region, axes, config, seed=(*frame, number)) for number, region in enumerate(found)]
    return planes_in_world(rims, context.poses()[frame])


def fill_task(context: Context, job: tuple[str, str, Frame]) -> None:
    """Give a frame's plain regions the planes that the frames around agree on: ``(read from, write to,
    frame)``."""
    source, target, frame = job
    found, trust = _plain_regions(context, source, frame)
    bank = context.workspace.read_array(PLANES)
    near = np.abs(bank[:, 1] - frame[1]) <= context.config.plain.window
    near &= np.isin(bank[:, 0], context.group_of(frame[0]))
    theta = fill_plain(
        np.log(context.image(source, frame)),
        trust,
        found,
        bank[near],
        context.poses()[frame],
        _axes_seen(context, frame),
        context.config.plain,
    )
    context.workspace.write(target, frame, np.exp(theta))


def _plain_regions(context: Context, name: str, frame: Frame) -> tuple[list[PlainRegion], Float32]:
    """Plain regions of a frame, and the trust ``(h, w)`` in its depth; nothing of what moves is trusted."""
    view, trust = context.workspace.views[frame[0]], _still_trust(context, frame)
    moves = np.asarray(context.workspace.read("moving", frame)) != STATIC
    theta, colour = np.log(context.image(name, frame)), context.colour(frame)
    return plain_regions(colour, theta, trust, moves, view.rays, context.config.plain, seed=frame), trust


def _still_trust(context: Context, frame: Frame) -> Float32:
    """Trust ``(h, w)`` in a frame's depth, none in that of what moves and around it."""
    trust = context.trust(frame)
    moves = (np.asarray(context.workspace.read("moving", frame)) != STATIC).astype(np.uint8)
    trust[cv2.dilate(moves, np.ones((5, 5), np.uint8)) > 0] = 0.0
    return trust


def _axes_seen(context: Context, frame: Frame) -> Array:
    """Directions ``(K, 3)`` of the scene in the axes of a frame's camera."""
    axes = context.workspace.read_array(AXES)
    own = axes[np.isin(axes[:, 0], context.group_of(frame[0]))]
    return np.asarray(own[:, 1:] @ context.poses()[frame][:3, :3])


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


@dataclass(frozen=True)
class FinishedFrame:
    """A frame at the input resolution."""

    frame: Frame
    depth: Float32
    """``(H, W)``"""
    confidence: Float32
    """``(H, W)`` in [0, 1]"""
    moving: npt.NDArray[np.uint8]
    """``(H, W)`` 255 where it moves: the static model fails and the views of the instant agree on a depth;
    128 where it fails and they do not."""
    before_px: dict[int, float]
    """Median residual of the flow to each camera with the tracked depth and poses; no entry without flow."""
    after_px: dict[int, float]
    """The same with those of the refinement."""


def finish_task(context: Context, job: tuple[str, Frame]) -> FinishedFrame:
    """Depth, confidence and motion mask of a frame from the array named first."""
    name, frame = job
    view = context.workspace.views[frame[0]]
    # as in tracking: confidence falls to a half at 5 % error
    confidence = context.trust(frame)
    moving = np.asarray(context.workspace.read("moving", frame))
    confidence[moving == MOVING] = np.maximum(confidence, 0.5)[moving == MOVING]
    confidence[moving == UNEXPLAINED] = 0.0
    grey = np.asarray(context.workspace.read("grey", frame), np.uint8)
    size = (view.camera.width, view.camera.height)
    mask = np.array([0, 255, 128], np.uint8)[moving]
    inverse_depth = context.image(name, frame)
    checked = context.raster(frame, CHECK_SPACING)
    edges = context.edges(frame, context.poses(), own_camera=False, among=checked)
    tracked_wTc = context.workspace.read_array("tracked_poses")
    before = context.edges(frame, tracked_wTc, own_camera=False, among=checked)
    return FinishedFrame(
        frame=frame,
        depth=1.0 / upsample(inverse_depth, grey, context.config.edge_contrast),
        confidence=view.grow(confidence),
        moving=np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)),
        before_px=_median_residuals(before, context.image("tracked", frame)),
        after_px=_median_residuals(edges, inverse_depth),
    )


def _median_residuals(edges: Sequence[Edge], inverse_depth: Float32) -> dict[int, float]:
    """By camera that the edges lead to."""
    residuals: dict[int, list[Float32]] = {}
    for edge in edges:
        sure = edge.weight >= SURE_WEIGHT
        terms = edge.terms(inverse_depth.ravel()[edge.pixels])
        residual = terms.residual[sure & terms.valid]
        residuals.setdefault(edge.j[0], []).append(np.hypot(residual[:, 0], residual[:, 1]))
    return {
        camera: float(np.median(np.concatenate(values)))
        for camera, values in residuals.items()
        if sum(map(len, values)) > 0
    }


def upsample(inverse_depth: Float32, grey: npt.NDArray[np.uint8], contrast: float) -> Float32:
    """``(H, W)`` of ``(h, w)``: a pixel takes the four around it by nearness and likeness of luminance.

    Joint bilateral upsampling (https://dl.acm.org/doi/10.1145/1276377.1276497) of log depth.
    """
    height, width = grey.shape
    if inverse_depth.shape == grey.shape:
        return inverse_depth
    luminance = cv2.GaussianBlur(grey, (0, 0), 0.7).astype(np.float32)
    small = cv2.resize(luminance, inverse_depth.shape[::-1], interpolation=cv2.INTER_AREA)
    theta = np.log(inverse_depth)
    rows = (np.arange(height, dtype=np.float32) + 0.5) * inverse_depth.shape[0] / height - 0.5
    cols = (np.arange(width, dtype=np.float32) + 0.5) * inverse_depth.shape[1] / width - 0.5
    total, value = np.zeros_like(luminance), np.zeros_like(luminance)
    top, left = np.floor(rows), np.floor(cols)
    for row, near_row in ((top, 1.0 - (rows - top)), (top + 1, rows - top)):
        for col, near_col in ((left, 1.0 - (cols - left)), (left + 1, cols - left)):
            y = np.clip(row, 0, inverse_depth.shape[0] - 1).astype(int)
            x = np.clip(col, 0, inverse_depth.shape[1] - 1).astype(int)
            unlike = (luminance - small[y[:, None], x]) / np.float32(contrast)
            share = (near_row[:, None] * near_col) * (np.exp(-(unlike**2)) + np.float32(1e-3))
            total += share
            value += share * theta[y[:, None], x]
    return np.exp(value / total).astype(np.float32)


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
