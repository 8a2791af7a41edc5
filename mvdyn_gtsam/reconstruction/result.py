"""A reconstruction read back from its folder, lazily."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.encoding import decode_confidence, decode_depth, decode_mask
from mvdyn_gtsam.reconstruction.files import read_tum
from mvdyn_gtsam.reconstruction.layout import (
    arrays_path,
    confidence_path,
    depth_path,
    diagnostics_path,
    motion_path,
    tracked_folder,
    trajectory_path,
)
from mvdyn_gtsam.reconstruction.manifest import cameras_of, read_manifest

Pixel = TypeVar("Pixel", np.float32, np.uint8)


class Reconstruction:
    """Poses, depth and confidence of every frame of every camera; only the manifest is read at load time.

    All methods raise ResultError, one line naming the file, when something is missing or damaged.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest
        self._cameras = {camera.name: camera for camera in cameras_of(manifest)}

    @staticmethod
    def load(folder: Path | str) -> Reconstruction:
        """Open a reconstruction folder, also one whose run was interrupted."""
        folder = Path(folder)
        if not folder.is_dir():
            raise ResultError(f"{folder}: no such folder; make a reconstruction with: mvdyn reconstruct")
        return Reconstruction(folder, read_manifest(folder))

    @property
    def cameras(self) -> list[str]:
        """Camera names, in the order of the capture."""
        return list(self._cameras)

    @property
    def name(self) -> str:
        """Name of the capture."""
        return str(self.manifest["capture"]["name"])

    @property
    def capture_source(self) -> Path | None:
        """File or folder of the capture, where it was when the run was last begun; None where not known."""
        source = self.manifest.get("capture_source")
        return None if source is None else Path(source)

    @property
    def frame_count(self) -> int:
        """Frames per camera."""
        return int(self.manifest["capture"]["frame_count"])

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.manifest["capture"]["fps"])

    @property
    def status(self) -> str:
        """ "running", "complete", "interrupted" or "failed"; "running" also after a kill."""
        return str(self.manifest["status"])

    @property
    def unit(self) -> str:
        """ "arbitrary" or "metric"."""
        return str(self.manifest.get("unit", "arbitrary"))

    @property
    def stages(self) -> list[str]:
        """Names of the finished stages."""
        return [str(stage["name"]) for stage in self.manifest["stages"]]

    @property
    def groups(self) -> list[list[str]]:
        """Cameras that share one world frame and scale; cameras in no group could not be placed."""
        return [list(group) for group in self.manifest["groups"]]

    @property
    def timestamps(self) -> npt.NDArray[np.float64]:
        """``(T,)`` seconds on the common clock."""
        return np.arange(self.frame_count) / self.fps

    def camera(self, name: str) -> Camera:
        """Size, intrinsics and original distortion of a camera."""
        if name not in self._cameras:
            raise ResultError(f"{self.folder}: no camera {name!r}; it has {', '.join(self._cameras)}")
        return self._cameras[name]

    def intrinsics(self, name: str) -> npt.NDArray[np.float64]:
        """``(3, 3)`` pinhole matrix at the input resolution, pixel centres at integers."""
        return self.camera(name).intrinsics

    def trajectory(self, name: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Timestamps ``(T,)`` in s and poses wTc ``(T, 4, 4)`` of every frame; NaN where there is none."""
        self.camera(name)
        path = trajectory_path(self.folder, name)
        wTc = np.full((self.frame_count, 4, 4), np.nan)
        if not path.is_file():
            raise ResultError(f"{path}: missing; the run did not get that far: continue it with --resume")
        times, poses = read_tum(path)
        frames = np.rint(times * self.fps).astype(int)
        outside = (frames < 0) | (frames >= self.frame_count) | (np.abs(times * self.fps - frames) > 0.1)
        if outside.any():
            raise ResultError(
                f"{path}: timestamp {times[outside][0]:g} s is not that of a frame; reconstruct again"
            )
        wTc[frames] = poses
        return self.timestamps, wTc

    def has_depth(self, name: str, time: int) -> bool:
        """Whether depth of frame ``time`` was written."""
        self._check_frame(name, time)
        return depth_path(self.folder, name, time).is_file()

    def depth(self, name: str, time: int) -> npt.NDArray[np.float32]:
        """z-depth ``(H, W) float32`` of frame ``time`` at the input resolution; NaN = invalid."""
        path = depth_path(self.folder, name, time)
        return self._checked(path, name, decode_depth(self._read(path, name, time)))

    def confidence(self, name: str, time: int) -> npt.NDArray[np.float32]:
        """Confidence ``(H, W) float32`` in [0, 1] of frame ``time``'s depth."""
        path = confidence_path(self.folder, name, time)
        return self._checked(path, name, decode_confidence(self._read(path, name, time)))

    def motion(self, name: str, time: int) -> npt.NDArray[np.uint8]:
        """Motion mask ``(H, W) uint8`` of frame ``time``, once refined.

        255: it moves, and the views of its instant agree on its depth; 128: it moves and they do not, or
        none sees it; 0: it stands still.
        """
        path = motion_path(self.folder, name, time)
        if "refinement" not in self.stages:
            raise ResultError(
                f"{path}: motion is found by the refinement; run it with: mvdyn reconstruct --resume"
                " --stage refinement"
            )
        return self._checked(path, name, decode_mask(self._read(path, name, time)))

    def tracked(self) -> Reconstruction:
        """What tracking said before the refinement; this very reconstruction where there was none."""
        kept = tracked_folder(self.folder)
        return Reconstruction.load(kept) if "refinement" in self.stages else self

    def arrays(self, name: str) -> dict[str, npt.NDArray[Any]]:
        """Arrays of ``diagnostics/<name>.npz``, e.g. marginal covariances of the keyframes."""
        path = arrays_path(self.folder, name)
        try:
            with np.load(path, allow_pickle=False) as stored:
                return {key: stored[key] for key in stored.files}
        except FileNotFoundError as error:
            raise ResultError(f"{path}: missing; this run did not write it") from error
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ResultError(f"{path}: damaged ({error}); reconstruct again") from error

    def diagnostics(self, name: str) -> Any:
        """Value of ``diagnostics/<name>.json``, e.g. edge counts per time step."""
        path = diagnostics_path(self.folder, name)
        try:
            return json.loads(path.read_text())
        except FileNotFoundError as error:
            raise ResultError(f"{path}: missing; this run did not write it") from error
        except (OSError, ValueError) as error:
            raise ResultError(f"{path}: damaged ({error}); reconstruct again") from error

    def _check_frame(self, name: str, time: int) -> None:
        self.camera(name)
        if not 0 <= time < self.frame_count:
            raise ResultError(
                f"{self.folder}: no frame {time} of {name}; frames are 0..{self.frame_count - 1}"
            )

    def _read(self, path: Path, name: str, time: int) -> bytes:
        self._check_frame(name, time)
        try:
            return path.read_bytes()
        except FileNotFoundError as error:
            raise ResultError(
                f"{path}: missing (the run is {self.status}); continue it with mvdyn reconstruct --resume"
            ) from error
        except OSError as error:
            raise ResultError(f"{path}: cannot be read ({error.strerror})") from error

    def _checked(self, path: Path, name: str, image: npt.NDArray[Pixel] | None) -> npt.NDArray[Pixel]:
        camera = self.camera(name)
        if image is None or image.shape != (camera.height, camera.width):
            raise ResultError(f"{path}: damaged; delete it and continue with mvdyn reconstruct --resume")
        return image
