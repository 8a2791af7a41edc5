"""A camera that stands still or only turns, as one image: all its frames share one centre.

Without parallax its video holds no depth, but it holds more than one frame: the median over time is free of
noise and of whatever moves, and frames of a turning camera join into one wider pinhole image.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera, Capture
from mvdyn_gtsam.frontend.start.features import Features, extract_features, match_features
from mvdyn_gtsam.frontend.start.model import StartFrame
from mvdyn_gtsam.geometry import invert_pose, pixel_rays, project, rotation_angle_deg

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

TURN_PX = 2.0
"""Error up to which a match agrees with a turn about the centre; SIFT, plus a hand's tremor on a tripod."""
LEAST_SHARE = 0.5
"""Share of the matches of two frames that a turn must explain, else the camera has moved. Source: choice."""
LEAST_MATCHES = 20
STILL_PX = 1.5
"""Shift of the image up to which a camera counts as standing still."""
WIDEST = 3.0
"""Largest joined image, in widths and heights of the camera's: a pinhole stretches beyond 60 degrees."""


@dataclass(frozen=True)
class StillView:
    """All frames of a camera without parallax as one image of a virtual pinhole camera r."""

    camera: int
    pinhole: Camera
    """The virtual camera; the real one itself where it stands still."""
    image: npt.NDArray[np.uint8]
    """``(H, W) uint8`` median over time, as the virtual camera sees it."""
    seen: npt.NDArray[np.bool_]
    """``(H, W)`` where any frame looked."""
    features: Features
    """Keypoints of the median image."""
    times: npt.NDArray[np.int64]
    """``(K,)`` instants, first and last of the video among them."""
    rRc: Array
    """``(K, 3, 3)`` rotation of the real camera at each instant, in r."""

    @property
    def turns(self) -> bool:
        return bool((rotation_angle_deg(self.rRc) > 1e-6).any())


def build_still_view(
    capture: Capture,
    camera: int,
    times: npt.NDArray[np.int64],
    *,
    features: int,
    contrast: float,
) -> StillView | None:
    """The view of a camera that stands still or turns; None where its frames do not share one centre."""
    own = capture.cameras[camera]
    per_frame = [extract_features(capture.read(camera, int(t)), features, contrast) for t in times]
    rRc = estimate_rotations(per_frame, own.intrinsics)
    if rRc is None:
        return None
    pinhole = virtual_pinhole(own, rRc)
    frames = np.zeros((len(times), pinhole.height, pinhole.width), np.uint8)
    covered = np.zeros(frames.shape, bool)
    ones = np.full((own.height, own.width), 255, np.uint8)
    for row, time in enumerate(times):
        grey = cv2.cvtColor(capture.read(camera, int(time)), cv2.COLOR_RGB2GRAY)
        homography = pinhole.intrinsics @ rRc[row] @ np.linalg.inv(own.intrinsics)
        size = (pinhole.width, pinhole.height)
        frames[row] = cv2.warpPerspective(grey, homography, size)
        covered[row] = cv2.warpPerspective(ones, homography, size, flags=cv2.INTER_NEAREST) > 0
    image, seen = _median(frames, covered)
    found = extract_features(np.repeat(image[..., None], 3, 2), features, contrast)
    # The rim of what was seen is an edge of the canvas, not of the world.
    inner = cv2.erode(seen.astype(np.uint8), np.ones((17, 17), np.uint8), borderValue=1) > 0
    column, row_of = np.rint(found.pixels).astype(int).T
    keep = inner[row_of, column] if len(found.pixels) else np.zeros(0, bool)
    return StillView(
        camera=camera,
        pinhole=pinhole,
        image=image,
        seen=seen,
        features=Features(found.pixels[keep], found.descriptors[keep]),
        times=times,
        rRc=rRc,
    )


def estimate_rotations(features: Sequence[Features], intrinsics: Array) -> Array | None:
    """Rotation ``rRc (K, 3, 3)`` of every frame against the middle one; None where frames do more than turn.

    Frames are compared with the middle one where they overlap enough, else with their neighbour. All are
    exactly the identity where the image never shifts by more than ``STILL_PX``.
    """
    middle = len(features) // 2
    rRc = np.tile(np.eye(3), (len(features), 1, 1))
    for index in [*range(middle - 1, -1, -1), *range(middle + 1, len(features))]:
        inward = index + 1 if index < middle else index - 1
        for other in dict.fromkeys((middle, inward)):
            oRc = relative_rotation(features[other], features[index], intrinsics)
            if oRc is not None:
                rRc[index] = rRc[other] @ oRc
                break
        else:
            return None
    shift_px = np.radians(rotation_angle_deg(rRc)) * intrinsics[0, 0]
    return rRc if (shift_px > STILL_PX).any() else np.tile(np.eye(3), (len(features), 1, 1))


