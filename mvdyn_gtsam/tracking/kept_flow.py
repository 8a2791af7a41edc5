"""Measured flow as tracking keeps it for the whole video: five bytes a point instead of twelve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32, GridFlow

STEPS = 65535
"""Steps across the longer side of the other image: 1/128 px at 512 pixels, 1/34 px at 1920."""
WEIGHT_STEPS = 255


@dataclass(frozen=True, eq=False)
class KeptFlow:
    """A ``GridFlow`` in fixed point; rounding is far below the error of the flow itself.

    A target outside the other image, which has no weight, moves to its border.
    """

    steps: npt.NDArray[np.uint16]
    """``(N, 2)`` position in the other image, in ``step_px``."""
    weight_steps: npt.NDArray[np.uint8]
    """``(N,)``"""
    step_px: float

    @staticmethod
    def of(flow: GridFlow, width: int, height: int) -> KeptFlow:
        """Keep ``flow``, which leads into an image of that size."""
        step_px = max(width, height) / STEPS
        target = np.clip(flow.target, 0.0, [width - 1, height - 1])
        return KeptFlow(
            np.rint(target / step_px).astype(np.uint16),
            np.rint(flow.weight * np.float32(WEIGHT_STEPS)).astype(np.uint8),
            step_px,
        )

    @property
    def target(self) -> Float32:
        """``(N, 2)`` px in the other image."""
        return self.steps.astype(np.float32) * np.float32(self.step_px)

    @property
    def weight(self) -> Float32:
        """``(N,)`` in [0, 1]."""
        return self.weight_steps.astype(np.float32) * np.float32(1.0 / WEIGHT_STEPS)

    @cached_property
    def mean_weight(self) -> float:
        """Mean of ``weight``."""
        return float(self.weight_steps.mean() / WEIGHT_STEPS)
