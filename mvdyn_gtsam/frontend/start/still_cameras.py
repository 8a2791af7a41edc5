"""Places for cameras without parallax (they stand still or only turn), which have no map of their own.

Where another camera has depth, its map points place them: pose from points, several hypotheses, and dense
warping of the map's views into the still one before any is believed. Where none has, each still camera is one
image of an incremental structure from motion. Whoever is left gets a group, and a made-up depth, of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.dense_map import DenseMap
from mvdyn_gtsam.frontend.start.features import match_features
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.frontend.start.still_view import StillView
from mvdyn_gtsam.frontend.start.structure_from_motion import matched_views, structure_from_motion
from mvdyn_gtsam.frontend.start.verification import Verdict, VerificationConfig, verify_seen
from mvdyn_gtsam.geometry import Similarity, invert_pose, project, transform_points

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
SamePoint = tuple[int, int, Index]
"""Camera a, camera b and the ``(M, 2)`` rows of their map points that are one."""


@dataclass(frozen=True)
class StillConfig:
    """Cameras without parallax."""

    frames: int = 12
    """Instants joined into a camera's one image. Source: choice; a median of 12 hides what stays for 5."""
    map_frames: int = 9
    """Frames of a map matched with a still camera. Source: choice, time."""
    map_ratio: float = 0.9
    """Lowe's ratio against a map; geometry weeds out. Source: PlacementConfig.match_ratio."""
    still_ratio: float = 0.9
    """Lowe's ratio between still cameras; geometry weeds out. Source: panoptic_basketball_6cam."""
    inlier_px: float = 4.0
    """Reprojection error up to which a match supports a pose. Source: COLMAP filter_max_reproj_error."""
    minimum_inliers: int = 12
    """Keypoints that must support a pose. Source: choice."""
    minimum_trust: float = 0.6
    """Favourable share of testimony; maps see what floats and need less. Source: true > .65, false < .45."""
    minimum_agreement: float = 0.03
    """Agreeing share of the image per view of the map. Source: as above."""
    minimum_explained: float = 0.15
    """Share of a still camera's matches that the solution must explain. Source: panoptic_basketball_6cam."""
    minimum_angle_deg: float = 2.0
    """Median angle between the rays of two still cameras to a point. Source: COLMAP's filter is 1.5."""

    def __post_init__(self) -> None:
        if min(self.frames, self.map_frames) < 2 or self.minimum_inliers < 6:
            raise ConfigError("frontend.wide_baseline.still: at least 2 frames and 6 inliers")
        if not (0.0 < self.map_ratio <= 1.0 and 0.0 < self.still_ratio <= 1.0):
            raise ConfigError("frontend.wide_baseline.still: ratios must be above 0, at most 1")


@dataclass(frozen=True)
class StillPlacement:
    """What joins the placed maps: still cameras as maps of one frame, to be adjusted with the others."""

    groups: tuple[Mapping[int, Similarity], ...]
    """The groups handed in, with still cameras added, then a group of still cameras; not the lone ones."""
    maps: Mapping[int, CameraMap] = field(default_factory=dict)
    """Of each placed still camera; one frame, that of its view."""
    same_point: tuple[SamePoint, ...] = ()


@dataclass(frozen=True)
class PointsSeen:
    """Keypoints of a still view matched with points of placed maps."""

    keypoint: Index
    """``(M,)``"""
    camera: Index
    """``(M,)`` whose map the point belongs to."""
    row: Index
    """``(M,)`` in that map's points."""
    world: Array
    """``(M, 3)``"""


