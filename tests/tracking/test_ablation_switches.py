"""Settings that leave a part out do leave it out, and tracking still works."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.config import load_config
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.rig import likely_mounts
from tests.tracking.synthetic_scene import Scene, rig, two_cameras
from tests.tracking.test_tracker import Tracked, errors, track


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_cameras(count=6)


def run(scene: Scene, *settings: str) -> Tracked:
    return track(scene, ((0, 1),), settings, start=scene.start(((0, 1),), times=(0, 5)))


@pytest.fixture(scope="module")
def whole(scene: Scene) -> Tracked:
    return run(scene)


def between(tracked: Tracked) -> int:
    return sum(edge.i[0] != edge.j[0] for edge in tracked[2].edges)


def test_without_the_graph_no_connection_joins_two_cameras(scene: Scene, whole: Tracked) -> None:
    without = run(scene, "graph.inter_camera=false")
    assert between(whole) > 0 == between(without)
    assert all(edge.i[0] == edge.j[0] for edge in without[0].state.graph.edges)
    assert all(counts.spatial == counts.spatio_temporal == 0 for counts in without[2].counts)
    # one world still, in which the start's poses hold the cameras
    assert without[2].groups == ((0, 1),)
    position, rotation = errors(without[2].wTc, scene.wTc)
    assert position < 0.05 and rotation < 1.0


def test_without_the_graph_no_mount_does_either() -> None:
    state = run(rig(count=6), "graph.inter_camera=false")[0].state
    poses = {keyframe.frame: keyframe.wTc for keyframe in state.keyframes}
    assert likely_mounts(poses, state.rig_config)  # there is one to be found
    assert state.mounts == {}


@pytest.mark.parametrize("model", ["fixed_shape", "carried_shape"])
def test_poses_are_found_with_a_depth_of_fixed_shape(scene: Scene, whole: Tracked, model: str) -> None:
    tracker, _, result = run(scene, f"tracking.depth_model={model}")
    assert np.abs(result.wTc - whole[2].wTc).max() > 1e-5
    position, rotation = errors(result.wTc, scene.wTc)
    assert position < 0.1 and rotation < 1.0
    solved = [
        float(np.ptp(keyframe.log_depth - keyframe.prior_log_depth)) for keyframe in tracker.state.keyframes
    ]
    if model == "carried_shape":  # nothing but the scale
        assert max(solved) < 1e-9
    else:
        assert min(solved) > 1e-3


def test_an_unknown_depth_model_is_refused() -> None:
    with pytest.raises(ConfigError, match="structureless, fixed_shape, carried_shape"):
        load_config(None, ["tracking.depth_model=flat"])
