"""``import.json``: what a folder of another method's results cannot say by itself."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from mvdyn_gtsam.errors import ResultError

OPTIONS_NAME = "import.json"


@dataclass(frozen=True)
class ImportOptions:
    """Keys of ``import.json``, all optional."""

    convention: str | None = None
    """``wTc`` (camera-to-world, the default) or ``cTw`` (world-to-camera, "extrinsics")."""
    axes: str | None = None
    """Of the camera: ``opencv`` (x right, y down, z forward) or ``opengl`` (y up, z backward)."""
    timestamps: str = "seconds"
    """Of TUM lines: ``seconds`` on the clock of the capture, or ``frames``, which are frame numbers."""
    first_frame: int = 0
    """Number that the first frame has in file names and frame numbers: 0, or 1 after ``ffmpeg %06d.png``."""
    depth_scale: float | None = None
    """Depth = value * depth_scale of 16-bit PNG, in the unit of the poses."""


_CHOICES = {
    "convention": ("wTc", "cTw"),
    "axes": ("opencv", "opengl"),
    "timestamps": ("seconds", "frames"),
}


def read_options(folders: Sequence[Path]) -> ImportOptions:
    """``import.json`` of the first of ``folders`` that has one; the defaults where none has.

    Raises ResultError for a key or value that does not exist.
    """
    path = next((folder / OPTIONS_NAME for folder in folders if (folder / OPTIONS_NAME).is_file()), None)
    if path is None:
        return ImportOptions()
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ResultError(f"{path}: cannot be read as JSON ({error})") from error
    known = [field.name for field in fields(ImportOptions)]
    if not isinstance(content, dict) or not set(content) <= set(known):
        wrong = sorted(set(content) - set(known)) if isinstance(content, dict) else [content]
        raise ResultError(f"{path}: {wrong[0]!r} is none of the keys {', '.join(known)}")
    for key, value in content.items():
        _check(path, key, value)
    return ImportOptions(**content)


def _check(path: Path, key: str, value: Any) -> None:
    if key in _CHOICES:
        if value not in _CHOICES[key]:
            raise ResultError(f'{path}: "{key}" is {value!r}; it must be {" or ".join(_CHOICES[key])}')
        return
    kind: Any = int if key == "first_frame" else (int, float)
    if isinstance(value, bool) or not isinstance(value, kind) or not math.isfinite(value) or value < 0:
        raise ResultError(f'{path}: "{key}" is {value!r}; it must be a number that is not negative')
    if key == "depth_scale" and value == 0:
        raise ResultError(f'{path}: "depth_scale" is 0; it must be the depth of one unit of the PNG')
