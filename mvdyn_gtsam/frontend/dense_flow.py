"""Dense optical flow between two images, both directions from one measurement, with weights in [0, 1]."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.grid import Grid

Float32 = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

REMAP_STEP = 1.0 / 32.0
"""cv2.remap rounds positions to this; a seed on the same raster is warped and composed exactly."""


@dataclass(frozen=True)
class FlowConfig:
    """Dense flow and its weights."""

    finest_scale: int = 1
    """Pyramid level DIS stops at; 0 is full resolution. Source: experiments/results/flow_accuracy.md: 1 costs
    less than half of 0, and the poses came out as accurate."""
    patch_size: int = 8
    """DIS patch, px. Source: experiments/results/flow_accuracy.md."""
    patch_stride: int = 6
    """Distance between DIS patches, px. Source: experiments/results/flow_accuracy.md."""
    gradient_iterations: int = 12
    """Gradient-descent steps per DIS patch. Source: experiments/results/flow_accuracy.md."""
    variational_iterations: int = 0
    """Fixed-point iterations of the variational refinement per level; its smoothness lowers the error of
    single points but makes neighbours wrong together. Source: experiments/results/flow_accuracy.md."""
    forward_backward_sigma: float = 0.5
    """Weight is exp(-(forward-backward error / sigma)^2), px. Source:
    experiments/results/flow_accuracy.md."""
    border_margin: int = 2
    """Points and targets closer than this to an image border get no weight, px. Source: choice."""
    residual_limit: float = 20.0
    """Length of a residual flow on top of a seed at which the weight falls to 1/e, px. Source: choice."""
    ncc_window: int = 9
    """Side of the window of the normalised cross-correlation of guided flow, px. Source: choice."""
    ncc_noise: float = 2.0
    """Image noise, grey levels: contrast below it counts as no correlation. Source: choice."""
    ncc_low: float = 0.5
    """Correlation at or below which guided flow has no weight. Source: choice."""
    ncc_high: float = 0.8
    """Correlation at or above which guided flow keeps its whole weight. Source: choice."""
    occlusion_tolerance: float = 0.1
    """Relative depth difference at which the occlusion test's weight falls to 1/e. Source: choice."""

    def __post_init__(self) -> None:
        for name, low in (
            ("finest_scale", 0), ("patch_size", 4), ("patch_stride", 1), ("gradient_iterations", 1),
            ("variational_iterations", 0), ("border_margin", 0), ("ncc_window", 3),
        ):  # fmt: skip
            if getattr(self, name) < low:
                raise ConfigError(f"frontend.flow.{name} is {getattr(self, name)}; it must be at least {low}")
        for name in ("forward_backward_sigma", "residual_limit", "ncc_noise", "occlusion_tolerance"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"frontend.flow.{name} is {getattr(self, name)}; it must be above 0")
        if not self.ncc_low < self.ncc_high <= 1.0:
            raise ConfigError(
                f"frontend.flow.ncc_low is {self.ncc_low} and ncc_high {self.ncc_high}; "
                "they must be ascending and at most 1"
            )


@dataclass(frozen=True)
class FlowPair:
    """Both directions of one measurement; each side has its own image's size."""

    forward: Float32
    """``(H_i, W_i, 2)`` px: pixel x of image i is seen at ``x + forward`` in image j. Finite everywhere."""
    backward: Float32
    """``(H_j, W_j, 2)`` px, from j to i."""
    forward_weight: Float32
    """``(H_i, W_i)`` in [0, 1]."""
    backward_weight: Float32
    """``(H_j, W_j)`` in [0, 1]."""

    def reversed(self) -> FlowPair:
        """The same measurement seen from j."""
        return FlowPair(self.backward, self.forward, self.backward_weight, self.forward_weight)


class DenseFlow(Protocol):
    """Anything that measures flow between two images: classical, or a network behind ONNX."""

    def measure(
        self,
        image_i: Image,
        image_j: Image,
        seed: Float32 | None = None,
        seed_backward: Float32 | None = None,
    ) -> FlowPair:
        """Flow between images ``(H, W[, 3]) uint8``, grey or RGB.

        ``seed (H_i, W_i, 2)`` and ``seed_backward (H_j, W_j, 2)`` predict the flow, NaN where they
        cannot; there the weight is 0. Images of different size need both seeds (ValueError).
        """
        ...


