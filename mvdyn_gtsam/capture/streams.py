"""Frames of one camera decoded on demand: from image files, from a video, and views upon those.

Every stream hands out read-only ``(H, W, 3) uint8`` RGB arrays and can be pickled: what is open or
cached stays behind and is opened anew in the other process.
"""

from __future__ import annotations

import logging
import os
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.capture.images import image_size, read_image
from mvdyn_gtsam.capture.model import FrameStream
from mvdyn_gtsam.errors import CaptureError

logger = logging.getLogger(__name__)

Image = npt.NDArray[np.uint8]

KEPT_BYTES = 48 * 2**20
"""Decoded frames that a camera's stream keeps, 85 of 512x384: of a short clip all, for tracking reads it five
times. One sent to another process keeps few: there are several of those, each with a part of the video."""
FEWEST_KEPT = 4


class MediaStream(FrameStream):
    """What a camera's own file or files hold, before any offset, crop or undistortion."""

    label: str
    """The file, or the pattern, as messages name it."""
    width: int
    height: int
    fps: float | None
    """Frames per second where the container says so."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def read(self, time: int) -> Image: ...


class _FrameCache:
    """The few frames read last; they go out read-only since several callers share them."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._frames: OrderedDict[int, Image] = OrderedDict()

    @staticmethod
    def of_size(width: int, height: int) -> _FrameCache:
        """Room for ``KEPT_BYTES`` of such frames."""
        return _FrameCache(max(FEWEST_KEPT, KEPT_BYTES // (3 * width * height)))

    def get(self, time: int) -> Image | None:
        if time in self._frames:
            self._frames.move_to_end(time)
        return self._frames.get(time)

    def put(self, time: int, frame: Image) -> Image:
        frame.flags.writeable = False
        self._frames[time] = frame
        if len(self._frames) > self._capacity:
            self._frames.popitem(last=False)
        return frame


def _checked_index(time: int, count: int, label: str) -> int:
    if not 0 <= time < count:
        raise IndexError(f"{label}: frame {time} of {count}")
    return time


class ImageStream(MediaStream):
    """One image file per frame, in the order given. Every file is checked when the stream is made.

    Raises CaptureError, naming the file, where one is missing, cut short, no image or of another size.
    """

    def __init__(self, paths: Sequence[Path], label: str | None = None, fps: float | None = None) -> None:
        if not paths:
            raise CaptureError(f"{label}: there are no images; check the folder and the file extension")
        self.paths = tuple(paths)
        self.label = label if label is not None else f"{paths[0].parent}/*{paths[0].suffix}"
        self.fps = fps
        self.width, self.height = image_size(paths[0])
        for path in paths[1:]:
            size = image_size(path)
            if size != (self.width, self.height):
                raise CaptureError(
                    f"{path}: {size[0]}x{size[1]} pixels, but {paths[0].name} in the same folder has "
                    f"{self.width}x{self.height}; give every image of a camera one size"
                )
        self._cache = _FrameCache.of_size(self.width, self.height)

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, time: int) -> Image:
        """Frame ``time``. Raises CaptureError where the file vanished or cannot be decoded."""
        frame = self._cache.get(_checked_index(time, len(self.paths), self.label))
        if frame is None:
            frame = read_image(self.paths[time])
            if frame.shape[:2] != (self.height, self.width):
                raise CaptureError(f"{self.paths[time]}: changed its size since the capture was loaded")
            self._cache.put(time, frame)
        return frame

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": _FrameCache(FEWEST_KEPT)}


class VideoStream(MediaStream):
    """A video file through OpenCV. In order it is decoded once; any order gives the same frames.

    Seeking by frame number is not exact in every container (variable rate, edit lists), so a jump back
    is believed only where the time stamp of the frame it lands on is the one seen on the way forward;
    otherwise the file is opened again and decoded from its start.

    Raises CaptureError where the file is missing, undecodable or, unless ``accept_truncated``, holds
    fewer frames than its container promises.
    """

    _inherited: Any

    def __init__(self, path: Path, accept_truncated: bool = False) -> None:
        self.path = path
        self.label = str(path)
        self._reset()
        if not path.is_file():
            raise CaptureError(f"{path}: there is no such file; check the path")
        if path.stat().st_size == 0:
            raise CaptureError(f"{path}: the file is empty; copy it again from its source")
        video = self._open()
        if not video.grab():
            raise CaptureError(f"{path}: not a single frame can be decoded; copy it again or re-encode it")
        _, first = video.retrieve()
        self.height, self.width = (int(n) for n in first.shape[:2])
        self._cache = _FrameCache.of_size(self.width, self.height)
        rate = float(video.get(cv2.CAP_PROP_FPS))
        self.fps = rate if np.isfinite(rate) and rate > 0 else None
        self.promised_count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        self._count = self._decodable_count(video)
        video.release()
        if self._count < self.promised_count:
            found = (
                f"{path}: truncated: {self._count} of the {self.promised_count} frames its header promises"
            )
            if not accept_truncated:
                raise CaptureError(
                    f"{found} can be decoded; copy it again, or accept the shorter video with --truncate "
                    "(truncate=True)"
                )
            logger.warning("%s are used", found)

    def __len__(self) -> int:
        return self._count

    def read(self, time: int) -> Image:
        """Frame ``time``. Raises CaptureError where the file vanished or can no longer be decoded."""
        _checked_index(time, self._count, self.label)
        if self._owner != os.getpid():
            # A forked process shares its parent's file position and lacks the decoder's threads: it needs
            # a decoder of its own, and closing the inherited one would wait for those threads for ever.
            inherited = self._video
            self._reset()
            self._inherited = inherited
        frame = self._cache.get(time)
        if frame is None:
            frame = self._cache.put(time, self._decode(time))
        return frame

    def __getstate__(self) -> dict[str, Any]:
        return {
            k: self.__dict__[k]
            for k in ("path", "label", "width", "height", "fps", "promised_count", "_count")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    def _reset(self) -> None:
        self._owner = os.getpid()
        self._cache = _FrameCache(FEWEST_KEPT)
        self._video: Any = None
        self._inherited = None
        self._position = -1  # the frame grabbed last
        self._stamps: list[float] = []  # time stamp of every frame grabbed on the way forward, ms

    def _open(self) -> Any:
        # FFmpeg and OpenCV print complaints of their own otherwise; the user gets one line.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        log_level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        try:
            # A file read that took long is no error: the process was suspended, by Ctrl-Z for one.
            patient = [cv2.CAP_PROP_READ_TIMEOUT_MSEC, np.iinfo(np.int32).max]
            video = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG, patient)
        finally:
            cv2.utils.logging.setLogLevel(log_level)
        if not video.isOpened():
            raise CaptureError(
                f"{self.path}: cannot be decoded as a video (cut short, or of an unknown format); "
                "copy it again, or re-encode it to H.264 MP4"
            )
        return video

    def _decodable_count(self, video: Any) -> int:
        """Frames that can be decoded: the container's word where its last frame is there, else counted."""
        if self.promised_count > 1:
            video.set(cv2.CAP_PROP_POS_FRAMES, self.promised_count - 1)
            if video.grab() and not video.grab():
                return self.promised_count
        fresh = self._open()
        count = 0
        while fresh.grab():
            count += 1
        fresh.release()
        return count

    def _decode(self, time: int) -> Image:
        if self._video is None:
            self._restart()
        if time <= self._position and not self._seek_back(time):
            self._restart()
        while self._position < time:
            self._grab()
        decoded, frame = self._video.retrieve()
        if not decoded or frame.shape[:2] != (self.height, self.width):
            raise CaptureError(f"{self.path}: frame {time} cannot be decoded; copy it again or re-encode it")
        return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))

    def _restart(self) -> None:
        if self._video is not None:
            self._video.release()
        self._video = self._open()
        self._position = -1

    def _grab(self) -> None:
        if not self._video.grab():
            raise CaptureError(
                f"{self.path}: frame {self._position + 1} of {self._count} can no longer be decoded; "
                "copy it again or re-encode it"
            )
        self._position += 1
        if self._position == len(self._stamps):
            self._stamps.append(float(self._video.get(cv2.CAP_PROP_POS_MSEC)))

    def _seek_back(self, time: int) -> bool:
        """Land on frame ``time``, seen before; False where the container cannot do that exactly."""
        if self._stamps.count(self._stamps[time]) != 1:
            return False
        self._video.set(cv2.CAP_PROP_POS_FRAMES, time)
        if not self._video.grab():
            return False
        self._position = time
        return float(self._video.get(cv2.CAP_PROP_POS_MSEC)) == self._stamps[time]


