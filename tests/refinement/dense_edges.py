"""Edges of small views of the analytic scene, with exact flow, and the true depth that they lead to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.geometry import invert_pose, project, transform_points
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.edges import Edge
from mvdyn_gtsam.refinement.views import DenseView
from tests.refinement.scenes import FOCAL, HEIGHT, INTRINSICS, WIDTH, Scene

Float32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


def small_view(stride: int) -> DenseView:
    """Of the scene's cameras, all alike."""
    camera = Camera("c", WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    return DenseView.of(camera, 1.0 / stride)


def full_pixels(view: DenseView) -> npt.NDArray[np.float64]:
    """Where the view's pixels ``(h * w, 2)`` lie in the input."""
    y, x = np.mgrid[: view.shape[0], : view.shape[1]]
    scale = [WIDTH / view.shape[1], HEIGHT / view.shape[0]]
    return (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * scale - 0.5


def true_theta(scene: Scene, frame: Frame, view: DenseView) -> Float32:
    """``(h, w)`` log inverse depth."""
    return -np.log(scene.depth(frame, full_pixels(view))).reshape(view.shape).astype(np.float32)


def true_edge(scene: Scene, i: Frame, j: Frame, view: DenseView) -> Edge:
    """Flow of all pixels that frame j sees, none of them hidden."""
    pixels = full_pixels(view)
    rays, depth = view.rays.astype(np.float64), scene.depth(i, pixels)
    jTi = invert_pose(scene.wTc[j]) @ scene.wTc[i]
    target, expected = project(transform_points(jTi, rays * depth[:, None]), INTRINSICS)
    inside = np.all((target >= 0.0) & (target <= [WIDTH - 1, HEIGHT - 1]), axis=1)
    target = np.where(inside[:, None], target, 0.0)
    seen = np.flatnonzero(inside & (np.abs(scene.depth(j, target) / expected - 1.0) < 1e-6))
    scale = [view.shape[1] / WIDTH, view.shape[0] / HEIGHT]
    col, row = np.rint((target[seen] + 0.5) * scale - 0.5).astype(np.int64).T
    within = (col >= 0) & (row >= 0) & (col < view.shape[1]) & (row < view.shape[0])
    return Edge(
        i=i,
        j=j,
        pixels=seen,
        rays=view.rays[seen],
        target=target[seen].astype(np.float32),
        weight=np.ones(len(seen), np.float32),
        nearest=np.where(within, row * view.shape[1] + col, -1),
        jTi=jTi,
        intrinsics_j=INTRINSICS,
    )


def true_edges(scene: Scene, i: Frame, view: DenseView, offsets: Sequence[int] = (1, 2)) -> list[Edge]:
    """To all neighbours of a frame."""
    return [true_edge(scene, i, j, view) for j in scene.pairs(offsets)[i]]


def with_wrong_flow(edges: Sequence[Edge], share: float, seed: int = 0) -> list[Edge]:
    """Flow to anywhere for a share of the pixels of each edge."""
    rng = np.random.default_rng(seed)
    changed = []
    for edge in edges:
        wrong = rng.random(len(edge.pixels)) < share
        anywhere = rng.uniform(0.0, [WIDTH, HEIGHT], edge.target.shape).astype(np.float32)
        changed.append(replace(edge, target=np.where(wrong[:, None], anywhere, edge.target)))
    return changed


def with_motion(edges: Sequence[Edge], moves: Mask, px_per_frame: Sequence[float]) -> list[Edge]:
    """The pixels ``moves (h, w)`` move over the image besides: seen at all other times, not at their own."""
    changed = []
    for edge in edges:
        shift = np.array(px_per_frame, np.float32) * np.float32(edge.j[1] - edge.i[1])
        changed.append(replace(edge, target=edge.target + shift * moves.ravel()[edge.pixels, None]))
    return changed


def in_double(edge: Edge) -> Edge:
    """The edge in double precision, for finite differences."""
    wide: dict[str, Any] = {
        name: getattr(edge, name).astype(np.float64) for name in ("rays", "target", "weight")
    }
    return replace(edge, **wide)
