"""Fixtures every room shares."""

from __future__ import annotations

from pathlib import Path

import cv2  # noqa: F401  (before pycolmap: the other order aborts the process at the first PNG write)
import pytest
from hypothesis import settings

# Examples are the same in every run, and a busy machine must not fail a test by its clock.
settings.register_profile("mvdyn", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("mvdyn")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """``../shared/data`` next to the checkout: captures too large, or not free, to keep in the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"{SHARED_DATA} is not there: this test needs the shared captures")
    return SHARED_DATA
