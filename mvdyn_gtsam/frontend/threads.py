"""Measuring side by side: with how many threads, and in which order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


def flow_threads() -> int:
    """``OMP_NUM_THREADS`` where that is a number above 0, as numerical libraries read it, else one per
    processor of this process: reconstructions side by side are each given their share that way."""
    first = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if first.isdecimal() and int(first) > 0:
        return int(first)
    # not everywhere: macOS has no affinity
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_order(jobs: Iterable[Callable[[], Result]], workers: int | None = None) -> Iterator[Result]:
    """Results of ``jobs`` in their order, ``workers`` (default ``flow_threads()``) of them run side by side.

    Jobs are taken from their iterable in the caller's thread, few ahead, for they hold images. What a job
    raises is raised here; those after it may or may not have run.
    """
    workers = flow_threads() if workers is None else workers
    if workers < 2:
        yield from (job() for job in jobs)
        return
    running: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for job in jobs:
                running.append(pool.submit(job))
                if len(running) > 2 * workers:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
