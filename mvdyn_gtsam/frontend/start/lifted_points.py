"""Keypoints lifted onto dense depth: what two cameras can be matched by where few points were triangulated.

A point is triangulated when it is found again in several frames of its camera; on plain or repeated surfaces
few are, and hardly ever those that the other camera recognises. Dense flow gives depth to any keypoint. Wide
baselines also distort what surrounds a keypoint, so a few frames are looked at as from several directions
(Morel and Yu 2009, ASIFT).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Capture
from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.dense_map import DenseMap, DepthView
from mvdyn_gtsam.frontend.start.features import Features, extract_tilted_features
from mvdyn_gtsam.frontend.start.placement import PlacementConfig, PointMatches, match_maps
from mvdyn_gtsam.geometry import pixel_rays, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class LiftConfig:
    """Keypoints lifted onto dense depth, for cameras that triangulated points do not connect."""

    tilted_frames: int = 4
    """Frames of each camera looked at as from several directions. Source: choice, time."""
    tilted_features: int = 500
    """Keypoints of each direction. Source: choice, time."""
    match_ratio: float = 0.8
    """Lowe's ratio between cameras. Source: Lowe 2004."""
    apart_px: float = 4.0
    """Keypoints nearer than this are one seen from several directions, and no rivals. Source: choice."""
    minimum_trust: float = 0.85
    """Share of favourable testimony a placement needs, unless no other is near it in matches. Source:
    experiments/placement_trust.py; see ``ClassicalInitializer``."""
    minimum_inliers: int = 20
    """Matches that must support it. Source: experiments/start_variants.py; a true one with 12 ended up
    2.5 degrees off."""
    minimum_share: float = 0.4
    """Share of the comparable surface that has to agree. Source: experiments/start_variants.py; one that had
    0.35, of a map that was bent, stayed 2.3 degrees off."""

    def __post_init__(self) -> None:
        if self.tilted_frames < 0 or self.tilted_features < 1:
            raise ConfigError("frontend.wide_baseline.lift: tilted_frames >= 0, tilted_features >= 1")
        if not 0.0 < self.match_ratio <= 1.0 or self.apart_px < 0.0:
            raise ConfigError("frontend.wide_baseline.lift: match_ratio from 0 to 1, apart_px at least 0")


def lift_map(capture: Capture, dense: DenseMap, config: LiftConfig, contrast: float) -> DenseMap:
    """The map with a point for every keypoint of its dense frames that has depth there and was none yet."""
    sparse = dense.sparse
    return lift_keypoints(
        dense,
        {
            frame: extract_tilted_features(
                capture.read(sparse.camera, int(sparse.times[frame])), config.tilted_features, contrast
            )
            for frame in _tilted(dense, config)
        },
    )


def lift_keypoints(dense: DenseMap, more: Mapping[int, Features]) -> DenseMap:
    """The map with the keypoints of its dense frames, and those of ``more`` by row of the map, as points.

    The points it had keep their rows.
    """
    sparse = dense.sparse
    features, owners, points = list(sparse.features), list(sparse.point_of_keypoint), [sparse.points]
    count = len(sparse.points)
    for seen, view in zip(dense.seen, dense.views, strict=True):
        own, owner = features[seen.frame], owners[seen.frame]
        if seen.frame in more:
            own = joined(own, more[seen.frame])
            owner = np.concatenate([owner, np.full(len(own.pixels) - len(owner), -1, np.int64)])
        depth = depth_at(view, own.pixels)
        new = np.flatnonzero((owner < 0) & np.isfinite(depth))
        rays = pixel_rays(own.pixels[new], view.intrinsics)
        points.append(transform_points(view.mTc, rays * depth[new, None]))
        owner = owner.copy()
        owner[new] = count + np.arange(len(new))
        count += len(new)
        features[seen.frame], owners[seen.frame] = own, owner
    return replace(
        dense,
        sparse=replace(
            sparse,
            features=tuple(features),
            point_of_keypoint=tuple(owners),
            points=np.concatenate(points),
        ),
    )


def match_lifted(
    first: DenseMap, second: DenseMap, config: LiftConfig, placement: PlacementConfig
) -> PointMatches:
    """Matches between the dense frames of two lifted maps."""
    return match_maps(
        first.sparse,
        second.sparse,
        replace(placement, match_ratio=config.match_ratio),
        frames=(_tilted(first, config), _tilted(second, config)),
        apart_px=config.apart_px,
    )


def _tilted(dense: DenseMap, config: LiftConfig) -> list[int]:
    """Rows of the map that are looked at from several directions, spread over its dense frames."""
    count = len(dense.seen)
    chosen = np.linspace(0, count - 1, min(config.tilted_frames, count)).round().astype(int)
    return [dense.seen[row].frame for row in np.unique(chosen)]


def joined(first: Features, second: Features) -> Features:
    """Keypoints of one frame, found in two ways."""
    return Features(
        np.concatenate([first.pixels, second.pixels]),
        np.concatenate([first.descriptors, second.descriptors]),
    )


def depth_at(view: DepthView, pixels: Array) -> Array:
    """Depth ``(N,)`` at the grid points nearest to ``(N, 2)`` pixels; NaN where it is not trustworthy."""
    rows, cols = view.grid.shape
    column, row = np.rint((pixels - view.grid.pixels[0]) / view.grid.stride).astype(np.int64).T
    nearest = np.clip(row, 0, rows - 1) * cols + np.clip(column, 0, cols - 1)
    return np.asarray(view.depth[nearest])
