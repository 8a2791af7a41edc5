"""What holds for the whole video of one group of cameras: their paths, its scale, up, and where to look from.

Everything shown is in units of the median depth: the unit of a result is arbitrary, near planes, sizes of
points and half-precision coordinates are not.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.geometry import transform_points
from mvdyn_gtsam.reconstruction import Reconstruction
from mvdyn_gtsam.viewer.colours import camera_colour

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

FRAMES_MEASURED = 3
"""Frames of each camera whose depth tells the scale of the scene."""
BEHIND = (0.0, -0.5, -0.9)
"""Where one stands behind a camera, and a little above, in its frame and in median depths."""
LOOKED_AT = (0.0, 0.0, 1.0)
"""Where one looks from there: at what the camera sees."""


@dataclass(frozen=True)
class DepthRange:
    """Depths of some frames, in the reconstruction's unit: 2nd, 50th and 98th percentile."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class Viewpoint:
    """Where somebody looks from, in median depths."""

    position: Array
    """``(3,)``"""
    look_at: Array
    """``(3,)``"""
    up: Array
    """``(3,)``"""
    fov: float
    """Vertical field of view in rad."""


@dataclass(frozen=True)
class Scene:
    """One group of cameras over the whole video, in median depths."""

    cameras: tuple[Camera, ...]
    colours: Mapping[str, tuple[int, int, int]]
    depths: DepthRange
    wTc: Mapping[str, Array]
    """``(T, 4, 4)`` per camera, NaN where there is no pose."""
    up: Array
    """``(3,)``, unit length: against gravity, as far as the cameras were held upright."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    def camera(self, name: str) -> Camera:
        """The camera called ``name``."""
        return self.cameras[self.names.index(name)]

    def has_pose(self, name: str, time: int) -> bool:
        """Whether camera ``name`` has a pose at frame ``time``."""
        return bool(posed_times(self.wTc[name])[time])


def read_scene(poses: Reconstruction, depths: Reconstruction, group: Sequence[str]) -> Scene:
    """The cameras of ``group`` with the trajectories of ``poses`` in the scale of ``depths``.

    What is not there yet is said in a line each. Raises ResultError when no frame of the group has a pose.
    """
    wTc: dict[str, Array] = {}
    for name in group:
        try:
            trajectory = poses.trajectory(name)[1]
        except ResultError as error:
            log.warning("%s is not shown: %s", name, error)
            continue
        posed = int(posed_times(trajectory).sum())
        if posed < len(trajectory):
            log.warning(
                "%s: %d of %d frames have a pose; the others are not shown", name, posed, len(trajectory)
            )
        if posed:
            wTc[name] = trajectory
    if not wTc:
        raise ResultError(
            f"{poses.folder}: no frame of {', '.join(group)} has a pose (the run is {poses.status});"
            " continue it with mvdyn reconstruct --resume"
        )
    measured = depth_range(depths, {name: posed_times(trajectory) for name, trajectory in wTc.items()})
    if measured is None:
        log.warning("%s: no depth yet: only the cameras are shown", depths.folder)
        measured = DepthRange(*([_extent(wTc.values())] * 3))
    for trajectory in wTc.values():
        trajectory[:, :3, 3] /= measured.median
    colours = {name: camera_colour(index) for index, name in enumerate(poses.cameras)}
    cameras = tuple(poses.camera(name) for name in wTc)
    return Scene(cameras, colours, measured, wTc, upwards(list(wTc.values())))


def posed_times(wTc: Array) -> npt.NDArray[np.bool_]:
    """``(T,)``: which of the frames of a trajectory ``(T, 4, 4)`` have a pose."""
    return np.asarray(np.isfinite(wTc).reshape(len(wTc), -1).all(axis=1))


def depth_range(result: Reconstruction, posed: Mapping[str, npt.NDArray[np.bool_]]) -> DepthRange | None:
    """Depths of a few ``posed`` ``(T,)`` frames of every camera, or None where there is none.

    Frames whose depth was not written, or cannot be read, are said.
    """
    values = [np.empty(0, np.float32)]
    for name, present in posed.items():
        written = present & [result.has_depth(name, time) for time in range(len(present))]
        if written.sum() < present.sum():
            log.warning("%s: %d of %d frames have depth", name, int(written.sum()), int(present.sum()))
        for time in spread_times(written, FRAMES_MEASURED):
            try:
                depth = result.depth(name, time)[::4, ::4]
            except ResultError as error:  # the others tell the scale as well
                log.warning("%s", error)
                continue
            values.append(depth[np.isfinite(depth)])
    together = np.concatenate(values)
    if not len(together):
        return None
    return DepthRange(*(float(value) for value in np.percentile(together, (2.0, 50.0, 98.0))))


def spread_times(present: npt.NDArray[np.bool_], count: int) -> Sequence[int]:
    """At most ``count`` of the times that are ``present`` ``(T,)``, spread over all of them."""
    times = np.flatnonzero(present)
    places = np.linspace(0, len(times) - 1, min(count, len(times))).round().astype(int)
    return [int(times[place]) for place in places]


def upwards(wTc: Sequence[Array]) -> Array:
    """Unit ``(3,)``: the mean of the cameras' own up, their -y axes, over all poses ``(T, 4, 4)``.

    That of the first pose where these cancel out.
    """
    every = np.concatenate(wTc)
    axes = -every[posed_times(every), :3, 1]
    mean = axes.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return np.asarray(mean / length if length > 0.1 else axes[0])


def first_view(scene: Scene) -> Viewpoint:
    """From behind the first camera at its first pose."""
    name = scene.names[0]
    return behind_camera(scene, name, int(np.flatnonzero(posed_times(scene.wTc[name]))[0]))


def behind_camera(scene: Scene, name: str, time: int) -> Viewpoint:
    """From behind camera ``name``, which must have a pose at frame ``time``, at what it sees."""
    position, look_at = transform_points(scene.wTc[name][time], np.array([BEHIND, LOOKED_AT]))
    return Viewpoint(position, look_at, scene.up, vertical_fov(scene.camera(name)))


def through_camera(scene: Scene, name: str, time: int) -> Viewpoint | None:
    """What camera ``name`` sees at frame ``time``; None where it has no pose then."""
    if name not in scene.names or not scene.has_pose(name, time):
        return None
    wTc = scene.wTc[name][time]
    return Viewpoint(wTc[:3, 3], wTc[:3, 3] + wTc[:3, 2], -wTc[:3, 1], vertical_fov(scene.camera(name)))


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view in rad, as of a centred principal point."""
    return 2.0 * math.atan(0.5 * camera.height / camera.fy)


def _extent(trajectories: Iterable[Array]) -> float:
    """How far the cameras get from where the first of them began; 1 where they all stand in one place."""
    every = np.concatenate([trajectory[:, :3, 3] for trajectory in trajectories])
    every = every[np.isfinite(every).all(axis=1)]
    return float(np.linalg.norm(every - every[0], axis=1).max()) or 1.0
