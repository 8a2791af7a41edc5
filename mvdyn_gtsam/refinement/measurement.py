"""What the refinement measures on images: swept depth of every frame, and dense flow of every pair."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import DenseFlow, Float32, FlowConfig, FlowPair
from mvdyn_gtsam.frontend.guided_flow import guided_weight, predicted_flow
from mvdyn_gtsam.frontend.plane_sweep import SweepConfig, SweepView, ladder_of, sweep, sweep_instant
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.neighbours import times_in_view
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView, pixels_seen
from mvdyn_gtsam.refinement.workspace import Workspace

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

CARRIED_STEPS = 3
"""Of the fixed point that finds a pixel of one frame in another one swept. Source: choice."""
MARGIN = 8
"""Pixels of the swept size around what moves that are swept with it: its outline in other cameras is that
unsure. Source: choice."""


def sweep_frame(
    workspace: Workspace, frame: Frame, group: Sequence[int], wTc: Array, config: SweepConfig
) -> Float32:
    """Inverse depth of a frame at the view's size, swept against its instant and other times.

    ``wTc (N, T, 4, 4)``. Reads ``grey``, ``tracked`` and ``tracked_confidence`` of the workspace.
    """
    own = DenseView.of(workspace.views[frame[0]].camera, config.scale)
    sources = _sources(workspace, frame, group, wTc, config)
    found = sweep(
        np.asarray(own.shrink(workspace.read("grey", frame)), np.uint8),
        own.intrinsics,
        [_sweep_view(workspace, frame, j, wTc, config) for j in sources],
        _ladder(workspace, [frame, *sources], config),
        np.asarray(own.shrink(workspace.read("tracked", frame)), np.float32),
        np.asarray(own.shrink(workspace.read("tracked_confidence", frame)), np.float32),
        config,
    )
    size = workspace.views[frame[0]].shape[::-1]
    return np.asarray(cv2.resize(found, size, interpolation=cv2.INTER_LINEAR), np.float32)


def carry_sweep(workspace: Workspace, frame: Frame, swept: Frame, wTc: Array) -> Float32:
    """Inverse depth of a frame at the view's size, from that of another frame of its camera that was
    ``swept``.

    Each pixel takes the depth of the pixel that sees its point there: a fixed point, since where that is
    depends on the depth. ``wTc (N, T, 4, 4)``. Reads ``swept`` of the workspace.
    """
    view = workspace.views[frame[0]]
    jTi = invert_pose(wTc[swept]) @ wTc[frame]
    there = np.asarray(workspace.read("swept", swept), np.float32)
    found = there.ravel()
    depth_of_rays = view.rays @ jTi[2, :3].astype(np.float32)
    for _ in range(CARRIED_STEPS):
        at, front = pixels_seen(found, view.rays, jTi, view.intrinsics)
        seen = cv2.remap(
            there, at.reshape(*view.shape, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        depth_ratio = depth_of_rays + np.float32(jTi[2, 3]) * found
        found = np.where(front, seen.ravel() * depth_ratio, found)
    return found.reshape(view.shape)


def sweep_moving(
    workspace: Workspace, frame: Frame, group: Sequence[int], wTc: Array, moves: Mask, config: SweepConfig
) -> Float32:
    """Inverse depth of a frame at the view's size: where it ``moves (h, w)``, and around, swept against the
    other views of its instant, elsewhere ``swept``.

    Reads ``grey``, ``tracked`` and ``swept`` of the workspace.
    """
    view = workspace.views[frame[0]]
    own = DenseView.of(view.camera, config.scale)
    sources = _sources(workspace, frame, group, wTc, config)
    views = [_sweep_view(workspace, frame, j, wTc, config) for j in sources if j[1] == frame[1]]
    there = np.asarray(cv2.resize(moves.astype(np.float32), own.shape[::-1], interpolation=cv2.INTER_AREA))
    rows, columns = (
        slice(max(0, int(at.min()) - MARGIN), int(at.max()) + MARGIN + 1) for at in np.nonzero(there)
    )
    intrinsics = own.intrinsics.copy()
    intrinsics[:2, 2] -= columns.start, rows.start
    grey = np.asarray(own.shrink(workspace.read("grey", frame)), np.uint8)[rows, columns]
    ladder = _ladder(workspace, [frame, *sources], config)
    found = np.array(own.shrink(workspace.read("swept", frame)), np.float32)
    found[rows, columns] = sweep_instant(np.ascontiguousarray(grey), intrinsics, views, ladder, config)
    return np.asarray(cv2.resize(found, view.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _sources(
    workspace: Workspace, frame: Frame, group: Sequence[int], wTc: Array, config: SweepConfig
) -> list[Frame]:
    """What a frame is swept against: the other cameras of its instant, and its camera at other times."""
    camera, time = frame
    times = times_in_view(workspace, frame, wTc, config.temporal_offsets, config.least_shared)
    return [(other, time) for other in group if other != camera] + [(camera, t) for t in times]


def _sweep_view(workspace: Workspace, frame: Frame, j: Frame, wTc: Array, config: SweepConfig) -> SweepView:
    view = DenseView.of(workspace.views[j[0]].camera, config.scale)
    return SweepView(
        grey=np.asarray(view.shrink(workspace.read("grey", j)), np.uint8),
        intrinsics=view.intrinsics,
        jTi=invert_pose(wTc[j]) @ wTc[frame],
        same_instant=j[1] == frame[1],
    )


def _ladder(workspace: Workspace, frames: Sequence[Frame], config: SweepConfig) -> Float32:
    """Inverse depths to try, by what tracking knows of ``frames``."""
    known = [np.asarray(workspace.read("tracked", j), np.float32)[::4, ::4].ravel() for j in frames]
    return ladder_of(np.concatenate(known), config.levels)


def measure_pair(
    workspace: Workspace,
    i: Frame,
    j: Frame,
    wTc: Array,
    flow: DenseFlow,
    flow_config: FlowConfig,
    config: RefinementConfig,
    guide: str,
) -> FlowPair:
    """Both directions between two frames: plain where one camera moved little, else guided by depth and
    poses.

    ``guide`` is the workspace's array of inverse depths. Unlike in tracking the guide's depth does not
    judge the result: it may be wrong where things move. Agreement of the two directions and likeness of the
    patches do.
    """
    grey_i, grey_j = (np.asarray(workspace.read("grey", frame), np.uint8) for frame in (i, j))
    jTi = invert_pose(wTc[j]) @ wTc[i]
    seed = _seed(workspace, i, j, jTi, guide)
    if i[0] == j[0] and _mean_length(seed) <= config.guided_px:
        pair = flow.measure(grey_i, grey_j)
    else:
        pair = flow.measure(grey_i, grey_j, seed, _seed(workspace, j, i, invert_pose(jTi), guide))
    # within a camera the flow of a plain wall is that of its surroundings: poor, but better than nothing
    least = config.plain_weight if i[0] == j[0] else 0.0
    unknown_i, unknown_j = (np.full(grey.shape, np.nan, np.float32) for grey in (grey_i, grey_j))
    alike_i = guided_weight(pair.forward, grey_i, grey_j, unknown_i, unknown_j, flow_config)
    alike_j = guided_weight(pair.backward, grey_j, grey_i, unknown_j, unknown_i, flow_config)
    return FlowPair(
        pair.forward,
        pair.backward,
        pair.forward_weight * np.maximum(alike_i, np.float32(least)),
        pair.backward_weight * np.maximum(alike_j, np.float32(least)),
    )


def _mean_length(flow: Float32) -> float:
    """Of ``flow (h, w, 2)`` px where it is known, none taken for longer than the image is wide."""
    x, y = flow[..., 0], flow[..., 1]
    # np.linalg.norm over the last axis takes ten times as long
    length = np.sqrt(x * x + y * y)
    return float(np.nanmean(np.minimum(length, np.float32(flow.shape[1]))))


def _seed(workspace: Workspace, i: Frame, j: Frame, jTi: Array, guide: str) -> Float32:
    view_i, view_j = workspace.views[i[0]], workspace.views[j[0]]
    depth = 1.0 / view_i.grow(np.asarray(workspace.read(guide, i), np.float32))
    shape_j = (view_j.camera.height, view_j.camera.width)
    return predicted_flow(depth, view_i.camera.intrinsics, view_j.camera.intrinsics, jTi, shape_j)