@dataclass(frozen=True)
class GridFlow:
    """What the tracker keeps of a dense flow."""

    target: Float32
    """``(N, 2)`` px in the other image."""
    weight: Float32
    """``(N,)`` in [0, 1]."""


def sample_pair(pair: FlowPair, grid_i: Grid, grid_j: Grid) -> tuple[GridFlow, GridFlow]:
    """``(i -> j at grid_i, j -> i at grid_j)``."""
    return (
        _sample(pair.forward, pair.forward_weight, grid_i),
        _sample(pair.backward, pair.backward_weight, grid_j),
    )


class DisFlow:
    """Dense inverse search (https://arxiv.org/abs/1603.03590, cv2.DISOpticalFlow), weighted by how well
    the two directions agree."""

    def __init__(self, config: FlowConfig | None = None) -> None:
        self.config = config if config is not None else FlowConfig()

    def measure(
        self,
        image_i: Image,
        image_j: Image,
        seed: Float32 | None = None,
        seed_backward: Float32 | None = None,
    ) -> FlowPair:
        """See ``DenseFlow.measure``."""
        return measure_both(self.flow, to_grey(image_i), to_grey(image_j), seed, seed_backward, self.config)

    def flow(self, grey_i: Image, grey_j: Image, halved: int = 0) -> Float32:
        """One direction ``(H, W, 2)`` between grey images of one size, no weights.

        Images that have been ``halved`` before need as many levels less of the pyramid.
        """
        config = self.config
        # A new engine per call: it keeps buffers, and is neither thread-safe nor picklable.
        engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        engine.setFinestScale(config.finest_scale - halved)
        engine.setPatchSize(config.patch_size)
        engine.setPatchStride(config.patch_stride)
        engine.setGradientDescentIterations(config.gradient_iterations)
        engine.setVariationalRefinementIterations(config.variational_iterations)
        flow: Float32 = engine.calc(grey_i, grey_j, None)
        return flow


def measure_both(
    flow: Callable[[Image, Image], Float32],
    grey_i: Image,
    grey_j: Image,
    seed: Float32 | None,
    seed_backward: Float32 | None,
    config: FlowConfig,
) -> FlowPair:
    """Both directions by a one-way ``flow``, on top of the seeds, with forward-backward weights.

    A seed is applied by warping the other image with it and measuring what remains. Without
    ``seed_backward`` it is the inverse of ``seed``.
    """
    if seed is None and seed_backward is None:
        if grey_i.shape != grey_j.shape:
            raise ValueError(f"images of {grey_i.shape} and {grey_j.shape} pixels need a seed for their flow")
        forward, backward = flow(grey_i, grey_j), flow(grey_j, grey_i)
        trust_forward, trust_backward = (np.ones(grey_i.shape, np.float32) for _ in range(2))
    else:
        if seed is None:
            assert seed_backward is not None
            seed = invert_flow(seed_backward, grey_i.shape)
        elif seed_backward is None:
            seed_backward = invert_flow(seed, grey_j.shape)
        forward, trust_forward = seeded_flow(flow, grey_i, grey_j, seed, config)
        backward, trust_backward = seeded_flow(flow, grey_j, grey_i, seed_backward, config)
    return FlowPair(
        forward,
        backward,
        trust_forward * forward_backward_weight(forward, backward, trust_backward > 0.0, config),
        trust_backward * forward_backward_weight(backward, forward, trust_forward > 0.0, config),
    )


