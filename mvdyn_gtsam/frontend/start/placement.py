"""Where one camera's map stands in another's: hypotheses for one similarity from matches over all times.

Static structure may be matched between any two instants, so the matches of many frame pairs vote for pairs
of map points. Repeated texture votes too, and often with more inliers than the truth, so hypotheses are
scored by how much *different* structure they explain, several are kept, and none is believed here:
``verification`` decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.features import match_features
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.frontend.threads import in_order
from mvdyn_gtsam.geometry import Similarity, invert_pose, rotation_angle_deg

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

DIFFERENCE = 1e-6
"""Step of the refinement's numerical derivatives: radians, median depths, log scale."""


@dataclass(frozen=True)
class PlacementConfig:
    """Hypotheses for the similarity between two cameras' maps."""

    match_ratio: float = 0.9
    """Lowe's ratio between cameras; loose, since geometry weeds out. Source: experiments/wide_baseline.py."""
    frames_per_camera: int = 7
    """Frames of each camera, spread over its video, matched with all of the other's. Source: choice, time."""
    inlier_px: float = 6.0
    """Reprojection error up to which a match supports a hypothesis. Source: experiments/wide_baseline.py."""
    samples: int = 20000
    """Three-point samples drawn per search. Source: 99.9 % to hit three inliers at 7 % inliers."""
    cell: float = 0.08
    """Side of the cells, in median depths, by which explained structure is counted. Source: choice."""
    cell_votes: float = 4.0
    """Votes at which a cell is full: more of the same texture adds nothing. Source: choice."""
    hypotheses: int = 8
    """Distinct hypotheses kept for verification. Source: choice, time."""

    def __post_init__(self) -> None:
        if not 0.0 < self.match_ratio <= 1.0:
            raise ConfigError(f"frontend.placement.match_ratio is {self.match_ratio}; above 0, at most 1")
        if min(self.frames_per_camera, self.samples, self.hypotheses) < 1:
            raise ConfigError("frontend.placement: frames_per_camera, samples and hypotheses must be >= 1")
        if min(self.inlier_px, self.cell, self.cell_votes) <= 0.0:
            raise ConfigError("frontend.placement: inlier_px, cell and cell_votes must be above 0")


@dataclass(frozen=True)
class PointMatches:
    """Pairs of map points of cameras a and b that were matched, each with one observation in either."""

    rows: Index
    """``(M, 2)`` rows of the points in map a and in map b."""
    point_a: Array
    """``(M, 3)`` in map a."""
    point_b: Array
    """``(M, 3)`` in map b."""
    aTm: Array
    """``(M, 4, 4)`` map a in the observing frame of camera a (a world-to-camera pose)."""
    bTm: Array
    """``(M, 4, 4)`` likewise for b."""
    pixel_a: Array
    """``(M, 2)`` px"""
    pixel_b: Array
    """``(M, 2)`` px"""
    votes: Array
    """``(M,)`` frame pairs in which the two points were matched."""

    def __len__(self) -> int:
        return len(self.votes)

    def subset(self, chosen: npt.NDArray[np.bool_]) -> PointMatches:
        return PointMatches(
            self.rows[chosen], self.point_a[chosen], self.point_b[chosen], self.aTm[chosen], self.bTm[chosen],
            self.pixel_a[chosen], self.pixel_b[chosen], self.votes[chosen],
        )  # fmt: skip


@dataclass(frozen=True)
class Hypothesis:
    """A possible placement of map b in map a."""

    aSb: Similarity
    support: float
    """Structure explained: votes, at most ``cell_votes`` per cell, the lesser of the two maps' counts."""
    inliers: int


