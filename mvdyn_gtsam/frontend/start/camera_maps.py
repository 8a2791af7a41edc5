"""Each camera's own map with dense depth, and another where the first explains too little of what is seen."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.frontend.dense_flow import DenseFlow
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, densify_map
from mvdyn_gtsam.frontend.start.features import Features, extract_features
from mvdyn_gtsam.frontend.start.focal import focal_candidates, no_focal
from mvdyn_gtsam.frontend.start.followed_keypoints import Matches, follow_keypoints, joined_matches
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.frontend.start.single_camera import (
    CameraMap,
    build_camera_map,
    choose_frames,
    match_neighbours,
    usable_pairs,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MappedCamera:
    """What a camera's own video tells."""

    camera: Camera
    """With the focal length found, where it was not known."""
    sparse: CameraMap
    dense: DenseMap | None
    """None without parallax."""

    @property
    def rigidity(self) -> float:
        """Share of the flow that the map explains; 0 without parallax."""
        return 0.0 if self.dense is None else self.dense.rigidity


@dataclass(frozen=True)
class SeenFrames:
    """Frames of one camera, spaced by its motion, and what they have in common."""

    times: npt.NDArray[np.int64]
    """``(K,)`` frame numbers."""
    features: tuple[Features, ...]
    pairs: Matches
    """By rows of the frames."""
    reach: int
    """Rows between frames whose flow is measured at most."""


def seen_frames(capture: Capture, index: int, config: WideBaselineConfig) -> SeenFrames:
    """The frames of one camera that its map is made of."""
    times, motion = choose_frames(
        capture, index, config.frame_step, config.maximum_frames, config.minimum_frames
    )
    features = tuple(
        extract_features(capture.read(index, int(t)), config.features, config.contrast) for t in times
    )
    # Where the frames are closer, as many neighbours reach as far.
    spacing = max(motion / max(len(times) - 1, 1), 1e-6)
    reach = round(config.dense_map.neighbours * config.frame_step / spacing)
    return SeenFrames(times, features, match_neighbours(features, config.neighbours, config.ratio), reach)


def map_of(
    capture: Capture,
    index: int,
    camera: Camera,
    seen: SeenFrames,
    flow: DenseFlow,
    config: WideBaselineConfig,
) -> MappedCamera:
    """Structure from motion of the frames as of ``camera``, number ``index`` with some intrinsics, and dense
    depth."""
    sparse = build_camera_map(
        index, camera, seen.times, seen.features, seen.pairs, minimum_angle_deg=config.minimum_parallax_deg
    )
    if not sparse.has_depth:
        return MappedCamera(camera, sparse, None)
    cameras = (*capture.cameras[:index], camera, *capture.cameras[index + 1 :])
    own = replace(capture, cameras=cameras)
    return MappedCamera(camera, sparse, densify_map(own, sparse, flow, config.dense_map, seen.reach))


def map_camera(capture: Capture, index: int, flow: DenseFlow, config: WideBaselineConfig) -> MappedCamera:
    """Structure from motion of one camera, and its dense depth where it shows any parallax.

    Where what moves outweighs what stands still, or a texture repeats, descriptors can tie a map to the wrong
    thing. A rigid scene then explains little of the flow; keypoints followed along that flow are added, and
    of the two maps the one that explains more is kept; so it is of maps with different focal lengths, where
    that is not known. Raises TrackingError where the focal length is neither known nor told by the video.
    """
    camera, seen = capture.cameras[index], seen_frames(capture, index, config)
    candidates = [camera]
    if not camera.focal_known:
        candidates = focal_candidates(camera, seen.features, usable_pairs(seen.pairs))
    maps = [map_of(capture, index, own, seen, flow, config) for own in candidates]
    first = max(maps, key=lambda mapped: mapped.rigidity)
    if first.dense is None and not camera.focal_known:
        raise no_focal(camera, "it shows no parallax: the camera stands still, or only turns")
    if first.dense is None or first.rigidity >= config.minimum_rigidity:
        return first
    followed = follow_keypoints(
        lambda row: capture.read(index, int(seen.times[row])), seen.features, config.neighbours, flow
    )
    more = replace(seen, pairs=joined_matches(seen.pairs, followed))
    second = map_of(capture, index, first.camera, more, flow, config)
    logger.info(
        "%s: its map explains %.0f %% of the flow, %.0f %% with keypoints followed along it",
        camera.name,
        100.0 * first.rigidity,
        100.0 * second.rigidity,
    )
    return max(first, second, key=lambda mapped: mapped.rigidity)
