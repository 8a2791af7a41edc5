"""MAKE: dynamic scenes filmed by several hand-held cameras, with exact ground truth.

Rays are cast with embreex (Embree, wheels only, the extra ``scenes``) and not with Open3D, whose import needs
system libraries (libGL, libusb) that fresh machines lack.
"""

from mvdyn_gtsam.scenes.generate import Scene, make_scene
from mvdyn_gtsam.scenes.settings import SceneSettings

__all__ = ["Scene", "SceneSettings", "make_scene"]
