"""Threads for measuring: what the environment says, else the processors of the process."""

from __future__ import annotations

import os

import pytest

from mvdyn_gtsam.frontend.threads import flow_threads


@pytest.mark.parametrize(("value", "threads"), [("3", 3), ("1", 1), ("4,2", 4)])
def test_the_environment_decides(monkeypatch: pytest.MonkeyPatch, value: str, threads: int) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert flow_threads() == threads


@pytest.mark.parametrize("value", ["", "0", "many", "-2"])
def test_nonsense_is_ignored(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert flow_threads() == available
