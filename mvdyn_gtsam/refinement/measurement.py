"""What the refinement measures on images: swept depth of every frame, and dense flow of every pair."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import DenseFlow, Float32, FlowConfig, FlowPair
from mvdyn_gtsam.frontend.guided_flow import guided_weight, predicted_flow
from mvdyn_gtsam.frontend.plane_sweep import SweepConfig, SweepView, SweptDepth, ladder_of, sweep
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.neighbours import times_in_view
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

Array = npt.NDArray[np.float64]


def sweep_frame(
    workspace: Workspace, frame: Frame, group: Sequence[int], wTc: Array, config: SweepConfig
) -> SweptDepth:
    """A frame at the view's size, swept against its instant and other times.

    ``wTc (N, T, 4, 4)``. Reads ``grey``, ``tracked`` and ``tracked_confidence`` of the workspace.
    """
    camera, time = frame
    views = [DenseView.of(view.camera, config.scale) for view in workspace.views]
    own = views[camera]
    sources = [(other, time) for other in group if other != camera]
    sources += [
        (camera, t)
        for t in times_in_view(workspace, frame, wTc, config.temporal_offsets, config.least_shared)
    ]
    others = [
        SweepView(
            grey=np.asarray(views[j[0]].shrink(workspace.read("grey", j)), np.uint8),
            intrinsics=views[j[0]].intrinsics,
            jTi=invert_pose(wTc[j]) @ wTc[frame],
            same_instant=j[1] == time,
        )
        for j in sources
    ]
    tracked = np.asarray(workspace.read("tracked", frame), np.float32)
    known = np.concatenate([tracked[::4, ::4].ravel(), *(_samples(workspace, j) for j in sources)])
    found = sweep(
        np.asarray(own.shrink(workspace.read("grey", frame)), np.uint8),
        own.intrinsics,
        others,
        ladder_of(known, config.levels),
        np.asarray(own.shrink(tracked), np.float32),
        np.asarray(own.shrink(workspace.read("tracked_confidence", frame)), np.float32),
        config,
    )
    size = workspace.views[camera].shape[::-1]
    grown = [
        np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.float32)
        for image in (found.inverse_depth, found.instant)
    ]
    return SweptDepth(*grown)


def _samples(workspace: Workspace, frame: Frame) -> Float32:
    return np.asarray(workspace.read("tracked", frame), np.float32)[::4, ::4].ravel()


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
