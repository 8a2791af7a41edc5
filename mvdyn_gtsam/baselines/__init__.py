"""COMPARE: COLMAP and GLOMAP through pycolmap, each in a process of its own."""

from mvdyn_gtsam.baselines.comparison import compare
from mvdyn_gtsam.baselines.results import Comparison, MethodResult
from mvdyn_gtsam.baselines.runner import BaselineResult, run_baseline
from mvdyn_gtsam.baselines.settings import BASELINES, METHODS, BaselineSettings

__all__ = [
    "BASELINES",
    "METHODS",
    "BaselineResult",
    "BaselineSettings",
    "Comparison",
    "MethodResult",
    "compare",
    "run_baseline",
]
