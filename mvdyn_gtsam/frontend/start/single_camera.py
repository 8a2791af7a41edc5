"""Each camera alone: a sparse map of what one camera saw, in a frame and scale of its own.

One camera's own video has small steps and much overlap, so ordinary structure from motion is reliable
there even where a joint one is not. What remains unknown is one similarity per camera.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.frontend.start.features import Features, match_features
from mvdyn_gtsam.frontend.start.followed_keypoints import Matches
from mvdyn_gtsam.frontend.start.structure_from_motion import matched_views, structure_from_motion
from mvdyn_gtsam.geometry import invert_pose, transform_points

logger = logging.getLogger(__name__)


LEAST_MATCHES = 15
"""Of a pair of frames, to count: COLMAP's min_num_matches."""
LEAST_STEP = 0.005
"""Narrowest step in image widths, 2.5 px of 512: a camera that stands still has no motion but noise."""


@dataclass(frozen=True)
class CameraMap:
    """Sparse map of one camera; m is the camera's own map frame, median depth 1.

    A camera that shows no parallax (it stands still or only turns) has ``points`` empty; its ``mTc`` then
    hold rotations only.
    """

    camera: int
    times: npt.NDArray[np.int64]
    """``(K,)`` frame numbers, increasing."""
    mTc: npt.NDArray[np.float64]
    """``(K, 4, 4)``"""
    features: tuple[Features, ...]
    """Per frame."""
    point_of_keypoint: tuple[npt.NDArray[np.int64], ...]
    """Per frame ``(N,)``: row in ``points``, -1 where the keypoint was not triangulated."""
    points: npt.NDArray[np.float64]
    """``(P, 3)`` in frame m."""

    @property
    def has_depth(self) -> bool:
        return len(self.points) > 0


def choose_frames(
    capture: Capture, camera: int, step: float, maximum: int, minimum: int = 2
) -> tuple[npt.NDArray[np.int64], float]:
    """Frame numbers spaced by image motion over the whole video, and that motion per frame as image widths.

    A new frame is taken each time the median optical flow since the last one adds up to ``step`` image
    widths; wider steps where that would give more than ``maximum`` frames, narrower ones where it would give
    fewer than ``minimum``. First and last are always taken.
    """
    flow_estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    travelled = np.zeros(capture.frame_count)
    previous: npt.NDArray[np.uint8] | None = None
    for time in range(capture.frame_count):
        frame = cv2.cvtColor(capture.read(camera, time), cv2.COLOR_RGB2GRAY)
        small = cv2.resize(
            frame, (256, round(256 * frame.shape[0] / frame.shape[1])), interpolation=cv2.INTER_AREA
        )
        if previous is not None:
            flow = flow_estimator.calc(previous, small, None)[::4, ::4].reshape(-1, 2)
            moved = np.median(np.linalg.norm(flow, axis=1)) / small.shape[1]
            travelled[time] = travelled[time - 1] + moved
        previous = np.asarray(small, np.uint8)
    narrowed = min(step, max(travelled[-1] / max(minimum - 1, 1), LEAST_STEP))
    step = max(narrowed, travelled[-1] / max(maximum - 1, 1))
    chosen = [0]
    for time in range(1, capture.frame_count):
        if travelled[time] - travelled[chosen[-1]] >= step:
            chosen.append(time)
    if chosen[-1] != capture.frame_count - 1:
        chosen.append(capture.frame_count - 1)
    return np.array(chosen), float(travelled[-1])


def build_camera_map(
    index: int,
    camera: Camera,
    times: npt.NDArray[np.int64],
    features: Sequence[Features],
    pairs: Matches,
    *,
    minimum_angle_deg: float,
) -> CameraMap:
    """Structure from motion of camera number ``index`` alone, in a process of its own.

    ``pairs`` are matches by rows of the frames. A camera whose median triangulation angle stays below
    ``minimum_angle_deg`` is returned without points. May be called from several threads. Raises TrackingError
    where the process fails.
    """
    own = tuple(features)
    without_depth = _map_without_depth(index, times, own)
    pairs = usable_pairs(pairs)
    if len(times) < 3 or not pairs:
        return without_depth
    found = _read_map(
        index, times, own, structure_from_motion(camera.name, matched_views([camera], own, pairs))
    )
    angle = _median_triangulation_angle_deg(found)
    logger.info(
        "%s alone: %d of %d frames, %d points, %.1f degrees of parallax",
        camera.name,
        len(found.times),
        len(times),
        len(found.points),
        angle,
    )
    return found if angle >= minimum_angle_deg else without_depth


def usable_pairs(pairs: Matches) -> Matches:
    """Those with matches enough to count."""
    return {pair: matches for pair, matches in pairs.items() if len(matches) >= LEAST_MATCHES}


def match_neighbours(features: Sequence[Features], neighbours: int, ratio: float) -> Matches:
    """Matches of every frame's descriptors with those of the ``neighbours`` frames after it."""
    pairs = {}
    for first in range(len(features)):
        for second in range(first + 1, min(first + neighbours + 1, len(features))):
            pairs[first, second] = match_features(features[first], features[second], ratio)
    return pairs


def _read_map(
    camera: int,
    times: npt.NDArray[np.int64],
    features: tuple[Features, ...],
    solution: dict[str, npt.NDArray[np.float64]],
) -> CameraMap:
    registered = np.flatnonzero(np.isfinite(solution["cTw"][:, 0, 0]))
    points = solution["points"]
    splits = np.cumsum([len(frame.pixels) for frame in features])[:-1]
    point_of_keypoint = np.split(solution["point_of_keypoint"].astype(np.int64), splits)
    # So little is a chance find: most frames of one video follow from each other, and see much in common.
    if len(registered) < max(3, 0.5 * len(times)) or len(points) < 100:
        return _map_without_depth(camera, times, features)
    mTc = invert_pose(solution["cTw"][registered])
    depth = np.concatenate(
        [
            transform_points(invert_pose(mTc[row]), points[rows[rows >= 0]])[:, 2]
            for row, rows in enumerate(point_of_keypoint[frame] for frame in registered)
        ]
    )
    unit = float(np.median(depth))
    mTc[:, :3, 3] /= unit
    return CameraMap(
        camera=camera,
        times=times[registered],
        mTc=mTc,
        features=tuple(features[frame] for frame in registered),
        point_of_keypoint=tuple(point_of_keypoint[frame] for frame in registered),
        points=points / unit,
    )


def _map_without_depth(
    camera: int, times: npt.NDArray[np.int64], features: tuple[Features, ...]
) -> CameraMap:
    return CameraMap(
        camera=camera,
        times=times[:1],
        mTc=np.eye(4)[None],
        features=features[:1],
        point_of_keypoint=(np.full(len(features[0].pixels), -1, np.int64),),
        points=np.zeros((0, 3)),
    )


def _median_triangulation_angle_deg(camera_map: CameraMap) -> float:
    """Median over points of the largest angle between the first ray that saw it and a later one."""
    if not camera_map.has_depth:
        return 0.0
    centres = camera_map.mTc[:, :3, 3]
    first = np.full(len(camera_map.points), -1)
    angle = np.zeros(len(camera_map.points))
    for frame, rows in enumerate(camera_map.point_of_keypoint):
        seen = rows[rows >= 0]
        new = seen[first[seen] < 0]
        first[new] = frame
        before = camera_map.points[seen] - centres[first[seen]]
        now = camera_map.points[seen] - centres[frame]
        cosine = (before * now).sum(1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(now, axis=1))
        angle[seen] = np.maximum(angle[seen], np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return float(np.median(angle[first >= 0]))
