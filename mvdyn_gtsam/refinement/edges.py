"""Flow as the solves use it: where it is trusted, in pixels of the input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32, pixel_raster
from mvdyn_gtsam.geometry import invert_pose
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.connections import is_first
from mvdyn_gtsam.refinement.solve.residuals import FlowTerms, turned_flow_terms, turned_rays
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

Array = npt.NDArray[np.float64]

LEAST_WEIGHT = 0.02
"""Flow trusted less is left out: it would cost as much time as any."""
SURE_WEIGHT = 0.2
"""Weight of flow that may say that something moves: on plain walls flow errs."""


@dataclass(frozen=True)
class Edge:
    """Flow of one frame to another at the ``M`` pixels where it is trusted."""

    i: Frame
    j: Frame
    pixels: npt.NDArray[np.int64]
    """``(M,)`` flat indices in view i."""
    rays: Float32
    """``(M, 3)`` with z = 1."""
    target: Float32
    """``(M, 2)`` px of the input resolution of camera j."""
    weight: Float32
    """``(M,)`` in (0, 1]"""
    nearest: npt.NDArray[np.int64]
    """``(M,)`` flat index in view j of the pixel seen; -1 outside."""
    jTi: Array
    """``(4, 4)``"""
    intrinsics_j: Array
    """``(3, 3)`` at the input resolution."""

    @property
    def same_instant(self) -> bool:
        return self.i[1] == self.j[1]

    @cached_property
    def turned(self) -> Float32:
        """``(3, M)`` the rays in the axes of camera j."""
        return turned_rays(self.rays, self.jTi)

    def terms(self, inverse_depth: Float32) -> FlowTerms:
        """L_flow at inverse depths ``(M,)``."""
        translation = self.jTi[:3, 3]
        return turned_flow_terms(inverse_depth, self.turned, translation, self.intrinsics_j, self.target)

    def without(self, excluded: npt.NDArray[np.bool_]) -> Edge:
        """The edge without the pixels of view i that ``excluded (N,)`` marks."""
        kept = np.flatnonzero(~excluded[self.pixels])
        return replace(
            self,
            pixels=self.pixels[kept],
            rays=np.take(self.rays, kept, axis=0),
            target=np.take(self.target, kept, axis=0),
            weight=self.weight[kept],
            nearest=self.nearest[kept],
        )


def load_edges(
    workspace: Workspace,
    i: Frame,
    neighbours: Iterable[Frame],
    wTc: Array,
    among: npt.NDArray[np.int64] | None = None,
) -> list[Edge]:
    """Edges of a frame to those of ``neighbours`` whose flow was measured; ``wTc (N, T, 4, 4)``.

    ``among (P,)`` are flat indices of pixels, in ascending order: only these are looked at.
    """
    edges = []
    raster = pixel_raster(workspace.views[i[0]].shape).reshape(-1, 2)
    for j in neighbours:
        first = is_first(i, j)
        ends = (i, j) if first else (j, i)
        if not workspace.has_flow(*ends):
            continue
        measured = workspace.read_flow(*ends, backward=not first, among=among, least=LEAST_WEIGHT)
        view_i, view_j, pixels = workspace.views[i[0]], workspace.views[j[0]], measured.pixels
        small = np.take(raster, pixels, axis=0) + measured.flow
        edges.append(
            Edge(
                i=i,
                j=j,
                pixels=pixels,
                rays=np.take(view_i.rays, pixels, axis=0),
                target=_in_full_pixels(small, view_j),
                weight=measured.weight,
                nearest=_nearest(small, view_j.shape),
                jTi=invert_pose(wTc[j]) @ wTc[i],
                intrinsics_j=view_j.camera.intrinsics,
            )
        )
    return edges


@dataclass(frozen=True)
class FlowTargets:
    """Where sure flow finds the ``N`` pixels of a frame at ``K`` other times of its camera."""

    times: npt.NDArray[np.int32]
    """``(K,)``"""
    pixels: npt.NDArray[np.int32]
    """``(K, N)`` flat indices; -1 where flow is not sure, or leads outside."""


def flow_targets(edges: Sequence[Edge], pixels: int) -> FlowTargets:
    """Of a frame of so many ``pixels`` and its ``edges`` within the camera."""
    table = np.full((len(edges), pixels), -1, np.int32)
    for row, edge in zip(table, edges, strict=True):
        sure = edge.weight >= SURE_WEIGHT
        row[edge.pixels[sure]] = edge.nearest[sure]
    return FlowTargets(np.array([edge.j[1] for edge in edges], dtype=np.int32), table)


def _in_full_pixels(small: Float32, view: DenseView) -> Float32:
    scale = np.array(
        [view.camera.width / view.shape[1], view.camera.height / view.shape[0]], dtype=np.float32
    )
    # each axis in one piece of memory: the residuals are computed by axis
    by_axis = np.ascontiguousarray(small.T) + np.float32(0.5)
    return (by_axis * scale[:, None] - np.float32(0.5)).T


def _nearest(target: Float32, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    col, row = np.rint(np.ascontiguousarray(target.T)).astype(np.int32)
    inside = (col >= 0) & (row >= 0) & (col < shape[1]) & (row < shape[0])
    return np.where(inside, row.astype(np.int64) * shape[1] + col, -1)
