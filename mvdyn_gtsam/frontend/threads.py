"""How many threads to measure with."""

from __future__ import annotations

import os


def flow_threads() -> int:
    """``OMP_NUM_THREADS`` where that is a number above 0, as numerical libraries read it, else one per
    processor of this process: reconstructions side by side are each given their share that way."""
    first = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if first.isdecimal() and int(first) > 0:
        return int(first)
    # not everywhere: macOS has no affinity
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
