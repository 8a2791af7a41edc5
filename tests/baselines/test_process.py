from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.baselines.process import run_measured
from mvdyn_gtsam.errors import BaselineError


def python(code: str) -> list[str]:
    return [sys.executable, "-S", "-c", code]


def test_time_and_output_are_recorded(tmp_path: Path) -> None:
    usage = run_measured(python("import time; time.sleep(0.3); print('hello')"), tmp_path / "a.log")
    assert usage.exit_code == 0 and usage.problem is None
    assert 0.3 <= usage.seconds < 5.0
    assert (tmp_path / "a.log").read_text() == "hello\n"


def test_peak_memory_is_that_of_the_command_and_not_of_the_caller(tmp_path: Path) -> None:
    # Makes this very process large first: a plain fork would hand its peak down to the command.
    ballast = np.ones(30_000_000)
    small = run_measured(python("pass"), tmp_path / "small.log")
    large = run_measured(python("x = b'x' * 150_000_000"), tmp_path / "large.log")
    assert ballast.sum() == 30_000_000
    assert small.peak_mb is not None and small.peak_mb < 60
    assert large.peak_mb is not None and 140 < large.peak_mb < 220


def test_memory_of_a_grandchild_counts(tmp_path: Path) -> None:
    inner = "x = b'x' * 150_000_000"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-S', '-c', {inner!r}], check=True)"
    usage = run_measured(python(code), tmp_path / "a.log")
    assert usage.peak_mb is not None and usage.peak_mb > 140


def test_a_failure_is_told_by_its_last_line(tmp_path: Path) -> None:
    code = "import sys; print('first'); sys.stderr.write('the disk is full\\n'); sys.exit(3)"
    usage = run_measured(python(code), tmp_path / "a.log")
    assert usage.exit_code == 3
    assert usage.problem is not None and usage.problem.startswith("the disk is full (exit code 3")


def test_a_crash_is_told_by_its_signal(tmp_path: Path) -> None:
    usage = run_measured(python("import os; os.kill(os.getpid(), 11)"), tmp_path / "a.log")
    assert usage.exit_code == -11
    assert usage.problem is not None and "killed by SIGSEGV" in usage.problem


def test_a_timeout_stops_the_whole_tree(tmp_path: Path) -> None:
    alive = tmp_path / "alive"
    inner = f"import time, pathlib; time.sleep(2.5); pathlib.Path({str(alive)!r}).touch()"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-S', '-c', {inner!r}])"
    usage = run_measured(python(code), tmp_path / "a.log", timeout_s=0.5)
    assert usage.problem is not None and "stopped after 0.5 s" in usage.problem
    time.sleep(2.5)
    assert not alive.exists()


def test_a_command_that_does_not_exist_is_a_failure(tmp_path: Path) -> None:
    usage = run_measured([str(tmp_path / "nothing")], tmp_path / "a.log")
    assert usage.exit_code != 0 and usage.problem is not None and "nothing" in usage.problem


def test_a_log_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BaselineError, match="cannot be written"):
        run_measured(python("pass"), tmp_path / "file" / "a.log")
