"""What is shown at an instant: points and frusta, as values, from frames and what was asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.geometry import backproject, transform_points
from mvdyn_gtsam.viewer.colours import colour_confidence, colour_depth, colour_motion
from mvdyn_gtsam.viewer.frames import Frame
from mvdyn_gtsam.viewer.scene import Scene, vertical_fov

Image = npt.NDArray[np.uint8]

PICTURE_WIDTH = 320
"""px of the picture in a frustum."""
DITHER_SIZE = 64
FRAMES_UPON_EACH_OTHER = 3.0
"""How many of those gathered show a place: so much denser do its points lie than those of one frame."""


class Show(StrEnum):
    """Which points of an instant are shown."""

    ALL = "all"
    MOVING = "moving"
    STILL = "still"
    GATHERED = "gathered"
    """What moves, within what stands still at several times."""


class Colouring(StrEnum):
    """What the colours of points and pictures say."""

    IMAGE = "image"
    CAMERA = "camera"
    DEPTH = "depth"
    CONFIDENCE = "confidence"
    MOTION = "motion"


@dataclass(frozen=True)
class Choice:
    """What somebody wants to see."""

    time: int = 0
    group: int = 0
    tracking: bool = False
    """What tracking said, not the refinement."""
    hidden: frozenset[str] = frozenset()
    """Cameras that are not shown."""
    show: Show = Show.ALL
    colouring: Colouring = Colouring.IMAGE
    min_confidence: float = 0.0
    """Plain walls have none where no flow tells of them, and are in place all the same."""
    points: int = 100_000
    """At most that many points of one instant, all cameras together."""
    point_size: float = 1.5
    """In distances between neighbouring points at the median depth: above 1, surfaces are closed there."""
    frustum_size: float = 0.08
    """Distance of its picture from the camera, in median depths."""
    through: str | None = None
    """The camera that is looked through."""


@dataclass(frozen=True)
class Points:
    """A coloured cloud."""

    positions: npt.NDArray[np.float32]
    """``(N, 3)`` in median depths."""
    colours: Image
    """``(N, 3)`` RGB"""
    spacing: float
    """Distance between neighbours at the median depth, in median depths."""

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class CameraPicture:
    """One camera at one time: its frustum with a picture in it, and the points that it sees."""

    camera: str
    wTc: npt.NDArray[np.float64]
    """``(4, 4)`` in median depths."""
    fov: float
    """Vertical, in rad."""
    aspect: float
    """Width over height of the field of view."""
    colour: tuple[int, int, int]
    image: Image | None
    """``(h, w, 3)`` RGB, at most PICTURE_WIDTH wide."""
    points: Points
    """In the camera's frame, where half precision holds them to a fraction of a pixel."""


@dataclass(frozen=True)
class Picture:
    """All that is seen at one instant."""

    choice: Choice
    cameras: tuple[CameraPicture, ...]
    background: Points | None
    """What stands still, in the world frame, where it was asked for."""


def camera_picture(scene: Scene, frame: Frame, choice: Choice, budget: int) -> CameraPicture:
    """The frustum of ``frame`` and at most ``budget`` of its points. The camera must have a pose then."""
    camera = scene.camera(frame.camera)
    colour = scene.colours[frame.camera]
    painted = paint(frame, choice.colouring, scene)
    return CameraPicture(
        frame.camera,
        scene.wTc[frame.camera][frame.time],
        vertical_fov(camera),
        (camera.width / camera.fx) / (camera.height / camera.fy),
        colour,
        None if painted is None else _small(painted),
        frame_points(frame, choice, painted, colour, budget, scene.depths.median),
    )


