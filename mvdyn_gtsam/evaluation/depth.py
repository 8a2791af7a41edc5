"""Depth against the true depth: Abs.Rel, delta < 1.25 and the median point distance M_d."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import EvaluationError
from mvdyn_gtsam.evaluation.association import CameraMatch, ReconstructionLike
from mvdyn_gtsam.evaluation.groundtruth import GroundTruth
from mvdyn_gtsam.geometry import Similarity, backproject, transform_points

Array = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.floating]

MIN_PIXELS = 16
"""Fewer valid pixels than this do not tell a frame's scale and offset apart from noise."""

MAX_DISTANCES = 20_000_000
"""Point distances kept for one median (160 MB); beyond, every frame is thinned on a regular stride."""


@dataclass
class _PixelSums:
    """Sums over pixels, so that static and moving parts add up to the whole."""

    pixels: int = 0
    relative: float = 0.0
    within: int = 0

    def add(self, relative: Array, within: npt.NDArray[np.bool_]) -> None:
        self.pixels += len(relative)
        self.relative += float(relative.sum())
        self.within += int(within.sum())

    @property
    def abs_rel(self) -> float | None:
        return self.relative / self.pixels if self.pixels else None

    @property
    def delta_1_25(self) -> float | None:
        return self.within / self.pixels if self.pixels else None


@dataclass(frozen=True)
class DepthScores:
    """Depth metrics pooled over all pixels with a true and an estimated depth; None: nothing there."""

    abs_rel: float | None
    delta_1_25: float | None
    abs_rel_static: float | None
    abs_rel_moving: float | None
    delta_1_25_static: float | None
    delta_1_25_moving: float | None
    m_d: float | None
    """Strict: median distance in metres of corresponding points in the world after the trajectory's full
    Sim(3), so that errors of pose and of depth both count."""
    m_d_static: float | None
    m_d_moving: float | None
    m_d_scale_only: float | None
    """The paper's supplement read to the letter, ``D = s D_est``: the same in each camera's own frame, where
    the depth takes the Sim(3)'s scale and the pose plays no part."""
    frames: int
    """Frames with a true depth image."""
    frames_without_estimate: int
    """Those of them where the reconstruction has no usable depth: failures."""
    coverage: float | None
    """Fraction of the pixels with a true depth that have an estimated one."""


@dataclass
class _Accumulator:
    all: _PixelSums = field(default_factory=_PixelSums)
    static: _PixelSums = field(default_factory=_PixelSums)
    moving: _PixelSums = field(default_factory=_PixelSums)
    world_distances: list[npt.NDArray[np.float32]] = field(default_factory=list)
    camera_distances: list[npt.NDArray[np.float32]] = field(default_factory=list)
    static_distances: list[npt.NDArray[np.float32]] = field(default_factory=list)
    moving_distances: list[npt.NDArray[np.float32]] = field(default_factory=list)
    frames: int = 0
    frames_without_estimate: int = 0
    true_pixels: int = 0
    estimated_pixels: int = 0

    def scores(self) -> DepthScores:
        return DepthScores(
            abs_rel=self.all.abs_rel,
            delta_1_25=self.all.delta_1_25,
            abs_rel_static=self.static.abs_rel,
            abs_rel_moving=self.moving.abs_rel,
            delta_1_25_static=self.static.delta_1_25,
            delta_1_25_moving=self.moving.delta_1_25,
            m_d=_median(self.world_distances),
            m_d_static=_median(self.static_distances),
            m_d_moving=_median(self.moving_distances),
            m_d_scale_only=_median(self.camera_distances),
            frames=self.frames,
            frames_without_estimate=self.frames_without_estimate,
            coverage=self.estimated_pixels / self.true_pixels if self.true_pixels else None,
        )


def fit_scale_and_offset(estimated: Array, truth: Array) -> tuple[float, float]:
    """``s, o`` of ``min sum (s * estimated + o - truth)^2`` over ``(N,)`` depths: plain least squares.

    Constant estimates leave ``s`` undetermined: then ``s = 0`` and ``o`` is the mean of the truth.
    """
    centered = estimated - estimated.mean()
    variance = float(centered @ centered)
    if variance <= 1e-12 * len(estimated) * float(np.mean(estimated**2)):
        return 0.0, float(truth.mean())
    scale = float(centered @ truth) / variance
    return scale, float(truth.mean() - scale * estimated.mean())


