"""Whether two cameras' maps can stand where a hypothesis puts them: dense warping over many instants.

Dense depth of a few frames of each camera is carried into the other camera's frames. Where a hypothesis is
true, surfaces meet at the same depth and look the same. Where it is false, one camera's surfaces float in
space the other one looks straight through, or surfaces meet that look different; a repeated texture cannot
hide that, because everything around it disagrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.dense_map import DepthView
from mvdyn_gtsam.geometry import Similarity, invert_pose, pixel_rays, project, transform_points

Array = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class VerificationConfig:
    """When a placement is believed."""

    agree: float = 0.07
    """Relative depth difference up to which two surfaces are one. Source: experiments/wide_baseline.py."""
    conflict: float = 0.15
    """How much nearer a surface must be to float in seen-through space. Source: as above."""
    texture: float = 3.0
    """Grey-level deviation in a patch below which looks prove nothing. Source: image noise, 2 levels."""
    same_look: float = 0.6
    """Normalised cross-correlation from which two patches look the same. Source: as above."""
    other_look: float = 0.1
    """And below which they look different. Source: as above."""
    other_look_careful: float = 0.3
    """The same where looks are compared at several depths, of which the likest counts. Source:
    experiments/placement_trust.py, 0.1 to 0.3 compared."""
    looks: int = 10
    """Depths nearer and farther by up to ``agree`` at which they are compared again, in care: far aside, a
    hundredth of the depth is several pixels. Source: as above, 4 to 14 compared."""

    def __post_init__(self) -> None:
        if not 0.0 < self.agree <= self.conflict:
            raise ConfigError("frontend.verification: agree must be above 0 and at most conflict")
        if max(self.other_look, self.other_look_careful) > self.same_look:
            raise ConfigError(
                "frontend.verification: other_look and other_look_careful must be at most same_look"
            )
        if self.looks < 0 or self.looks % 2:
            raise ConfigError(f"frontend.verification.looks is {self.looks}; it must be even, 0 or more")


@dataclass(frozen=True)
class Verdict:
    """What dense warping says of a placement; areas in shares of one image, summed over frame pairs."""

    agreement: float
    """Textured area that meets the other camera's surface at its depth and looks the same."""
    contradiction: float
    """Area that floats in front of what the other camera sees, or meets it and looks different."""
    frame_pairs: int
    """Pairs of frames with any overlap."""
    comparable: float = 0.0
    """Textured area that should meet the other camera's surface: all but what that one hides."""

    @property
    def share(self) -> float:
        """Share of what could agree that does."""
        return self.agreement / max(self.comparable, 1e-12)

    @property
    def trust(self) -> float:
        """Share of the testimony that is in favour."""
        return self.agreement / max(self.agreement + self.contradiction, 1e-12)


def verify_placement(
    views_a: Sequence[DepthView],
    views_b: Sequence[DepthView],
    aSb: Similarity,
    config: VerificationConfig,
    careful: bool = False,
) -> Verdict:
    """Warp every view of either camera into every view of the other.

    ``careful``: what looks different must do so at every depth within the tolerance; takes several times as
    long.
    """
    agreement = contradiction = comparable = 0.0
    overlapping = 0
    bSa = aSb.inverse()
    for a in views_a:
        for b in views_b:
            forward = _testimony(a, b, bSa, config, careful)
            backward = _testimony(b, a, aSb, config, careful)
            overlapping += forward.overlaps or backward.overlaps
            agreement += forward.agreement + backward.agreement
            contradiction += forward.contradiction + backward.contradiction
            comparable += forward.comparable + backward.comparable
    return Verdict(agreement, contradiction, overlapping, comparable)


@dataclass(frozen=True)
class _Testimony:
    """Shares of the source image, and whether the views overlap at all."""

    agreement: float = 0.0
    contradiction: float = 0.0
    comparable: float = 0.0
    overlaps: bool = False


def _testimony(
    source: DepthView,
    target: DepthView,
    targetSsource: Similarity,
    config: VerificationConfig,
    careful: bool,
) -> _Testimony:
    known = np.isfinite(source.depth)
    warp = _warp(source, target, targetSsource, known)
    z, x, y = _seen_at(warp, target.intrinsics, 1.0)
    inside = known & _within(x, y, target)
    if not inside.any():
        return _Testimony()
    surface = _depth_at(target, x, y, inside)
    offset = np.log(np.where(inside, z, 1.0)) - np.log(surface)
    with np.errstate(invalid="ignore"):
        meets = np.abs(offset) < config.agree
        floats = offset < -config.conflict
        not_hidden = offset < config.conflict
    look, textured = _look(source, target, x, y, inside, config)
    same = meets & textured & (look > config.same_look)
    least = config.other_look_careful if careful else config.other_look
    different = meets & textured & (look < least)
    # A depth that is off by what passes for one surface moves the image; a fine pattern then looks different.
    for error in _errors_of_depth(config) if careful else ():
        if not different.any():
            break
        _, x, y = _seen_at(warp, target.intrinsics, float(np.exp(error)))
        again, _ = _look(source, target, x, y, known & _within(x, y, target), config)
        different &= ~(again >= least)
    total = len(source.depth)
    return _Testimony(
        float(same.sum() / total),
        float((different | floats).sum() / total),
        float((not_hidden & textured).sum() / total),
        True,
    )