def match_maps(
    map_a: CameraMap,
    map_b: CameraMap,
    config: PlacementConfig,
    frames: tuple[Sequence[int], Sequence[int]] | None = None,
    apart_px: float = 0.0,
) -> PointMatches:
    """Match frames of two cameras at all times and pool the matches by map point.

    ``frames``: rows of either map, instead of some spread over its video.
    ``apart_px``: see ``match_features``.
    """
    frames_a, frames_b = (
        frames
        if frames is not None
        else (
            _spread(len(map_a.times), config.frames_per_camera),
            _spread(len(map_b.times), config.frames_per_camera),
        )
    )

    def matched(frame_a: int, frame_b: int) -> Index:
        first, second = map_a.features[frame_a], map_b.features[frame_b]
        pairs = match_features(first, second, config.match_ratio, apart_px)
        point_a = map_a.point_of_keypoint[frame_a][pairs[:, 0]]
        point_b = map_b.point_of_keypoint[frame_b][pairs[:, 1]]
        both = (point_a >= 0) & (point_b >= 0)
        label = np.broadcast_to([frame_a, frame_b], (len(pairs), 2))
        return np.column_stack([point_a, point_b, label, pairs])[both]

    observations = list(in_order(partial(matched, a, b) for a in frames_a for b in frames_b))
    table = np.concatenate(observations) if observations else np.zeros((0, 6), np.int64)
    if len(table) == 0:
        point, pose, pixel = np.zeros((0, 3)), np.zeros((0, 4, 4)), np.zeros((0, 2))
        return PointMatches(pixel.astype(np.int64), point, point, pose, pose, pixel, pixel, np.zeros(0))
    _, first, votes = np.unique(table[:, :2], axis=0, return_index=True, return_counts=True)
    rows = table[first]
    return PointMatches(
        rows=rows[:, :2],
        point_a=map_a.points[rows[:, 0]],
        point_b=map_b.points[rows[:, 1]],
        aTm=invert_pose(map_a.mTc)[rows[:, 2]],
        bTm=invert_pose(map_b.mTc)[rows[:, 3]],
        pixel_a=_pixels(map_a, rows[:, 2], rows[:, 4]),
        pixel_b=_pixels(map_b, rows[:, 3], rows[:, 5]),
        votes=votes.astype(np.float64),
    )


def propose_placements(
    matches: PointMatches, intrinsics_a: Array, intrinsics_b: Array, config: PlacementConfig
) -> list[Hypothesis]:
    """Distinct hypotheses, best supported first; repeatable (fixed seed).

    After each search the matches its winner explains are set aside and the rest is searched again, so that
    a large repeated texture cannot hide what else would fit.
    """
    random = np.random.default_rng(0)
    scorer = PlacementScorer(matches, intrinsics_a, intrinsics_b, config)
    found: list[Hypothesis] = []
    remaining = np.ones(len(matches), bool)
    for _ in range(3):
        if remaining.sum() < 4:
            break
        candidates = _search(matches, remaining, scorer, random, config)
        if not candidates:
            break
        new = _distinct(candidates, found, config.hypotheses)
        found.extend(new)
        for hypothesis in new[:1]:
            remaining &= scorer.errors(hypothesis.aSb) > config.inlier_px
    refined = scorer.hypotheses([refine_placement(h.aSb, matches, scorer) for h in found])
    refined.sort(key=lambda hypothesis: -hypothesis.support)
    return _distinct(refined, [], config.hypotheses)


def agreeing_pairs(
    matches: PointMatches,
    aSb: Similarity,
    intrinsics_a: Array,
    intrinsics_b: Array,
    config: PlacementConfig,
) -> Index:
    """Rows ``(K, 2)`` of the map points of a and b that are one if the placement is true."""
    if len(matches) == 0:
        return np.zeros((0, 2), np.int64)
    errors = PlacementScorer(matches, intrinsics_a, intrinsics_b, config).errors(aSb)
    return matches.rows[errors < config.inlier_px]


def refine_placement(aSb: Similarity, matches: PointMatches, scorer: PlacementScorer) -> Similarity:
    """Least squares on the reprojections, both ways, of the matches that support ``aSb``."""
    for _ in range(3):
        near = scorer.errors(aSb) < 2.0 * scorer.config.inlier_px
        if near.sum() < 4:
            return aSb
        chosen = PlacementScorer(
            matches.subset(near), scorer.intrinsics_a, scorer.intrinsics_b, scorer.config
        )
        aSb = _fit(aSb, chosen)
    return aSb


def _fit(aSb: Similarity, scorer: PlacementScorer) -> Similarity:
    def moved(step: Array) -> Similarity:
        rotation = aSb.rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        return Similarity(aSb.scale * float(np.exp(step[6])), rotation, aSb.translation + step[3:6])

    def residuals(step: Array) -> Array:
        return _bounded(np.concatenate(scorer.residuals([moved(step)]), axis=-1)).ravel()

    def jacobian(step: Array) -> Array:
        """Forward differences, all seven at once: least_squares would ask for one after the other."""
        steps = DIFFERENCE * np.maximum(1.0, np.abs(step))
        placements = [moved(step), *(moved(step + row) for row in np.diag(steps))]
        found = _bounded(np.concatenate(scorer.residuals(placements), axis=-1))
        found = found.reshape(len(placements), -1)
        return ((found[1:] - found[0]) / steps[:, None]).T

    solution = least_squares(residuals, np.zeros(7), jacobian, loss="soft_l1", f_scale=1.0, max_nfev=20)
    return moved(solution.x)


