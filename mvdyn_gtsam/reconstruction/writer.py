"""Writing a reconstruction while it is being computed: at any moment the folder can be read and resumed."""

from __future__ import annotations

import io
import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.encoding import encode_confidence, encode_depth, encode_mask
from mvdyn_gtsam.reconstruction.files import format_tum, write_atomically, write_json
from mvdyn_gtsam.reconstruction.layout import (
    arrays_path,
    confidence_path,
    depth_path,
    motion_path,
    predictions_folder,
    refinement_folder,
    tracked_folder,
    trajectory_path,
)
from mvdyn_gtsam.reconstruction.manifest import (
    FOUND_KEYS,
    MANIFEST_NAME,
    CaptureInfo,
    Status,
    cameras_of,
    is_reconstruction,
    new_manifest,
    read_manifest,
)

log = logging.getLogger(__name__)

_OUR_FOLDERS = (
    "trajectories", "depth", "confidence", "motion", "diagnostics", "exports", "pictures", "tracking",
    "refinement", "predictions",
)  # fmt: skip
_REPLACED = ("trajectories", "depth", "confidence")
"""What a refinement writes anew; tracking's go to a folder of their own."""


class ReconstructionWriter:
    """Writes one reconstruction folder; use as a context manager, which records how the run ended.

    Every method raises ResultError (one line, naming the file) when the disk is full or a file cannot
    be written; files written before stay whole.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self._manifest = manifest
        self._sizes = {c["name"]: (c["height"], c["width"]) for c in manifest["capture"]["cameras"]}
        self._frame_count = int(manifest["capture"]["frame_count"])

    @staticmethod
    def create(
        folder: Path | str,
        capture_info: CaptureInfo,
        config: Mapping[str, Any],
        *,
        resume: bool = False,
        overwrite: bool = False,
        unit: str = "arbitrary",
        depth_prior: str | None = None,
    ) -> ReconstructionWriter:
        """Open ``folder`` for writing and put its manifest there with status ``running``.

        ``config`` is ``mvdyn_gtsam.config.to_dict(config)``; ``unit`` is "arbitrary" or "metric";
        ``depth_prior`` names the one that tracking uses. With ``resume`` an existing reconstruction of the
        same capture is continued (what is there stays, but not the depth of a tracking that another
        ``config`` or prior left unfinished; a folder that does not exist yet is started); ``resuming`` says
        which of both go with what is finished. With ``overwrite`` an existing reconstruction is removed
        first. Raises ResultError when the folder holds anything else.
        """
        folder = Path(folder)
        refuse_unusable(folder, resume=resume, overwrite=overwrite)
        fresh = {**new_manifest(capture_info, config, unit), "depth_prior": depth_prior}
        if resume and is_reconstruction(folder):
            manifest = read_manifest(folder)
            _refuse_other_capture(folder, manifest, fresh)
            _remove_outdated(folder, manifest, fresh)
            manifest.update(
                status=Status.RUNNING.value,
                **{key: fresh[key] for key in ("config", "versions", "depth_prior", "capture_source")},
            )
        else:
            if is_reconstruction(folder):
                remove_reconstruction(folder)
            manifest = fresh
        writer = ReconstructionWriter(folder, manifest)
        writer._write_manifest()
        return writer

    def __enter__(self) -> ReconstructionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._set_status(Status.COMPLETE)
            return
        try:
            self._set_status(Status.INTERRUPTED if issubclass(kind, KeyboardInterrupt) else Status.FAILED)
        except ResultError as problem:  # must not hide the error that ended the run
            log.warning("the manifest still says running: %s", problem)

    def write_trajectory(
        self,
        camera: str,
        timestamps: npt.NDArray[np.float64],
        wTc: npt.NDArray[np.float64],
        *,
        refined: bool = False,
    ) -> None:
        """Write poses ``wTc`` ``(T, 4, 4)`` at ``timestamps`` ``(T,)`` s, one per frame; NaN = no pose.

        Those that are ``refined`` are seen by readers after ``publish_refined``.
        """
        folder = self._refined if refined else self.folder
        self._check_camera(camera)
        if wTc.shape != (self._frame_count, 4, 4) or timestamps.shape != (self._frame_count,):
            raise ValueError(
                f"{camera}: poses {wTc.shape}, timestamps {timestamps.shape} for {self._frame_count} frames"
            )
        write_atomically(trajectory_path(folder, camera), format_tum(timestamps, wTc).encode())

    def write_depth(
        self,
        camera: str,
        time: int,
        depth: npt.NDArray[np.floating],
        confidence: npt.NDArray[np.floating],
        *,
        refined: bool = False,
    ) -> None:
        """Write depth ``(H, W)`` (NaN = invalid) and confidence ``(H, W)`` in [0, 1] of frame ``time``.

        Those that are ``refined`` are seen by readers after ``publish_refined``.
        """
        folder = self._refined if refined else self.folder
        self._check_frame(camera, time)
        if depth.shape != self._sizes[camera] or confidence.shape != self._sizes[camera]:
            raise ValueError(
                f"{camera}: depth {depth.shape}, confidence {confidence.shape}, frame {self._sizes[camera]}"
            )
        content, dropped = encode_depth(depth)
        if dropped:
            log.warning(
                "%s frame %d: %d depths outside the storable range are invalid", camera, time, dropped
            )
        # Depth last: its presence says that both files of the frame are there.
        write_atomically(confidence_path(folder, camera, time), encode_confidence(confidence))
        write_atomically(depth_path(folder, camera, time), content)

    def has_depth(self, camera: str, time: int) -> bool:
        """Whether depth and confidence of that frame are on disk."""
        self._check_frame(camera, time)
        return depth_path(self.folder, camera, time).is_file()

    @property
    def predictions_folder(self) -> Path:
        """Where predictions of a depth prior are kept while tracking works."""
        return predictions_folder(self.folder)

    @property
    def refinement_folder(self) -> Path:
        """Where a refinement keeps its state until ``publish_refined``."""
        return refinement_folder(self.folder)

    def write_motion(self, camera: str, time: int, moving: npt.NDArray[np.uint8]) -> None:
        """Write a motion mask ``(H, W)``; seen by readers after ``publish_refined``."""
        self._check_frame(camera, time)
        write_atomically(motion_path(self._refined, camera, time), encode_mask(moving))

    def publish_refined(self) -> None:
        """Let the refined frames and poses take the place of tracking's, which move to ``tracking/``.

        ``tracking/`` is a reconstruction of its own, to compare with. May be called again when it was
        interrupted. Raises ResultError when a folder cannot be moved.
        """
        kept = tracked_folder(self.folder)
        stages = [stage for stage in self._manifest["stages"] if stage["name"] != "refinement"]
        write_json(
            kept / MANIFEST_NAME, {**self._manifest, "stages": stages, "status": Status.COMPLETE.value}
        )
        try:
            for name in _REPLACED:
                if not (self._refined / name).is_dir():
                    continue  # moved before the interruption
                if not (kept / name).is_dir():
                    (self.folder / name).rename(kept / name)
                if (self.folder / name).is_dir():
                    shutil.rmtree(self.folder / name)
                (self._refined / name).rename(self.folder / name)
            if (self._refined / "motion").is_dir():
                shutil.rmtree(self.folder / "motion", ignore_errors=True)
                (self._refined / "motion").rename(self.folder / "motion")
        except OSError as error:
            raise ResultError(
                f"{self.folder}: refined frames cannot be put in place ({error.strerror}); nothing is lost:"
                " continue with --resume"
            ) from error

    @property
    def _refined(self) -> Path:
        return self.refinement_folder / "result"

    def tracked(self) -> Path:
        """Folder of the tracking's trajectories and depth: this one, or ``tracking/`` once refined."""
        kept = tracked_folder(self.folder)
        return kept if all((kept / name).is_dir() for name in _REPLACED) else self.folder

    def write_arrays(self, name: str, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Write ``diagnostics/<name>.npz`` (e.g. covariances); read with ``Reconstruction.arrays``."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **dict(arrays))
        write_atomically(arrays_path(self.folder, name), buffer.getvalue())

    def read_arrays(self, name: str) -> dict[str, npt.NDArray[Any]]:
        """What ``write_arrays`` wrote, in this run or in the one that is resumed.

        Raises ResultError where that is missing, as in a copy without its diagnostics.
        """
        path = arrays_path(self.folder, name)
        if not path.is_file():
            raise ResultError(
                f"{path}: is missing, and the next stage needs it; remove {self.folder}, or start anew with"
                " --overwrite"
            )
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)

    def set_groups(self, groups: Sequence[Sequence[str]]) -> None:
        """Set the lists of cameras that share a world frame; every camera may be in one group at most."""
        for group in groups:
            for camera in group:
                self._check_camera(camera)
        self._manifest["groups"] = [list(group) for group in groups]
        self._write_manifest()

    def set_found_intrinsics(self, found: Mapping[str, Camera], deviation: Mapping[str, float]) -> None:
        """Set the cameras, by name, whose intrinsics were found, and the standard deviations of their focal
        lengths where known, px."""
        for camera in found:
            self._check_camera(camera)
        self._manifest["found_intrinsics"] = {
            name: {**{key: getattr(camera, key) for key in FOUND_KEYS}, "deviation": deviation.get(name)}
            for name, camera in found.items()
        }
        self._write_manifest()

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Those of the capture, with the intrinsics that were found."""
        return cameras_of(self._manifest)

    def set_unit(self, unit: str) -> None:
        """Set the unit of translations and depth: "arbitrary" or "metric"."""
        if unit not in ("arbitrary", "metric"):
            raise ValueError(f"unit {unit!r} is neither 'arbitrary' nor 'metric'")
        self._manifest["unit"] = unit
        self._write_manifest()

    def set_diagnostics(self, name: str, value: Any) -> None:
        """Write ``diagnostics/<name>.json``: anything JSON-able, e.g. edge counts per time step."""
        write_json(self.folder / "diagnostics" / f"{name}.json", value)

    def add_note(self, note: str) -> None:
        """Add a sentence for the user to the manifest; the same sentence is kept once."""
        if note not in self._manifest["notes"]:
            self._manifest["notes"].append(note)
            self._write_manifest()

    def finish_stage(self, name: str, seconds: float, notes: Sequence[str] = ()) -> None:
        """Record that stage ``name`` is finished and took ``seconds``."""
        stages = [stage for stage in self._manifest["stages"] if stage["name"] != name]
        stages.append({"name": name, "seconds": float(seconds), "notes": list(notes)})
        self._manifest["stages"] = stages
        self._write_manifest()

    def stage_finished(self, name: str) -> bool:
        """Whether stage ``name`` was finished, in this run or in the one that is resumed."""
        return any(stage["name"] == name for stage in self._manifest["stages"])

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the finished stages, in order."""
        return tuple(stage["name"] for stage in self._manifest["stages"])

    def _set_status(self, status: Status) -> None:
        self._manifest["status"] = status.value
        self._write_manifest()

    def _write_manifest(self) -> None:
        write_json(self.folder / MANIFEST_NAME, self._manifest)

    def _check_camera(self, camera: str) -> None:
        if camera not in self._sizes:
            raise ValueError(f"unknown camera {camera!r}; the capture has {', '.join(self._sizes)}")

    def _check_frame(self, camera: str, time: int) -> None:
        self._check_camera(camera)
        if not 0 <= time < self._frame_count:
            raise ValueError(f"{camera}: frame {time} outside 0..{self._frame_count - 1}")


