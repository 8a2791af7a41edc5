"""The manifest of a reconstruction folder: what it holds, in which conventions, made how."""

from __future__ import annotations

import json
import os
import platform
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Any

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.reconstruction.encoding import CONFIDENCE_ENCODING, DEPTH_ENCODING

FORMAT = "mvdyn-reconstruction"
SCHEMA = 1
"""Raised when a reader of the old layout would misread the new one."""
MANIFEST_NAME = "manifest.json"
FOUND_KEYS = ("fx", "fy", "cx", "cy")
"""Of a camera whose intrinsics were found, px."""

CONVENTIONS = {
    "trajectories": "TUM lines 'timestamp tx ty tz qx qy qz qw' of wTc, the pose of the camera in the world"
    " (camera-to-world); a frame without a pose has no line",
    "timestamps": "seconds on the common clock, frame index / fps",
    "camera_axes": "OpenCV: x right, y down, z forward",
    "pixels": "integer coordinates are pixel centres;"
    " a centred principal point is ((width - 1) / 2, (height - 1) / 2)",
    "intrinsics": "pinhole at the input resolution, of the undistorted frames; of a camera whose focal_known"
    " is false those of capture are first guesses, and found_intrinsics has what was found, in px",
    "depth": f"z-depth (not ray length) at the input resolution; {DEPTH_ENCODING}; NaN once read",
    "confidence": f"0 (do not use) to 1; {CONFIDENCE_ENCODING}",
    "groups": "cameras of one group share one world frame and one scale; different groups do not",
}
LIBRARIES = ("mvdyn_gtsam", "gtsam", "numpy", "scipy", "opencv-python-headless", "pycolmap", "onnxruntime")


class Status(StrEnum):
    """How the run that wrote the folder ended; ``running`` also after a kill."""

    RUNNING = "running"
    COMPLETE = "complete"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class CaptureInfo:
    """What a reconstruction keeps of its capture."""

    name: str
    fps: float
    frame_count: int
    cameras: tuple[Camera, ...]
    first_frame_crc32: tuple[int, ...] = ()
    """Per camera, of the first frame's pixels; tells a resumed run that it reads the same videos."""
    source: str | None = None
    """File or folder of the capture; it may be moved, and tells no captures apart."""

    @staticmethod
    def from_capture(capture: Capture) -> CaptureInfo:
        """Describe ``capture``; decodes the first frame of each camera."""
        checksums = tuple(
            zlib.crc32(capture.read(index, 0).tobytes()) for index in range(len(capture.cameras))
        )
        source = None if capture.source is None else str(capture.source)
        return CaptureInfo(capture.name, capture.fps, capture.frame_count, capture.cameras, checksums, source)

    def to_manifest(self) -> dict[str, Any]:
        """The ``capture`` entry of the manifest, as plain JSON values."""
        entry: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        del entry["source"]
        for camera in entry["cameras"]:
            # so that runs of versions that knew no other go on
            if camera["focal_known"]:
                del camera["focal_known"]
        return entry


def new_manifest(capture_info: CaptureInfo, config: Mapping[str, Any], unit: str) -> dict[str, Any]:
    """Manifest of a run that starts now. Raises ResultError when a camera name cannot be a file name."""
    for camera in capture_info.cameras:
        if not re.fullmatch(r"[\w][\w .+-]*", camera.name):
            raise ResultError(f"camera name {camera.name!r} cannot be a file name; rename it in capture.json")
    return {
        "format": FORMAT,
        "schema": SCHEMA,
        "status": Status.RUNNING.value,
        "unit": unit,
        "conventions": CONVENTIONS,
        "capture": capture_info.to_manifest(),
        "capture_source": capture_info.source,
        "groups": [],
        "stages": [],
        "notes": [],
        "config": dict(config),
        "versions": library_versions(),
        "machine": {"platform": platform.platform(), "cpu_count": os.cpu_count()},
    }


def library_versions() -> dict[str, str]:
    """Installed versions of Python and of the libraries that decide the numbers."""
    versions = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of ``folder``. Raises ResultError in one line when there is none that can be used."""
    path = folder / MANIFEST_NAME
    if not path.is_file():
        raise ResultError(
            f"{folder}: not a reconstruction (no {MANIFEST_NAME}); make one with: mvdyn reconstruct"
        )
    try:
        manifest = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ResultError(
            f"{path}: cannot be read ({error}); remove its folder, or reconstruct again with --overwrite"
        ) from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ResultError(f'{path}: not the manifest of a reconstruction ("format" is not "{FORMAT}")')
    if manifest.get("schema") != SCHEMA:
        raise ResultError(
            f"{path}: schema {manifest.get('schema')!r}, this version reads {SCHEMA};"
            " update mvdyn_gtsam or reconstruct again"
        )
    problem = _layout_problem(manifest)
    if problem:
        raise ResultError(f"{path}: {problem}; remove its folder, or reconstruct again with --overwrite")
    return manifest


def is_reconstruction(folder: Path) -> bool:
    """Whether ``folder`` holds a manifest of ours, however broken the rest is."""
    path = folder / MANIFEST_NAME
    try:
        return path.is_file() and f'"{FORMAT}"' in path.read_text(errors="replace")
    except OSError as error:
        raise ResultError(f"{path}: cannot be read ({error.strerror})") from error


def cameras_of(manifest: Mapping[str, Any]) -> tuple[Camera, ...]:
    """The cameras of a manifest, with the intrinsics that were found."""
    return tuple(
        Camera(
            **{
                **entry,
                "distortion": tuple(entry.get("distortion", ())),
                **_found_intrinsics(manifest, entry["name"]),
            }
        )
        for entry in manifest["capture"]["cameras"]
    )


def _found_intrinsics(manifest: Mapping[str, Any], camera: str) -> dict[str, float]:
    found = manifest.get("found_intrinsics", {}).get(camera)
    return {} if found is None else {key: float(found[key]) for key in FOUND_KEYS}


def _layout_problem(manifest: Mapping[str, Any]) -> str | None:
    for key, kind in (
        ("status", str),
        ("capture", dict),
        ("groups", list),
        ("stages", list),
        ("config", dict),
    ):
        if not isinstance(manifest.get(key), kind):
            return f'"{key}" is missing or no {kind.__name__}'
    capture = manifest["capture"]
    if not isinstance(capture.get("frame_count"), int) or not isinstance(capture.get("fps"), int | float):
        return '"capture" has no frame_count or fps'
    if capture["fps"] <= 0:
        return '"capture" has an fps that is not positive'
    try:
        names = [camera.name for camera in cameras_of(manifest)]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        return f'"capture" has cameras that cannot be read ({error})'
    return _groups_problem(manifest["groups"], names)


def _groups_problem(groups: Sequence[Any], names: Sequence[str]) -> str | None:
    if not all(isinstance(group, list) for group in groups):
        return '"groups" is not a list of lists of camera names'
    members = [name for group in groups for name in group]
    unknown = [name for name in members if name not in names]
    if unknown:
        return f'"groups" names the unknown camera {unknown[0]!r}'
    if len(set(members)) != len(members):
        return '"groups" names a camera twice'
    return None
