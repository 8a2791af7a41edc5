"""The process that does the structure from motion, and what is said when it fails."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.start.structure_from_motion import structure_from_motion


def test_a_worker_that_fails_is_one_line_that_says_whose() -> None:
    with pytest.raises(TrackingError, match="structure from motion of cam7 failed: ") as raised:
        structure_from_motion("cam7", {"count": np.zeros(3)})
    assert "\n" not in str(raised.value)
