"""Depth priors (monocular networks and the like) and their alignment to the reconstruction's scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]


class DepthPrior(Protocol):
    """Anything that predicts depth from one image."""

    @property
    def name(self) -> str:
        """What the manifest calls it; a run is not resumed with a prior of another name."""
        ...

    def predict(
        self,
        image: npt.NDArray[np.uint8],
        intrinsics: npt.NDArray[np.float64],
        camera: str,
        time: int,
    ) -> tuple[Float32, Float32 | None] | None:
        """Depth ``(H, W)`` and confidence ``(H, W)`` in [0, 1] or None; None for a frame it does not know.

        ``image`` is ``(H, W, 3) uint8`` RGB, ``intrinsics (3, 3)``; ``camera`` and ``time`` say which frame
        it is. Depth is z-depth, not inverse, up to a scale and an offset that are the same for all frames;
        what is not finite or not positive is unknown. Asked at most once per frame and run.
        """
        ...


class NoDepthPrior:
    """The default: depth is carried over by the flow."""

    name = "none"

    def predict(
        self,
        image: npt.NDArray[np.uint8],
        intrinsics: npt.NDArray[np.float64],
        camera: str,
        time: int,
    ) -> None:
        """None."""
        return None


@dataclass(frozen=True)
class ScaleOffset:
    """``aligned = scale * prior + offset``."""

    scale: float
    offset: float

    def apply(self, prior: npt.NDArray[np.floating]) -> Float32:
        """The aligned depth, NaN where it is not positive."""
        aligned = np.float32(self.scale) * np.asarray(prior, np.float32) + np.float32(self.offset)
        return np.where(aligned > 0.0, aligned, np.float32(np.nan))


def align_scale_offset(
    prior_depths: Sequence[npt.NDArray[np.floating]],
    initial_depths: Sequence[npt.NDArray[np.floating]],
    *,
    robust: bool = False,
    iterations: int = 10,
) -> ScaleOffset:
    """One global ``s, o`` minimising ``sum_k ||s D_mono^k + o - D_init^k||^2`` (paper, prior alignment).

    The k-th depths have one shape and any unit; pixels that are NaN in either do not count. ``robust``
    begins with a line through medians and re-weights by Cauchy's loss at the median absolute residual, so
    that what moves or is wrong in either does not pull. Raises ValueError for different shapes and when the
    scale is not determined or not positive.
    """
    if len(prior_depths) != len(initial_depths):
        raise ValueError(f"{len(prior_depths)} prior depths against {len(initial_depths)} initial ones")
    pairs = [_valid(prior, initial) for prior, initial in zip(prior_depths, initial_depths, strict=True)]
    prior = np.concatenate([p for p, _ in pairs]) if pairs else np.zeros(0)
    initial = np.concatenate([d for _, d in pairs]) if pairs else np.zeros(0)
    weight = np.ones_like(prior)
    result = _solve(prior, initial, weight)
    if robust:
        result = _median_line(prior, initial)
    for _ in range(iterations if robust else 0):
        residual = result.scale * prior + result.offset - initial
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-9 * float(np.abs(initial).max()))
        result = _solve(prior, initial, 1.0 / (1.0 + (residual / spread) ** 2))
    if not result.scale > 0.0:
        raise ValueError(f"the prior's depth falls as the reconstruction's rises (scale {result.scale:.3g})")
    return result


def _median_line(prior: npt.NDArray[np.float64], initial: npt.NDArray[np.float64]) -> ScaleOffset:
    """Median slope of pairs half the samples apart (Theil 1950): least squares would begin at the mercy of a
    prior's few very far or near depths."""
    order = np.argsort(prior, kind="stable")
    low, high = order[: len(order) // 2], order[-(len(order) // 2) :]
    rise = prior[high] > prior[low]
    scale = float(np.median((initial[high] - initial[low])[rise] / (prior[high] - prior[low])[rise]))
    return ScaleOffset(scale, float(np.median(initial - scale * prior)))


def _valid(prior: npt.NDArray[Any], initial: npt.NDArray[Any]) -> tuple[npt.NDArray[np.float64], ...]:
    if prior.shape != initial.shape:
        raise ValueError(f"a prior depth of shape {prior.shape} against an initial one of {initial.shape}")
    both = np.isfinite(prior) & np.isfinite(initial)
    return prior[both].astype(np.float64), initial[both].astype(np.float64)


def _solve(
    prior: npt.NDArray[np.float64], initial: npt.NDArray[np.float64], weight: npt.NDArray[np.float64]
) -> ScaleOffset:
    total = weight.sum()
    if total <= 0.0:
        raise ValueError("prior and initial depths have no valid pixel in common")
    mean_prior, mean_initial = (weight * prior).sum() / total, (weight * initial).sum() / total
    centred = prior - mean_prior
    variance = (weight * centred * centred).sum() / total
    if variance <= 1e-12 * mean_prior**2:
        raise ValueError("the prior's depth is constant, which leaves scale and offset undetermined")
    scale = float((weight * centred * (initial - mean_initial)).sum() / total / variance)
    return ScaleOffset(scale, float(mean_initial - scale * mean_prior))
