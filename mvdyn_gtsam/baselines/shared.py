"""Frames, features and matches that several methods start from, and what they took to make."""

from __future__ import annotations

import hashlib
import json
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from mvdyn_gtsam.baselines.settings import Request
from mvdyn_gtsam.reconstruction import CaptureInfo

Value = TypeVar("Value")


@dataclass(frozen=True)
class SharedCost:
    """What the phases before mapping took; every method that starts from them counts it as its own."""

    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall clock of each phase."""
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    """Peak resident memory of the process that did them, up to their end."""

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "seconds": dict(self.seconds)}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> SharedCost:
        return SharedCost(dict(values["seconds"]), float(values["cpu_seconds"]), float(values["peak_mb"]))


class Phases:
    """Wall-clock seconds of each phase, and CPU time over all of them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds = 0.0

    def run(self, name: str, work: Callable[[], Value]) -> Value:
        """Do ``work`` and keep what it took under ``name``."""
        start, cpu_start = time.monotonic(), time.process_time()
        value = work()
        self.seconds[name] = time.monotonic() - start
        self.cpu_seconds += time.process_time() - cpu_start
        return value

    def cost(self) -> SharedCost:
        """So far, with the peak memory of this process."""
        # Kilobytes on Linux, bytes on macOS.
        unit = 1024.0 if sys.platform != "darwin" else 1024.0**2
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
        return SharedCost(dict(self.seconds), self.cpu_seconds, peak_mb)


def shared_folder(database: Path, request: Request, info: CaptureInfo, version: str) -> Path:
    """Where ``database`` keeps what is made of this capture with these settings by this version of pycolmap.

    The name holds a digest of everything that decides the content, so that nothing stale is taken up;
    folders that are no longer asked for may be deleted.
    """
    settings = request.settings
    content = {
        "capture": str(request.capture.resolve()),
        "info": info.to_manifest(),
        "settings": settings.to_json(),
        "files": [_stamps(path) for path in (settings.masks, settings.descriptor) if path is not None],
        "pycolmap": version,
    }
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
    masks = "-masks" if settings.masks is not None else ""
    return database / f"{settings.pairing}{masks}-{digest}"


def _stamps(path: Path) -> list[tuple[str, int, int]]:
    """Path, size and time of change of a file, or of every file below a folder."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    states = [(file, file.stat()) for file in files]
    return [(str(file.resolve()), state.st_size, state.st_mtime_ns) for file, state in states]
