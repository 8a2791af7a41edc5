"""iSAM2 over the poses and depth scales of the latest keyframes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import gtsam
import numpy as np

from factors.keys import S, X
from factors.structureless import solve_log_depths
from mvdyn_gtsam.config import TrackingConfig
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.tracking.keyframe_factor import keyframe_factor
from mvdyn_gtsam.tracking.model import Keyframe, View, measurement_of

Priors = Callable[[Keyframe], list[gtsam.NonlinearFactor]]

MINIMUM_WEIGHT = 0.01
"""Mean weight below which a measured edge says nothing and is left out of the solve."""


def useful_neighbours(keyframe: Keyframe) -> list[Frame]:
    """Frames that the keyframe has a flow of any weight to, in a fixed order."""
    return [frame for frame, flow in sorted(keyframe.flows.items()) if flow.mean_weight > MINIMUM_WEIGHT]


class SlidingWindow:
    """Keyframes of the window as iSAM2 variables.

    A keyframe's factor is removed and added anew when it gains edges. Poses and scales of all but the latest
    ``free`` keyframes of a camera keep their linearisation. What left the window stays in the tree until as
    many keyframes again have been added; then the tree is built anew from the window, older neighbours
    being constants, so that a step's cost does not depend on the length of the video.
    """

    def __init__(self, views: tuple[View, ...], config: TrackingConfig, priors: Priors) -> None:
        self._views, self._config, self._priors = views, config, priors
        self._isam = _make_isam()
        self._members: dict[Frame, Keyframe] = {}
        self._index: dict[Frame, int] = {}
        self._per_camera: list[list[Keyframe]] = [[] for _ in views]

    def update(self, new: list[Keyframe], touched: list[Keyframe], all_frames: dict[Frame, Keyframe]) -> None:
        """Add ``new`` keyframes, renew the factors of ``touched`` ones, and write the solution into them.

        ``touched`` includes the new ones; those no longer in the tree are ignored.
        """
        for keyframe in new:
            self._per_camera[keyframe.camera].append(keyframe)
        limit = 2 * self._config.window
        if any(sum(k.frame in self._members for k in track) + 1 > limit for track in self._per_camera):
            self._rebuild(all_frames)
            return
        for keyframe in new:
            self._members[keyframe.frame] = keyframe
        renewed = [keyframe for keyframe in touched if keyframe.frame in self._members]
        self._solve(new, renewed, all_frames)

    def release(self) -> None:
        """Give the tree's memory back: tracking is over."""
        self._isam = _make_isam()
        self._members.clear()
        self._index.clear()

    def _rebuild(self, all_frames: dict[Frame, Keyframe]) -> None:
        self._isam = _make_isam()
        self._index.clear()
        window = self._config.window
        for track in self._per_camera:
            del track[:-window]
        members = [keyframe for track in self._per_camera for keyframe in track]
        self._members = {keyframe.frame: keyframe for keyframe in members}
        self._solve(members, members, all_frames)

    def _solve(self, new: list[Keyframe], renewed: list[Keyframe], all_frames: dict[Frame, Keyframe]) -> None:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        owners: list[Frame] = []
        remove: list[int] = []
        for keyframe in renewed:
            factor = self._factor(keyframe, all_frames)
            if factor is None:
                continue
            if keyframe.frame in self._index:
                remove.append(self._index.pop(keyframe.frame))
            graph.add(factor)
            owners.append(keyframe.frame)
        for keyframe in new:
            values.insert(X(*keyframe.frame), gtsam.Pose3(keyframe.wTc))
            values.insert(S(*keyframe.frame), keyframe.log_scale)
            for prior in self._priors(keyframe):
                graph.add(prior)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = remove
        parameters.noRelinKeys = self._settled_keys()
        result = self._isam.update(graph, values, parameters)
        indices = result.getNewFactorsIndices()
        for position, frame in enumerate(owners):
            self._index[frame] = int(indices[position])
        again = gtsam.ISAM2UpdateParams()
        again.noRelinKeys = parameters.noRelinKeys
        for _ in range(self._config.step_iterations - 1):
            result = self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), again)
            if result.getVariablesRelinearized() == 0:
                break
        self._read_back(renewed, all_frames)

    def _factor(self, keyframe: Keyframe, all_frames: dict[Frame, Keyframe]) -> gtsam.CustomFactor | None:
        neighbours = [frame for frame in useful_neighbours(keyframe) if frame in all_frames]
        if not neighbours:
            return None
        fixed = {frame: all_frames[frame].wTc for frame in neighbours if frame not in self._members}
        # a factor must not change: its flows and the start of its depths are those of now
        snapshot = replace(keyframe, flows=dict(keyframe.flows))
        measure = partial(
            measurement_of,
            snapshot,
            neighbours,
            self._views,
            self._config,
            thin=True,
            robust_px=self._config.window_robust_px,
            measured=True,
        )
        return keyframe_factor(keyframe.frame, neighbours, fixed, cache(measure))

    def _settled_keys(self) -> gtsam.KeyList:
        keys = gtsam.KeyList()
        for track in self._per_camera:
            for keyframe in track[: -self._config.free]:
                if keyframe.frame in self._members:
                    keys.push_back(X(*keyframe.frame))
                    keys.push_back(S(*keyframe.frame))
        return keys

    def _read_back(self, renewed: list[Keyframe], all_frames: dict[Frame, Keyframe]) -> None:
        estimate = self._isam.calculateEstimate()
        for keyframe in self._members.values():
            keyframe.wTc = estimate.atPose3(X(*keyframe.frame)).matrix()
            keyframe.log_scale = estimate.atDouble(S(*keyframe.frame))
        for keyframe in renewed:
            solve_depth(keyframe, all_frames, self._views, self._config)


def solve_depth(
    keyframe: Keyframe,
    frames: dict[Frame, Keyframe],
    views: tuple[View, ...],
    config: TrackingConfig,
    steps: int = 4,
) -> None:
    """Solve the keyframe's log depths at the current poses of ``frames``.

    Nothing changes where it has no useful neighbour among ``frames``. A carried shape keeps its form.
    """
    neighbours = [frame for frame in useful_neighbours(keyframe) if frame in frames]
    if not neighbours:
        return
    measurement = measurement_of(keyframe, neighbours, views, config, steps)
    wTj = np.stack([frames[frame].wTc for frame in neighbours])
    keyframe.log_depth, keyframe.information = solve_log_depths(
        measurement, keyframe.wTc, wTj, keyframe.log_scale
    )
    if config.depth_model == "carried_shape":
        keyframe.log_depth = keyframe.prior_log_depth + keyframe.log_scale


def _make_isam() -> gtsam.ISAM2:
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    # radians, and world units of which the median depth is one: about a tenth of a pixel
    parameters.setRelinearizeThreshold(2e-4)
    parameters.findUnusedFactorSlots = True
    return gtsam.ISAM2(parameters)
