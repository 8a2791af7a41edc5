"""What the wide-baseline start hands to the tracker: groups of cameras and a sparse skeleton of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import TrackingError


@dataclass(frozen=True)
class StartFrame:
    """One frame of the skeleton: where its camera was, and the sparse depths it saw."""

    time: int
    wTc: npt.NDArray[np.float64]
    """``(4, 4)`` in the world frame of the camera's group."""
    pixels: npt.NDArray[np.float64]
    """``(M, 2)`` px."""
    depth: npt.NDArray[np.float64]
    """``(M,)`` z-depth at ``pixels``, in the unit of the group's world."""


@dataclass(frozen=True)
class FoundIntrinsics:
    """What the images say of a camera with square pixels."""

    focal: float
    """px"""
    cx: float
    cy: float
    deviation: float
    """Standard deviation of the focal length, px."""


@dataclass(frozen=True)
class Start:
    """Rough poses over the whole video, good to about half a degree and a few percent of the depth."""

    groups: tuple[tuple[int, ...], ...]
    """Camera indices that share a world frame; every camera is in exactly one group."""
    frames: tuple[tuple[StartFrame, ...], ...]
    """Per camera, in time order, at least one."""
    notes: tuple[str, ...] = ()
    """What a reader of the result must know, such as cameras whose place or depth nobody could see."""
    intrinsics: Mapping[int, FoundIntrinsics] = field(default_factory=dict)
    """By camera index, of those whose focal length was not known."""


def found_cameras(cameras: Sequence[Camera], start: Start) -> tuple[Camera, ...]:
    """The cameras with the intrinsics that the start found.

    Raises TrackingError where one is neither known nor found.
    """
    result = list(cameras)
    for index, camera in enumerate(cameras):
        if index in start.intrinsics:
            found = start.intrinsics[index]
            result[index] = replace(camera, fx=found.focal, fy=found.focal, cx=found.cx, cy=found.cy)
        elif not camera.focal_known:
            raise TrackingError(
                f"{camera.name}: the start did not find its focal length; give its intrinsics"
            )
    return tuple(result)


def start_to_arrays(start: Start) -> dict[str, npt.NDArray[np.float64]]:
    """Plain arrays that ``start_from_arrays`` turns back into the start."""
    frames = [(camera, frame) for camera, own in enumerate(start.frames) for frame in own]
    group_of = {camera: group for group, members in enumerate(start.groups) for camera in members}
    return {
        "group": np.array([group_of[camera] for camera in range(len(start.frames))], np.float64),
        "camera": np.array([camera for camera, _ in frames], np.float64),
        "time": np.array([frame.time for _, frame in frames], np.float64),
        "wTc": np.stack([frame.wTc for _, frame in frames]),
        "count": np.array([len(frame.depth) for _, frame in frames], np.float64),
        "pixels": np.concatenate([frame.pixels for _, frame in frames]),
        "depth": np.concatenate([frame.depth for _, frame in frames]),
        "intrinsics": np.array(
            [(camera, *astuple(found)) for camera, found in start.intrinsics.items()], np.float64
        ).reshape(-1, 5),
    }


def start_from_arrays(arrays: Mapping[str, npt.NDArray[np.float64]]) -> Start:
    """The inverse of ``start_to_arrays``."""
    group = arrays["group"].astype(int)
    splits = np.cumsum(arrays["count"].astype(int))[:-1]
    frames: list[list[StartFrame]] = [[] for _ in group]
    for camera, time, wTc, pixels, depth in zip(
        arrays["camera"].astype(int),
        arrays["time"].astype(int),
        arrays["wTc"],
        np.split(arrays["pixels"], splits),
        np.split(arrays["depth"], splits),
        strict=True,
    ):
        frames[camera].append(StartFrame(int(time), wTc, pixels, depth))
    return Start(
        groups=tuple(tuple(np.flatnonzero(group == number).tolist()) for number in range(group.max() + 1)),
        frames=tuple(tuple(own) for own in frames),
        # starts of earlier versions have none
        intrinsics={
            int(camera): FoundIntrinsics(*found)
            for camera, *found in arrays.get("intrinsics", np.zeros((0, 5))).tolist()
        },
    )