def place_still_cameras(
    cameras: Sequence[Camera],
    dense: Mapping[int, DenseMap],
    groups: Sequence[Mapping[int, Similarity]],
    views: Mapping[int, StillView],
    config: StillConfig,
    verification: VerificationConfig,
) -> StillPlacement:
    """Place every still camera that something connects: first in groups with depth, then among themselves."""
    placed: list[dict[int, Similarity]] = [dict(group) for group in groups]
    maps: dict[int, CameraMap] = {}
    same_point: list[SamePoint] = []
    for camera, view in views.items() if groups else ():
        found = _place_in_best_group(cameras, dense, groups, view, config, verification)
        if found is None:
            continue
        group, rTw, seen = found
        maps[camera], pairs = _map_of_seen(view, rTw, seen)
        wTr = invert_pose(rTw)
        placed[group][camera] = Similarity(1.0, wTr[:3, :3], wTr[:3, 3])
        same_point.extend(pairs)
    left = {camera: view for camera, view in views.items() if camera not in maps}
    if len(left) >= 2:
        own_maps, own_same = solve_still_views(list(left.values()), config)
        if own_maps:
            placed.append({camera: Similarity.identity() for camera in own_maps})
            maps |= own_maps
            same_point.extend(own_same)
    return StillPlacement(tuple(placed), maps, tuple(same_point))


# ---- pose from points of a camera that has depth ----------------------------------------------------------


def _place_in_best_group(
    cameras: Sequence[Camera],
    dense: Mapping[int, DenseMap],
    groups: Sequence[Mapping[int, Similarity]],
    view: StillView,
    config: StillConfig,
    verification: VerificationConfig,
) -> tuple[int, Array, PointsSeen] | None:
    best: tuple[float, int, Array, PointsSeen] | None = None
    stride = next(iter(dense.values())).views[0].grid.stride if dense else 1
    smooth = cv2.GaussianBlur(view.image.astype(np.float32), (0, 0), 0.35 * stride)
    name = cameras[view.camera].name
    for number, group in enumerate(groups):
        seen = match_points(view, [dense[c].sparse for c in group], [group[c] for c in group], config)
        hypotheses = propose_poses(seen, view, config)
        logger.info("%s: %d matches with map points, %d poses", name, len(seen.keypoint), len(hypotheses))
        for rTw, error in hypotheses:
            verdicts = [
                verify_seen(dense[c].views, wSm, smooth, view.pinhole.intrinsics, rTw, verification)
                for c, wSm in group.items()
            ]
            verdict = Verdict(
                sum(v.agreement for v in verdicts),
                sum(v.contradiction for v in verdicts),
                sum(v.frame_pairs for v in verdicts),
            )
            logger.debug(
                "%s: %d inliers, %s, trust %.2f",
                name,
                (error < config.inlier_px).sum(),
                verdict,
                verdict.trust,
            )
            if verdict.trust < config.minimum_trust:
                continue
            if verdict.agreement < config.minimum_agreement * verdict.frame_pairs:
                continue
            strength = verdict.agreement * verdict.trust
            if best is None or strength > best[0]:
                # Seen from far aside, errors of the map's depths show: joint adjustment needs room for them.
                best = strength, number, rTw, _subset(seen, error < 2.0 * config.inlier_px)
    if best is None:
        logger.info("%s: no pose from other cameras' points stands up to dense warping", name)
        return None
    logger.info("%s: placed by %d points of other cameras", name, len(best[3].keypoint))
    return best[1:]


def match_points(
    view: StillView, maps: Sequence[CameraMap], wSm: Sequence[Similarity], config: StillConfig
) -> PointsSeen:
    """Match the view with frames of all maps at all times: it stands still, so all speak of one pose."""
    found = [np.zeros((0, 3), np.int64)]
    for camera_map in maps:
        count = len(camera_map.times)
        for frame in np.unique(np.linspace(0, count - 1, min(count, config.map_frames)).round().astype(int)):
            pairs = match_features(view.features, camera_map.features[frame], config.map_ratio)
            row = camera_map.point_of_keypoint[frame][pairs[:, 1]]
            label = np.full(len(pairs), camera_map.camera)
            found.append(np.column_stack([pairs[:, 0], label, row])[row >= 0])
    table = np.unique(np.concatenate(found), axis=0)
    world = np.zeros((len(table), 3))
    for camera_map, similarity in zip(maps, wSm, strict=True):
        own = table[:, 1] == camera_map.camera
        world[own] = similarity.transform_points(camera_map.points[table[own, 2]])
    return PointsSeen(table[:, 0], table[:, 1], table[:, 2], world)


