"""Where the depth solve begins: of several depths per pixel the one that the flow within the camera likes
best, and for what moves a depth from the views of its instant."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.edges import SURE_WEIGHT, Edge, FlowTargets
from mvdyn_gtsam.refinement.medians import known_median
from mvdyn_gtsam.refinement.moving.free_space import BEHIND
from mvdyn_gtsam.refinement.settings import RefinementConfig
from mvdyn_gtsam.refinement.solve.depth import robust_cost

Mask = npt.NDArray[np.bool_]

BOX = 5
"""Side of the square over which costs are averaged before a pixel decides, px of the view."""
SCORING_EDGES = 6
"""Edges that judge the candidates, those that see most parallax."""
STILL_VIEWS, STILL_SIDE = 2, 5
"""Frames that must see a pixel stand still, and side of the least square that does, px of the view. Source:
as ``RefinementConfig.still_px``."""
AROUND, NEAREST_SHARE = 8, 0.95
"""Width of the rim of a moving region, px of the view, and the share of it that is not the nearest. Source:
choice."""
LEAST_PARALLAX_PX = 10.0
"""Motion of a pixel per unit of log depth below which its triangulated depth is no candidate."""


def best_candidate(
    candidates: Sequence[Float32], edges: Sequence[Edge], config: RefinementConfig, margin: float = 0.2
) -> Float32:
    """Inverse depth ``(h, w)``: at each pixel the candidate ``(h, w)`` with the lowest L_flow around it.

    The depths triangulated from single edges are candidates too. The first of ``candidates`` is kept unless
    another is better by ``margin`` px of the summed cost.
    """
    shape = candidates[0].shape
    judges = most_telling(edges, candidates[0], SCORING_EDGES)
    triangulated = [_triangulated(edge, candidates[0]) for edge in judges[: SCORING_EDGES // 2]]
    best = candidates[0].copy()
    lowest = _score(best, judges, config, shape)
    for candidate in [*candidates[1:], *triangulated]:
        score = _score(candidate, judges, config, shape)
        better = score < lowest - margin
        best[better], lowest[better] = candidate[better], score[better]
    return best


def most_telling(edges: Sequence[Edge], inverse_depth: Float32, count: int) -> list[Edge]:
    """The ``count`` edges that see most parallax of depth ``(h, w)`` where they are trusted."""
    return sorted(edges, key=lambda edge: -_parallax(edge, inverse_depth))[:count]


def static_residual(inverse_depth: Float32, edges: Sequence[Edge]) -> Float32:
    """Median residual ``(h, w)`` px of the flow within the camera if nothing moved; NaN where there is
    none."""
    rho = inverse_depth.ravel()
    own = [edge for edge in edges if edge.j[0] == edge.i[0]]
    table = np.full((len(own), rho.size), np.nan, np.float32)
    for row, edge in zip(table, own, strict=True):
        terms = edge.terms(rho[edge.pixels])
        # behind the camera the residual is zero, which must not pass for standing still
        sure = (edge.weight >= SURE_WEIGHT) & terms.valid
        residual = terms.residual[sure]
        row[edge.pixels[sure]] = np.hypot(residual[:, 0], residual[:, 1])
    return known_median(table).reshape(inverse_depth.shape)


def proven_still(residual: Float32, edges: Sequence[Edge], config: RefinementConfig) -> Mask:
    """``(h, w)`` where the flow to two frames at least finds things just where they would be if nothing
    moved; ``residual (h, w)`` is that of ``static_residual``. Without what is thin."""
    views = np.zeros(residual.size, np.uint8)
    for edge in edges:
        views[edge.pixels[edge.weight >= SURE_WEIGHT]] += 1
    still = (residual < config.still_px) & (views.reshape(residual.shape) >= STILL_VIEWS)
    kernel = np.ones((STILL_SIDE, STILL_SIDE), np.uint8)
    return np.asarray(cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)


def before_all_around(theta: Float32, labels: npt.NDArray[np.int32], known: Mask) -> Mask:
    """``(h, w)`` where regions of ``labels (h, w)``, numbered from 1, are nearer than all around them.

    By log inverse depth ``theta (h, w)``, which is ``known (h, w)`` for what stands around; everywhere in
    regions around which it is not.
    """
    found = np.zeros(labels.shape, bool)
    kernel = np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8)
    for label in range(1, int(labels.max(initial=0)) + 1):
        region = labels == label
        rim = (cv2.dilate(region.astype(np.uint8), kernel) > 0) & (labels == 0) & known
        limit = np.quantile(theta[rim], NEAREST_SHARE) + BEHIND if rim.any() else -np.inf
        found |= region & (theta > limit)
    return found


def failing_regions(residual: Float32, config: RefinementConfig) -> npt.NDArray[np.uint8]:
    """``(h, w)`` 1 in the regions where the static model fails; ``residual (h, w)`` px, NaN: unknown."""
    fails = cv2.medianBlur((np.nan_to_num(residual) > config.moving_px).astype(np.uint8), 5)
    labels = regions(closed(fails, config), config)
    strong = np.nan_to_num(residual) > 2.0 * config.moving_px
    result = np.zeros(residual.shape, np.uint8)
    for label in range(1, labels.max() + 1):
        region = labels == label
        # hardly failing: noise of flow on plain walls, not motion
        if strong[region].mean() > 0.3:
            result[region] = 1
    return result


def moving_regions(
    own: npt.NDArray[np.uint8],
    targets: FlowTargets,
    there: Sequence[npt.NDArray[np.uint8]],
    config: RefinementConfig,
) -> npt.NDArray[np.int32]:
    """Label ``(h, w)`` of the regions that move, 0 elsewhere.

    ``own (h, w)`` says where the static model fails in this frame, ``there`` where it does at the times of
    the ``targets``. The pixels and those that the flow finds there vote: what moves evenly along its epipolar
    lines for a moment passes for static in one frame, and noise for motion, but not in most.
    """
    votes, count = _votes(targets.pixels, there)
    moves = votes + own.ravel() >= config.moving_share * (count + 1.0)
    return _whole_regions(moves.reshape(own.shape), config)


def carried_regions(
    own: npt.NDArray[np.uint8],
    time: int,
    targets: FlowTargets,
    there: Sequence[npt.NDArray[np.uint8]],
    beside: Mask,
    stands: Mask,
    config: RefinementConfig,
) -> npt.NDArray[np.uint8]:
    """Where the static model fails in the frame of a ``time`` ``(h, w)``, with what moves in those before or
    after.

    As in ``moving_regions``; here nearly all of one side must agree, so that what is found is carried to the
    ends of a video, over pauses, and through moments of even motion; but not where others see a surface that
    ``stands (h, w)`` there. Where flow leads nowhere, what moves too fast for it, ``beside (h, w)`` decides:
    whether it moves there in the frames next to this one.
    """
    carried, found_flow = np.zeros(own.size, bool), np.zeros(own.size, bool)
    for side in (targets.times < time, targets.times > time):
        others = [fails for fails, on_side in zip(there, side, strict=True) if on_side]
        votes, count = _votes(targets.pixels[side], others)
        carried |= (count > 0.0) & (votes >= config.carried_share * count)
        found_flow |= count > 0.0
    carried |= ~found_flow & beside.ravel()
    found = _whole_regions(carried.reshape(own.shape) & ~stands, config)
    return np.maximum(own, (found > 0).astype(np.uint8))


def _votes(targets: npt.NDArray[np.int32], there: Sequence[npt.NDArray[np.uint8]]) -> tuple[Float32, Float32]:
    """How many of the frames ``there`` call each pixel failing, and how many see it, ``(N,)`` each; they see
    it at ``targets (K, N)``."""
    votes = np.zeros(targets.shape[1], np.float32)
    for pixels, fails in zip(targets, there, strict=True):
        # the last index stands for none, and is masked
        votes += np.take(fails.ravel(), pixels) * (pixels >= 0)
    return votes, (targets >= 0).sum(axis=0).astype(np.float32)


def _whole_regions(mask: Mask, config: RefinementConfig) -> npt.NDArray[np.int32]:
    return regions(closed(cv2.medianBlur(mask.astype(np.uint8), 5), config), config)


def closed(mask: npt.NDArray[np.uint8], config: RefinementConfig) -> npt.NDArray[np.uint8]:
    """``mask (h, w)`` with its gaps closed."""
    side = 2 * round(config.moving_gap * mask.shape[1] / 2) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel), np.uint8)


def regions(mask: npt.NDArray[np.uint8], config: RefinementConfig) -> npt.NDArray[np.int32]:
    """Connected parts of ``mask (h, w)``, numbered from 1; specks are left out."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    result = np.zeros(mask.shape, np.int32)
    kept = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= config.moving_area * mask.size]
    for number, label in enumerate(kept, start=1):
        result[labels == label] = number
    return result


