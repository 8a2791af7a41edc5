"""EuRoC MAV recordings in the ASL folder layout: ``mav0/camN`` with ``sensor.yaml`` and ``data.csv``.

Layout: https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mvdyn_gtsam.capture.assemble import Source, assemble_capture
from mvdyn_gtsam.capture.images import natural_key, read_bytes
from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.capture.streams import ImageStream
from mvdyn_gtsam.errors import CaptureError

logger = logging.getLogger(__name__)

_NO_DISTORTION = ("none", "")
_RADIAL_TANGENTIAL = ("radial-tangential", "radtan", "plumb_bob")


def is_euroc(folder: Path) -> bool:
    """Whether ``folder`` is an ASL recording, or its ``mav0``."""
    return any((folder / inner).glob("cam*/sensor.yaml") for inner in (".", "mav0")) and bool(
        _sensors(folder)
    )


def load_euroc(folder: Path, *, cameras: Sequence[str] | None = None, truncate: bool = False) -> Capture:
    """Load the cameras of an ASL folder (all, or those named), at the instants given in ``data.csv``.

    Frames belong together when their time stamps are equal; an instant that a camera lacks is refused,
    or left out with ``truncate``. Raises CaptureError naming the file and the fix.
    """
    folder = Path(folder)
    sensors = _sensors(folder)
    if not sensors:
        raise CaptureError(f"{folder}: no mav0/cam*/sensor.yaml here; give the folder of one ASL recording")
    if cameras is not None:
        by_name = {sensor.parent.name: sensor for sensor in sensors}
        missing = [name for name in cameras if name not in by_name]
        if missing:
            raise CaptureError(
                f"{folder}: there is no camera {missing[0]}; choose among {', '.join(by_name)}"
            )
        sensors = [by_name[name] for name in cameras]
    tables = {sensor.parent.name: _read_table(sensor.parent) for sensor in sensors}
    stamps = _shared_stamps(folder, tables, truncate)
    fps = 1e9 / float(np.median(np.diff(stamps)))
    sources = []
    for sensor in sensors:
        table = tables[sensor.parent.name]
        stream = ImageStream([table[stamp] for stamp in stamps], label=str(sensor.parent / "data"), fps=fps)
        sources.append(Source(_camera(sensor), stream))
    return assemble_capture(folder.resolve().name, fps, sources, truncate=truncate)


def _sensors(folder: Path) -> list[Path]:
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    return sorted(root.glob("cam*/sensor.yaml"), key=lambda sensor: natural_key(sensor.parent))


def _camera(sensor: Path) -> Camera:
    try:
        content = yaml.safe_load(read_bytes(sensor))
    except yaml.YAMLError as error:
        raise CaptureError(f"{sensor}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise CaptureError(f"{sensor}: must hold the keys intrinsics and resolution")
    fx, fy, cx, cy = _numbers(content, "intrinsics", 4, sensor)
    width, height = _numbers(content, "resolution", 2, sensor)
    model = content.get("camera_model", "pinhole")
    if model != "pinhole":
        raise CaptureError(
            f"{sensor}: camera_model {model!r} is not read; undistort the images to a pinhole first"
        )
    return Camera(
        sensor.parent.name, int(width), int(height), fx, fy, cx, cy, distortion=_distortion(content, sensor)
    )


def _distortion(content: Mapping[str, Any], sensor: Path) -> tuple[float, ...]:
    model = content.get("distortion_model") or ""
    if model in _NO_DISTORTION:
        return ()
    if model not in _RADIAL_TANGENTIAL:
        raise CaptureError(
            f"{sensor}: distortion_model {model!r} is not read (radial-tangential is); undistort first"
        )
    return _numbers(content, "distortion_coefficients", 4, sensor)


def _numbers(content: Mapping[str, Any], key: str, count: int, sensor: Path) -> tuple[float, ...]:
    values = content.get(key)
    try:
        numbers = tuple(float(value) for value in values or ())
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count:
        raise CaptureError(f'{sensor}: "{key}" must be a list of {count} numbers, not {values!r}')
    return numbers


def _read_table(camera: Path) -> dict[int, Path]:
    """Image file by time stamp (ns) of one camera."""
    path = camera / "data.csv"
    table: dict[int, Path] = {}
    lines = read_bytes(path).decode("utf-8", errors="replace").splitlines()
    for number, row in enumerate(csv.reader(lines, skipinitialspace=True), start=1):
        if not row or row[0].startswith("#"):
            continue
        if len(row) < 2 or not row[0].strip().isdigit():
            raise CaptureError(
                f"{path}: line {number} must be 'timestamp [ns],filename', not {','.join(row)!r}"
            )
        table[int(row[0])] = camera / "data" / row[1].strip()
    if not table:
        raise CaptureError(f"{path}: lists no images; copy it again from its source")
    return table


def _shared_stamps(folder: Path, tables: Mapping[str, Mapping[int, Path]], truncate: bool) -> list[int]:
    every = set.union(*(set(table) for table in tables.values()))
    shared = sorted(set.intersection(*(set(table) for table in tables.values())))
    for name, table in tables.items():
        missing = every - set(table)
        if missing and not truncate:
            raise CaptureError(
                f"{folder}: camera {name} is short: it has no image at {len(missing)} of {len(every)} "
                f"instants, first at {min(missing)} ns; supply them, or accept the {len(shared)} shared ones "
                "with --truncate (truncate=True)"
            )
    if len(shared) < 2:
        raise CaptureError(
            f"{folder}: fewer than two instants are seen by every camera; check the time stamps"
        )
    steps = np.diff(shared)
    uneven = int(np.count_nonzero(np.abs(steps / np.median(steps) - 1.0) > 0.5))
    if uneven:
        logger.warning("%s: %d time steps are longer than the rest; motion there is larger", folder, uneven)
    return shared
