"""What a baseline is run with; the defaults are the paper's."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mvdyn_gtsam.errors import BaselineError

Method = Literal["colmap", "glomap"]
METHODS: tuple[Method, ...] = ("colmap", "glomap")

RESULT_NAME = "baseline.json"
"""What the worker leaves in its folder besides the reconstruction: seconds per phase, number of points."""

ALL_FOCALS_REFINED = "every focal length was refined, those that are known, too: GLOMAP can hold all or none."
"""Note of a result for which some focal lengths were known."""

Pairing = Literal["window", "retrieval", "exhaustive"]


@dataclass(frozen=True)
class Baseline:
    """One row of the paper's tables: a mapper, what it matches, and whether moving things are masked."""

    method: Method
    pairing: Pairing = "window"
    masked: bool = False


BASELINES: Mapping[str, Baseline] = {
    "colmap": Baseline("colmap"),
    "glomap": Baseline("glomap"),
    "colmap-masks": Baseline("colmap", masked=True),
    "glomap-masks": Baseline("glomap", masked=True),
    "colmap-retrieval": Baseline("colmap", pairing="retrieval"),
    "glomap-retrieval": Baseline("glomap", pairing="retrieval"),
    "colmap-exhaustive": Baseline("colmap", pairing="exhaustive"),
    "glomap-exhaustive": Baseline("glomap", pairing="exhaustive"),
}
"""By name; ``exhaustive`` is a control of ours, every image with every other, and not in the paper."""


@dataclass(frozen=True)
class BaselineSettings:
    """Settings of COLMAP and GLOMAP; every default is the paper's (supplement, "Parameters setting")."""

    intra_window: int = 10
    """Frame i is matched with frames i-10 .. i+10 of its own camera."""
    inter_window: int = 5
    """Frame i is matched with frames i-5 .. i+5 of every other camera."""
    pairing: Pairing = "window"
    """``window`` as in the paper; ``retrieval``: the windows, and what a global descriptor finds most similar
    besides; ``exhaustive``: every image with every other, a control."""
    masks: Path | None = None
    """Folder ``<camera>/<%06d>.png`` of every frame; no features are taken where it is above 127 (moving)."""
    descriptor: Path | None = None
    """ONNX model of a global descriptor, for ``retrieval``: one input ``(1, 3, H, W)`` float32, RGB in
    [0, 1]; its first output is the descriptor, ``(1, D)``."""
    retrieval_pairs: int = 20
    """Frames retrieved for each, of those that the windows leave out. 20 is what hloc takes with NetVLAD for
    image sequences (--num_loc of hloc/pipelines/RobotCar/pipeline.py); the paper does not say."""
    num_threads: int = -1
    """Threads of every phase; -1: all cores, which is also what our own method uses."""
    random_seed: int = 0
    """Fixes RANSAC and the random start of global positioning."""

    def to_json(self) -> dict[str, Any]:
        values = dataclasses.asdict(self)
        return {key: str(value) if isinstance(value, Path) else value for key, value in values.items()}

    @staticmethod
    def from_json(values: dict[str, Any]) -> BaselineSettings:
        paths = {key: Path(values[key]) for key in ("masks", "descriptor") if values.get(key) is not None}
        return BaselineSettings(**{**values, **paths})


@dataclass(frozen=True)
class Request:
    """What the worker process is asked for."""

    capture: Path
    method: Method
    out: Path
    settings: BaselineSettings
    database: Path | None = None
    """Folder that keeps frames, features and matches of each capture and settings for other methods."""
    truncate: bool = False
    estimate_focal: bool = False
    """No focal length of the capture counts as known."""

    def to_json(self) -> dict[str, Any]:
        return {
            "capture": str(self.capture),
            "method": self.method,
            "out": str(self.out),
            "settings": self.settings.to_json(),
            "database": None if self.database is None else str(self.database),
            "truncate": self.truncate,
            "estimate_focal": self.estimate_focal,
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
            estimate_focal=bool(values["estimate_focal"]),
        )
