"""Freed memory is used again."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import numpy as np
from mvdyn_gtsam.memory import keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory()

def use():
    arrays = [np.ones(2**17) for _ in range(30)]
    del arrays

use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    use()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has mallopt")
def test_arrays_find_the_pages_of_those_before_them() -> None:
    def faults(mode: str) -> int:
        command = [sys.executable, "-c", FAULTS, mode]
        return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)

    # 30 arrays of 256 pages, ten times
    assert faults("default") > 10_000
    assert faults("keep") < 1_000