def propose_poses(seen: PointsSeen, view: StillView, config: StillConfig) -> list[tuple[Array, Array]]:
    """Poses ``rTw`` and the error in px ``(M,)`` of each match under it; repeatable (fixed seed).

    What a pose explains is set aside before the next search: a repeated texture cannot hide the truth.
    """
    cv2.setRNGSeed(0)
    intrinsics = view.pinhole.intrinsics
    pixels = view.features.pixels[seen.keypoint]
    remaining = np.ones(len(pixels), bool)
    poses = []
    for _ in range(4):
        rows = np.flatnonzero(remaining)
        if len(np.unique(seen.keypoint[rows])) < config.minimum_inliers:
            break
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            seen.world[rows], pixels[rows], intrinsics, None, iterationsCount=5000,
            reprojectionError=config.inlier_px, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not found or inliers is None or len(inliers) < 6:
            break
        support = np.zeros(len(pixels), bool)
        support[rows[inliers.ravel()]] = True
        for _ in range(3):
            rotation, translation = cv2.solvePnPRefineLM(
                seen.world[support], pixels[support], intrinsics, None, rotation, translation
            )
            rTw = np.eye(4)
            rTw[:3, :3], rTw[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
            where, _ = project(transform_points(rTw, seen.world), intrinsics)
            error = np.nan_to_num(np.linalg.norm(where - pixels, axis=1), nan=np.inf)
            support = error < config.inlier_px
            if support.sum() < 6:
                break
        remaining[rows[inliers.ravel()]] = False
        remaining &= ~support
        if len(np.unique(seen.keypoint[support])) >= config.minimum_inliers:
            poses.append((rTw, error))
    return poses


def _map_of_seen(view: StillView, rTw: Array, seen: PointsSeen) -> tuple[CameraMap, list[SamePoint]]:
    """The view as a map of one frame whose points are those it was placed by."""
    keypoints, first, own_row = np.unique(seen.keypoint, return_index=True, return_inverse=True)
    points = transform_points(rTw, seen.world[first])
    pairs = [
        (
            int(other),
            view.camera,
            np.column_stack([seen.row[seen.camera == other], own_row.ravel()[seen.camera == other]]),
        )
        for other in np.unique(seen.camera)
    ]
    return _one_frame_map(view, np.eye(4), keypoints, points), pairs


def _one_frame_map(view: StillView, mTr: Array, keypoints: Index, points: Array) -> CameraMap:
    point_of_keypoint = np.full(len(view.features.pixels), -1, np.int64)
    point_of_keypoint[keypoints] = np.arange(len(points))
    return CameraMap(
        camera=view.camera,
        times=view.times[:1],
        mTc=mTr[None],
        features=(view.features,),
        point_of_keypoint=(point_of_keypoint,),
        points=points,
    )


def _subset(seen: PointsSeen, chosen: npt.NDArray[np.bool_]) -> PointsSeen:
    return PointsSeen(seen.keypoint[chosen], seen.camera[chosen], seen.row[chosen], seen.world[chosen])


# ---- still cameras among themselves -----------------------------------------------------------------------


def solve_still_views(
    views: Sequence[StillView], config: StillConfig
) -> tuple[dict[int, CameraMap], list[SamePoint]]:
    """Maps of the still cameras that incremental structure from motion joins, in one world of median depth 1.

    Empty where nothing stands up: too few matches, too small angles, or a solution that explains too little.
    Raises TrackingError when the process that solves fails.
    """
    pairs = {}
    for a in range(len(views)):
        for b in range(a + 1, len(views)):
            matches = match_features(views[a].features, views[b].features, config.still_ratio)
            if len(matches) >= 15:  # COLMAP's min_num_matches
                pairs[a, b] = matches
    if not pairs:
        logger.info("still cameras: no two of them look alike enough to be connected")
        return {}, []
    problem = matched_views([view.pinhole for view in views], [view.features for view in views], pairs)
    solution = structure_from_motion("the still cameras", {**problem, "few_views": True})
    cTw, points = solution["cTw"], solution["points"]
    splits = np.cumsum([len(view.features.pixels) for view in views])[:-1]
    rows = np.split(solution["point_of_keypoint"].astype(np.int64), splits)
    joined = _believed(views, pairs, cTw, points, rows, config)
    if len(joined) < 2:
        return {}, []
    depth = [transform_points(cTw[v], points[rows[v][rows[v] >= 0]])[:, 2] for v in joined]
    unit = float(np.median(np.concatenate(depth)))
    maps = {}
    for v in joined:
        wTr = invert_pose(cTw[v])
        wTr[:3, 3] /= unit
        keypoints = np.flatnonzero(rows[v] >= 0)
        maps[views[v].camera] = _one_frame_map(views[v], wTr, keypoints, points[rows[v][keypoints]] / unit)
    return maps, _same_landmarks(views, rows, joined)


def _same_landmarks(
    views: Sequence[StillView], rows: Sequence[Index], joined: Sequence[int]
) -> list[SamePoint]:
    same = []
    own = {v: rows[v][rows[v] >= 0] for v in joined}
    for a in joined:
        for b in joined:
            if a < b:
                _, row_a, row_b = np.intersect1d(own[a], own[b], return_indices=True)
                same.append((views[a].camera, views[b].camera, np.column_stack([row_a, row_b])))
    return same


def _believed(
    views: Sequence[StillView],
    pairs: Mapping[tuple[int, int], Index],
    cTw: Array,
    points: Array,
    rows: Sequence[Index],
    config: StillConfig,
) -> list[int]:
    """The registered views whose place explains enough of what they matched, at a fair angle."""
    joined = [v for v in range(len(views)) if np.isfinite(cTw[v, 0, 0]) and (rows[v] >= 0).any()]
    while len(joined) >= 2:
        shares, angles, counts = {}, {}, {}
        for v in joined:
            explained = total = 0
            for (a, b), matches in pairs.items():
                if v in (a, b) and a in joined and b in joined:
                    row_a, row_b = rows[a][matches[:, 0]], rows[b][matches[:, 1]]
                    explained += int(((row_a == row_b) & (row_a >= 0)).sum())
                    total += len(matches)
            shares[v], counts[v] = explained / max(total, 1), explained
            angles[v] = _angle_deg(v, joined, cTw, points, rows)
            logger.info(
                "%s: %d matches with other still cameras, %.0f %% explained, %.1f degrees between rays",
                views[v].pinhole.name, total, 100 * shares[v], angles[v],
            )  # fmt: skip
        worst = min(joined, key=lambda v: shares[v])
        bad = [
            v for v in joined if counts[v] < config.minimum_inliers or angles[v] < config.minimum_angle_deg
        ]
        if shares[worst] < config.minimum_explained:
            bad.append(worst)
        if not bad:
            return joined
        logger.info("%s: its place among the still cameras is not believed", views[bad[0]].pinhole.name)
        joined.remove(bad[0])
    return []


def _angle_deg(v: int, joined: Sequence[int], cTw: Array, points: Array, rows: Sequence[Index]) -> float:
    """Median over the points of a view of the largest angle to another view's ray."""
    seen = rows[v][rows[v] >= 0]
    widest = np.zeros(len(seen))
    centres = {other: invert_pose(cTw[other])[:3, 3] for other in joined}
    own = points[seen] - centres[v]
    for other in joined:
        if other != v:
            both = np.isin(seen, rows[other])
            ray = points[seen] - centres[other]
            cosine = (own * ray).sum(1) / (np.linalg.norm(own, axis=1) * np.linalg.norm(ray, axis=1))
            widest[both] = np.maximum(widest[both], np.degrees(np.arccos(np.clip(cosine, -1, 1)))[both])
    return float(np.median(widest))