def _parallax(edge: Edge, inverse_depth: Float32) -> float:
    """Motion over the image per unit of log depth, px, summed over the edge's pixels."""
    rho = inverse_depth.ravel()[edge.pixels][::16]
    baseline = np.linalg.norm(edge.jTi[:3, 3]) * edge.intrinsics_j[0, 0]
    return float((np.minimum(baseline * rho, 100.0) * edge.weight[::16]).sum())


def _score(
    inverse_depth: Float32, edges: Sequence[Edge], config: RefinementConfig, shape: tuple[int, ...]
) -> Float32:
    rho = inverse_depth.ravel()
    total = np.zeros(rho.size, np.float32)
    for edge in edges:
        terms = edge.terms(rho[edge.pixels])
        each = robust_cost(np.abs(terms.residual).sum(axis=1), config.flow_lambda)
        # behind the camera: as bad as 20 lambdas off
        worst = config.flow_lambda * (1.0 + np.log(20.0))
        total[edge.pixels] += edge.weight * np.where(terms.valid, each, worst)
    return np.asarray(cv2.blur(total.reshape(shape), (BOX, BOX)), np.float32)


def _triangulated(edge: Edge, fallback: Float32) -> Float32:
    """Inverse depth ``(h, w)`` where the edge's flow meets its epipolar line; ``fallback`` without
    parallax."""
    intrinsics = edge.intrinsics_j
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]], np.float32)
    seen = (edge.target - intrinsics[:2, 2].astype(np.float32)) / focal
    turned = edge.rays @ edge.jTi[:3, :3].T.astype(np.float32)
    translation = edge.jTi[:3, 3].astype(np.float32)
    constant = turned[:, :2] - seen * turned[:, 2:]
    slope = translation[:2] - seen * translation[2]
    squared = (slope**2).sum(axis=1)
    rho = -(constant * slope).sum(axis=1) / np.maximum(squared, 1e-12)
    good = (rho > 0.0) & (np.sqrt(squared) * focal[0] * rho > LEAST_PARALLAX_PX)
    result = fallback.copy()
    result.ravel()[edge.pixels[good]] = rho[good]
    return result
