"""Tasks side by side in processes, results in the order of the jobs."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType

import cv2

from mvdyn_gtsam.errors import ConfigError, ResultError
from mvdyn_gtsam.refinement.context import Context
from mvdyn_gtsam.refinement.tasks import run_task

PARENT_CHECK_S = 1.0
"""How often a worker looks whether the process it works for is still there."""

_context: Context | None = None
"""Of a worker process: it serves one refinement and receives its context once."""


class TaskPool:
    """Runs tasks of ``tasks.TASKS``; with one worker in this very process."""

    def __init__(self, context: Context, workers: int) -> None:
        """``workers`` 0 takes one per processor."""
        self._context = context
        self._workers = worker_count(workers)
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> TaskPool:
        """Raises ConfigError where the flow cannot travel to processes."""
        if self._workers > 1:
            try:
                pickle.dumps(self._context)
            except (pickle.PicklingError, TypeError, AttributeError) as error:
                raise ConfigError(
                    f"this flow cannot be sent to other processes ({error}); set refinement.workers=1"
                ) from error
            threads = os.environ.get("OPENBLAS_NUM_THREADS")
            # read when numpy is imported: a worker is one of several
            os.environ["OPENBLAS_NUM_THREADS"] = "1"
            try:
                self._executor = ProcessPoolExecutor(
                    self._workers,
                    multiprocessing.get_context("spawn"),
                    _receive,
                    (self._context, os.getpid()),
                )
                # each starts with a job, while the environment is as it must see it; nobody waits for them,
                # since the first step needs none
                for _ in range(self._workers):
                    self._executor.submit(_ready)
            finally:
                if threads is None:
                    del os.environ["OPENBLAS_NUM_THREADS"]
                else:
                    os.environ["OPENBLAS_NUM_THREADS"] = threads
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)

    def map(self, task: str, jobs: Sequence[object]) -> Iterator[object]:
        """Results of ``task`` for each of ``jobs``, in order. Raises ResultError when a process dies."""
        if self._executor is None:
            for job in jobs:
                yield run_task(self._context, task, job)
            return
        # a few jobs ahead of the reader: results are images, and memory must not grow with the video
        ahead = 4 * self._workers
        pending: list[Future[object]] = []
        try:
            pending += [self._executor.submit(_run, task, job) for job in jobs[:ahead]]
            for index in range(len(jobs)):
                if index + ahead < len(jobs):
                    pending.append(self._executor.submit(_run, task, jobs[index + ahead]))
                yield pending.pop(0).result()
        except BrokenProcessPool as error:
            raise _broken() from error
        finally:
            for future in pending:
                future.cancel()


def worker_count(workers: int) -> int:
    """Processes that a setting means: 0 is one per processor of this process."""
    if workers > 0:
        return workers
    # not everywhere: macOS has no affinity
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _broken() -> ResultError:
    return ResultError(
        "a process of the refinement died, for want of memory perhaps; continue with --resume, and"
        " --set refinement.workers=1 if it happens again (scripts must call reconstruct() under"
        " `if __name__ == '__main__':`)"
    )


def _receive(context: Context, parent: int) -> None:
    global _context  # noqa: PLW0603 - the one way to hand a worker what all its jobs share
    _context = context
    cv2.setNumThreads(1)
    # Ctrl-C reaches every process of the terminal: the parent alone says so and ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()


def _leave_with(parent: int) -> None:
    """End this worker when its parent was killed: nobody would ever send it another job."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_S)
    os._exit(1)


def _ready() -> None:
    """Does nothing: makes the processes start."""


def _run(task: str, job: object) -> object:
    assert _context is not None
    return run_task(_context, task, job)
