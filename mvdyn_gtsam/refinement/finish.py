"""A refined frame at the input resolution: what is handed out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.context import CHECK_SPACING, MOVING, UNEXPLAINED, Context
from mvdyn_gtsam.refinement.edges import SURE_WEIGHT, Edge


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
