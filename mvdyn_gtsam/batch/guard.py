"""Run the command of one clip: ``python -I guard.py LOCK OWNER RUN_FILE RUN COMMAND...``.

Between a Dask worker and the reconstruction it started (both sides may be killed without a word):

* the lock is taken before the command starts, and the command inherits it, so that a clip that was given to
  another worker waits until the last process of the first attempt is gone;
* the command ends, politely first, when the Dask worker ``OWNER`` is gone or ``RUN_FILE`` no longer holds
  ``RUN``, which is how a batch that is interrupted says so, on other machines too.

A program of its own that imports little: Linux lets a child inherit the peak memory of its starter.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

CHECK_S = 0.5
GRACE_S = 10.0
"""What a command has to write down that it was interrupted, before it is killed."""
EXIT_STOPPED = 130


def main(arguments: list[str]) -> int:
    """Exit code of the command, which a signal kills this process by, too."""
    lock_path, owner, run_file, run, *command = arguments

    def wanted() -> bool:
        return _owner_lives(int(owner)) and Path(run_file).read_text() == run

    with open(lock_path, "a") as lock:
        while wanted():
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(CHECK_S)
        else:
            return EXIT_STOPPED
        child = subprocess.Popen(command, pass_fds=[lock.fileno()])
    while True:
        try:
            code = child.wait(CHECK_S)
            break
        except subprocess.TimeoutExpired:
            if not wanted():
                _stop(child)
                return EXIT_STOPPED
    if code < 0:
        if -code == signal.SIGINT:  # the only one Python handles itself
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    return code


def _owner_lives(owner: int) -> bool:
    """Whether the process that started ours is still the child of ``owner``: orphans get another parent."""
    try:
        return psutil.Process(os.getppid()).ppid() == owner
    except psutil.NoSuchProcess:
        return False


def _stop(child: subprocess.Popen[bytes]) -> None:
    child.terminate()
    try:
        child.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
