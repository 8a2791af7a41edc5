"""Run a command in a process of its own and measure it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mvdyn_gtsam.errors import BaselineError

_LAUNCHER = Path(__file__).with_name("measure_child.py")


@dataclass(frozen=True)
class ProcessUsage:
    """What a finished process took."""

    exit_code: int
    """Negative: killed by that signal."""
    seconds: float
    """Wall clock, from start to exit."""
    cpu_seconds: float | None
    """User and system time of the process and all its children; None after a timeout."""
    peak_mb: float | None
    """Peak resident memory of the largest single process of the tree, in MiB; None after a timeout."""
    problem: str | None
    """One line why it failed, else None."""


def run_measured(
    command: Sequence[str],
    log: Path,
    *,
    timeout_s: float | None = None,
    environment: Mapping[str, str] | None = None,
) -> ProcessUsage:
    """Run ``command``, both outputs into ``log``; a failure or timeout is reported, not raised.

    The whole process tree is killed on timeout and on Ctrl-C. Raises BaselineError when the log cannot be
    written.
    """
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        log_file = log.open("wb")
    except OSError as error:
        raise BaselineError(f"{log}: cannot be written ({error.strerror})") from error
    start = time.monotonic()
    with log_file, tempfile.TemporaryDirectory(prefix="mvdyn-usage-") as folder:
        usage_path = Path(folder) / "usage.json"
        process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_LAUNCHER), str(usage_path), *command],
            stdin=subprocess.DEVNULL,
            stdout=log_file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=None if environment is None else dict(environment),
        )
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            _kill(process)
            problem = f"stopped after {timeout_s:g} s"
            return ProcessUsage(-signal.SIGKILL, time.monotonic() - start, None, None, problem)
        except BaseException:
            _kill(process)
            raise
        if not usage_path.is_file():
            return ProcessUsage(
                process.returncode, time.monotonic() - start, None, None, _problem(process.returncode, log)
            )
        usage = json.loads(usage_path.read_text())
    code = int(usage["exit_code"])
    return ProcessUsage(
        code, usage["seconds"], usage["cpu_seconds"], usage["peak_mb"], _problem(code, log) if code else None
    )


def _kill(process: subprocess.Popen[bytes]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _problem(code: int, log: Path) -> str:
    """The last line of the log, which is where a well-behaved program says why it gave up."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    last = lines[-1][:300] if lines else "it said nothing"
    if code < 0:
        return f"killed by {signal.Signals(-code).name}: {last}"
    return f"{last} (exit code {code})"
