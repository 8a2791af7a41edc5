"""MANY: the captures of a folder, each reconstructed in a process of its own, on Dask distributed."""

from mvdyn_gtsam.batch.clips import BatchError, Clip, find_clips
from mvdyn_gtsam.batch.report import BatchReport, Row, State
from mvdyn_gtsam.batch.run import BatchSettings, run_batch

__all__ = [
    "BatchError",
    "BatchReport",
    "BatchSettings",
    "Clip",
    "Row",
    "State",
    "find_clips",
    "run_batch",
]
