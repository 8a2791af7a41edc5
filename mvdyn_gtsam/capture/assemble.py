"""Checks across cameras, and the one place where cameras and their media become a Capture."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mvdyn_gtsam.capture.images import natural_key
from mvdyn_gtsam.capture.model import Camera, Capture, FrameStream
from mvdyn_gtsam.capture.streams import (
    ImageStream,
    MediaStream,
    TrimmedStream,
    UndistortedStream,
    VideoStream,
)
from mvdyn_gtsam.errors import CaptureError

logger = logging.getLogger(__name__)

CAMERA_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
_DISTORTION_LENGTHS = (4, 5, 8)
_RATE_TOLERANCE = 0.01


@dataclass(frozen=True)
class Source:
    """A camera and the media it was filmed with, not yet checked against each other."""

    camera: Camera
    media: MediaStream


def open_media(source: str, folder: Path, truncate: bool) -> MediaStream:
    """Open a video, or the images of a glob, given relative to ``folder``.

    Raises CaptureError where nothing is there or it cannot be decoded.
    """
    path = folder / source
    if path.is_dir():
        raise CaptureError(f'{path}: is a folder; name its images with a pattern such as "{source}/*.jpg"')
    if any(letter in source for letter in "*?[") and not path.exists():
        pattern = Path(source)
        root = Path(pattern.anchor) if pattern.is_absolute() else folder
        relative = pattern.relative_to(pattern.anchor) if pattern.is_absolute() else pattern
        paths = sorted((p for p in root.glob(str(relative)) if p.is_file()), key=_folder_then_name)
        if not paths:
            raise CaptureError(f"{path}: no file matches this pattern; check the folder and the extension")
        return ImageStream(paths, label=str(path))
    return VideoStream(path, accept_truncated=truncate)


def assemble_capture(
    name: str, fps: float, sources: Sequence[Source], *, truncate: bool = False, num_frames: int | None = None
) -> Capture:
    """Check cameras and media against each other and join them into one Capture.

    Whole-frame time offsets shift the streams and all are cut to the range they share; what remains
    below half a frame is reported and left alone. ``truncate`` accepts cameras of different length by
    cutting all to the shortest; ``num_frames`` is what the capture claims to hold.
    Raises CaptureError, one line with the fix, on the first thing found wrong.
    """
    if not sources:
        raise CaptureError(f"{name}: there are no cameras; list at least one under cameras")
    _check_names(name, [source.camera.name for source in sources])
    for source in sources:
        _check_camera(source.camera)
        _check_size(source)
    _check_labels(sources)
    check_rate(fps, name)
    _check_rates(fps, sources)
    _check_lengths(sources, truncate, num_frames)
    if len(sources) == 1:
        logger.warning(
            "%s: one camera only: there is nothing to connect it to, depth comes from its motion", name
        )
    start, count, firsts = _common_range(name, fps, sources)
    streams = [_finish(source, first, count) for source, first in zip(sources, firsts, strict=True)]
    return Capture(
        name=name,
        fps=fps,
        cameras=tuple(source.camera for source in sources),
        streams=tuple(streams),
        start_time=start / fps,
    )


def check_rate(fps: float, name: str) -> None:
    """Raise CaptureError unless ``fps`` is a positive finite number."""
    if not (math.isfinite(fps) and fps > 0):
        raise CaptureError(f"{name}: fps is {fps}; give the frames per second as a positive number")


def _folder_then_name(path: Path) -> tuple[str, tuple[list[str | int], str]]:
    return str(path.parent), natural_key(path)


def _check_names(capture: str, names: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if not CAMERA_NAME.fullmatch(name):
            raise CaptureError(
                f"{capture}: camera name {name!r} cannot be a file name; use letters, digits, _ - and ."
            )
        # Results are files named after cameras, and some file systems ignore case.
        if name.lower() in seen:
            raise CaptureError(f"{capture}: two cameras are named {name!r}; give each camera its own name")
        seen.add(name.lower())


def _check_labels(sources: Sequence[Source]) -> None:
    users: dict[str, str] = {}
    for source in sources:
        label, name = source.media.label, source.camera.name
        if label in users:
            logger.warning(
                "%s: cameras %s and %s read the same frames; is this meant?", label, users[label], name
            )
        users[label] = name


def _check_camera(camera: Camera) -> None:
    where = f"camera {camera.name}"
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.time_offset, *camera.distortion)
    if not all(math.isfinite(number) for number in numbers):
        raise CaptureError(f"{where}: intrinsics, distortion and time_offset must be finite numbers")
    if camera.fx <= 0 or camera.fy <= 0:
        raise CaptureError(
            f"{where}: focal lengths fx={camera.fx:g}, fy={camera.fy:g} must be positive, in pixels"
        )
    if not (-0.5 <= camera.cx <= camera.width - 0.5 and -0.5 <= camera.cy <= camera.height - 0.5):
        raise CaptureError(
            f"{where}: the principal point ({camera.cx:g}, {camera.cy:g}) is outside the {camera.width}x"
            f"{camera.height} image; give cx, cy in pixels of this resolution"
        )
    if camera.distortion and len(camera.distortion) not in _DISTORTION_LENGTHS:
        raise CaptureError(
            f"{where}: distortion has {len(camera.distortion)} numbers; give k1,k2,p1,p2,k3 (OpenCV order)"
        )


def _check_size(source: Source) -> None:
    camera, media = source.camera, source.media
    if (media.width, media.height) == (camera.width, camera.height):
        return
    if not camera.focal_known:
        raise CaptureError(
            f"{media.label}: frames are {media.width}x{media.height}, but camera {camera.name} is said to "
            f"have {camera.width}x{camera.height}; correct its width and height, and cx, cy if given"
        )
    message = (
        f"{media.label}: frames are {media.width}x{media.height}, but camera {camera.name} has intrinsics "
        f"for {camera.width}x{camera.height}; scale the intrinsics to the frames"
    )
    if media.width * camera.height == media.height * camera.width:
        s = media.width / camera.width
        message += (
            f": fx={camera.fx * s:.6g}, fy={camera.fy * s:.6g}, cx={(camera.cx + 0.5) * s - 0.5:.6g}, "
            f"cy={(camera.cy + 0.5) * s - 0.5:.6g}"
        )
    else:
        message += " (the aspect ratio differs too: is it the right camera, or was it cropped?)"
    raise CaptureError(message)


def _check_rates(fps: float, sources: Sequence[Source]) -> None:
    rated = [(source.media.fps, source.media) for source in sources if source.media.fps is not None]
    if not rated:
        return
    slow, fast = min(rated, key=lambda r: r[0]), max(rated, key=lambda r: r[0])
    frames = min(len(source.media) for source in sources)
    # Half a frame of drift over the clip: beyond it, frames of one index were not taken at one instant.
    if frames * (fast[0] - slow[0]) / fast[0] > 0.5:
        raise CaptureError(
            f"{slow[1].label}: {slow[0]:.6g} frames per second, but {fast[1].label} has {fast[0]:.6g}; "
            f"bring all cameras to one rate, e.g. ffmpeg -i INPUT -r {slow[0]:.6g} OUTPUT"
        )
    if abs(slow[0] / fps - 1.0) > _RATE_TOLERANCE:
        logger.warning(
            "%s: the container says %.6g frames per second, the capture says %.6g; the latter is used",
            slow[1].label,
            slow[0],
            fps,
        )


def _check_lengths(sources: Sequence[Source], truncate: bool, num_frames: int | None) -> None:
    _check_gaps(sources)
    shortest = min(sources, key=lambda source: len(source.media))
    longest = max(sources, key=lambda source: len(source.media))
    short, long = len(shortest.media), len(longest.media)
    if truncate:
        if short != long:
            logger.warning("every camera is cut to the %d frames of %s", short, shortest.camera.name)
        return
    if short != long:
        raise CaptureError(
            f"{shortest.media.label}: camera {shortest.camera.name} is short: {short} frames, but "
            f"{longest.camera.name} has {long}; supply the missing frames, or accept the common "
            f"{short} with --truncate (truncate=True)"
        )
    if num_frames is not None and num_frames != short:
        raise CaptureError(
            f"{shortest.media.label}: {short} frames, but the capture says num_frames {num_frames}; "
            "supply the missing frames or correct num_frames"
        )


def _check_gaps(sources: Sequence[Source]) -> None:
    """Refuse images missing in the middle of one camera: the rest would be out of step with the others."""
    images = [(source, source.media) for source in sources if isinstance(source.media, ImageStream)]
    gaps = [_first_gap(media.paths) for _, media in images]
    if None not in gaps:
        return
    for (source, media), gap in zip(images, gaps, strict=True):
        if gap is not None:
            raise CaptureError(
                f"{media.label}: camera {source.camera.name} misses frames that other cameras have: {gap}; "
                "supply them, or remove the same instants from every camera"
            )


def _first_gap(paths: Sequence[Path]) -> str | None:
    """Where evenly numbered images skip a number; None where they do not, or are not evenly numbered."""
    numbers = [re.findall(r"\d+", path.stem) for path in paths]
    if len(paths) < 3 or any(not found for found in numbers):
        return None
    counts = [int(found[-1]) for found in numbers]
    steps = [after - before for before, after in zip(counts, counts[1:], strict=False)]
    step = min(steps)
    if step <= 0 or steps.count(step) <= len(steps) // 2:
        return None
    for path, size in zip(paths, steps, strict=False):
        if size != step:
            return f"the numbers jump after {path.name}"
    return None


def _common_range(name: str, fps: float, sources: Sequence[Source]) -> tuple[int, int, list[int]]:
    """First common index, number of common frames, and each camera's own first frame."""
    shifts = []
    for source in sources:
        frames = source.camera.time_offset * fps
        shift = round(frames)
        if abs(frames - shift) > 1e-3:
            logger.warning(
                "camera %s: of its time offset %.6g s, %.3g ms are not a whole frame and stay uncorrected",
                source.camera.name,
                source.camera.time_offset,
                1000.0 * (frames - shift) / fps,
            )
        shifts.append(shift)
    start = max(shifts)
    end = min(shift + len(source.media) for shift, source in zip(shifts, sources, strict=True))
    if end <= start:
        late = sources[shifts.index(start)].camera
        raise CaptureError(
            f"{name}: with the time offsets given no instant is seen by every camera "
            f"({late.name} starts last, {late.time_offset:g} s); check time_offset, in seconds"
        )
    return start, end - start, [start - shift for shift in shifts]


def _finish(source: Source, first: int, count: int) -> FrameStream:
    stream: FrameStream = source.media
    if first != 0 or count != len(source.media):
        stream = TrimmedStream(stream, first, count)
    if any(source.camera.distortion):
        stream = UndistortedStream(stream, source.camera.intrinsics, source.camera.distortion)
    return stream
