"""A depth prior in the scale of the start: the paper's *prior alignment*, and what tracking reads of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import DepthPriorError
from mvdyn_gtsam.frontend.depth_priors.depth_prior import Float32, ScaleOffset, align_scale_offset
from mvdyn_gtsam.frontend.depth_priors.predictions import Prediction, Predictions
from mvdyn_gtsam.frontend.grid import Grid
from mvdyn_gtsam.frontend.start.model import Start, StartFrame
from mvdyn_gtsam.progress import Progress

logger = logging.getLogger(__name__)

Image = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

LEAST_SAMPLES = 10
"""Depths of the start that a prior must know for a scale and an offset."""
NEAREST = 0.1
"""Share of the start's nearest depth (its 1st percentile) below which an aligned prior counts as unknown: an
offset brings some of a prior's errors next to zero, where their logarithm would outweigh everything."""


@dataclass(frozen=True)
class GridDepth:
    """A prior's word on one frame, at the points of a grid."""

    log_depth: Array
    """``(N,)`` in the unit of the group's world, NaN where unknown."""
    confidence: Array
    """``(N,)`` in (0, 1]."""


PriorAtGrid = Callable[[int, int, Image, Grid], GridDepth | None]
"""Camera, time and image of a frame, and where its depth is asked for; None where nothing is known of it."""


@dataclass(frozen=True)
class Alignment:
    """How a prior's depth becomes that of a group of cameras."""

    group: tuple[int, ...]
    scale_offset: ScaleOffset
    nearest: float
    """Depth below which nothing is believed."""
    error: float
    """Median of ``|aligned / start - 1|`` over the samples."""

    def apply(self, depth: Float32) -> Float32:
        """Log depth in the unit of the group's world, NaN where unknown."""
        aligned = self.scale_offset.apply(depth)
        return np.log(np.where(aligned >= self.nearest, aligned, np.float32(np.nan)))


class AlignedPrior:
    """The predictions in the unit of the start, for tracking's grid and for whole frames."""

    def __init__(self, predictions: Predictions, alignments: Sequence[Alignment]) -> None:
        self._predictions, self.alignments = predictions, tuple(alignments)
        self._of: Mapping[int, Alignment] = {camera: one for one in alignments for camera in one.group}

    def at_grid(self, camera: int, time: int, image: Image, grid: Grid) -> GridDepth | None:
        """See ``PriorAtGrid``."""
        prediction = self._predictions.get(camera, time, image)
        if prediction is None:
            return None
        log_depth = self._of[camera].apply(grid.sample(prediction.depth)).astype(np.float64)
        confidence = (
            np.ones(len(grid)) if prediction.confidence is None else grid.sample(prediction.confidence)
        )
        return GridDepth(log_depth, np.where(np.isfinite(log_depth), confidence, 1.0).astype(np.float64))

    def dense(self, camera: int, time: int, image: Image) -> Float32 | None:
        """Log depth ``(H, W)``, NaN where unknown; None where nothing is known."""
        prediction = self._predictions.get(camera, time, image)
        return None if prediction is None else self._of[camera].apply(prediction.depth)


def align_to_start(
    predictions: Predictions, start: Start, read: Callable[[int, int], Image], progress: Progress
) -> AlignedPrior:
    """One scale and offset per group of cameras, fitted to the depths of all its frames in the start.

    ``read(camera, time)`` hands out a frame. Raises DepthPriorError, naming the cameras, where they do not
    determine any.
    """
    total, done = sum(len(frames) for frames in start.frames), 0
    alignments = []
    for group in start.groups:
        priors, depths = [], []
        for camera in group:
            for frame in start.frames[camera]:
                priors.append(_sampled(predictions.get(camera, frame.time, read(camera, frame.time)), frame))
                depths.append(frame.depth)
                done += 1
                progress.update("depth prior", done, total, predictions.cameras[camera].name)
        names = ", ".join(predictions.cameras[camera].name for camera in group)
        try:
            alignment = _fit(group, np.concatenate(priors), np.concatenate(depths))
        except ValueError as error:
            raise DepthPriorError(
                f"{names}: the depth prior {predictions.name} cannot be aligned to the start: {error}"
            ) from error
        fit = alignment.scale_offset
        logger.info(
            "depth prior of %s: scale %.4g, offset %+.4g, off by %.1f %% in the median",
            *(names, fit.scale, fit.offset, 100.0 * alignment.error),
        )
        alignments.append(alignment)
    return AlignedPrior(predictions, alignments)


def _fit(group: tuple[int, ...], prior: Array, depth: Array) -> Alignment:
    known = np.isfinite(prior)
    if known.sum() < LEAST_SAMPLES:
        raise ValueError(
            f"it knows {known.sum()} of the {len(depth)} points whose depth the start knows; at least"
            f" {LEAST_SAMPLES} are needed"
        )
    if np.ptp(depth) == 0.0:
        # A camera that nothing connects has a made-up depth (``wide_baseline``): any unit will do, so the
        # prior keeps its shape.
        fit = ScaleOffset(float(depth[0] / np.median(prior[known])), 0.0)
    else:
        fit = align_scale_offset([prior], [depth], robust=True)
    ratio = fit.apply(prior[known]) / depth[known]
    error = float(np.median(np.abs(np.nan_to_num(ratio) - 1.0)))
    return Alignment(group, fit, NEAREST * float(np.percentile(depth, 1.0)), error)


def _sampled(prediction: Prediction | None, frame: StartFrame) -> Array:
    """The prediction ``(M,)`` at the pixels nearest to the frame's points; NaN where unknown or outside."""
    values = np.full(len(frame.pixels), np.nan)
    if prediction is not None:
        x, y = np.rint(frame.pixels).astype(int).T
        height, width = prediction.depth.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        values[inside] = prediction.depth[y[inside], x[inside]]
    return values
