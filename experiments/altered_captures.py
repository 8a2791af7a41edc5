"""Captures made out of others: pieces of their videos, cropped, reversed, noisier, with the truth to match.

What a method was developed on says little about what it has never seen. These share scenes with it, but not
what it sees of them: less common view, fewer frames, worse images, or no common view at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from experiments.records import ExperimentError
from experiments.start_errors import Frames, true_frames
from mvdyn_gtsam.capture import load_capture
from mvdyn_gtsam.capture.model import Camera, Capture, FrameStream
from mvdyn_gtsam.evaluation import GroundTruth, load_groundtruth
from mvdyn_gtsam.geometry import backproject, invert_pose, project, transform_points

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

SAMPLE_PX = 4
"""Pixels between the points by which common view is measured."""
SAME_SURFACE = 0.05
"""Relative difference of depth up to which two cameras see one surface."""


@dataclass(frozen=True)
class Alteration:
    """What is done to the images of one camera."""

    left: float = 0.0
    """Share of the width cut away."""
    right: float = 0.0
    scale: float = 1.0
    """Of the resolution."""
    noise: float = 0.0
    """Standard deviation, grey levels of 255, added."""
    gain: tuple[float, float] = (1.0, 1.0)
    """Exposure at the first and at the last frame."""
    blur_px: int = 0
    """Length of a motion blur in a direction that changes from frame to frame."""
    jpeg: int = 0
    """Quality of a compression of every frame; 0: none."""


@dataclass(frozen=True)
class Part:
    """Some frames of one camera of a capture, altered."""

    capture: str
    camera: str
    start: int = 0
    stop: int | None = None
    step: int = 1
    reverse: bool = False
    alteration: Alteration = Alteration()


@dataclass(frozen=True)
class AlteredCapture:
    """A capture, the true poses of its frames, and how much its cameras see in common."""

    capture: Capture
    truth: dict[str, Frames]
    median_depth: float
    """Metres, over the true depth images of the parts."""
    shared_at_once: dict[tuple[str, str], float]
    """Share of the view that a pair has in common at one instant, mean over instants and directions."""
    shared: dict[tuple[str, str], float]
    """The same with any instant of the other: of each frame, with whichever shares most."""


@dataclass(frozen=True)
class AlteredStream:
    """Frames of another stream, picked and altered; the same frame always comes out the same."""

    stream: FrameStream
    chosen: tuple[int, ...]
    alteration: Alteration

    def __len__(self) -> int:
        return len(self.chosen)

    def read(self, time: int) -> Image:
        """Frame ``chosen[time]`` of the stream, ``(H, W, 3) uint8`` RGB."""
        part = time / max(len(self) - 1, 1)
        return alter(self.stream.read(self.chosen[time]), self.alteration, part, self.chosen[time])


def alter(image: Image, alteration: Alteration, part: float, seed: int) -> Image:
    """One image altered; ``part`` of the video is over, from 0 to 1, and ``seed`` decides noise and blur."""
    random = np.random.default_rng(seed)
    first, last = columns(image.shape[1], alteration)
    image = image[:, first:last]
    if alteration.scale != 1.0:
        width, height = round(image.shape[1] * alteration.scale), round(image.shape[0] * alteration.scale)
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    if alteration.blur_px > 1:
        image = np.asarray(cv2.filter2D(image, -1, _streak(alteration.blur_px, random)), np.uint8)
    gain = alteration.gain[0] + part * (alteration.gain[1] - alteration.gain[0])
    if alteration.noise > 0.0 or gain != 1.0:
        values = gain * image + random.normal(0.0, 1.0, image.shape) * alteration.noise
        image = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    if alteration.jpeg:
        _, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, alteration.jpeg])
        image = np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(image)


def columns(width: int, alteration: Alteration) -> tuple[int, int]:
    """First column kept and the one after the last."""
    return round(width * alteration.left), width - round(width * alteration.right)


def altered_camera(camera: Camera, alteration: Alteration, name: str) -> Camera:
    """The camera of the altered images. Raises ExperimentError where a scale does not divide the size."""
    first, last = columns(camera.width, alteration)
    width, height = (last - first) * alteration.scale, camera.height * alteration.scale
    if not (width.is_integer() and height.is_integer()):
        raise ExperimentError(
            f"{name}: {last - first}x{camera.height} cannot be scaled by {alteration.scale}"
        )
    s = alteration.scale
    return replace(
        camera,
        name=name,
        width=int(width),
        height=int(height),
        fx=camera.fx * s,
        fy=camera.fy * s,
        cx=(camera.cx - first + 0.5) * s - 0.5,
        cy=(camera.cy + 0.5) * s - 0.5,
    )


def _streak(length: int, random: np.random.Generator) -> Array:
    kernel = np.zeros((length, length))
    angle = random.uniform(0.0, np.pi)
    reach = 0.5 * (length - 1)
    for along in np.linspace(-reach, reach, 4 * length):
        kernel[round(reach + along * np.sin(angle)), round(reach + along * np.cos(angle))] += 1.0
    return kernel / kernel.sum()


def alter_capture(name: str, parts: Sequence[Part], folders: Mapping[str, Path]) -> AlteredCapture:
    """Put the parts together; ``folders`` are those of their captures. Parts of different ones share no view.

    Raises ExperimentError for parts of different length or a camera that is not there.
    """
    cameras = [part.camera for part in parts]
    names = [
        f"{one}_{cameras[:row].count(one)}" if one in cameras[:row] else one
        for row, one in enumerate(cameras)
    ]
    views = [_view(part, folders[part.capture], own) for part, own in zip(parts, names, strict=True)]
    if len({len(view.stream) for view in views}) != 1:
        raise ExperimentError(f"{name}: its parts have {[len(view.stream) for view in views]} frames")
    capture = Capture(name, views[0].fps, tuple(v.camera for v in views), tuple(v.stream for v in views))
    pairs = [(a, b) for row, a in enumerate(views) for b in views[row + 1 :]]
    shares = {(a.camera.name, b.camera.name): _shares(a, b) for a, b in pairs}
    depths = np.concatenate([depth[np.isfinite(depth)] for view in views for depth in view.depth.values()])
    return AlteredCapture(
        capture=capture,
        truth={view.camera.name: view.truth for view in views},
        median_depth=float(np.median(depths)),
        shared_at_once={pair: share[0] for pair, share in shares.items()},
        shared={pair: share[1] for pair, share in shares.items()},
    )


@dataclass(frozen=True)
class _View:
    """One part, ready: depth images are sampled, at the altered camera's pixels."""

    world: str
    fps: float
    camera: Camera
    stream: AlteredStream
    truth: Frames
    pixels: Array
    depth: dict[int, Array]


