"""Threads for measuring: what the environment says, else the processors of the process."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import pytest

from mvdyn_gtsam.frontend.threads import flow_threads, in_order


@pytest.mark.parametrize(("value", "threads"), [("3", 3), ("1", 1), ("4,2", 4)])
def test_the_environment_decides(monkeypatch: pytest.MonkeyPatch, value: str, threads: int) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert flow_threads() == threads


@pytest.mark.parametrize("value", ["", "0", "many", "-2"])
def test_nonsense_is_ignored(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert flow_threads() == available


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_results_come_in_the_order_of_their_jobs(workers: int) -> None:
    taken: list[int] = []

    def jobs() -> Iterator[Callable[[], int]]:
        for number in range(20):
            taken.append(threading.get_ident())
            yield lambda number=number: number**2  # type: ignore[misc]

    found = in_order(jobs(), workers)
    assert next(found) == 0
    assert len(taken) <= 2 * workers + 1  # few ahead, for they hold images
    assert list(found) == [number**2 for number in range(1, 20)]
    assert set(taken) == {threading.get_ident()}


def test_jobs_run_side_by_side() -> None:
    met = threading.Barrier(2, timeout=10.0)
    assert len(list(in_order([met.wait, met.wait], 2))) == 2


@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_job_raises_ends_all(workers: int) -> None:
    done: list[int] = []

    def fail() -> None:
        raise OSError("full")

    jobs: list[Callable[[], None]] = [fail] + [lambda: done.append(1)] * 50
    with pytest.raises(OSError, match="full"):
        list(in_order(jobs, workers))
    assert len(done) < 50