def _bounded(residuals: Array) -> Array:
    return np.clip(np.nan_to_num(residuals, nan=1e3), -1e3, 1e3)


class PlacementScorer:
    """Reprojection errors and support of placements, for one set of matches."""

    def __init__(
        self, matches: PointMatches, intrinsics_a: Array, intrinsics_b: Array, config: PlacementConfig
    ) -> None:
        self.matches, self.config = matches, config
        self.intrinsics_a, self.intrinsics_b = intrinsics_a, intrinsics_b
        self.cells_a = _cells(matches.point_a, config.cell)
        self.cells_b = _cells(matches.point_b, config.cell)

    def residuals(self, aSb: Sequence[Similarity]) -> tuple[Array, Array]:
        """``(H, M, 2)`` px each, for H placements: of b's points in a's frames, and of a's points in b's."""
        matches = self.matches
        b_in_a = np.stack([one.transform_points(matches.point_b) for one in aSb])
        a_in_b = np.stack([one.inverse().transform_points(matches.point_a) for one in aSb])
        in_a = _reproject(b_in_a, matches.aTm, self.intrinsics_a)
        in_b = _reproject(a_in_b, matches.bTm, self.intrinsics_b)
        return in_a - matches.pixel_a, in_b - matches.pixel_b

    def errors(self, aSb: Similarity) -> Array:
        """``(M,)`` px, the larger of the two; inf behind a camera."""
        return self._errors([aSb])[0]

    def hypotheses(self, aSb: Sequence[Similarity]) -> list[Hypothesis]:
        """Each placement with what speaks for it; together, for one by one takes three times as long."""
        if not aSb:
            return []
        errors = self._errors(aSb)
        value = np.maximum(0.0, 1.0 - (errors / self.config.inlier_px) ** 2)
        value *= np.minimum(self.matches.votes, 5.0)
        inliers = (errors < self.config.inlier_px).sum(axis=1)
        return [
            Hypothesis(one, self._support(row), int(count))
            for one, row, count in zip(aSb, value, inliers, strict=True)
        ]

    def _errors(self, aSb: Sequence[Similarity]) -> Array:
        in_a, in_b = self.residuals(aSb)
        worse = np.maximum(np.linalg.norm(in_a, axis=-1), np.linalg.norm(in_b, axis=-1))
        return np.nan_to_num(worse, nan=np.inf)

    def _support(self, value: Array) -> float:
        return min(
            float(np.minimum(np.bincount(cells, value), self.config.cell_votes).sum())
            for cells in (self.cells_a, self.cells_b)
        )


