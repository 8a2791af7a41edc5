"""Least squares: residuals, phase 1 (``scale``), phase 2 (``depth`` and ``poses`` in turn)."""
