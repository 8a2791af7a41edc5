"""Cameras that turn out to be mounted on one another: found by their motion, believed if images agree.

Nothing says beforehand that two cameras form a rig. Hand-held ones never keep a relative pose; a pair that
keeps its relative rotation to a fraction of a degree may be a rig, and where holding it as one costs next to
nothing in the images, it is one. Its fixed distance then keeps the scale from drifting.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from factors.keys import M
from factors.rig import mount_factor
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.geometry import invert_pose, rotation_angle_deg

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]
"""Two cameras, ascending."""

FEWEST_INSTANTS = 5
"""Instants at which both cameras' poses are known, at least; fewer may agree by chance."""
ROTATION_SIGMA = np.radians(0.01)
"""How firmly a mount is held: a mount gives a little, and cameras are synchronised to finite precision."""
TRANSLATION_SIGMA = 1e-3
"""The same, as a share of the cameras' distance."""


@dataclass(frozen=True)
class RigConfig:
    """Finding cameras that are mounted on one another."""

    rotation_deg: float = 0.2
    """Largest deviation of the relative rotation from its mean. Source: kitti_odo_seq2_traffic has 0.02
    before it is held; hand-held pairs swing by degrees."""
    distance_share: float = 0.3
    """Largest deviation of the relative position from its mean, in mean distances; wide, since the scale that
    a mount is to hold may have drifted. Source: choice, twice kitti_odo_seq2_traffic's."""
    cost_increase: float = 0.1
    """Relative increase of the images' cost up to which a mount is believed. Source: choice;
    kitti_odo_seq2_traffic has 0.055, most of it from imperfect rectification."""

    def __post_init__(self) -> None:
        if min(self.rotation_deg, self.distance_share, self.cost_increase) < 0.0:
            raise ConfigError("frontend.wide_baseline.adjustment.rig: no number may be negative")


def likely_mounts(wTc: Mapping[tuple[int, int], Array], config: RigConfig) -> dict[Pair, Array]:
    """Mean ``aTb (4, 4)`` of every pair of cameras that keeps it at all common instants.

    ``wTc`` holds poses ``(4, 4)`` by ``(camera, time)``.
    """
    times: dict[int, set[int]] = {}
    for camera, time in wTc:
        times.setdefault(camera, set()).add(time)
    found: dict[Pair, Array] = {}
    for a, b in ((a, b) for a in sorted(times) for b in sorted(times) if a < b):
        common = sorted(times[a] & times[b])
        if len(common) < FEWEST_INSTANTS:
            continue
        aTb = np.stack([invert_pose(wTc[a, time]) @ wTc[b, time] for time in common])
        mean = np.eye(4)
        mean[:3, :3] = Rotation.from_matrix(aTb[:, :3, :3]).mean().as_matrix()
        mean[:3, 3] = aTb[:, :3, 3].mean(axis=0)
        distance = np.linalg.norm(aTb[:, :3, 3], axis=1).mean()
        moved = np.linalg.norm(aTb[:, :3, 3] - mean[:3, 3], axis=1).max()
        turned = rotation_angle_deg(mean[:3, :3].T @ aTb[:, :3, :3]).max()
        if turned <= config.rotation_deg and moved <= config.distance_share * distance:
            found[a, b] = mean
    return found


def add_mounts(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    mounts: Mapping[Pair, Array],
    frames: Iterable[tuple[tuple[int, int], int]],
) -> None:
    """Hold every pair of ``mounts`` (``aTb``) at its common instants; its mount becomes a variable.

    ``frames`` are ``((camera, time), pose key)``.
    """
    key_of = dict(frames)
    for (a, b), aTb in mounts.items():
        values.insert(M(a, b), gtsam.Pose3(aTb))
        translation_sigma = TRANSLATION_SIGMA * float(np.linalg.norm(aTb[:3, 3]))
        for (camera, time), key in key_of.items():
            if camera == a and (b, time) in key_of:
                keys = (key, key_of[b, time], M(a, b))
                graph.add(mount_factor(keys, float(ROTATION_SIGMA), translation_sigma))


def solved_mounts(values: gtsam.Values, mounts: Mapping[Pair, Array]) -> dict[Pair, Array]:
    """The mounts as a solution has them."""
    return {pair: values.atPose3(M(*pair)).matrix() for pair in mounts}
