"""Where things lie in a reconstruction folder."""

from __future__ import annotations

from pathlib import Path


def trajectory_path(folder: Path, camera: str) -> Path:
    """TUM file of a camera."""
    return folder / "trajectories" / f"{camera}.txt"


def depth_path(folder: Path, camera: str, time: int) -> Path:
    """Depth of one frame."""
    return folder / "depth" / camera / f"{time:06d}.png"


def confidence_path(folder: Path, camera: str, time: int) -> Path:
    """Confidence of one frame."""
    return folder / "confidence" / camera / f"{time:06d}.png"


def arrays_path(folder: Path, name: str) -> Path:
    """Optional arrays, e.g. covariances."""
    return folder / "diagnostics" / f"{name}.npz"


def diagnostics_path(folder: Path, name: str) -> Path:
    """Optional JSON diagnostics, e.g. edge counts."""
    return folder / "diagnostics" / f"{name}.json"


def motion_path(folder: Path, camera: str, time: int) -> Path:
    """Motion mask of one frame, once refined."""
    return folder / "motion" / camera / f"{time:06d}.png"


def tracked_folder(folder: Path) -> Path:
    """What tracking said, as a reconstruction of its own, once a refined one has taken its place."""
    return folder / "tracking"


def predictions_folder(folder: Path) -> Path:
    """Where predictions of a depth prior lie until tracking is done."""
    return folder / "predictions"


def refinement_folder(folder: Path) -> Path:
    """Where a refinement works until it is done."""
    return folder / "refinement"
