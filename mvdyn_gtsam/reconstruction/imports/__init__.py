"""Results of other methods, read into the form that the metrics take; conventions: docs/import.md."""

from mvdyn_gtsam.reconstruction.imports.load import load_result
from mvdyn_gtsam.reconstruction.imports.result import ImportedResult

__all__ = ["ImportedResult", "load_result"]
