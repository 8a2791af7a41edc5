"""Where the cameras stand: beside each other on an arc, turned apart until they share what is asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.geometry import invert_pose, pixel_rays, project, transform_points
from mvdyn_gtsam.scenes.mesh import MISS, Instant, View, build_mesh
from mvdyn_gtsam.scenes.motion import Array, HandHeld
from mvdyn_gtsam.scenes.settings import SceneSettings
from mvdyn_gtsam.scenes.world import Body, body_poses, build_world

EYE_HEIGHT = 1.5
PITCH = -0.12
PROBES = 32
"""Rays across the image with which overlap is measured."""
INSTANTS = 3
_HANDS = 4
_STEPS = 9


def headings_of(settings: SceneSettings, angle: float) -> Array:
    """``(C,)`` rad, ``angle`` apart, the middle one along y."""
    places = np.arange(settings.cameras, dtype=np.float64) - (settings.cameras - 1) / 2
    return np.pi / 2 - angle * places


def make_cameras(settings: SceneSettings, angle: float) -> list[HandHeld]:
    """Hand-held cameras whose axes cross ``settings.meet`` metres ahead, neighbours ``angle`` (rad) apart."""
    cameras = []
    for index, heading in enumerate(headings_of(settings, angle)):
        rng = np.random.default_rng([settings.seed, _HANDS, index])
        position = (-settings.meet * np.cos(heading), -settings.meet * np.sin(heading), EYE_HEIGHT)
        frequency = rng.uniform(0.12, 0.25, 5)
        frequency[:3] = np.maximum(frequency[:3], settings.camera_motion / (2 * np.pi * 0.45))
        speed = settings.camera_motion * np.array([0.9, 0.9, 0.35])
        sway = min(settings.camera_motion / 0.4, 1.5) * np.array([0.09, 0.05])
        amplitude = np.concatenate([speed / (2 * np.pi * frequency[:3]), sway])
        drift = np.stack([amplitude, frequency, rng.uniform(0, 2 * np.pi, 5)], axis=1)
        strength = settings.shake * np.repeat([0.002, 0.002], 3)[:, None] * rng.uniform(0.3, 1.0, (6, 3))
        shake = np.stack([strength, rng.uniform(2.0, 5.0, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))], axis=2)
        cameras.append(HandHeld(position, float(heading), PITCH, drift, shake))
    return cameras


def solve_angle(settings: SceneSettings) -> tuple[float, list[Body]]:
    """Angle (rad) between neighbouring cameras at which they overlap as the settings ask, and the world.

    Overlap falls with the angle, so bisection finds it; at 0 it is what the cameras' own wandering leaves.
    People walk where the cameras look, and hide a part: so first without them, then with them in place.
    """
    if settings.cameras == 1:
        return 0.0, build_world(settings, headings_of(settings, 0.0).tolist())
    still = replace(settings, motion=0.0)
    angle = _bisect_angle(settings, build_world(still, [0.0]))
    world = build_world(settings, headings_of(settings, angle).tolist())
    return (_bisect_angle(settings, world) if settings.motion > 0.0 else angle), world


def _bisect_angle(settings: SceneSettings, world: Sequence[Body]) -> float:
    # Only the geometry counts, so nothing is painted.
    mesh = build_mesh(world, replace(settings, texture=0.0, focal=None, width=16, height=16))
    moments = [Instant(mesh, body_poses(world, seconds)) for seconds in probed_seconds(settings)]
    low, high = 0.0, min(1.4 * settings.field_of_view, math.pi)
    for _ in range(_STEPS):
        middle = (low + high) / 2
        overlap = np.mean(neighbour_overlaps(settings, make_cameras(settings, middle), moments))
        low, high = (middle, high) if overlap > settings.overlap else (low, middle)
    return low


def probed_seconds(settings: SceneSettings) -> Array:
    """``(INSTANTS,)`` s, over the length of the scene: when overlap is measured."""
    return np.linspace(0.0, (settings.frames - 1) / settings.fps, INSTANTS)


def neighbour_overlaps(
    settings: SceneSettings, cameras: Sequence[HandHeld], moments: Sequence[Instant]
) -> Array:
    """``(C - 1,)``: share of the pixels of camera i whose surface camera i + 1 sees at that instant, averaged
    with the reverse and over ``moments``, those of ``probed_seconds``. What is hidden is not seen."""
    overlaps = np.zeros((INSTANTS, len(cameras) - 1))
    for k, (seconds, moment) in enumerate(zip(probed_seconds(settings), moments, strict=True)):
        views = [View(moment, camera(seconds)) for camera in cameras]
        for i in range(len(cameras) - 1):
            there = _seen_share(settings, views[i], views[i + 1])
            back = _seen_share(settings, views[i + 1], views[i])
            overlaps[k, i] = (there + back) / 2
    return overlaps.mean(axis=0)


def _seen_share(settings: SceneSettings, view_i: View, view_j: View) -> float:
    x = np.linspace(0, settings.width - 1, PROBES)
    y = np.linspace(0, settings.height - 1, max(2, PROBES * settings.height // settings.width))
    rays = pixel_rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), settings.intrinsics)
    hits = view_i.cast(rays.astype(np.float32))
    points = view_i.exact_points(hits, rays)[hits.face != MISS]
    seen = visible(settings, view_j, transform_points(invert_pose(view_j.wTc) @ view_i.wTc, points))
    return float(seen.sum() / len(rays))


def visible(settings: SceneSettings, view: View, points: Array) -> npt.NDArray[np.bool_]:
    """``(N,)``: camera-frame points ``(N, 3)`` inside the image and not hidden by anything."""
    pixels, z = project(points, settings.intrinsics)
    x, y = pixels.T
    with np.errstate(invalid="ignore"):
        inside = (x >= -0.5) & (x <= settings.width - 0.5) & (y >= -0.5) & (y <= settings.height - 0.5)
    result = np.zeros(len(points), dtype=bool)
    rays = points[inside] / z[inside, None]
    result[inside] = view.cast(rays.astype(np.float32)).depth >= z[inside] * (1.0 - 1e-4)
    return result
