"""MAKE: dynamic scenes filmed by several hand-held cameras, with exact ground truth.

Rays are cast with embreex (Embree, wheels only, the extra ``scenes``) and not with Open3D, whose import needs
system libraries (libGL, libusb) that fresh machines lack.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mvdyn_gtsam.scenes.generate import Scene as Scene
    from mvdyn_gtsam.scenes.generate import make_scene as make_scene
    from mvdyn_gtsam.scenes.settings import SceneSettings as SceneSettings

__all__ = ["Scene", "SceneSettings", "make_scene"]

# Resolved on first use: the command line shows its help without loading numpy and OpenCV.
_WHERE = {"Scene": "generate", "SceneSettings": "settings", "make_scene": "generate"}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'mvdyn_gtsam.scenes' has no attribute {name!r}")
    return getattr(import_module(f"mvdyn_gtsam.scenes.{_WHERE[name]}"), name)
