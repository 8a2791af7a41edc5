"""What stands between a Dask worker and the process of a clip, by killing either side."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from mvdyn_gtsam.baselines.process import ProcessUsage, run_measured
from mvdyn_gtsam.batch import guard

SLEEP = "import pathlib, sys, time; pathlib.Path(sys.argv[1]).touch(); time.sleep(60)"
OWNER = """
import os, sys
from pathlib import Path
from mvdyn_gtsam.baselines.process import run_measured
command = [str(os.getpid()) if word == "OWNER" else word for word in sys.argv[2:]]
run_measured(command, Path(sys.argv[1]))
"""


def guarded(folder: Path, owner: str, *command: str) -> list[str]:
    (folder / "run").write_text("this")
    words = [sys.executable, "-I", guard.__file__, str(folder / "lock"), owner, str(folder / "run"), "this"]
    return [*words, *command]


def run(folder: Path, code: str) -> ProcessUsage:
    command = guarded(folder, str(os.getpid()), sys.executable, "-S", "-c", code)
    return run_measured(command, folder / "log")


def until(condition: Callable[[], bool], seconds: float = 15.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process, as a Dask worker is one, that runs a guarded command which would take a minute."""
    command = guarded(tmp_path, "OWNER", sys.executable, "-S", "-c", SLEEP, str(tmp_path / "started"))
    process = subprocess.Popen([sys.executable, "-c", OWNER, str(tmp_path / "log"), *command])
    tree: list[psutil.Process] = []
    try:
        until((tmp_path / "started").exists)
        tree = psutil.Process(process.pid).children(recursive=True)
        yield process
    finally:
        process.kill()
        process.wait()
        for child in tree:
            with suppress(psutil.NoSuchProcess):
                child.kill()


def test_exit_code_output_and_signal_are_those_of_the_command(tmp_path: Path) -> None:
    assert run(tmp_path, "pass").problem is None
    usage = run(tmp_path, "import sys; sys.exit('the disk is full')")
    assert usage.exit_code == 1 and usage.problem == "the disk is full (exit code 1)"
    usage = run(tmp_path, "import os; os.kill(os.getpid(), 9)")
    assert usage.exit_code == -signal.SIGKILL and "killed by SIGKILL" in str(usage.problem)
    usage = run(tmp_path, "x = b'x' * 150_000_000")
    assert usage.peak_mb is not None and 140 < usage.peak_mb < 220


def test_the_command_dies_with_the_worker_that_started_it(
    tmp_path: Path, owner: subprocess.Popen[bytes]
) -> None:
    tree = psutil.Process(owner.pid).children(recursive=True)
    assert len(tree) == 3  # launcher, guard, command
    owner.kill()
    assert psutil.wait_procs(tree, timeout=15)[1] == []


def test_the_command_stops_when_the_batch_is_interrupted(
    tmp_path: Path, owner: subprocess.Popen[bytes]
) -> None:
    (tmp_path / "run").write_text("")
    assert owner.wait(timeout=15) == 0


def test_a_second_attempt_waits_until_the_first_is_gone(
    tmp_path: Path, owner: subprocess.Popen[bytes]
) -> None:
    command = psutil.Process(owner.pid).children(recursive=True)[-1]
    guard_process = command.parent()
    assert guard_process is not None
    guard_process.kill()  # the worst case: what watched the command is gone, the command writes on
    second = subprocess.Popen(
        [sys.executable, "-c", OWNER, str(tmp_path / "log2")]
        + guarded(tmp_path, "OWNER", sys.executable, "-S", "-c", "print('in')")
    )
    time.sleep(1.0)
    assert second.poll() is None and command.is_running()
    command.kill()
    assert second.wait(timeout=15) == 0
    assert (tmp_path / "log2").read_text() == "in\n"
