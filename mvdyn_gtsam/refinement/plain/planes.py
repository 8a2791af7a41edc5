"""Depth of plain regions: the plane that their rims share over many frames.

On a wall or ceiling without texture no flow says anything, but its rim is seen: where it meets other
surfaces and where its texture begins. Planes are fitted to each rim, any and those that stand upright. One
frame's rim leaves several open (a ceiling that meets one wall may be that wall, too), so a region takes the
plane on which the rims of all frames around agree best, as far as it fits its own rim. Piecewise planar
stereo (https://doi.org/10.1109/ICCV.2009.5459417) lets plain regions take planes found elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import pdist, squareform

from mvdyn_gtsam.frontend.dense_flow import Float32
from mvdyn_gtsam.refinement.plain.axes import bases, basis_of
from mvdyn_gtsam.refinement.settings import PlainConfig

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

HYPOTHESES = 150
"""Planes through three points of a rim that are tried."""
PLANES_PER_RIM = 3
"""Planes kept of one rim at most. Where hardly any of it fits another they are the same again: that plane
has all that the rim has to say."""
RIM_POINTS = 300
"""Points of a rim looked at, drawn at random beyond."""
SURFACE_POINTS = 1000
"""Of a frame that its surfaces are found among. Source: choice."""
LEAST_POINTS = 20
"""Of a rim that is believed."""
LEAST_TRUST = 0.05
"""Trust from which a pixel counts as seen."""
WELL_SEEN = 0.5
"""Mean trust from which a region needs no plane."""
JUDGED_PIXELS = 60
"""Pixels of a region at which planes are compared."""
JUDGED_PLANES = 500
"""Planes compared for a region, drawn at random beyond: with all, 40 frames of panoptic_basketball_6cam took
4 s each, where thousands fit, with 1000 0.2 s. On hololens_office_2seg 322 fit at most."""
MAJORITY = 0.5
"""Of the planes that fit a region's rim, those that must agree on its depth."""
HALF_KNOWN_SIGMA = 0.1
"""Standard deviation of a plane's log depth at which a pixel takes half of it."""


@dataclass(frozen=True)
class PlainRegion:
    """A plain region and what is seen of its rim."""

    pixels: npt.NDArray[np.int64]
    """``(M,)`` flat indices of the region, grown to the image's edge around it."""
    rays: Array
    """``(M, 3)``"""
    rim_rays: Array
    """``(R, 3)``"""
    rim_inverse_depth: Array
    """``(R,)``"""
    rim_trust: Array
    """``(R,)``"""


@dataclass(frozen=True)
class RimPlanes:
    """The planes ``q`` that a region's rim fits: ``q . ray`` is the inverse depth along a ray with z = 1."""

    planes: Array
    """``(K, 3)``"""
    shares: Array
    """``(K,)`` of the rim's trust that each explains."""
    size: int
    """Pixels of the region."""


def plain_regions(
    colour: Float32,
    theta: Float32,
    trust: Float32,
    excluded: Mask,
    rays: Float32,
    config: PlainConfig,
    seed: Sequence[int],
) -> list[PlainRegion]:
    """Regions of the image ``colour (h, w, 3)`` without contrast whose depth is little trusted.

    ``theta (h, w)`` is log inverse depth, ``trust (h, w)`` how far it is believed, in [0, 1]; pixels of
    ``excluded (h, w)`` belong to no region; ``rays (h w, 3)`` has z = 1; ``seed`` makes the draw of points
    repeatable.
    """
    random = np.random.default_rng(seed)
    found = []
    for region in _without_contrast(colour, excluded, config):
        if trust[region > 0].mean() > WELL_SEEN:
            continue
        rim = cv2.dilate(region, np.ones((2 * config.rim + 1,) * 2, np.uint8)) > 0
        points = np.flatnonzero(rim.ravel() & (trust.ravel() > LEAST_TRUST))
        if len(points) < LEAST_POINTS:
            continue
        if len(points) > RIM_POINTS:
            points = random.choice(points, RIM_POINTS, replace=False)
        rim_rays, weight = rays[points].astype(np.float64), trust.ravel()[points].astype(np.float64)
        inverse_depth = np.exp(theta.ravel()[points]).astype(np.float64)
        pixels = np.flatnonzero(cv2.dilate(region, np.ones((5, 5), np.uint8)).ravel())
        found.append(PlainRegion(pixels, rays[pixels].astype(np.float64), rim_rays, inverse_depth, weight))
    return found