def _errors_of_depth(config: VerificationConfig) -> list[float]:
    """Of log depth, ``looks`` of them over the tolerance, the smallest first."""
    steps = np.linspace(-config.agree, config.agree, config.looks + 1)
    return sorted((float(step) for step in np.delete(steps, config.looks // 2)), key=abs)


def _warp(
    source: DepthView, target: DepthView, targetSsource: Similarity, known: npt.NDArray[np.bool_]
) -> tuple[Array, Array]:
    """The source's points ``(N, 3)`` in the axes of the target, but from the source's centre, which is at
    ``(3,)``: their depth may then be scaled by what one likes."""
    cSm = Similarity(1.0, *_parts(invert_pose(target.mTc))).compose(targetSsource)
    cSs = cSm.compose(Similarity(1.0, *_parts(source.mTc)))
    rays = pixel_rays(source.grid.pixels, source.intrinsics)
    turned = rays @ (cSs.scale * cSs.rotation).T
    return turned * np.where(known, source.depth, 1.0)[:, None], cSs.translation


def _parts(pose: Array) -> tuple[Array, Array]:
    return pose[:3, :3], pose[:3, 3]


def _seen_at(warp: tuple[Array, Array], intrinsics: Array, factor: float) -> tuple[Array, Array, Array]:
    """Depth and pixel ``(N,)`` in the target of the source's points, their depth times ``factor``."""
    points, centre = warp
    z = factor * points[:, 2] + centre[2]
    z = np.where(z > 1e-6, z, np.nan)
    x = intrinsics[0, 0] * (factor * points[:, 0] + centre[0]) / z + intrinsics[0, 2]
    y = intrinsics[1, 1] * (factor * points[:, 1] + centre[1]) / z + intrinsics[1, 2]
    return z, x, y


def _within(x: Array, y: Array, view: DepthView) -> npt.NDArray[np.bool_]:
    height, width = view.image.shape
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1))


def _depth_at(view: DepthView, x: Array, y: Array, inside: npt.NDArray[np.bool_]) -> Array:
    """The view's own depth at the nearest grid point; NaN where unknown."""
    rows, cols = view.grid.shape
    origin = view.grid.pixels[0]
    column = np.where(inside, np.rint((x - origin[0]) / view.grid.stride), 0).astype(int)
    row = np.where(inside, np.rint((y - origin[1]) / view.grid.stride), 0).astype(int)
    nearest = np.clip(row, 0, rows - 1) * cols + np.clip(column, 0, cols - 1)
    return np.where(inside, view.depth[nearest], np.nan)


def _look(
    source: DepthView,
    target: DepthView,
    x: Array,
    y: Array,
    inside: npt.NDArray[np.bool_],
    config: VerificationConfig,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Normalised cross-correlation on the source grid (5 x 5 grid points) and where there is texture."""
    shape = source.grid.shape
    map_x = np.where(inside, x, -1).astype(np.float32).reshape(shape)
    map_y = np.where(inside, y, -1).astype(np.float32).reshape(shape)
    warped = cv2.remap(target.image, map_x, map_y, cv2.INTER_LINEAR)
    own = source.grid.sample(source.image).reshape(shape)
    mask = inside.reshape(shape).astype(np.float32)

    def mean(field: Float32) -> Float32:
        return cv2.boxFilter(field, -1, (5, 5), normalize=False)

    count = np.maximum(mean(mask), 1.0)
    own, warped = own * mask, warped * mask
    mean_own, mean_warped = mean(own) / count, mean(warped) / count
    variance_own = np.maximum(mean(own * own) / count - mean_own**2, 0.0)
    variance_warped = np.maximum(mean(warped * warped) / count - mean_warped**2, 0.0)
    covariance = mean(own * warped) / count - mean_own * mean_warped
    noise = 1.0
    look = covariance / np.sqrt((variance_own + noise) * (variance_warped + noise))
    enough = (count >= 13) & (variance_own > config.texture**2) & (mask > 0)
    return look.ravel().astype(np.float64), enough.ravel()


def verify_seen(
    views: Sequence[DepthView],
    wSm: Similarity,
    image: Float32,
    intrinsics: Array,
    targetTw: Array,
    config: VerificationConfig,
) -> Verdict:
    """Warp views of one map into an image ``(H, W)`` without depth (a camera that shows no parallax).

    Only looks can testify: that something floats cannot be seen, so ask for more trust. Points hidden behind
    nearer ones of the same view say nothing.
    """
    agreement = contradiction = 0.0
    overlapping = 0
    for view in views:
        known = np.isfinite(view.depth)
        rays = pixel_rays(view.grid.pixels, view.intrinsics)
        points = transform_points(view.mTc, rays * np.where(known, view.depth, 1.0)[:, None])
        pixels, depth = project(transform_points(targetTw, wSm.transform_points(points)), intrinsics)
        height, width = image.shape
        with np.errstate(invalid="ignore"):
            inside = known & ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(1)
        inside &= _nearest(pixels, depth, inside, 2 * view.grid.stride, 1.0 + config.agree)
        if not inside.any():
            continue
        target = DepthView(view.time, np.eye(4), intrinsics, view.grid, view.depth, image)
        look, textured = _look(view, target, pixels[:, 0], pixels[:, 1], inside, config)
        overlapping += 1
        agreement += float((inside & textured & (look > config.same_look)).mean())
        contradiction += float((inside & textured & (look < config.other_look)).mean())
    return Verdict(agreement, contradiction, overlapping)


def _nearest(
    pixels: Array, depth: Array, inside: npt.NDArray[np.bool_], cell_px: int, tolerance: float
) -> npt.NDArray[np.bool_]:
    """Which points are the foremost, to within a factor, of those that fall into their cell."""
    cells = np.where(inside[:, None], pixels, 0.0).astype(np.int64) // cell_px
    index = cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0]
    front = np.full(index.max() + 1, np.inf)
    np.minimum.at(front, index[inside], depth[inside])
    return np.asarray(depth <= tolerance * front[index])
