"""One run of one variant: tracked in a process of its own, scored, and summed up as an entry."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.ablations.starts import make_start, write_start
from experiments.ablations.studies import Variant
from experiments.records import ROOT, ExperimentError, finite, key_of
from mvdyn_gtsam.baselines.process import run_measured
from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.config import load_config, to_dict
from mvdyn_gtsam.errors import MvdynError
from mvdyn_gtsam.evaluation import evaluate, load_groundtruth
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.tracking.model import View

KINDS = ("temporal", "spatial", "spatio_temporal")


def run_key(capture: Path, variant: Variant, overrides: Sequence[str]) -> str:
    """What decides a run's figures, whatever it is called: studies share what they have in common.

    Raises ConfigError for unknown settings.
    """
    settings = to_dict(load_config(None, [*overrides, *variant.settings]))
    del settings["refinement"]
    return key_of(capture=capture.resolve().name, start=variant.start.describe(), settings=settings)


def check_truth(capture: Path) -> None:
    """Raises ExperimentError where there is nothing to score against: hours later would be too late."""
    if not (capture / "groundtruth").is_dir():
        raise ExperimentError(
            f"{capture}: has no groundtruth folder; an ablation is scored against true poses"
        )


def measure(
    capture: Path, variant: Variant, overrides: Sequence[str], work: Path, timeout_s: float | None = None
) -> dict[str, Any]:
    """Track and score; a variant that fails is an entry that says so.

    The start is made beforehand and not part of time and memory. Starts and logs stay in ``work``, the
    reconstruction does not.
    """
    settings = [*overrides, *variant.settings]
    key = run_key(capture, variant, overrides)
    folder = work / capture.resolve().name
    name = hashlib.sha256(key.encode()).hexdigest()[:12]
    out, log, given = folder / name, folder / f"{name}.log", folder / f"{name}.npz"
    entry: dict[str, Any] = {
        "capture": capture.resolve().name,
        "settings": settings,
        "start": variant.start.describe(),
        "problem": None,
        "registered": 0.0,
        "scores": None,
        "log": str(log),
    }
    shutil.rmtree(out, ignore_errors=True)
    try:
        _prepare(capture, variant, settings, folder, given)
        command = [sys.executable, "-m", "experiments.ablations.worker"]
        words = [str(capture.resolve()), str(given.resolve()), str(out.resolve()), *settings]
        usage = run_measured([*command, *words], log, timeout_s=timeout_s, environment=_environment())
        entry |= {
            "seconds": finite(usage.seconds),
            "cpu_seconds": finite(usage.cpu_seconds),
            "peak_mb": finite(usage.peak_mb),
            "problem": usage.problem,
        }
        if usage.problem is None:
            entry |= _outcome(capture, out)
    except MvdynError as error:
        entry["problem"] = str(error)
    finally:
        shutil.rmtree(out, ignore_errors=True)
        given.unlink(missing_ok=True)
    return entry


def _environment() -> dict[str, str]:
    """With the checkout on the path: the experiments are no part of the installed package."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def _prepare(capture: Path, variant: Variant, settings: Sequence[str], folder: Path, given: Path) -> None:
    loaded, truth = load_capture(capture), load_groundtruth(capture / "groundtruth")
    start = make_start(variant.start, loaded, truth, load_config(None, settings), folder)
    write_start(start, given)


def _outcome(capture: Path, out: Path) -> dict[str, Any]:
    """Scores, connections and keyframes of a finished run. Raises EvaluationError, ResultError."""
    result = Reconstruction.load(out)
    scores = evaluate(result, capture / "groundtruth").to_json()
    connections = result.arrays("connections")["frames"].reshape(-1, 4)
    loaded, config = load_capture(capture), result.manifest["config"]
    grid = View.of(loaded.cameras[0], config["tracking"]["grid_points"]).grid
    return {
        "scores": scores,
        "registered": scores["registered"],
        "groups": result.groups,
        "edges_per_step": result.diagnostics("edges_per_step"),
        "directions": len(connections),
        "directions_between_cameras": int((connections[:, 0] != connections[:, 2]).sum()),
        "keyframes": sum(len(times) for times in result.diagnostics("keyframes").values()),
        "seconds_of_parts": result.diagnostics("seconds"),
        "grid_step_px": grid.stride,
    }
