"""How the C library handles memory that was freed."""

from __future__ import annotations

import ctypes

# https://man7.org/linux/man-pages/man3/mallopt.3.html
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3

KEPT_BYTES = 64 * 2**20
"""Freed memory that each arena keeps at most."""
LARGEST_KEPT_BYTES = 2 * 2**20
"""Blocks above it are returned at once. With 32 MiB, the most glibc allows, the peak grew by 94 MB from 150
to 300 frames of robodog_overlap, with 2 by 40 (experiments.scaling)."""


def keep_freed_memory() -> bool:
    """Keep freed memory for the next arrays instead of handing it back to the system each time.

    Arrays of images come and go, and each new page costs a fault: the system took 2.2
    of 26 processor seconds of tracking hololens_office_2seg, and takes 1.9 with this. For the whole process,
    so a program's to call, not a library's. Returns whether the C library can do so (glibc).
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return False
    return bool(mallopt(M_TRIM_THRESHOLD, KEPT_BYTES) and mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES))
