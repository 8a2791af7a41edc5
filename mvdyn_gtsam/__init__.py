"""Several moving cameras film one event: every frame's camera pose and dense depth, in one world frame."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mvdyn_gtsam.capture import load_capture as load_capture
    from mvdyn_gtsam.pipeline import reconstruct as reconstruct
    from mvdyn_gtsam.reconstruction import Reconstruction as Reconstruction

__all__ = ["Reconstruction", "load_capture", "reconstruct"]

# Resolved on first use: the command line shows its help without loading gtsam and OpenCV.
_WHERE = {
    "Reconstruction": "mvdyn_gtsam.reconstruction",
    "load_capture": "mvdyn_gtsam.capture",
    "reconstruct": "mvdyn_gtsam.pipeline",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'mvdyn_gtsam' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)
