"""One table of several methods on the same frames of the same capture, one after the other on one machine."""

from __future__ import annotations

import json
import logging
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from mvdyn_gtsam.baselines.masks import find_masks
from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.baselines.results import Comparison, MethodResult
from mvdyn_gtsam.baselines.runner import log_path, run_worker
from mvdyn_gtsam.baselines.settings import ALL_FOCALS_REFINED, BASELINES, BaselineSettings, Request
from mvdyn_gtsam.capture import Capture, open_capture, with_unknown_focal
from mvdyn_gtsam.errors import BaselineError, MvdynError
from mvdyn_gtsam.evaluation import GroundTruth, ReconstructionLike, evaluate, load_groundtruth
from mvdyn_gtsam.evaluation.comparison_plots import save_comparison_plots
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.reconstruction.imports import load_result

OURS = "ours"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Inputs:
    """What every method of one comparison is given."""

    capture: Path
    stage: str
    truncate: bool
    estimate_focal: bool
    timeout_s: float | None
    our_arguments: Sequence[str]
    database: Path | None
    settings: Mapping[str, BaselineSettings]
    """Of each baseline."""
    imported: Mapping[str, ReconstructionLike]
    paths: Mapping[str, Path]
    """Where the imported ones came from."""


def compare(
    capture: Path,
    groundtruth: Path | None,
    methods: Sequence[str],
    out: Path,
    *,
    imported: Mapping[str, Path] | None = None,
    stage: str = "tracking",
    settings: BaselineSettings | None = None,
    database: Path | None = None,
    share_matches: bool = False,
    truncate: bool = False,
    estimate_focal: bool = False,
    timeout_s: float | None = None,
    our_arguments: Sequence[str] = (),
    plots: bool = True,
    on_finished: Callable[[MethodResult], None] | None = None,
) -> Comparison:
    """Run each method (``ours`` or one of ``BASELINES``) in a process of its own and score what it wrote.

    ``out/<method>`` holds each result, ``out/<method>.log`` what it said, ``out/compare.json`` and
    ``compare.md`` the table, written anew after each method so that an interrupted comparison keeps what was
    done; ``plots`` adds ``trajectories.png`` and ``error.png`` at the end. Without ground truth only
    registration, time and memory are compared.

    ``imported`` names results made elsewhere (``load_result`` reads them), which become rows without time
    and memory. Of ``settings``, ``masks`` serves the masked baselines alone (see ``find_masks``),
    ``descriptor`` and ``retrieval_pairs`` those with retrieval; ``pairing`` is the method's. With
    ``database``, a folder that is kept, baselines of equal settings share frames, features and matches, in
    this comparison and later ones of the same capture; ``share_matches`` does so for this one alone. What is
    taken over counts in time and memory of each. With ``estimate_focal`` every method that is run has to find
    the focal lengths, whatever the capture knows. ``our_arguments`` are added to our command.

    Raises BaselineError for an unknown method and for masks or a descriptor that are missing, EvaluationError
    for unusable ground truth, ResultError for an imported result that is none, CaptureError for a camera with
    distortion and ``estimate_focal``: all before anything runs. A method that fails becomes a row that says
    so.
    """
    paths = dict(imported or {})
    methods = list(dict.fromkeys(methods))
    _check_names(methods, paths)
    truth = None if groundtruth is None else load_groundtruth(groundtruth)
    base = settings or BaselineSettings()
    needs_capture = paths or estimate_focal or any(BASELINES[m].masked for m in methods if m != OURS)
    opened = open_capture(capture, truncate=truncate) if needs_capture else None
    if opened is not None and estimate_focal:
        with_unknown_focal(opened)  # refuses what no method can do without them
    inputs = _Inputs(
        capture=capture,
        stage=stage,
        truncate=truncate,
        estimate_focal=estimate_focal,
        timeout_s=timeout_s,
        our_arguments=our_arguments,
        database=out / "matches" if share_matches and database is None else database,
        settings={m: settings_of(m, base, opened, groundtruth) for m in methods if m != OURS},
        imported={name: load_result(path, opened) for name, path in paths.items()} if opened else {},
        paths=paths,
    )
    results: list[MethodResult] = []
    name = Path(capture).resolve().name
    for method in (*methods, *paths):
        results.append(_row(method, inputs, out, truth))
        if on_finished is not None:
            on_finished(results[-1])
        _write(Comparison(name, tuple(results)), out)
    if share_matches and database is None:
        shutil.rmtree(out / "matches", ignore_errors=True)
    if plots and truth is not None:
        _plot(results, inputs, truth, out)
    return Comparison(name, tuple(results))