def rim_planes(region: PlainRegion, axes: Array, config: PlainConfig, seed: Sequence[int]) -> RimPlanes:
    """Planes that the rim of a region fits: any, those upright on ``axes (K, 3)``, and those with one of
    these for a normal."""
    random = np.random.default_rng(seed)
    rim = (region.rim_rays, region.rim_inverse_depth, region.rim_trust)
    fitted = [_planes_of(*rim, config, random, basis) for basis in bases(axes)]
    planes, shares = (np.concatenate(each) for each in zip(*fitted, strict=True))
    return RimPlanes(planes, shares, len(region.pixels))


def surfaces(
    theta: Float32, trust: Float32, rays: Float32, config: PlainConfig, seed: Sequence[int]
) -> Array:
    """``(N, 4)``: planes ``q`` of the largest surfaces that are well seen, and their share of all that is;
    arguments as of ``plain_regions``."""
    seen = np.flatnonzero(trust.ravel() > WELL_SEEN)
    if len(seen) < LEAST_POINTS:
        return np.zeros((0, 4))
    random = np.random.default_rng(seed)
    points = random.choice(seen, min(len(seen), SURFACE_POINTS), replace=False)
    inverse_depth = np.exp(theta.ravel()[points]).astype(np.float64)
    found = _planes_of(
        rays[points].astype(np.float64), inverse_depth, np.ones(len(points)), config, random, np.eye(3)
    )
    return np.column_stack(found)


def planes_in_world(rims: Sequence[RimPlanes], wTc: Array) -> Array:
    """``(N, 5)``: unit normal and offset, ``n . p = d``, of every rim's planes, and its say."""
    rows = []
    for rim in rims:
        for plane, share in zip(rim.planes, rim.shares, strict=True):
            normal = wTc[:3, :3] @ plane
            length = np.linalg.norm(normal)
            offset = (1.0 + normal @ wTc[:3, 3]) / length
            rows.append([*(normal / length), offset, share * np.sqrt(rim.size)])
    return np.array(rows).reshape(-1, 5)


def planes_in_camera(world: Array, wTc: Array) -> Array:
    """``(N, 3)`` planes ``q`` of a camera, from normals and offsets ``(N, 4)``; NaN for one through its
    centre."""
    normal = world[:, :3] @ wTc[:3, :3]
    distance = world[:, 3] - world[:, :3] @ wTc[:3, 3]
    return normal / np.where(np.abs(distance) > 1e-9, distance, np.nan)[:, None]


def fill_plain(
    theta: Float32,
    trust: Float32,
    regions: Sequence[PlainRegion],
    bank: Array,
    wTc: Array,
    axes: Array,
    config: PlainConfig,
) -> Float32:
    """``theta (h, w)`` with agreed planes, as far as ``trust (h, w)`` leaves room and a plane is known.

    ``bank (N, 7)`` are the planes of all frames around, this one's among them: camera, time, and
    ``planes_in_world``. A region on which they do not agree keeps its depth.
    """
    planes, weight = planes_in_camera(bank[:, 2:6], wTc), bank[:, 6]
    frames = np.unique(bank[:, :2], axis=0, return_inverse=True)[1]
    result = theta.copy()
    for region in regions:
        agreed = agreed_plane(region, planes, weight, frames, config)
        if agreed is None:
            continue
        low, high = _range(region, config)
        filled = np.log(np.clip(region.rays @ agreed.plane, low, high)).astype(np.float32)
        basis = basis_of(agreed.plane, axes)
        known = 1.0 / (1.0 + (_uncertainty(region, agreed, basis, config) / HALF_KNOWN_SIGMA) ** 2)
        share = ((1.0 - trust.ravel()[region.pixels]) * known).astype(np.float32)
        result.ravel()[region.pixels] += share * (filled - theta.ravel()[region.pixels])
    return result


