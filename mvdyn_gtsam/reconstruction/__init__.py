"""OUT: the result on disk and in memory, and its exporters."""

from mvdyn_gtsam.reconstruction.manifest import CaptureInfo, Status
from mvdyn_gtsam.reconstruction.result import Reconstruction
from mvdyn_gtsam.reconstruction.writer import ReconstructionWriter, refuse_unusable

__all__ = ["CaptureInfo", "Reconstruction", "ReconstructionWriter", "Status", "refuse_unusable"]
