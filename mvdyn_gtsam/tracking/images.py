"""The few frames held in memory; older ones are decoded again where the capture allows it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import to_grey
from mvdyn_gtsam.graph.connections import Frame

Image = npt.NDArray[np.uint8]
Read = Callable[[int, int], Image]

MOST_FRAMES = 256
"""Frames held at most, however small: those further back are seldom needed and quickly decoded again."""


class ImageStore:
    """Images by frame, the ones used least recently dropped beyond ``capacity_bytes`` or
    ``MOST_FRAMES``.

    With ``grey`` only their luminance ``(H, W)`` is kept and handed out.
    """

    def __init__(self, capacity_bytes: int, read: Read | None = None, grey: bool = False) -> None:
        self._capacity, self._grey = capacity_bytes, grey
        self.read = read
        self._images: OrderedDict[Frame, Image] = OrderedDict()
        self._bytes = 0

    def put(self, frame: Frame, image: Image) -> None:
        if frame in self._images:
            self._images.move_to_end(frame)
            return
        if self._grey:
            image = to_grey(image)
        self._images[frame] = image
        self._bytes += image.nbytes
        while len(self._images) > 1 and (self._bytes > self._capacity or len(self._images) > MOST_FRAMES):
            _, dropped = self._images.popitem(last=False)
            self._bytes -= dropped.nbytes

    def drop(self, frame: Frame) -> None:
        image = self._images.pop(frame, None)
        if image is not None:
            self._bytes -= image.nbytes

    def make_room(self) -> None:
        """Drop every image that can be read again."""
        if self.read is not None:
            self._images.clear()
            self._bytes = 0

    def available(self, frame: Frame) -> bool:
        """Whether ``get`` can deliver."""
        return frame in self._images or self.read is not None

    def get(self, frame: Frame) -> Image:
        """The image. Raises KeyError where it was dropped and cannot be read again."""
        image = self._images.get(frame)
        if image is None:
            if self.read is None:
                raise KeyError(f"frame {frame} is no longer held and there is nothing to read it from")
            self.put(frame, self.read(*frame))
        else:
            self._images.move_to_end(frame)
        return self._images[frame]
