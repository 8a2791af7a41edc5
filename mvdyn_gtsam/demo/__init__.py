"""The bundled clip of ``mvdyn demo``: two hand-held cameras, a robot dog, exact ground truth (rendered)."""

from __future__ import annotations

from pathlib import Path


def demo_capture() -> Path:
    """Folder of the bundled capture, with ``capture.json`` and ``groundtruth/``."""
    return Path(__file__).parent / "robodog"