def refuse_unusable(folder: Path, *, resume: bool, overwrite: bool) -> None:
    """Raise ResultError unless a run may write to ``folder``: absent, empty, or ours and allowed."""
    if folder.exists() and not folder.is_dir():
        raise ResultError(f"{folder}: is a file; choose another --out")
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not is_reconstruction(folder):
        raise ResultError(f"{folder}: not empty and not a reconstruction; choose another --out")
    if not (resume or overwrite):
        raise ResultError(
            f"{folder}: already holds a reconstruction; add --resume to continue it or --overwrite"
        )


def _refuse_other_capture(folder: Path, manifest: Mapping[str, Any], fresh: Mapping[str, Any]) -> None:
    known = [[c.get("focal_known", True) for c in one["capture"]["cameras"]] for one in (manifest, fresh)]
    if len(known[0]) == len(known[1]) and known[0] != known[1]:
        raise ResultError(
            f"{folder}: was begun with other cameras whose focal length is to be found; give or leave out"
            " --estimate-focal as then, or choose another --out"
        )
    for key, value in fresh["capture"].items():
        if manifest["capture"].get(key) != value:
            raise ResultError(
                f"{folder}: was made from another capture ({key} differs);"
                " choose another --out or --overwrite"
            )


def _remove_outdated(folder: Path, manifest: Mapping[str, Any], fresh: Mapping[str, Any]) -> None:
    """Depth of an unfinished tracking is written once: none may stay that would be another now."""
    if any(stage["name"] == "tracking" for stage in manifest["stages"]):
        return
    before, now = (
        {section: values for section, values in one["config"].items() if section != "refinement"}
        for one in (manifest, fresh)
    )
    if before == now and manifest.get("depth_prior") == fresh["depth_prior"]:
        return
    try:
        for name in ("depth", "confidence"):
            if (folder / name).exists():
                log.warning("%s: is measured again, with other settings", folder / name)
                shutil.rmtree(folder / name)
    except OSError as error:
        raise ResultError(
            f"{folder}: depth of other settings cannot be removed ({error.strerror})"
        ) from error


def remove_reconstruction(folder: Path) -> None:
    """Remove what a run wrote to ``folder``; other files stay. Raises ResultError when that fails."""
    # The manifest last: were the removal interrupted, the folder is still known as ours.
    try:
        for name in _OUR_FOLDERS:
            if (folder / name).exists():
                shutil.rmtree(folder / name)
        (folder / MANIFEST_NAME).unlink()
    except OSError as error:
        raise ResultError(f"{folder}: cannot be overwritten ({error.strerror})") from error
