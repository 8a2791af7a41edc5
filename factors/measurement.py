"""Dense flow of one keyframe to its neighbours, checked and laid out for the structureless factor; numpy
only."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from factors.flow_terms import read_only_copy
from factors.robust import Loss, LossName, make_loss

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StructurelessMeasurement:
    """Dense flow of the N grid points of keyframe i to E frames; arrays are copied and made read-only.

    Raises ValueError when shapes disagree, a ray, depth start or intrinsic is not finite or a weight is
    negative. NaN targets or weights count as no measurement, a NaN prior log depth or an infinite sigma as no
    prior.
    """

    rays: Array
    """``(N, 3)`` with z = 1, in frame i."""
    initial_log_depth: Array
    """``(N,)`` where the solution for the log depths starts."""
    prior_log_depth: Array
    """``(N,)`` mean of the prior before the scale: log D_i."""
    prior_sigma: Array
    """``(N,)`` standard deviation of the prior, in log depth."""
    intrinsics_j: Array
    """``(E, 4)`` fx fy cx cy, px."""
    target: Array
    """``(E, N, 2)`` where the flow leads, px in frame j."""
    weight: Array
    """``(E, N)`` in [0, 1]; 0 is no measurement."""
    robust_px: float = 1.0
    """Scale of the robust loss, px."""
    noise_px: float = 1.0
    """Standard deviation of a flow component of weight one, px."""
    loss: LossName = "cauchy"
    steps: int = 4
    """Gauss-Newton steps for the log depths per evaluation."""
    kernel: Loss = field(init=False, repr=False)
    """The robust loss itself."""
    planar_rays: Array = field(init=False, repr=False)
    """``(3, N)``"""
    planar_target: Array = field(init=False, repr=False)
    """``(2, E, N)``; zero where there is no measurement."""
    information: Array = field(init=False, repr=False)
    """``(E, N)`` weight over squared noise."""
    prior_information: Array = field(init=False, repr=False)
    """``(N,)``, 1 / sigma^2."""

    def __post_init__(self) -> None:
        _check_shapes(self)
        if not self.noise_px > 0.0:
            raise ValueError(f"noise_px must be positive, got {self.noise_px}")
        target = np.asarray(self.target, dtype=np.float64)
        weight = np.asarray(self.weight, dtype=np.float64)
        measured = np.isfinite(target).all(axis=2) & np.isfinite(weight)
        weight = np.where(measured, weight, 0.0)
        planar_target = np.where(measured, np.moveaxis(target, 2, 0), 0.0)
        prior = np.asarray(self.prior_log_depth, dtype=np.float64)
        sigma = np.asarray(self.prior_sigma, dtype=np.float64)
        if (weight < 0.0).any():
            raise ValueError("weights must not be negative")
        for name in ("rays", "initial_log_depth", "intrinsics_j"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} must be finite")
        if not (sigma > 0.0).all():
            raise ValueError("every prior sigma must be positive (use inf for no prior)")
        has_prior = np.isfinite(prior)
        arrays = {
            "planar_rays": np.asarray(self.rays, dtype=np.float64).T,
            "initial_log_depth": self.initial_log_depth,
            "prior_log_depth": np.where(has_prior, prior, 0.0),
            "prior_sigma": sigma,
            "prior_information": np.where(has_prior, sigma**-2.0, 0.0),
            "intrinsics_j": self.intrinsics_j,
            "planar_target": planar_target,
            "weight": weight,
            "information": weight / self.noise_px**2,
        }
        for name, array in arrays.items():
            object.__setattr__(self, name, read_only_copy(array))
        object.__setattr__(self, "rays", self.planar_rays.T)
        # a view: the planar copy is the only one kept
        object.__setattr__(self, "target", np.moveaxis(self.planar_target, 0, 2))
        object.__setattr__(self, "kernel", make_loss(self.loss, self.robust_px))


def _check_shapes(measurement: StructurelessMeasurement) -> None:
    points = len(measurement.rays)
    edges = len(measurement.weight)
    expected = {
        "rays": (points, 3),
        "initial_log_depth": (points,),
        "prior_log_depth": (points,),
        "prior_sigma": (points,),
        "intrinsics_j": (edges, 4),
        "target": (edges, points, 2),
        "weight": (edges, points),
    }
    for name, shape in expected.items():
        actual = np.shape(getattr(measurement, name))
        if actual != shape:
            raise ValueError(f"{name} must have shape {shape}, got {actual}")