def depth_scores(
    reconstruction: ReconstructionLike,
    groundtruth: GroundTruth,
    matches: Mapping[str, CameraMatch],
    gSe: Similarity,
) -> tuple[DepthScores, dict[str, DepthScores]]:
    """Scores over all cameras together, and of each camera.

    Abs.Rel and delta < 1.25 are taken after one scale and one offset per frame (least squares on all valid
    pixels); the point distances after the trajectory's Sim(3) alone. Raises EvaluationError when estimated
    and true images differ in size.
    """
    wanted = {camera: _frames_with_truth(groundtruth, match) for camera, match in matches.items()}
    count = sum(len(frames) for frames in wanted.values())
    budget = max(1000, MAX_DISTANCES // max(1, count))
    accumulators = {camera: _Accumulator() for camera in matches}
    for camera, match in matches.items():
        for image_number, row in wanted[camera]:
            _add_frame(
                accumulators[camera], reconstruction, groundtruth, match, image_number, row, gSe, budget
            )
    per_camera = {camera: accumulator.scores() for camera, accumulator in accumulators.items()}
    return _merged(accumulators.values()).scores(), per_camera


def median_true_depth(groundtruth: GroundTruth) -> float | None:
    """Median in metres over all true depth images; None without any."""
    wanted = [(camera, time) for camera in groundtruth.cameras for time in groundtruth.depth_frames(camera)]
    budget = max(1000, MAX_DISTANCES // max(1, len(wanted)))
    values = []
    for camera, time in wanted:
        depth = groundtruth.depth(camera, time)
        depth = depth[np.isfinite(depth)]
        values.append(depth[:: max(1, -(-len(depth) // budget))])
    return _median(values)


def frame_depth_error(
    reconstruction: ReconstructionLike, groundtruth: GroundTruth, camera: str, time: int
) -> npt.NDArray[np.float32]:
    """Relative error ``(H, W) float32`` of one frame after its own scale and offset; NaN: not measured."""
    truth = groundtruth.depth(camera, time)
    estimated = _estimated_depth(reconstruction, camera, time, truth.shape)
    error = np.full(truth.shape, np.nan, dtype=np.float32)
    if estimated is None:
        return error
    valid = np.isfinite(truth) & np.isfinite(estimated)
    if valid.sum() >= MIN_PIXELS:
        scale, offset = fit_scale_and_offset(
            estimated[valid].astype(np.float64), truth[valid].astype(np.float64)
        )
        error[valid] = np.abs(scale * estimated[valid] + offset - truth[valid]) / truth[valid]
    return error


def _frames_with_truth(groundtruth: GroundTruth, match: CameraMatch) -> list[tuple[int, int]]:
    """(number of the depth image, row of the match or -1 without a true pose) of one camera."""
    row_of = {int(frame): row for row, frame in enumerate(match.frames) if frame >= 0}
    return [(number, row_of.get(number, -1)) for number in groundtruth.depth_frames(match.camera)]


def _estimated_depth(
    reconstruction: ReconstructionLike, camera: str, time: int, shape: tuple[int, ...]
) -> FloatImage | None:
    if camera not in reconstruction.cameras or not reconstruction.has_depth(camera, time):
        return None
    depth = reconstruction.depth(camera, time)
    if depth.shape != shape:
        raise EvaluationError(
            f"{camera} frame {time}: estimated depth is {depth.shape[::-1]}, true depth {shape[::-1]} pixels;"
            " both must have the input resolution"
        )
    return depth


def _add_frame(
    total: _Accumulator,
    reconstruction: ReconstructionLike,
    groundtruth: GroundTruth,
    match: CameraMatch,
    time: int,
    row: int,
    gSe: Similarity,
    budget: int,
) -> None:
    truth = groundtruth.depth(match.camera, time)
    has_truth = np.isfinite(truth)
    total.frames += 1
    total.true_pixels += int(has_truth.sum())
    if time >= match.estimated_frame_count:
        total.frames_without_estimate += 1
        return
    estimated = _estimated_depth(reconstruction, match.camera, time, truth.shape)
    valid = has_truth & np.isfinite(estimated) if estimated is not None else np.zeros_like(has_truth)
    if estimated is None or valid.sum() < MIN_PIXELS:
        total.frames_without_estimate += 1
        return
    total.estimated_pixels += int(valid.sum())
    g, e = truth[valid].astype(np.float64), estimated[valid].astype(np.float64)
    moves = _moving_pixels(groundtruth, match.camera, time, valid)
    _add_relative_errors(total, g, e, moves)
    if row >= 0 and match.has_estimate[row]:
        own = reconstruction.intrinsics(match.camera)
        # an error of the focal length is one of the points
        true = groundtruth.intrinsics.get(match.camera, own)
        step = max(1, -(-len(g) // budget))
        pixels = np.argwhere(valid)[::step, ::-1].astype(np.float64)
        world, camera = _point_distances(
            backproject(pixels, g[::step], true),
            backproject(pixels, e[::step], own),
            match.truth[row],
            match.estimated[row],
            gSe,
        )
        total.world_distances.append(world)
        total.camera_distances.append(camera)
        if moves is not None:
            total.moving_distances.append(world[moves[::step]])
            total.static_distances.append(world[~moves[::step]])


def _moving_pixels(
    groundtruth: GroundTruth, camera: str, time: int, valid: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_] | None:
    """``(N,)`` of the N valid pixels, those that move; None without a mask of that frame."""
    moving = groundtruth.moving(camera, time)
    if moving is None:
        return None
    if moving.shape != valid.shape:
        raise EvaluationError(
            f"{camera} frame {time}: motion mask is {moving.shape[::-1]}, depth {valid.shape[::-1]} pixels"
        )
    return moving[valid]


def _add_relative_errors(
    total: _Accumulator, g: Array, e: Array, moves: npt.NDArray[np.bool_] | None
) -> None:
    scale, offset = fit_scale_and_offset(e, g)
    aligned = scale * e + offset
    relative = np.abs(aligned - g) / g
    with np.errstate(divide="ignore"):
        # A depth at or behind the camera is no depth: it fails the ratio test.
        within = (aligned > 0) & (np.maximum(aligned / g, g / np.where(aligned > 0, aligned, np.nan)) < 1.25)
    total.all.add(relative, within)
    if moves is None:
        return
    total.moving.add(relative[moves], within[moves])
    total.static.add(relative[~moves], within[~moves])


def _point_distances(
    true_points: Array, estimated_points: Array, gTc: Array, eTc: Array, gSe: Similarity
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Distances ``(N,)`` in the world after the Sim(3), and in the camera's frame after the scale alone, of
    points ``(N, 3)`` of the cameras."""
    world = transform_points(gTc, true_points) - gSe.transform_points(transform_points(eTc, estimated_points))
    camera = true_points - gSe.scale * estimated_points
    return (
        np.linalg.norm(world, axis=1).astype(np.float32),
        np.linalg.norm(camera, axis=1).astype(np.float32),
    )


def _merged(parts: Iterable[_Accumulator]) -> _Accumulator:
    total = _Accumulator()
    for part in parts:
        for name in ("all", "static", "moving"):
            sums: _PixelSums = getattr(total, name)
            other: _PixelSums = getattr(part, name)
            sums.pixels += other.pixels
            sums.relative += other.relative
            sums.within += other.within
        total.world_distances += part.world_distances
        total.camera_distances += part.camera_distances
        total.static_distances += part.static_distances
        total.moving_distances += part.moving_distances
        total.frames += part.frames
        total.frames_without_estimate += part.frames_without_estimate
        total.true_pixels += part.true_pixels
        total.estimated_pixels += part.estimated_pixels
    return total


def _median(parts: list[npt.NDArray[np.float32]]) -> float | None:
    values = np.concatenate(parts) if parts else np.zeros(0, dtype=np.float32)
    return float(np.median(values)) if len(values) else None
