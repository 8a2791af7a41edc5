"""Which cameras look like a rig by their motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.rig import FEWEST_INSTANTS, RigConfig, likely_mounts

Array = npt.NDArray[np.float64]
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("xyz", [2.0, -15.0, 1.0], degrees=True).as_matrix()
MOUNT[:3, 3] = [0.5, 0.02, -0.1]


def path(count: int, seed: int) -> Array:
    """``(T, 4, 4)`` of a camera that walks and looks about."""
    random = np.random.default_rng(seed)
    wTc = np.tile(np.eye(4), (count, 1, 1))
    wTc[:, :3, :3] = Rotation.from_rotvec(random.normal(0.0, 0.1, (count, 3)).cumsum(0)).as_matrix()
    wTc[:, :3, 3] = random.normal(0.0, 0.2, (count, 3)).cumsum(0)
    return wTc


def labelled(*paths: Array) -> dict[tuple[int, int], Array]:
    return {(camera, time): pose for camera, wTc in enumerate(paths) for time, pose in enumerate(wTc)}


def test_a_rig_is_found_with_its_mount() -> None:
    first = path(8, 0)
    found = likely_mounts(labelled(first, first @ MOUNT, path(8, 1)), RigConfig())
    assert list(found) == [(0, 1)]
    np.testing.assert_allclose(found[0, 1], MOUNT, atol=1e-12)


def test_a_rig_whose_scale_has_drifted_is_still_found() -> None:
    first = path(8, 0)
    mounts = np.tile(MOUNT, (8, 1, 1))
    mounts[:, :3, 3] *= np.linspace(0.85, 1.15, 8)[:, None]
    assert list(likely_mounts(labelled(first, first @ mounts), RigConfig())) == [(0, 1)]


@pytest.mark.parametrize("turn_deg", [0.5, 5.0])
def test_cameras_that_turn_apart_are_none(turn_deg: float) -> None:
    first = path(8, 0)
    turning = np.tile(MOUNT, (8, 1, 1))
    angles = np.linspace(-turn_deg, turn_deg, 8)
    turning[:, :3, :3] = Rotation.from_euler("y", angles[:, None], degrees=True).as_matrix() @ MOUNT[:3, :3]
    assert likely_mounts(labelled(first, first @ turning), RigConfig()) == {}


def test_cameras_that_walk_apart_without_turning_are_none() -> None:
    first = path(8, 0)
    walking = np.tile(MOUNT, (8, 1, 1))
    walking[:, 1, 3] += np.linspace(-0.4, 0.4, 8)
    assert likely_mounts(labelled(first, first @ walking), RigConfig()) == {}


def test_too_few_common_instants_show_nothing() -> None:
    first = path(FEWEST_INSTANTS - 1, 0)
    assert likely_mounts(labelled(first, first @ MOUNT), RigConfig()) == {}


def test_negative_limits_are_refused() -> None:
    with pytest.raises(ConfigError, match="rig"):
        replace(RigConfig(), cost_increase=-0.1)
