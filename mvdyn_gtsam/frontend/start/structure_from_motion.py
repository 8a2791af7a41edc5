"""Structure from motion of some views in a process of its own, which ``sfm_worker`` is."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.followed_keypoints import Matches


def matched_views(
    cameras: Sequence[Camera], features: Sequence[Features], pairs: Matches
) -> dict[str, npt.NDArray[Any]]:
    """What the worker is given of views with ``features`` and the matches of their ``pairs``; ``cameras`` are
    one for all or one per view."""
    return {
        "intrinsics": np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras]),
        "size": np.array([[camera.width, camera.height] for camera in cameras]),
        "count": np.array([len(view.pixels) for view in features]),
        "pixels": np.concatenate([view.pixels for view in features]),
        "pairs": np.array(list(pairs), np.int64),
        "match_count": np.array([len(matches) for matches in pairs.values()]),
        "matches": np.concatenate(list(pairs.values())),
    }


def structure_from_motion(whose: str, problem: Mapping[str, npt.ArrayLike]) -> dict[str, npt.NDArray[Any]]:
    """What the worker makes of a ``problem``; ``whose`` it is, for the message.

    May be called from several threads. Raises TrackingError where the worker fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "problem.npz", Path(folder) / "solution.npz"
        np.savez(source, allow_pickle=False, **dict(problem))
        command = [sys.executable, "-m", "mvdyn_gtsam.frontend.start.sfm_worker", str(source), str(target)]
        finished = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        if finished.returncode != 0:
            log = finished.stderr.decode(errors="replace").strip().splitlines()
            reason = log[-1] if log else f"exit code {finished.returncode}"
            raise TrackingError(f"structure from motion of {whose} failed: {reason}")
        with np.load(target) as arrays:
            return dict(arrays)