def frame_points(
    frame: Frame,
    choice: Choice,
    painted: Image | None,
    colour: tuple[int, int, int],
    budget: int,
    unit: float,
) -> Points:
    """At most ``budget`` points of ``frame`` in its camera's frame, spread evenly over those asked for.

    Colours are those of ``painted`` ``(h, w, 3)``, or ``colour``; ``unit`` is the length that becomes 1.
    """
    if frame.depth is None or frame.confidence is None:
        return no_points()
    wanted = np.isfinite(frame.depth) & (frame.confidence >= choice.min_confidence)
    if choice.show is not Show.ALL:
        if frame.motion is None:
            raise ValueError(f"{frame.camera}: no motion mask, and {choice.show} was asked for")
        wanted &= (frame.motion == 0) if choice.show is Show.STILL else (frame.motion > 0)
    kept = thin_out(wanted, budget)
    rows, columns = np.nonzero(kept)
    pixels = np.column_stack([columns, rows]).astype(np.float64)
    z = frame.depth[rows, columns].astype(np.float64) / unit
    positions = backproject(pixels, z, frame.intrinsics).astype(np.float32)
    colours = np.tile(np.array(colour, np.uint8), (len(z), 1)) if painted is None else painted[rows, columns]
    spacing = float(np.sqrt(np.count_nonzero(wanted) / max(len(z), 1)) / frame.intrinsics[0, 0])
    return Points(positions, colours, spacing)


def no_points() -> Points:
    """An empty cloud."""
    return Points(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8), 0.0)


def thin_out(wanted: npt.NDArray[np.bool_], budget: int) -> npt.NDArray[np.bool_]:
    """At most ``budget`` of the ``wanted`` pixels ``(h, w)``, spread evenly as in an ordered dither.

    The same pixels go first at every time, so that a still thing does not flicker.
    """
    if np.count_nonzero(wanted) <= budget:
        return wanted
    if budget <= 0:
        return np.zeros_like(wanted)
    order = _dither_order(wanted.shape)
    last = np.partition(order[wanted], budget)[budget]
    return wanted & (order < last)


def gathered_points(scene: Scene, frames: Sequence[Frame], choice: Choice, budget: int) -> Points:
    """What stands still in ``frames``, in the world, at most ``budget`` points of each."""
    still = [_still_points(scene, frame, choice, budget) for frame in frames]
    if not still:
        return no_points()
    return Points(
        np.concatenate([points.positions for points in still]),
        np.concatenate([points.colours for points in still]),
        max(points.spacing for points in still) / math.sqrt(FRAMES_UPON_EACH_OTHER),
    )


def paint(frame: Frame, colouring: Colouring, scene: Scene) -> Image | None:
    """Colours ``(h, w, 3)`` of the pixels of ``frame``, or None where that is not known of this frame."""
    if colouring is Colouring.DEPTH and frame.depth is not None:
        return colour_depth(frame.depth, scene.depths.low, scene.depths.high)
    if colouring is Colouring.CONFIDENCE and frame.confidence is not None:
        return colour_confidence(frame.confidence)
    if colouring is Colouring.MOTION and frame.motion is not None:
        return colour_motion(frame.motion, frame.image)
    if colouring is Colouring.CAMERA:
        return None
    return frame.image


def trajectory_lines(wTc: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Segments ``(N, 2, 3)`` between consecutive poses of ``(T, 4, 4)``; none across frames without one."""
    centres = wTc[:, :3, 3]
    segments = np.stack([centres[:-1], centres[1:]], axis=1)
    return segments[np.isfinite(segments).all(axis=(1, 2))].astype(np.float32)


def _still_points(scene: Scene, frame: Frame, choice: Choice, budget: int) -> Points:
    """Points in the world."""
    still = replace(choice, show=Show.STILL)
    painted = paint(frame, choice.colouring, scene)
    colour = scene.colours[frame.camera]
    points = frame_points(frame, still, painted, colour, budget, scene.depths.median)
    wTc = scene.wTc[frame.camera][frame.time]
    positions = transform_points(wTc, points.positions.astype(np.float64)).astype(np.float32)
    return replace(points, positions=positions)


def _dither_order(shape: tuple[int, ...]) -> npt.NDArray[np.int32]:
    """``(h, w)``: the ranks of an ordered dither; those below any rank lie evenly."""
    order = np.zeros((1, 1), np.int32)
    while len(order) < DITHER_SIZE:
        order = np.block([[4 * order, 4 * order + 2], [4 * order + 3, 4 * order + 1]])
    repeats = [-(-size // DITHER_SIZE) for size in shape]
    return np.asarray(np.tile(order, repeats)[: shape[0], : shape[1]])


def _small(image: Image) -> Image:
    height, width = image.shape[:2]
    if width <= PICTURE_WIDTH:
        return image
    size = (PICTURE_WIDTH, max(1, round(PICTURE_WIDTH * height / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
