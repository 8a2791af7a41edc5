"""COMPARE: COLMAP and GLOMAP through pycolmap, each in a process of its own."""

from mvdyn_gtsam.baselines.comparison import Comparison, MethodResult, compare
from mvdyn_gtsam.baselines.runner import BaselineResult, run_baseline
from mvdyn_gtsam.baselines.settings import METHODS, BaselineSettings

__all__ = [
    "METHODS",
    "BaselineResult",
    "BaselineSettings",
    "Comparison",
    "MethodResult",
    "compare",
    "run_baseline",
]