@dataclass(frozen=True)
class AgreedPlane:
    """A plane ``q`` and the frames that found it."""

    plane: Array
    """``(3,)``"""
    frames: int


def agreed_plane(
    region: PlainRegion, planes: Array, weight: Array, frames: npt.NDArray[np.int64], config: PlainConfig
) -> AgreedPlane | None:
    """Of ``planes (N, 3)`` that fit the region's rim the one that most others resemble, the mean of these.

    ``frames (N,)`` says which come from one frame. None where too few frames, or less than half of the planes
    that fit, agree.
    """
    shares = _share(planes, region.rim_rays, region.rim_inverse_depth, region.rim_trust, config)
    sample = region.rays[:: max(1, len(region.rays) // JUDGED_PIXELS)]
    inverse_depth = planes @ sample.T
    low, high = _range(region, config)
    inside = ((inverse_depth > low) & (inverse_depth < high)).mean(axis=1) > 0.8
    fits = np.flatnonzero((shares > config.rim_share) & inside)
    if len(fits) == 0:
        return None
    if len(fits) > JUDGED_PLANES:
        fits = np.sort(np.random.default_rng(0).choice(fits, JUDGED_PLANES, replace=False))
    log_depth = np.log(np.clip(inverse_depth[fits], low, high))
    alike = squareform(pdist(log_depth, "cityblock")) < config.agreement * len(sample)
    votes = alike @ (weight * shares)[fits] * shares[fits]
    best = votes.argmax()
    witnesses = len(np.unique(frames[fits[alike[best]]]))
    # short videos have fewer frames to ask
    wanted = min(config.witnesses, -(-(int(frames.max()) + 1) // 2))
    if witnesses < wanted or alike[best].mean() < MAJORITY:
        return None
    members = fits[alike[best]]
    agreed = np.average(planes[members], axis=0, weights=(weight * shares)[members])
    return AgreedPlane(agreed, witnesses)


def _uncertainty(region: PlainRegion, agreed: AgreedPlane, basis: Array, config: PlainConfig) -> Array:
    """Standard deviation ``(M,)`` of the log depth of a region's pixels.

    From how the fitting points of its rim lie: far from them, or across a line on which they are, little is
    known. The error of one frame's rim is common to its points; frames are independent. The plane is made of
    the columns of ``basis (3, d)``.
    """
    error = np.abs(region.rim_rays @ agreed.plane / region.rim_inverse_depth - 1.0)
    fitting = error < 1.5 * config.tolerance
    slope = region.rim_rays[fitting] @ basis / region.rim_inverse_depth[fitting, None]
    weight = region.rim_trust[fitting] / region.rim_trust[fitting].sum()
    information = (slope * weight[:, None]).T @ slope * agreed.frames / config.tolerance**2
    at_pixels = region.rays @ basis
    at_pixels /= np.maximum(region.rays @ agreed.plane, _range(region, config)[0])[:, None]
    covariance = np.linalg.pinv(information, hermitian=True)
    return np.sqrt(np.einsum("ni,ij,nj->n", at_pixels, covariance, at_pixels))


def _without_contrast(colour: Float32, excluded: Mask, config: PlainConfig) -> list[npt.NDArray[np.uint8]]:
    """``(h, w)`` each, 1 in one connected region without contrast: walls as bright as each other are told
    apart by their hue."""
    squares = [cv2.Sobel(colour, cv2.CV_32F, dx, 1 - dx, scale=0.125) ** 2 for dx in (1, 0)]
    slope = np.sqrt((squares[0] + squares[1]).sum(axis=2))
    plain = cv2.erode((slope < config.contrast).astype(np.uint8), np.ones((3, 3), np.uint8))
    plain[excluded] = 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(plain, connectivity=4)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= config.smallest * plain.size]
    kernel = np.ones((5, 5), np.uint8)
    return [
        np.asarray(cv2.morphologyEx((labels == k).astype(np.uint8), cv2.MORPH_CLOSE, kernel)) for k in large
    ]


def _planes_of(
    rays: Array,
    inverse_depth: Array,
    trust: Array,
    config: PlainConfig,
    random: np.random.Generator,
    basis: Array,
) -> tuple[Array, Array]:
    """The planes ``(K, 3)`` that points fit, by RANSAC, and the share ``(K,)`` of each.

    Only those made of the columns of ``basis (3, d)``, which as many points decide.
    """
    seen = rays @ basis
    drawn = random.choice(len(rays), (HYPOTHESES, basis.shape[1]), p=trust / trust.sum())
    drawn = drawn[np.abs(np.linalg.det(seen[drawn])) > 1e-4]
    planes: list[Array] = []
    if len(drawn) > 0:
        hypotheses = np.linalg.solve(seen[drawn], inverse_depth[drawn][..., None])[..., 0] @ basis.T
        error = np.abs(hypotheses @ rays.T / inverse_depth - 1.0)
        score = np.maximum(1.0 - (error / config.tolerance) ** 2, 0.0)
        left = trust.copy()
        for _ in range(PLANES_PER_RIM):
            best = (score @ left).argmax()
            plane = _fitted(hypotheses[best], rays, inverse_depth, trust, config, basis)
            if plane is None:
                break
            fitting = np.abs(rays @ plane / inverse_depth - 1.0) < config.tolerance
            left[fitting] = 0.0
            if _spread(seen[fitting]) >= config.spread:
                planes.append(plane)
    found = np.array(planes).reshape(-1, 3)
    shares = _share(found, rays, inverse_depth, trust, config)
    kept = shares > 0.25
    return found[kept], shares[kept]


def _fitted(
    plane: Array, rays: Array, inverse_depth: Array, trust: Array, config: PlainConfig, basis: Array
) -> Array | None:
    """``plane`` after weighted least squares on the points that it fits; None with too few."""
    for _ in range(3):
        fitting = np.abs(rays @ plane / inverse_depth - 1.0) < config.tolerance
        if np.count_nonzero(fitting) < LEAST_POINTS // 2:
            return None
        root = np.sqrt(trust[fitting]) / inverse_depth[fitting]
        scaled = rays[fitting] @ basis * root[:, None]
        plane = basis @ np.linalg.lstsq(scaled, inverse_depth[fitting] * root, rcond=None)[0]
    return plane


def _share(planes: Array, rays: Array, inverse_depth: Array, trust: Array, config: PlainConfig) -> Array:
    """``(N,)`` of the points' trust that each of ``planes (N, 3)`` explains."""
    # in single precision, which decides the same but at the very tolerance
    seen, share = (rays / inverse_depth[:, None]).astype(np.float32), (trust / trust.sum()).astype(np.float32)
    error = planes.astype(np.float32) @ seen.T
    error -= np.float32(1.0)
    np.abs(error, out=error)
    return np.asarray((error < 1.5 * config.tolerance).astype(np.float32) @ share, np.float64)


def _spread(seen: Array) -> float:
    """How far points, seen along ``(M, d)``, are from leaving a plane of ``d`` numbers undecided, in focal
    lengths: of any plane how far from one line of the image."""
    if seen.shape[1] == 3:
        seen = seen[:, :2] - seen[:, :2].mean(axis=0)
    return float(np.sqrt(max(np.linalg.eigvalsh(seen.T @ seen / max(1, len(seen)))[0], 0.0)))


def _range(region: PlainRegion, config: PlainConfig) -> tuple[float, float]:
    """Inverse depths that are believed in a region: not far from those of its rim."""
    return config.reach * region.rim_inverse_depth.min(), region.rim_inverse_depth.max() / config.reach
