"""What every task of the refinement is given."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import DenseFlow, Float32, FlowConfig
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.edges import Edge, FlowTargets, load_edges
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.views import DenseView
from mvdyn_gtsam.refinement.workspace import Workspace

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

TRUSTED_SIGMA = 0.05
"""Standard deviation of log depth at which a pixel's depth counts half as its own and half as its
surroundings'."""

CHECK_SPACING = 8
"""Distance of the pixels that choose edges and whose residuals are compared, px of the input."""

STATIC, MOVING, UNEXPLAINED = 0, 1, 2
"""Of the array ``moving``: nothing moves; it moves and the views of its instant tell its depth; they do
not."""
COLOUR = "colour"
"""The array of what ``smooth_colour`` makes of the images."""
TARGETS = "flow targets"
"""The table of ``FlowTargets``."""
LABELS = "labels"
"""The array of moving regions, numbered from 1 in every frame."""


@dataclass(frozen=True)
class Context:
    """What every task needs."""

    workspace: Workspace
    groups: tuple[tuple[int, ...], ...]
    neighbours: dict[Frame, tuple[Frame, ...]]
    config: RefinementConfig
    flow: DenseFlow
    flow_config: FlowConfig

    def group_of(self, camera: int) -> tuple[int, ...]:
        return next(group for group in self.groups if camera in group)

    def poses(self) -> Array:
        """``(N, T, 4, 4)`` as solved last."""
        return self.workspace.read_array("poses")

    def image(self, name: str, frame: Frame) -> Float32:
        return np.asarray(self.workspace.read(name, frame), np.float32)

    def edges(
        self, frame: Frame, wTc: Array, own_camera: bool, among: npt.NDArray[np.int64] | None = None
    ) -> list[Edge]:
        """Measured edges of a frame, at pixels ``among`` or all; ``own_camera``: only within its camera."""
        wanted = [j for j in self.neighbours.get(frame, ()) if not own_camera or j[0] == frame[0]]
        return load_edges(self.workspace, frame, wanted, wTc, among)

    def keep_flow_targets(self, frame: Frame, targets: FlowTargets) -> None:
        """For ``flow_targets``."""
        self.workspace.write_table(TARGETS, frame, np.column_stack([targets.times, targets.pixels]))

    def flow_targets(self, frame: Frame) -> FlowTargets:
        """As kept."""
        table = np.asarray(self.workspace.read_table(TARGETS, frame), np.int32)
        return FlowTargets(table[:, 0], table[:, 1:])

    def raster(self, frame: Frame, spacing: float) -> npt.NDArray[np.int64]:
        """Flat indices, ascending, of a frame's pixels ``spacing`` px of the input apart."""
        view = self.workspace.views[frame[0]]
        step = max(1, round(spacing * view.shape[1] / view.camera.width))
        pixels = np.arange(view.shape[0] * view.shape[1]).reshape(view.shape)
        return pixels[step // 2 :: step, step // 2 :: step].ravel()

    def luminance(self, frame: Frame) -> Float32:
        """``(h, w)`` without the noise of single pixels."""
        return np.asarray(self.workspace.read(COLOUR, frame)[..., 0], np.float32)

    def colour(self, frame: Frame) -> Float32:
        """``(h, w, 3)``: luminance and the two differences of colour, grey levels, likewise."""
        return self.image(COLOUR, frame)

    def trust(self, frame: Frame) -> Float32:
        """``(h, w)`` in [0, 1], how far the flow settles the depth solved last."""
        return trust_of(self.image("information", frame))


def smooth_colour(image: Image, view: DenseView) -> Image:
    """``(h, w, 3)`` of a grey or RGB image ``(H, W[, 3])``, without the noise of single pixels: luminance,
    and by how much it is redder and bluer than grey, 128 where it is not.

    Y, Cr and Cb of JPEG (https://www.w3.org/Graphics/JPEG/jfif3.pdf).
    """
    small = np.asarray(view.shrink(cv2.GaussianBlur(image, (0, 0), 1.0)), np.uint8)
    if image.ndim == 2:
        return np.dstack([small, np.full((*small.shape, 2), 128, np.uint8)])
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2YCrCb), np.uint8)


def trust_of(information: Float32) -> Float32:
    """In [0, 1] how far a depth of that ``information`` (inverse variance of its log) is believed."""
    return information / (information + np.float32(TRUSTED_SIGMA**-2))
