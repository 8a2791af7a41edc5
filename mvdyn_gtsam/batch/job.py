"""What a Dask worker does with one clip."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.batch.clips import Clip, groundtruth_of, has_groundtruth
from mvdyn_gtsam.batch.report import Row, State
from mvdyn_gtsam.errors import MvdynError, ResultError
from mvdyn_gtsam.frontend.depth_priors.depth_files import depth_files_name
from mvdyn_gtsam.reconstruction import Reconstruction, is_reconstruction
from mvdyn_gtsam.resuming import resumed

RUN_FILE = "run"
CONFIG_FILE = "config.json"
_GUARD = Path(__file__).with_name("guard.py")


class ClipKilledError(Exception):
    """The process of a clip was killed; raised so that Dask runs the clip again."""


@dataclass(frozen=True)
class Plan:
    """What is done with every clip; paths must be the same on all machines of the cluster."""

    out: Path
    stage: str
    run: str
    """Name of this run of the batch; the clips stop when ``run_file`` no longer holds it."""
    threads: int | None = None
    """Per clip; None: the processors of the worker's machine, shared out among its clips."""
    timeout_s: float | None = None
    evaluate: bool = True
    command: tuple[str, ...] = ()
    """In place of ``mvdyn reconstruct``, for tests."""
    depth_priors: Path | None = None
    """Folder of the depth priors, one folder per clip, or the ONNX file of a network for all clips."""
    depth_model: str | None = None
    """Which network that file holds, where it does not tell."""
    depth_network: str | None = None
    """What results call that file; None for a folder."""

    @property
    def state_folder(self) -> Path:
        """Where locks and the configuration are."""
        return self.out / ".batch"

    @property
    def run_file(self) -> Path:
        """Holds the name of the run that is on."""
        return self.state_folder / RUN_FILE

    @property
    def config_file(self) -> Path:
        """The settings that are asked for; the others have their defaults, or what a clip began with."""
        return self.state_folder / CONFIG_FILE

    def result(self, clip: Clip) -> Path:
        """The reconstruction of ``clip``."""
        return self.out / clip.name

    def log(self, clip: Clip) -> Path:
        """What its process said."""
        return self.out / f"{clip.name}.log"

    def depth_prior(self, clip: Clip) -> Path | None:
        """The depth prior of ``clip``, None where it has none."""
        if self.depth_priors is None or self.depth_network is not None:
            return self.depth_priors
        folder = self.depth_priors / clip.name
        return folder if folder.is_dir() else None

    def depth_prior_name(self, clip: Clip) -> str | None:
        """What a result made with it says of it."""
        if self.depth_network is not None:
            return self.depth_network
        folder = self.depth_prior(clip)
        return None if folder is None else depth_files_name(folder)

    def wanted(self) -> bool:
        """Whether the run is still on."""
        return self.run_file.read_text() == self.run

    def end(self) -> None:
        """Tell every clip that still runs, wherever it does, to stop."""
        self.run_file.write_text("")


def reconstruct_clip(clip: Clip, plan: Plan) -> Row:
    """Reconstruct ``clip``, going on where an earlier attempt stopped, and score it.

    A fresh process does it, not this one: a crash or a leak in native code cannot take the worker along, and
    it may start processes of its own, which Dask's daemonic workers may not. A failure is a row.
    Raises ClipKilledError where that process was killed by a signal.
    """
    try:
        return _reconstruct(clip, plan)
    except (MvdynError, OSError) as error:
        return Row(clip.name, State.FAILED, problem=one_line(error))


def is_finished(clip: Clip, plan: Plan) -> bool:
    """Whether the result is there, made with the settings and the depth prior that the plan asks for.

    With others it is not: ``mvdyn reconstruct --resume`` then says what differs.
    """
    if not is_reconstruction(plan.result(clip)):
        return False
    result, depth_prior = Reconstruction.load(plan.result(clip)), plan.depth_prior_name(clip)
    if depth_prior is not None and result.manifest.get("depth_prior") != depth_prior:
        return False
    asked = json.loads(plan.config_file.read_text())
    try:
        resumed(result.manifest["config"], result.stages, asked)
    except ResultError:
        return False
    return plan.stage in result.stages


