"""OUT: the result on disk and in memory, and its exporters."""

from mvdyn_gtsam.reconstruction.manifest import CaptureInfo, Status, is_reconstruction
from mvdyn_gtsam.reconstruction.result import Reconstruction
from mvdyn_gtsam.reconstruction.writer import ReconstructionWriter, refuse_unusable, remove_reconstruction

__all__ = [
    "CaptureInfo",
    "Reconstruction",
    "ReconstructionWriter",
    "Status",
    "is_reconstruction",
    "refuse_unusable",
    "remove_reconstruction",
]