def settings_of(
    method: str, base: BaselineSettings, capture: Capture | None, groundtruth: Path | None
) -> BaselineSettings:
    """Of the baseline called ``method``; what it has no use for is at its default, so that equal means equal.

    Raises BaselineError where masks or the descriptor that it needs are missing.
    """
    baseline = BASELINES[method]
    result = replace(
        base, pairing=baseline.pairing, masks=None, descriptor=None,
        retrieval_pairs=BaselineSettings.retrieval_pairs,
    )  # fmt: skip
    if baseline.masked and capture is not None:
        result = replace(result, masks=find_masks(capture, base.masks, groundtruth))
    if baseline.pairing == "retrieval":
        if base.descriptor is None:
            raise BaselineError(
                f"{method} needs a global descriptor: give its ONNX model with --descriptor, or compare with"
                f" {baseline.method}-exhaustive, which matches every frame with every other"
            )
        if not base.descriptor.is_file():
            raise BaselineError(f"{base.descriptor}: there is no such ONNX model; check the path")
        result = replace(result, descriptor=base.descriptor, retrieval_pairs=base.retrieval_pairs)
    return result


def our_command(capture: Path, folder: Path, stage: str, arguments: Sequence[str] = ()) -> list[str]:
    """The command line of our own method, as a user would give it."""
    return [
        *(sys.executable, "-m", "mvdyn_gtsam.cli.main", "reconstruct", str(capture), "--out", str(folder)),
        *("--stage", stage, "--overwrite", *arguments),
    ]


def _check_names(methods: Sequence[str], imported: Mapping[str, Path]) -> None:
    known = (OURS, *BASELINES)
    for method in methods:
        if method not in known:
            raise BaselineError(
                f"method {method!r} is none of {', '.join(known)}; a result made elsewhere is given as"
                " --method NAME=PATH"
            )
    for name in imported:
        if name in known:
            raise BaselineError(f"--method {name}={imported[name]}: {name} is a method of its own; rename it")
    if not methods and not imported:
        raise BaselineError(
            f"no method to compare; choose from {', '.join(known)}, or give --method NAME=PATH"
        )


def _row(method: str, inputs: _Inputs, out: Path, truth: GroundTruth | None) -> MethodResult:
    if method in inputs.imported:
        logger.info("%s: reading %s", method, inputs.paths[method])
        return _result(method, inputs.paths[method], None, inputs, truth)
    logger.info("%s: running", method)
    folder = out / method
    if method == OURS:
        extra = [*(["--truncate"] if inputs.truncate else []), *inputs.our_arguments]
        extra += ["--estimate-focal"] if inputs.estimate_focal else []
        usage = _run_ours(inputs.capture, folder, inputs.stage, extra, inputs.timeout_s)
    else:
        request = Request(
            inputs.capture,
            BASELINES[method].method,
            folder,
            inputs.settings[method],
            inputs.database,
            inputs.truncate,
            inputs.estimate_focal,
        )
        usage = run_worker(request, inputs.timeout_s)
    return _result(method, folder, usage, inputs, truth)


def _run_ours(
    capture: Path, folder: Path, stage: str, arguments: Sequence[str], timeout_s: float | None
) -> ProcessUsage:
    command = our_command(capture, folder, stage, arguments)
    return run_measured(command, log_path(folder), timeout_s=timeout_s)


def _result(
    method: str, folder: Path, usage: ProcessUsage | None, inputs: _Inputs, truth: GroundTruth | None
) -> MethodResult:
    problem = None if usage is None else usage.problem
    scores, registered, note = None, 0.0, None
    if problem is None:
        try:
            reconstruction = inputs.imported[method] if usage is None else Reconstruction.load(folder)
            registered = _registered(reconstruction)
            if isinstance(reconstruction, Reconstruction):
                note = ALL_FOCALS_REFINED if ALL_FOCALS_REFINED in reconstruction.manifest["notes"] else None
            scores = None if truth is None else evaluate(reconstruction, truth)
        except MvdynError as error:
            problem = str(error)
    if problem is not None:
        logger.warning("%s failed: %s", method, problem)
    return MethodResult(
        method=method,
        problem=problem,
        scores=scores,
        seconds=None if usage is None else usage.seconds,
        cpu_seconds=None if usage is None else usage.cpu_seconds,
        peak_mb=None if usage is None else usage.peak_mb,
        folder=folder,
        registered=registered,
        note=note,
    )


def _registered(reconstruction: ReconstructionLike) -> float:
    poses = np.concatenate([reconstruction.trajectory(camera)[1] for camera in reconstruction.cameras])
    return float(np.isfinite(poses).all(axis=(1, 2)).mean())


def _plot(results: Sequence[MethodResult], inputs: _Inputs, truth: GroundTruth, out: Path) -> None:
    scored = {
        result.method: inputs.imported.get(result.method) or Reconstruction.load(result.folder)
        for result in results
        if result.scores is not None
    }
    if not scored:
        return
    if find_spec("matplotlib") is None:
        logger.info("no plots: matplotlib is not installed (pip install mvdyn_gtsam[eval])")
        return
    try:
        for path in save_comparison_plots(scored, truth, out):
            logger.info("plot: %s", path)
    except MvdynError as error:  # the table is written and worth more
        logger.warning("%s", error)


def _write(comparison: Comparison, out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "compare.json").write_text(json.dumps(comparison.to_json(), indent=1) + "\n")
        (out / "compare.md").write_text(comparison.to_markdown())
    except OSError as error:
        raise BaselineError(f"{out}: the comparison cannot be written ({error.strerror})") from error