class TrimmedStream:
    """Frames ``start`` to ``start + count`` of another stream."""

    def __init__(self, source: FrameStream, start: int, count: int) -> None:
        self._source, self._start, self._count = source, start, count

    def __len__(self) -> int:
        return self._count

    def read(self, time: int) -> Image:
        _checked_index(time, self._count, f"trimmed to frames {self._start}..{self._start + self._count - 1}")
        return self._source.read(self._start + time)


class CroppedStream(MediaStream):
    """A rectangle of another stream, resized by area; pixels map by ``x' = (x - left + 0.5) s - 0.5``."""

    def __init__(
        self, source: MediaStream, rectangle: tuple[int, int, int, int], size: tuple[int, int]
    ) -> None:
        """``rectangle`` is left, top, width, height in px of the source; ``size`` is width, height."""
        self._source, self._rectangle = source, rectangle
        self.width, self.height = size
        self.label, self.fps = source.label, source.fps

    def __len__(self) -> int:
        return len(self._source)

    def read(self, time: int) -> Image:
        left, top, width, height = self._rectangle
        cropped = self._source.read(time)[top : top + height, left : left + width]
        shrinks = self.width < width
        mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(cropped, (self.width, self.height), interpolation=mode))


class UndistortedStream:
    """Another stream seen through an ideal pinhole of the same intrinsics; what was never seen is black."""

    def __init__(
        self, source: FrameStream, intrinsics: npt.NDArray[np.float64], distortion: tuple[float, ...]
    ) -> None:
        """``intrinsics`` is ``(3, 3)``; ``distortion`` in OpenCV order (4, 5 or 8 numbers)."""
        self._source, self._intrinsics, self._distortion = source, intrinsics, distortion
        self._maps: tuple[Any, Any] | None = None
        self._cache = _FrameCache(FEWEST_KEPT)

    def __len__(self) -> int:
        return len(self._source)

    def read(self, time: int) -> Image:
        frame = self._cache.get(time)
        if frame is None:
            distorted = self._source.read(time)
            maps = self._remapping(distorted.shape[1], distorted.shape[0])
            frame = self._cache.put(time, np.asarray(cv2.remap(distorted, *maps, cv2.INTER_LINEAR)))
        return frame

    def _remapping(self, width: int, height: int) -> tuple[Any, Any]:
        if self._maps is None:
            self._maps = cv2.initUndistortRectifyMap(
                self._intrinsics,
                np.array(self._distortion),
                None,
                self._intrinsics,
                (width, height),
                cv2.CV_32FC1,
            )
        return self._maps

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_maps": None, "_cache": _FrameCache(FEWEST_KEPT)}