def needs_scores(clip: Clip, plan: Plan, row: Row | None) -> bool:
    """Whether a finished clip has ground truth that it was not compared with."""
    return plan.evaluate and has_groundtruth(clip.folder) and (row is None or row.ate_m is None)


def described(clip: Clip, plan: Plan, state: State) -> Row:
    """The row of a finished clip, without time, memory and scores."""
    import numpy as np

    result = Reconstruction.load(plan.result(clip))
    poses = np.concatenate([result.trajectory(camera)[1] for camera in result.cameras])
    registered = float(np.isfinite(poses).all(axis=(1, 2)).mean())
    return Row(
        clip.name,
        state,
        len(result.cameras),
        result.frame_count,
        registered,
        groups=len(result.groups),
    )


def one_line(error: BaseException) -> str:
    """The message of an error, which some libraries spread over lines."""
    text = " ".join(str(error).split())
    return text if isinstance(error, MvdynError) else f"{type(error).__name__}: {text}"


def _reconstruct(clip: Clip, plan: Plan) -> Row:
    if not plan.wanted():
        return Row(clip.name, State.UNFINISHED)
    state, usage = State.KEPT, None
    if not is_finished(clip, plan):
        state = State.RESUMED if is_reconstruction(plan.result(clip)) else State.DONE
        usage = _run(clip, plan)
        if usage.problem is not None:
            return _unsuccessful(clip, plan, usage)
    row = described(clip, plan, state)
    if usage is not None:
        row = dataclasses.replace(row, seconds=usage.seconds, peak_mb=usage.peak_mb)
    return _scored(clip, plan, row) if needs_scores(clip, plan, None) else row


def _run(clip: Clip, plan: Plan) -> ProcessUsage:
    guard = [sys.executable, "-I", str(_GUARD), str(plan.state_folder / f"{clip.name}.lock")]
    guard += [str(os.getpid()), str(plan.run_file), plan.run]
    threads = plan.threads or _fair_share()
    command = [*(plan.command or (sys.executable, "-m", "mvdyn_gtsam.cli.main", "reconstruct"))]
    command += [str(clip.folder), "--out", str(plan.result(clip)), "--stage", plan.stage, "--resume"]
    command += ["--config", str(plan.config_file)]
    if (depth_prior := plan.depth_prior(clip)) is not None:
        command += ["--depth-prior", str(depth_prior)]
        command += ["--depth-model", plan.depth_model] if plan.depth_model is not None else []
    if not json.loads(plan.config_file.read_text()).get("refinement", {}).get("workers"):  # 0 is the default
        command += ["--set", f"refinement.workers={threads}"]
    environment = {**os.environ, **dict.fromkeys(("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), str(threads))}
    environment["PYTHON_CPU_COUNT"] = str(threads)  # what os.cpu_count() says, from Python 3.13 on
    return run_measured([*guard, *command], plan.log(clip), timeout_s=plan.timeout_s, environment=environment)


def _fair_share() -> int:
    from distributed import get_worker

    from mvdyn_gtsam.refinement.pool import worker_count

    return max(1, worker_count(0) // get_worker().state.nthreads)


def _unsuccessful(clip: Clip, plan: Plan, usage: ProcessUsage) -> Row:
    if not plan.wanted():
        return Row(clip.name, State.UNFINISHED, seconds=usage.seconds)
    timed_out = plan.timeout_s is not None and usage.seconds >= plan.timeout_s
    if usage.exit_code < 0 and not timed_out:
        raise ClipKilledError(usage.problem)
    return Row(clip.name, State.FAILED, seconds=usage.seconds, peak_mb=usage.peak_mb, problem=usage.problem)


def _scored(clip: Clip, plan: Plan, row: Row) -> Row:
    from mvdyn_gtsam.evaluation import evaluate

    try:
        result = Reconstruction.load(plan.result(clip))
        scores = evaluate(result, groundtruth_of(clip.folder, result))
    except MvdynError as error:  # the reconstruction is good all the same
        return dataclasses.replace(row, problem=f"not scored: {one_line(error)}")
    abs_rel = None if scores.depth is None else scores.depth.abs_rel
    return dataclasses.replace(row, ate_m=_finite(scores.ate_m), abs_rel=_finite(abs_rel))


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