def relative_rotation(first: Features, second: Features, intrinsics: Array) -> Array | None:
    """Rotation ``aRb`` between two frames of one centre by RANSAC over two-point samples (Kabsch 1976)."""
    pairs = match_features(first, second, 0.8)
    if len(pairs) < LEAST_MATCHES:
        return None
    a, b = (_unit_rays(f.pixels[rows], intrinsics) for f, rows in zip((first, second), pairs.T, strict=True))
    sample = np.random.default_rng(0).integers(0, len(pairs), (300, 2))
    limit = np.cos(TURN_PX / intrinsics[0, 0])
    candidates = _kabsch(a[sample], b[sample])
    agree = np.einsum("hij,nj,ni->hn", candidates, b, a) > limit
    inliers = agree[agree.sum(1).argmax()]
    for _ in range(3):
        if inliers.sum() < max(LEAST_MATCHES, LEAST_SHARE * len(pairs)):
            return None
        aRb = _kabsch(a[None, inliers], b[None, inliers])[0]
        inliers = ((b @ aRb.T) * a).sum(1) > limit
    return aRb


def virtual_pinhole(camera: Camera, rRc: Array) -> Camera:
    """The camera r whose image holds those of all rotations, up to ``WIDEST``; shifted by whole pixels."""
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [camera.width - 1, camera.height - 1]
    rays = np.concatenate([pixel_rays(corners.astype(float), camera.intrinsics) @ R.T for R in rRc])
    pixels, _ = project(rays, camera.intrinsics)
    size = np.array([camera.width, camera.height])
    margin = np.floor((WIDEST - 1.0) / 2.0 * size)
    behind = ~np.isfinite(pixels)
    low = np.where(behind, np.sign(rays[:, :2]) * np.inf, pixels).min(0)
    high = np.where(behind, np.sign(rays[:, :2]) * np.inf, pixels).max(0)
    low = np.floor(np.clip(low + 1e-6, -margin, 0)).astype(int)
    high = np.ceil(np.clip(high - 1e-6, size - 1, size - 1 + margin)).astype(int)
    width, height = (high - low + 1).tolist()
    return Camera(
        camera.name, width, height, camera.fx, camera.fy, camera.cx - int(low[0]), camera.cy - int(low[1])
    )


def frames_of_view(view: StillView, camera: Camera, placed: StartFrame) -> tuple[StartFrame, ...]:
    """The start's frames of the real camera from the one placed frame of its view (``wTc`` is wTr there).

    A camera that stands still gets its first and last frame, one that turns every instant of the view.
    """
    points = pixel_rays(placed.pixels, view.pinhole.intrinsics) * placed.depth[:, None]
    frames = []
    chosen = range(len(view.times)) if view.turns else np.unique([0, len(view.times) - 1])
    for row in chosen:
        rTc = np.eye(4)
        rTc[:3, :3] = view.rRc[row]
        pixels, depth = project(points @ invert_pose(rTc)[:3, :3].T, camera.intrinsics)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(1)
        frames.append(StartFrame(int(view.times[row]), placed.wTc @ rTc, pixels[inside], depth[inside]))
    return tuple(frames)


def lone_frames(camera: Camera, frame_count: int, view: StillView | None) -> tuple[StartFrame, ...]:
    """Frames at the origin of a camera whose depth nobody knows: 1 on a coarse grid, to be tracked by."""
    x, y = np.meshgrid((np.arange(8) + 0.5) / 8 * camera.width, (np.arange(6) + 0.5) / 6 * camera.height)
    pixels = np.column_stack([x.ravel(), y.ravel()]) - 0.5
    times = np.unique([0, frame_count - 1])
    wRc = np.tile(np.eye(3), (len(times), 1, 1))
    if view is not None and view.turns:
        times, wRc = view.times, view.rRc[0].T @ view.rRc
    wTc = np.tile(np.eye(4), (len(times), 1, 1))
    wTc[:, :3, :3] = wRc
    return tuple(
        StartFrame(int(time), pose, pixels, np.ones(len(pixels)))
        for time, pose in zip(times, wTc, strict=True)
    )


def _median(
    frames: npt.NDArray[np.uint8], covered: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
    """Median over the frames that look at a pixel, row by row to bound memory; and where any does."""
    image = np.zeros(frames.shape[1:], np.uint8)
    for row in range(len(image)):
        values = np.sort(np.where(covered[:, row], frames[:, row].astype(np.int16), 256), axis=0)
        count = covered[:, row].sum(0)
        low = np.take_along_axis(values, np.maximum((count - 1) // 2, 0)[None], 0)[0]
        high = np.take_along_axis(values, np.maximum(count // 2, 0)[None].clip(max=len(values) - 1), 0)[0]
        image[row] = np.where(count > 0, (low + np.where(high > 255, low, high)) // 2, 0)
    return image, np.asarray(covered.any(0))


def _unit_rays(pixels: Array, intrinsics: Array) -> Array:
    rays = pixel_rays(pixels, intrinsics)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _kabsch(a: Array, b: Array) -> Array:
    """Rotations ``aRb (H, 3, 3)`` of H sets of unit rays ``(H, N, 3)``."""
    left, _, right = np.linalg.svd(np.swapaxes(a, 1, 2) @ b)
    flip = np.ones((len(a), 3))
    flip[:, 2] = np.sign(np.linalg.det(left @ right))
    return np.asarray((left * flip[:, None]) @ right)
