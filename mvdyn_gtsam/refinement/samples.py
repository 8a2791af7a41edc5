"""What the pose and scale solves see of a frame: some of its pixels with their flow to all its neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.graph.connections import Frame

Array = npt.NDArray[np.float64]


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
        with self._path.open("wb") as file:
            for sample in samples:
                frames = np.array([sample.i, *sample.neighbours])
                try:
                    for array in (frames, *(getattr(sample, name) for name in _ARRAYS)):
                        np.save(file, array, allow_pickle=False)
                    file.flush()
                except OSError as error:
                    raise ResultError(
                        f"{self._path}: cannot be written ({error.strerror}); free space, then continue with"
                        " --resume"
                    ) from error

    def read(self) -> Iterator[FrameSample]:
        """The samples in the order written, one in memory at a time."""
        with self._path.open("rb") as file:
            while file.peek(1):
                i, *neighbours = [(int(camera), int(time)) for camera, time in np.load(file)]
                arrays = {name: np.load(file) for name in _ARRAYS}
                yield FrameSample(i=i, neighbours=tuple(neighbours), **arrays)


_ARRAYS = ("rays", "inverse_depth", "intrinsics", "target", "weight", "inverse_depth_there")