def _view(part: Part, source: Path, name: str) -> _View:
    capture, groundtruth = load_capture(source), load_groundtruth(source / "groundtruth")
    index = next((i for i, camera in enumerate(capture.cameras) if camera.name == part.camera), None)
    if index is None:
        raise ExperimentError(f"{source}: has no camera {part.camera}")
    frames = range(capture.frame_count)[part.start : part.stop : part.step]
    chosen = tuple(reversed(frames)) if part.reverse else tuple(frames)
    truth = true_frames(capture, groundtruth)[part.camera]
    camera = altered_camera(capture.cameras[index], part.alteration, name)
    columns_, rows = np.meshgrid(
        np.arange(0.0, camera.width, SAMPLE_PX), np.arange(0.0, camera.height, SAMPLE_PX)
    )
    pixels = np.column_stack([columns_.ravel(), rows.ravel()])
    return _View(
        world=part.capture,
        fps=capture.fps / part.step,
        camera=camera,
        stream=AlteredStream(capture.streams[index], chosen, part.alteration),
        truth={time: truth[frame] for time, frame in enumerate(chosen)},
        pixels=pixels,
        depth=_depths(groundtruth, part, chosen, pixels),
    )


def _depths(groundtruth: GroundTruth, part: Part, chosen: Sequence[int], pixels: Array) -> dict[int, Array]:
    """Time -> true depth at the pixels of the altered image."""
    known = set(groundtruth.depth_frames(part.camera))
    found = {}
    for time, frame in enumerate(chosen):
        if frame in known:
            depth = groundtruth.depth(part.camera, frame)
            first, _ = columns(depth.shape[1], part.alteration)
            where = np.rint((pixels + 0.5) / part.alteration.scale - 0.5).astype(int)
            found[time] = depth[where[:, 1], where[:, 0] + first].astype(np.float64)
    if not found:
        raise ExperimentError(f"{part.capture}, {part.camera}: no true depth among the frames chosen")
    return found


def _shares(a: _View, b: _View) -> tuple[float, float]:
    """Common view of two parts at one instant, and at any."""
    if a.world != b.world:
        return 0.0, 0.0
    at_once, ever = [], []
    for source, target in ((a, b), (b, a)):
        table = {(s, t): _seen(source, s, target, t) for s in source.depth for t in target.depth}
        at_once += [table[s, min(target.depth, key=lambda t: abs(t - s))] for s in source.depth]
        ever += [max(table[s, t] for t in target.depth) for s in source.depth]
    return float(np.mean(at_once)), float(np.mean(ever))


def _seen(source: _View, s: int, target: _View, t: int) -> float:
    """Share of the source's view at ``s`` whose surfaces the target sees at ``t``, nothing in between."""
    known = np.isfinite(source.depth[s])
    points = backproject(source.pixels[known], source.depth[s][known], source.camera.intrinsics)
    targetTsource = invert_pose(target.truth[t]) @ source.truth[s]
    pixels, z = project(transform_points(targetTsource, points), target.camera.intrinsics)
    size = [target.camera.width - 1, target.camera.height - 1]
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels <= size)).all(1)
    width = len(np.arange(0, target.camera.width, SAMPLE_PX))
    height = len(target.pixels) // width
    column, row = np.rint(pixels[inside] / SAMPLE_PX).astype(int).T
    surface = target.depth[t][np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)]
    with np.errstate(invalid="ignore"):
        same = np.abs(z[inside] / surface - 1.0) < SAME_SURFACE
    return float(same.sum() / max(known.sum(), 1))
