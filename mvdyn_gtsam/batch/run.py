"""A whole batch: what is there is kept, the rest runs on a cluster, the table grows with every clip."""

from __future__ import annotations

import dataclasses
import fcntl
import functools
import importlib.util
import logging
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mvdyn_gtsam.batch.clips import BatchError, Clip, find_clips, has_groundtruth
from mvdyn_gtsam.batch.job import Plan, described, is_finished, needs_scores, reconstruct_clip
from mvdyn_gtsam.batch.report import BatchReport, Row, State, read_rows
from mvdyn_gtsam.batch.scheduling import local_cluster, remote_cluster, require_dask, run_clips
from mvdyn_gtsam.config import Config, given_settings
from mvdyn_gtsam.errors import DepthPriorError, MvdynError
from mvdyn_gtsam.frontend.depth_priors.onnx_depth import OnnxDepth, is_model
from mvdyn_gtsam.progress import NullProgress, Progress
from mvdyn_gtsam.reconstruction.files import write_atomically, write_json
from mvdyn_gtsam.refinement.pool import worker_count

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class BatchSettings:
    """How a batch runs."""

    stage: str = "refinement"
    workers: int | None = None
    """Worker processes of the local cluster; None: one per processor, no more than clips."""
    threads: int | None = None
    """Per clip; None: the processors shared out among the workers."""
    scheduler: str | None = None
    """Address of a running Dask scheduler, in place of a local cluster."""
    retries: int = 3
    """How often a clip is run again when its process or worker was killed."""
    timeout_s: float | None = None
    """Per clip."""
    evaluate: bool = True
    """Score what has ground truth."""
    skip_failed: bool = False
    """Leave clips alone that failed in the earlier run."""
    depth_priors: Path | None = None
    """Folder with one folder per clip, of its name: depth of its single images. A clip without one has no
    depth prior. Or the ONNX file of a network, for all clips."""
    depth_model: str | None = None
    """Which network that file holds, where it does not tell."""
    command: tuple[str, ...] = ()
    """In place of ``mvdyn reconstruct``, for tests."""


def run_batch(
    folder: Path,
    out: Path,
    config: Config | Mapping[str, Any] | None = None,
    settings: BatchSettings | None = None,
    *,
    progress: Progress | None = None,
    on_row: Callable[[Row], None] | None = None,
) -> BatchReport:
    """Reconstruct every capture below ``folder`` into ``out/<name>``; may be called again to go on.

    ``out/<name>.log`` holds what each said, ``out/batch.json`` and ``batch.md`` the table, written anew after
    each clip. ``config`` is as in ``reconstruct`` with ``resume``: clips that were begun keep their settings.
    A clip that fails is a row. Raises, in one line, BatchError where nothing can be started or another batch
    works on ``out``, and DepthPriorError for a network that cannot be a depth prior.
    """
    settings = settings or BatchSettings()
    require_dask()
    clips = find_clips(folder, out)
    if settings.evaluate:
        _require_evaluation(clips)
    plan = Plan(
        out.absolute(),
        settings.stage,
        uuid.uuid4().hex,
        settings.threads,
        settings.timeout_s,
        settings.evaluate,
        settings.command,
        None if settings.depth_priors is None else settings.depth_priors.absolute(),
        settings.depth_model,
        _depth_network(settings),
    )
    _check_depth_priors(clips, plan)
    with _claimed(plan, given_settings(config)):
        earlier = read_rows(plan.out / "batch.json")
        rows = {clip.name: _known(clip, plan, earlier.get(clip.name)) for clip in clips}
        todo = [clip for clip in clips if _is_left(clip, plan, rows[clip.name], settings)]
        table = _Table(plan, {**earlier, **rows}, len(todo), progress or NullProgress(), on_row)
        if todo:
            _run(todo, plan, settings, table, len(rows))
    return BatchReport(settings.stage, tuple(table.rows[clip.name] for clip in clips))


class _Table:
    """The rows, on disk after each change."""

    def __init__(
        self,
        plan: Plan,
        rows: dict[str, Row],
        total: int,
        progress: Progress,
        on_row: Callable[[Row], None] | None,
    ) -> None:
        self.rows, self._plan, self._total, self._progress = rows, plan, total, progress
        self._on_row, self._done = on_row, 0
        self._write()

    def add(self, row: Row) -> None:
        earlier = self.rows[row.clip]
        if row.state is State.KEPT:  # it was only scored
            row = dataclasses.replace(row, seconds=earlier.seconds, peak_mb=earlier.peak_mb)
        self.rows[row.clip] = row
        self._write()
        self._done += 1
        if self._on_row is not None:
            self._on_row(row)
        self._progress.update("batch", self._done, self._total, row.clip)

    def _write(self) -> None:
        report = BatchReport(self._plan.stage, tuple(self.rows.values()))
        write_json(self._plan.out / "batch.json", report.to_json())
        write_atomically(self._plan.out / "batch.md", report.to_markdown().encode())


