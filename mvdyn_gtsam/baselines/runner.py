"""Run COLMAP or GLOMAP on a capture, in a process of its own, and read the result back."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.baselines.settings import METHODS, RESULT_NAME, BaselineSettings, Method, Request
from mvdyn_gtsam.baselines.shared import SharedCost
from mvdyn_gtsam.errors import BaselineError
from mvdyn_gtsam.reconstruction import Reconstruction


@dataclass(frozen=True)
class BaselineResult:
    """A finished baseline run; ``folder`` is a reconstruction folder without depth."""

    method: Method
    folder: Path
    trajectories: Mapping[str, npt.NDArray[np.float64]]
    """Camera -> ``wTc`` ``(T, 4, 4)``, NaN for frames outside the largest model."""
    registered: float
    """Fraction of all frames with a pose."""
    phases: Mapping[str, float]
    """Seconds of ``frames``, ``features``, ``matching``, ``mapping``; maybe ``masks``, ``retrieval``."""
    seconds: float
    """The whole process, plus the phases taken over from another method's run."""
    cpu_seconds: float
    """The same in user and system time."""
    peak_mb: float
    """Of this process or of the one that made what it took over, whichever is more."""
    points: int
    """Sparse points of the model."""


def run_baseline(
    capture: Path,
    method: Method,
    out: Path,
    *,
    settings: BaselineSettings | None = None,
    database: Path | None = None,
    truncate: bool = False,
    estimate_focal: bool = False,
    timeout_s: float | None = None,
) -> BaselineResult:
    """Reconstruct the capture folder with COLMAP (incremental) or GLOMAP (global mapping).

    Focal lengths that the capture does not know, or none with ``estimate_focal``, are left to the method.
    ``database`` names a folder where frames, features and matches are kept: the next method given the same
    folder, capture and settings starts from them, and their time and memory count for both. The log is
    ``<out>.log``. Raises BaselineError, with the reason in one line, when the method fails or finds no model;
    ResultError when ``out`` is in use.
    """
    if method not in METHODS:
        raise BaselineError(f"method {method!r} is none of {', '.join(METHODS)}")
    request = Request(
        capture, method, out, settings or BaselineSettings(), database, truncate, estimate_focal
    )
    usage = run_worker(request, timeout_s)
    if usage.problem is not None:
        raise BaselineError(f"{method}: {usage.problem}; log: {log_path(out)}")
    return read_result(method, out, usage)


def run_worker(request: Request, timeout_s: float | None = None) -> ProcessUsage:
    """As :func:`run_baseline`, but a failure is told in the usage and the result is left on disk.

    The usage includes what the method took over from an earlier one.
    """
    out = request.out
    # Not inside `out`: the worker accepts an empty folder or a reconstruction, nothing else.
    request_path = out.with_name(f"{out.name}.request.json")
    try:
        (out / RESULT_NAME).unlink(missing_ok=True)  # of an earlier run
        out.parent.mkdir(parents=True, exist_ok=True)
        request_path.write_text(json.dumps(request.to_json()))
    except OSError as error:
        raise BaselineError(f"{request_path}: cannot be written ({error.strerror})") from error
    command = [sys.executable, "-m", "mvdyn_gtsam.baselines.worker", str(request_path)]
    usage = run_measured(command, log_path(out), timeout_s=timeout_s)
    request_path.unlink()
    if not (out / RESULT_NAME).is_file():
        return usage  # it failed before there was anything to take over
    reused = SharedCost.from_json(_read_json(out / RESULT_NAME)["reused"])
    return dataclasses.replace(
        usage,
        seconds=usage.seconds + sum(reused.seconds.values()),
        cpu_seconds=None if usage.cpu_seconds is None else usage.cpu_seconds + reused.cpu_seconds,
        peak_mb=None if usage.peak_mb is None else max(usage.peak_mb, reused.peak_mb),
    )


def log_path(out: Path) -> Path:
    """Where the process that writes the folder ``out`` puts what it says."""
    return out.with_name(f"{out.name}.log")


def read_result(method: Method, out: Path, usage: ProcessUsage) -> BaselineResult:
    """Read back what the worker wrote. Raises BaselineError when it is not there."""
    content = _read_json(out / RESULT_NAME)
    reconstruction = Reconstruction.load(out)
    trajectories = {camera: reconstruction.trajectory(camera)[1] for camera in reconstruction.cameras}
    found = np.concatenate([np.isfinite(wTc).all(axis=(1, 2)) for wTc in trajectories.values()])
    return BaselineResult(
        method=method,
        folder=out,
        trajectories=trajectories,
        registered=float(found.mean()),
        phases=content["phases"],
        seconds=usage.seconds,
        cpu_seconds=usage.cpu_seconds if usage.cpu_seconds is not None else float("nan"),
        peak_mb=usage.peak_mb if usage.peak_mb is not None else float("nan"),
        points=int(content["points"]),
    )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise BaselineError(f"{path}: cannot be read ({error})") from error
    return content