def seeded_flow(
    flow: Callable[[Image, Image], Float32],
    grey_i: Image,
    grey_j: Image,
    seed: Float32,
    config: FlowConfig,
) -> tuple[Float32, Float32]:
    """Flow ``(H_i, W_i, 2)`` on top of ``seed`` and its trust ``(H_i, W_i)`` in [0, 1].

    The trust is 0 where the seed is NaN or leaves image j, and falls with the length of the residual.
    """
    seed = np.multiply(seed, np.float32(1.0 / REMAP_STEP), dtype=np.float32)
    np.rint(seed, out=seed)
    seed *= np.float32(REMAP_STEP)
    raster = pixel_raster(grey_i.shape)
    target = raster + seed
    unseen = ~inside(target, grey_j.shape, 0)
    target[unseen] = -1.0
    warped = cv2.remap(grey_j, target, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    # Where nothing is known the image itself stands in: no residual there, and no false edges.
    np.copyto(warped, grey_i, where=unseen)
    residual = flow(grey_i, warped)
    # Pixel x looks like the warped image at x + residual, whose own seed is the one to add; NaN spreads.
    seed[unseen] = np.nan
    composed = cv2.remap(seed, raster + residual, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.logical_or(unseen, np.isnan(composed[..., 0]), out=unseen)
    composed[unseen] = 0.0
    composed += residual
    squared = residual[..., 0] ** 2 + residual[..., 1] ** 2
    squared *= np.float32(-1.0 / config.residual_limit**2)
    trust = np.exp(squared, out=squared)
    trust[unseen] = 0.0
    return composed, trust


def forward_backward_weight(
    forward: Float32, backward: Float32, backward_known: npt.NDArray[np.bool_], config: FlowConfig
) -> Float32:
    """``(H_i, W_i)``: exp(-(|forward(x) + backward(x + forward(x))| / sigma)^2), 0 at and beyond borders."""
    target = pixel_raster(forward.shape[:2]) + forward
    returned = cv2.remap(backward, target, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    returned += forward
    squared = returned[..., 0] ** 2 + returned[..., 1] ** 2
    weight = np.exp(squared * np.float32(-1.0 / config.forward_backward_sigma**2))
    known = inside(target, backward.shape[:2], config.border_margin)
    if not backward_known.all():
        known &= cv2.remap(backward_known.astype(np.uint8), target, None, cv2.INTER_NEAREST) > 0
    weight *= known
    margin = config.border_margin
    if margin:
        weight[:margin], weight[-margin:], weight[:, :margin], weight[:, -margin:] = 0.0, 0.0, 0.0, 0.0
    return weight.astype(np.float32)


def invert_flow(flow: Float32, shape: tuple[int, ...], iterations: int = 4) -> Float32:
    """Backward flow ``(*shape, 2)`` of a smooth forward one: the fixed point of b(x) = -flow(x + b(x)).

    NaN where x does not come from image i.
    """
    backward: Float32 = np.zeros((*shape[:2], 2), np.float32)
    raster = pixel_raster(shape)
    known = np.nan_to_num(flow, nan=math.nan)
    for _ in range(iterations):
        source = raster + np.nan_to_num(backward)
        backward = -cv2.remap(known, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    backward[~inside(raster + backward, flow.shape[:2], 0)] = np.nan
    return backward


def inside(target: Float32, shape: tuple[int, ...], margin: float) -> npt.NDArray[np.bool_]:
    """``(...)`` bool: positions ``(..., 2)`` at least ``margin`` px inside an image; False for NaN."""
    x, y = target[..., 0], target[..., 1]
    height, width = shape[:2]
    result: npt.NDArray[np.bool_] = (x >= margin) & (y >= margin)
    result &= (x <= width - 1 - margin) & (y <= height - 1 - margin)
    return result


def pixel_raster(shape: tuple[int, ...]) -> Float32:
    """``(H, W, 2)``: the x, y of every pixel; not to be written to."""
    return _raster(*shape[:2])


# every pair of frames asks for it several times
@lru_cache(maxsize=4)
def _raster(height: int, width: int) -> Float32:
    raster = np.empty((height, width, 2), np.float32)
    raster[..., 0] = np.arange(width, dtype=np.float32)
    raster[..., 1] = np.arange(height, dtype=np.float32)[:, None]
    raster.setflags(write=False)
    return raster


def to_grey(image: npt.NDArray[Any]) -> Image:
    """Grey ``(H, W) uint8`` of a grey or RGB image."""
    if image.ndim == 2:
        return image
    grey: Image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return grey


def _sample(flow: Float32, weight: Float32, grid: Grid) -> GridFlow:
    target = grid.pixels.astype(np.float32) + grid.sample(flow)
    return GridFlow(target, grid.sample(weight))
