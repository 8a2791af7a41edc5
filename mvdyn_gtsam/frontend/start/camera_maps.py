"""Each camera's own map with dense depth, and another where the first explains too little of what is seen."""

from __future__ import annotations

import logging

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.frontend.dense_flow import DenseFlow
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, densify_map
from mvdyn_gtsam.frontend.start.features import extract_features
from mvdyn_gtsam.frontend.start.followed_keypoints import Matches, follow_keypoints
from mvdyn_gtsam.frontend.start.settings import WideBaselineConfig
from mvdyn_gtsam.frontend.start.single_camera import CameraMap, build_camera_map, choose_frames

logger = logging.getLogger(__name__)


def map_camera(
    capture: Capture, camera: int, flow: DenseFlow, config: WideBaselineConfig
) -> tuple[CameraMap, DenseMap | None]:
    """Structure from motion of one camera, and its dense depth where it shows any parallax.

    Where what moves outweighs what stands still, or a texture repeats, descriptors can tie a map to the wrong
    thing. A rigid scene then explains little of the flow; keypoints followed along that flow are added, and
    of the two maps the one that explains more is kept.
    """
    times, motion = choose_frames(
        capture, camera, config.frame_step, config.maximum_frames, config.minimum_frames
    )
    features = [
        extract_features(capture.read(camera, int(t)), config.features, config.contrast) for t in times
    ]
    # Where the frames are closer, as many neighbours reach as far.
    spacing = max(motion / max(len(times) - 1, 1), 1e-6)
    reach = round(config.dense_map.neighbours * config.frame_step / spacing)

    def solved(followed: Matches | None) -> tuple[CameraMap, DenseMap | None]:
        own = build_camera_map(
            camera,
            capture.cameras[camera],
            times,
            features,
            neighbours=config.neighbours,
            ratio=config.ratio,
            minimum_angle_deg=config.minimum_parallax_deg,
            followed=followed,
        )
        return own, densify_map(capture, own, flow, config.dense_map, reach) if own.has_depth else None

    own, dense = solved(None)
    if dense is None or dense.rigidity >= config.minimum_rigidity:
        return own, dense
    followed = follow_keypoints(
        lambda row: capture.read(camera, int(times[row])), features, config.neighbours, flow
    )
    again, dense_again = solved(followed)
    rigidity = 0.0 if dense_again is None else dense_again.rigidity
    logger.info(
        "%s: its map explains %.0f %% of the flow, %.0f %% with keypoints followed along it",
        capture.cameras[camera].name,
        100.0 * dense.rigidity,
        100.0 * rigidity,
    )
    return (again, dense_again) if rigidity > dense.rigidity else (own, dense)
