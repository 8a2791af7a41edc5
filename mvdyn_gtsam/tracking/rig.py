"""Cameras mounted on one another, in the polish: found among the keyframes, believed if flow bears it out."""

from __future__ import annotations

import logging

import gtsam

from factors.keys import X
from mvdyn_gtsam.frontend.rig import add_mounts, likely_mounts, solved_mounts
from mvdyn_gtsam.tracking.polish import Mounts, build_graph, minimise, take_solution
from mvdyn_gtsam.tracking.state import TrackState

logger = logging.getLogger(__name__)


def hold_mounts(state: TrackState) -> Mounts:
    """The mounts ``aTb`` that holding costs next to nothing; the keyframes are moved to where they hold."""
    keyframes, config = state.keyframes, state.tracking
    if not state.graph_config.inter_camera:  # a mount would connect cameras
        return {}
    likely = {
        pair: aTb
        for pair, aTb in likely_mounts({k.frame: k.wTc for k in keyframes}, state.rig_config).items()
        if state.group_of[pair[0]] == state.group_of[pair[1]]
    }
    if not likely:
        return likely
    graph, values = build_graph(
        keyframes, state.views, config, state.priors, thin=True, robust_px=config.window_robust_px
    )
    free = graph.error(values)
    held = gtsam.NonlinearFactorGraph(graph)
    add_mounts(held, values, likely, [(keyframe.frame, X(*keyframe.frame)) for keyframe in keyframes])
    solution, _, _ = minimise(held, values, held.error(values), config)
    increase = graph.error(solution) / max(free, 1e-12) - 1.0
    logger.debug("holding %s as mounted: cost %+.1f %%", list(likely), 100.0 * increase)
    if increase > state.rig_config.cost_increase:
        return {}
    take_solution(solution, keyframes, state.views, config)
    return solved_mounts(solution, likely)
