"""The result of another method, in the form that the metrics take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.imports.depth import read_depth


@dataclass(frozen=True)
class ImportedResult:
    """Poses are held, depth is read when asked for. All cameras are one group: one world, one scale."""

    folder: Path
    capture: Capture
    layout: str
    """How it was recognised: ``tum``, ``colmap``, ``nerfstudio`` or ``npz``."""
    poses: Mapping[str, npt.NDArray[np.float64]]
    """Camera -> wTc ``(T, 4, 4)``, NaN for frames without a pose."""
    own_intrinsics: Mapping[str, npt.NDArray[np.float64]]
    """Camera -> ``(3, 3)`` at the input resolution, where the method has its own."""
    depth_files: Mapping[tuple[str, int], Path]
    depth_scale: float | None = None

    @property
    def cameras(self) -> list[str]:
        """Camera names, in the order of the capture."""
        return [camera.name for camera in self.capture.cameras]

    @property
    def groups(self) -> Sequence[Sequence[str]]:
        """One group of all cameras."""
        return [self.cameras]

    def trajectory(self, camera: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Timestamps ``(T,)`` in s and poses wTc ``(T, 4, 4)`` of every frame; NaN where there is none."""
        self._camera(camera)
        return self.capture.timestamps, self.poses[camera]

    def intrinsics(self, camera: str) -> npt.NDArray[np.float64]:
        """``(3, 3)`` at the input resolution: the method's own where its files state them.

        Raises ResultError where neither these nor the capture does.
        """
        own = self._camera(camera)
        if camera not in self.own_intrinsics and not own.focal_known:
            raise ResultError(
                f"{self.folder}: does not state the intrinsics of {camera}, nor does the capture know its"
                " focal length; import a format that does, such as nerfstudio or COLMAP"
            )
        return self.own_intrinsics.get(camera, own.intrinsics)

    def has_depth(self, camera: str, time: int) -> bool:
        """Whether there is a depth file of that frame."""
        return (camera, time) in self.depth_files

    def depth(self, camera: str, time: int) -> npt.NDArray[np.float32]:
        """z-depth ``(H, W) float32`` at the input resolution, NaN = invalid, in the unit of the poses.

        Raises ResultError where the file is missing, damaged or of another aspect ratio.
        """
        owner = self._camera(camera)
        if not self.has_depth(camera, time):
            raise ResultError(f"{self.folder}: no depth of frame {time} of {camera}")
        return read_depth(self.depth_files[camera, time], owner.width, owner.height, self.depth_scale)

    def _camera(self, name: str) -> Camera:
        for camera in self.capture.cameras:
            if camera.name == name:
                return camera
        raise ResultError(f"{self.folder}: no camera {name!r}; it has {', '.join(self.cameras)}")
