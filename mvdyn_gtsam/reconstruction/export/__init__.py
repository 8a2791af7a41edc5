"""Exports of a reconstruction for other tools; each is tested by reprojection."""

from mvdyn_gtsam.reconstruction.export.colmap import export_colmap
from mvdyn_gtsam.reconstruction.export.nerfstudio import export_nerfstudio
from mvdyn_gtsam.reconstruction.export.ply import export_ply
from mvdyn_gtsam.reconstruction.export.tum import export_tum

__all__ = ["export_colmap", "export_nerfstudio", "export_ply", "export_tum"]