def _search(
    matches: PointMatches,
    usable: npt.NDArray[np.bool_],
    scorer: PlacementScorer,
    random: np.random.Generator,
    config: PlacementConfig,
) -> list[Hypothesis]:
    """Three-point samples, drawn by votes; the best of each batch scored by support, best first."""
    indices = np.flatnonzero(usable)
    chance = np.minimum(matches.votes[indices], 10.0)
    chance /= chance.sum()

    def best_of(sample: Index) -> list[Hypothesis]:
        scale, rotation, translation = _fit_three(matches.point_a[sample], matches.point_b[sample])
        finite = np.flatnonzero(scale > 0.0)
        scale, rotation, translation = scale[finite], rotation[finite], translation[finite]
        counts = _count_inliers(scale, rotation, translation, scorer)
        rows = np.argsort(-counts)[:25]
        return scorer.hypotheses(
            [Similarity(float(scale[row]), rotation[row], translation[row]) for row in rows]
        )

    # drawn here, in order: only what follows is done side by side
    samples = (
        indices[random.choice(len(indices), size=(2000, 3), p=chance)]
        for _ in range(max(1, config.samples // 2000))
    )
    found = in_order(partial(best_of, sample) for sample in samples)
    best = [hypothesis for batch in found for hypothesis in batch]
    best.sort(key=lambda hypothesis: -hypothesis.support)
    return best


def _count_inliers(scale: Array, rotation: Array, translation: Array, scorer: PlacementScorer) -> Array:
    """Votes within the inlier distance in camera a for each of H similarities; ``(H,)``."""
    matches, config = scorer.matches, scorer.config
    # At most 400 matches, the most voted: this only ranks samples before they are scored in full.
    top = np.argsort(-matches.votes, kind="stable")[:400]
    counts = np.zeros(len(scale))
    aTm, intrinsics = matches.aTm[top], scorer.intrinsics_a
    for start in range(0, len(scale), 500):
        part = slice(start, start + 500)
        world = (matches.point_b[top] @ np.swapaxes(rotation[part], 1, 2)) * scale[part, None, None]
        world += translation[part, None]
        error = np.linalg.norm(_reproject(world, aTm, intrinsics) - matches.pixel_a[top], axis=-1)
        counts[part] = ((error < config.inlier_px) * np.minimum(matches.votes[top], 5.0)).sum(1)
    return counts


def _fit_three(points_a: Array, points_b: Array) -> tuple[Array, Array, Array]:
    """Similarities ``aSb`` of H samples ``(H, 3, 3)`` (Umeyama 1991); scale 0 where a sample does not fit."""
    mean_a, mean_b = points_a.mean(1, keepdims=True), points_b.mean(1, keepdims=True)
    centred_a, centred_b = points_a - mean_a, points_b - mean_b
    left, singular, right = np.linalg.svd(np.swapaxes(centred_a, 1, 2) @ centred_b)
    flip = np.ones_like(singular)
    flip[:, 2] = np.sign(np.linalg.det(left @ right))
    rotation = (left * flip[:, None]) @ right
    scale = (singular * flip).sum(1) / np.maximum((centred_b**2).sum((1, 2)), 1e-12)
    translation = mean_a[:, 0] - scale[:, None] * (rotation @ mean_b[:, 0, :, None])[..., 0]
    fitted = (points_b @ np.swapaxes(rotation, 1, 2)) * scale[:, None, None] + translation[:, None]
    misfit = np.linalg.norm(fitted - points_a, axis=2).max(1)
    size = np.linalg.norm(centred_a, axis=2).max(1)
    scale[(misfit > 0.1 * size) | (size < 1e-9)] = 0.0
    return scale, rotation, translation


def _distinct(candidates: list[Hypothesis], known: list[Hypothesis], maximum: int) -> list[Hypothesis]:
    """The first of every bunch of similar hypotheses, none like a known one."""
    chosen: list[Hypothesis] = []
    for candidate in candidates:
        if len(chosen) == maximum:
            break
        if not any(same_placement(candidate.aSb, other.aSb) for other in [*known, *chosen]):
            chosen.append(candidate)
    return chosen


def same_placement(first: Similarity, second: Similarity) -> bool:
    """Whether two placements differ by less than refinement can bridge; maps have median depth 1."""
    return bool(
        rotation_angle_deg(first.rotation.T @ second.rotation) < 4.0
        and abs(np.log(first.scale / second.scale)) < 0.1
        and np.linalg.norm(first.translation - second.translation) < 0.1
    )


def _reproject(points: Array, cTm: Array, intrinsics: Array) -> Array:
    """Pixels ``(..., M, 2)`` of points ``(..., M, 3)`` in their own frames ``(M, 4, 4)``; NaN if behind."""
    camera = (cTm[:, :3, :3] @ points[..., None])[..., 0] + cTm[:, :3, 3]
    depth = np.where(camera[..., 2] > 1e-6, camera[..., 2], np.nan)
    x = intrinsics[0, 0] * camera[..., 0] / depth + intrinsics[0, 2]
    y = intrinsics[1, 1] * camera[..., 1] / depth + intrinsics[1, 2]
    return np.stack([x, y], axis=-1)


def _cells(points: Array, side: float) -> Index:
    cells = np.floor(points / side).astype(np.int64)
    return np.unique(cells, axis=0, return_inverse=True)[1].ravel()


def _spread(count: int, maximum: int) -> Index:
    """At most ``maximum`` of ``range(count)``, evenly, ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, maximum)).round().astype(np.int64))


def _pixels(camera_map: CameraMap, frames: Index, keypoints: Index) -> Array:
    rows = zip(frames, keypoints, strict=True)
    return np.array([camera_map.features[frame].pixels[keypoint] for frame, keypoint in rows])
