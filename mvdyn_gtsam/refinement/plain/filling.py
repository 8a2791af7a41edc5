"""Plain regions filled: planes of their rims, agreed between frames."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import STATIC, Context
from mvdyn_gtsam.refinement.plain.planes import (
    PlainRegion,
    fill_plain,
    plain_regions,
    planes_in_world,
    rim_planes,
    surfaces,
)

Array = npt.NDArray[np.float64]

AXES = "axes"
"""The list ``(N, 4)`` of the directions of all scenes: the first camera of its group, and unit vectors in its
world."""
PLANES = "planes"
"""The list ``(N, 7)`` of all planes of plain regions: camera, time, and ``planes_in_world``."""


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
