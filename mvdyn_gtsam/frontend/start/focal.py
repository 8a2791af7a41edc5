"""The focal length of a camera that does not tell it, from its own video.

Bundle adjustment with a free focal length ends in one of several minima where texture repeats or things move.
So it begins from several guesses. Keypoints do not tell which end is true, as those on what moves may fit a
false one; how much of the dense flow the maps explain does (``camera_maps``). What the images leave open is
refused.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.followed_keypoints import Matches
from mvdyn_gtsam.frontend.start.joint_adjustment import Adjusted
from mvdyn_gtsam.frontend.start.model import FoundIntrinsics
from mvdyn_gtsam.frontend.start.structure_from_motion import matched_views, structure_from_motion

logger = logging.getLogger(__name__)

FOCAL_GUESSES = (0.6, 0.95, 1.2, 1.7)
"""Focal lengths tried besides the camera's own guess, in lengths of the longer side: fields of view of 80 to
33 degrees, each within reach of the next. Source: experiments/focal.py."""
SAME = 0.02
"""Share by which two ends differ at most to be the same one. Source: experiments/focal.py."""
LEAST_FITTING = 0.3
"""Share of the most fitting sightings that an end needs to be considered. Source: choice; true ones had 0.93
and more in experiments/focal.py, and 0.56 on generated scenes in a trial that is not kept."""
MOST_DEVIATION = 0.01
"""Standard deviation from which on a focal length is not told, as a share of it. Source:
experiments/focal.py."""
DOUBTED = 0.01
"""By how much of it a given focal length must differ from what the images tell, to be doubted. Source:
experiments/focal.py; more than twice what found ones were off on whole rendered images."""
DOUBTED_DEVIATIONS = 5.0
"""And by how many standard deviations. Source: choice."""


@dataclass(frozen=True)
class FocalMinima:
    """Where bundle adjustment with a free focal length ends from each of several guesses; rows belong
    together."""

    guesses: npt.NDArray[np.float64]
    """``(G,)`` px."""
    focal: npt.NDArray[np.float64]
    """``(G,)`` px, NaN where no map can be made."""
    fitting: npt.NDArray[np.int64]
    """``(G,)`` sightings that fit there."""

    def distinct(self) -> list[float]:
        """The focal lengths that differ, px, those that most sightings fit first, down to ``LEAST_FITTING``;
        none where no map can be made from any guess."""
        found: list[float] = []
        order = np.argsort(-np.where(np.isfinite(self.focal), self.fitting, -1), kind="stable")
        for focal, fitting in zip(self.focal[order], self.fitting[order], strict=True):
            known = np.isfinite(focal) and fitting >= LEAST_FITTING * self.fitting[order[0]]
            if known and all(abs(focal / other - 1.0) > SAME for other in found):
                found.append(float(focal))
        return found


def focal_minima(camera: Camera, features: Sequence[Features], pairs: Matches) -> FocalMinima:
    """What the camera's own guess and each of ``FOCAL_GUESSES`` lead to with its frames' ``features`` and the
    matches of their ``pairs``; may be called from several threads. Raises TrackingError where the worker
    fails."""
    side = max(camera.width, camera.height)
    guesses = np.array([camera.fx, *(share * side for share in FOCAL_GUESSES)])
    if not pairs:
        return FocalMinima(guesses, np.full(len(guesses), np.nan), np.zeros(len(guesses), np.int64))
    problem = {**matched_views([camera], features, pairs), "focal_guesses": guesses}
    found = structure_from_motion(camera.name, problem)
    return FocalMinima(guesses, found["focal"], found["fitting"])


def focal_candidates(camera: Camera, features: Sequence[Features], pairs: Matches) -> list[Camera]:
    """The camera with every focal length that its frames' ``features`` and the matches of their ``pairs``
    allow; may be called from several threads.

    Raises TrackingError where they allow none.
    """
    minima = focal_minima(camera, features, pairs)
    logger.info(
        "%s: focal lengths from guesses %s px ended %s, fitting sightings %s",
        camera.name,
        np.round(minima.guesses).astype(int).tolist(),
        np.round(minima.focal, 1).tolist(),
        minima.fitting.tolist(),
    )
    distinct = minima.distinct()
    if not distinct:
        raise no_focal(camera, "no map can be made of it: it shows too little, or hardly any motion")
    return [replace(camera, fx=focal, fy=focal) for focal in distinct]


def found_intrinsics(adjusted: Adjusted) -> dict[int, FoundIntrinsics]:
    """The intrinsics that a joint adjustment found, by camera.

    Raises TrackingError where the images leave one open.
    """
    found = {}
    for index, deviation in adjusted.focal_deviation.items():
        camera = adjusted.cameras[index]
        if not deviation < MOST_DEVIATION * camera.fx:
            raise no_focal(
                camera, f"{camera.fx:.0f} px fits best, give or take {100.0 * deviation / camera.fx:.0f} %"
            )
        logger.info("%s: focal length %.1f px, give or take %.1f", camera.name, camera.fx, deviation)
        found[index] = FoundIntrinsics(camera.fx, camera.cx, camera.cy, deviation)
    return found


def doubts(cameras: Sequence[Camera], adjusted: Adjusted) -> list[str]:
    """A line for every camera of known focal length whose images tell another."""
    lines = []
    for index, told in adjusted.told_focal.items():
        given = cameras[index].fx
        off = abs(told.focal - given)
        if off > DOUBTED * given and off > DOUBTED_DEVIATIONS * told.deviation:
            lines.append(
                f"{cameras[index].name}: its intrinsics say a focal length of {given:.1f} px, and its images"
                f" {told.focal:.1f}, give or take {told.deviation:.1f}; check them, or have it found with"
                " --estimate-focal"
            )
            logger.warning(lines[-1])
    return lines


def no_focal(camera: Camera, reason: str) -> TrackingError:
    """What is to be raised where a video does not tell the focal length."""
    return TrackingError(
        f"{camera.name}: its video does not tell its focal length ({reason}); give its intrinsics, from a"
        " calibration, or from another video of the same phone and zoom"
    )
