"""What the pose and scale solves see of a frame: some of its pixels with their flow to all its neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.graph.connections import Frame

Array = npt.NDArray[np.float64]

ITEM_BYTES = 8
"""Of a number on disk, integer or not."""


@dataclass(frozen=True)
class FrameSample:
    """``M`` pixels of frame i and their flow to ``K`` neighbours."""

    i: Frame
    neighbours: tuple[Frame, ...]
    rays: Array
    """``(M, 3)`` with z = 1."""
    inverse_depth: Array
    """``(M,)`` of frame i."""
    intrinsics: Array
    """``(K, 3, 3)`` of the neighbours, in the pixels of ``target``."""
    target: Array
    """``(K, M, 2)`` px of the input resolution."""
    weight: Array
    """``(K, M)`` at least 0; 0 where there is no flow."""
    inverse_depth_there: Array
    """``(K, M)`` inverse depth that the neighbours have at the targets; NaN outside."""


class SampleStore:
    """Samples one after the other in a file of the workspace: a solve passes over them many times."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, samples: Iterable[FrameSample]) -> None:
        """Replace what the file holds. Raises ResultError when the disk is full."""
        # unbuffered: a full disk is met here, not when the file is closed
        with self._path.open("wb", buffering=0) as file:
            for sample in samples:
                frames = np.array([sample.i, *sample.neighbours], np.int64)
                sizes = np.array([len(sample.neighbours), len(sample.rays)], np.int64)
                arrays = [np.ascontiguousarray(getattr(sample, name), np.float64) for name in _shapes(0, 0)]
                # one piece without headers: to parse them took longer than to compute with what they head
                left = memoryview(b"".join(array.tobytes() for array in (sizes, frames, *arrays)))
                try:
                    while left:
                        left = left[file.write(left) :]
                except OSError as error:
                    raise ResultError(
                        f"{self._path}: cannot be written ({error.strerror}); free space, then continue with"
                        " --resume"
                    ) from error

    def read(self) -> Iterator[FrameSample]:
        """The samples in the order written, one in memory at a time."""
        with self._path.open("rb") as file:
            while head := file.read(2 * ITEM_BYTES):
                neighbours, pixels = (int(size) for size in np.frombuffer(head, np.int64))
                frames = np.frombuffer(file.read(2 * (neighbours + 1) * ITEM_BYTES), np.int64)
                i, *others = [(int(camera), int(time)) for camera, time in frames.reshape(-1, 2)]
                arrays = {
                    name: np.frombuffer(file.read(prod(shape) * ITEM_BYTES)).reshape(shape)
                    for name, shape in _shapes(neighbours, pixels).items()
                }
                yield FrameSample(i=i, neighbours=tuple(others), **arrays)


def _shapes(neighbours: int, pixels: int) -> dict[str, tuple[int, ...]]:
    """Of a sample's arrays, in the order in which they are written."""
    return {
        "rays": (pixels, 3),
        "inverse_depth": (pixels,),
        "intrinsics": (neighbours, 3, 3),
        "target": (neighbours, pixels, 2),
        "weight": (neighbours, pixels),
        "inverse_depth_there": (neighbours, pixels),
    }
