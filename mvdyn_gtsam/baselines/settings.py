"""What a baseline is run with; the defaults are the paper's."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mvdyn_gtsam.errors import BaselineError

Method = Literal["colmap", "glomap"]
METHODS: tuple[Method, ...] = ("colmap", "glomap")

RESULT_NAME = "baseline.json"
"""What the worker leaves in its folder besides the reconstruction: seconds per phase, number of points."""

Pairing = Literal["window", "exhaustive"]


@dataclass(frozen=True)
class BaselineSettings:
    """Settings of COLMAP and GLOMAP; every default is the paper's (supplement, "Parameters setting")."""

    intra_window: int = 10
    """Frame i is matched with frames i-10 .. i+10 of its own camera."""
    inter_window: int = 5
    """Frame i is matched with frames i-5 .. i+5 of every other camera."""
    pairing: Pairing = "window"
    """``window`` as in the paper; ``exhaustive``: every image with every other, a control."""
    masks: Path | None = None
    """Folder ``<camera>/<%06d>.png`` with 255 where something moves; no features are taken there."""
    num_threads: int = -1
    """Threads of every phase; -1: all cores, which is also what our own method uses."""
    random_seed: int = 0
    """Fixes RANSAC and the random start of global positioning."""

    def to_json(self) -> dict[str, Any]:
        values = dataclasses.asdict(self)
        values["masks"] = None if self.masks is None else str(self.masks)
        return values

    @staticmethod
    def from_json(values: dict[str, Any]) -> BaselineSettings:
        masks = values.get("masks")
        return BaselineSettings(**{**values, "masks": None if masks is None else Path(masks)})


@dataclass(frozen=True)
class Request:
    """What the worker process is asked for."""

    capture: Path
    method: Method
    out: Path
    settings: BaselineSettings
    database: Path | None = None
    """Folder that keeps frames, features and matches, so that a second method can start from them."""
    truncate: bool = False

    def to_json(self) -> dict[str, Any]:
        return {
            "capture": str(self.capture),
            "method": self.method,
            "out": str(self.out),
            "settings": self.settings.to_json(),
            "database": None if self.database is None else str(self.database),
            "truncate": self.truncate,
        }

    @staticmethod
    def from_json(values: dict[str, Any]) -> Request:
        if values["method"] not in METHODS:
            raise BaselineError(f"method {values['method']!r} is none of {', '.join(METHODS)}")
        return Request(
            capture=Path(values["capture"]),
            method=values["method"],
            out=Path(values["out"]),
            settings=BaselineSettings.from_json(values["settings"]),
            database=None if values["database"] is None else Path(values["database"]),
            truncate=bool(values["truncate"]),
        )
