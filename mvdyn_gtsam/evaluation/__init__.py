"""SCORE: trajectories through evo, depth and consistency between cameras."""

from mvdyn_gtsam.evaluation.association import PoseSource, ReconstructionLike
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth, load_groundtruth
from mvdyn_gtsam.evaluation.plots import save_depth_plot, save_plots
from mvdyn_gtsam.evaluation.report import format_table
from mvdyn_gtsam.evaluation.scores import Scores, evaluate, evaluate_poses

__all__ = [
    "GroundTruth",
    "PoseSource",
    "ReconstructionLike",
    "Scores",
    "evaluate",
    "evaluate_poses",
    "format_table",
    "load_groundtruth",
    "save_depth_plot",
    "save_plots",
]