def _run(todo: Sequence[Clip], plan: Plan, settings: BatchSettings, table: _Table, total: int) -> None:
    processors = worker_count(0)
    workers = min(settings.workers or processors, len(todo))
    kept = f"{total} clips, {len(todo)} to do"
    if settings.scheduler is not None:
        logger.info("%s on the workers of %s", kept, settings.scheduler)
        cluster = remote_cluster(settings.scheduler)
    else:
        threads = settings.threads or max(1, processors // workers)
        plan = dataclasses.replace(plan, threads=threads)
        logger.info("%s; clips at once: %d, threads of each: %d", kept, workers, threads)
        cluster = local_cluster(workers, settings.retries)
    with cluster as client:
        job = functools.partial(reconstruct_clip, plan=plan)
        run_clips(client, todo, job, retries=settings.retries, on_row=table.add, stop=plan.end)


def _known(clip: Clip, plan: Plan, earlier: Row | None) -> Row:
    """What can be said of ``clip`` before anything runs."""
    try:
        kept = described(clip, plan, State.KEPT) if is_finished(clip, plan) else None
    except MvdynError as error:  # its own run will say so, too; it must not stop the others
        logger.warning("%s", error)
        kept = None
    if kept is None:
        if earlier is not None and earlier.state is State.FAILED:
            return earlier
        return Row(clip.name, State.UNFINISHED)
    if earlier is None:
        return kept
    return dataclasses.replace(
        kept,
        seconds=earlier.seconds,
        peak_mb=earlier.peak_mb,
        ate_m=earlier.ate_m,
        abs_rel=earlier.abs_rel,
    )


def _is_left(clip: Clip, plan: Plan, row: Row, settings: BatchSettings) -> bool:
    if row.state is State.KEPT:
        return needs_scores(clip, plan, row)
    return not (settings.skip_failed and row.state is State.FAILED)


def _check_depth_priors(clips: Sequence[Clip], plan: Plan) -> None:
    if plan.depth_priors is None or plan.depth_network is not None:
        return
    without = [clip.name for clip in clips if plan.depth_prior(clip) is None]
    if len(without) == len(clips):
        raise BatchError(
            f"{plan.depth_priors}: holds no depth prior; it needs a folder per clip, such as"
            f" {plan.depth_priors / without[0]}"
        )
    if without:
        logger.warning("%s: no depth prior for %s", plan.depth_priors, ", ".join(without))


def _depth_network(settings: BatchSettings) -> str | None:
    """What results call the network of all clips, None where there is none; it is opened here once.

    Raises DepthPriorError where it cannot be used.
    """
    path = settings.depth_priors
    if path is not None and is_model(path):
        return OnnxDepth(path.absolute(), settings.depth_model).name
    if settings.depth_model is not None:
        raise DepthPriorError(
            f"--depth-model {settings.depth_model}: needs the network's file, --depth-prior MODEL.onnx"
        )
    return None


def _require_evaluation(clips: Sequence[Clip]) -> None:
    with_truth = next((clip for clip in clips if has_groundtruth(clip.folder)), None)
    if with_truth is not None and importlib.util.find_spec("evo") is None:
        raise BatchError(
            f"{with_truth.folder} has ground truth and scoring needs evo: pip install 'mvdyn_gtsam[eval]',"
            " or add --no-evaluate"
        )


@contextmanager
def _claimed(plan: Plan, asked: Mapping[str, Any]) -> Iterator[None]:
    """``plan.out`` is this run's alone. Raises BatchError where it cannot be."""
    try:
        plan.state_folder.mkdir(parents=True, exist_ok=True)
        lock = (plan.state_folder / "lock").open("a")
    except OSError as error:
        raise BatchError(f"{plan.out}: cannot be written ({error.strerror}); choose another --out") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BatchError(f"{plan.out}: another batch is working on it; wait for it to end") from error
        write_json(plan.config_file, asked)
        write_atomically(plan.run_file, plan.run.encode())
        try:
            yield
        finally:
            plan.end()
