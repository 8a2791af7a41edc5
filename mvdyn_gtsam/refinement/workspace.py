"""The refinement's dense state on disk: memory holds a window of frames, whatever the length of the video.

Everything lies in one folder that goes when the refinement is done. A journal says which steps are
finished, so that a killed run goes on where it was.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.frontend.dense_flow import Float32, FlowPair
from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.views import DenseView

JOURNAL = "journal.json"
STEPS_PER_PX = 64
"""Flow is kept as 16-bit integers of 1/64 px where it fits: float16 would round a flow of 300 px to 0.25
px."""
FLOW_HEADER_BYTES, FLOW_BYTES_PER_PIXEL = 8, 5
"""Of one direction on disk: the steps per px; two 16-bit numbers and a weight of 8 bits."""


@dataclass(frozen=True)
class DirectedFlow:
    """Flow of one frame to another at ``M`` pixels, in the views' pixels."""

    i: Frame
    j: Frame
    pixels: npt.NDArray[np.int64]
    """``(M,)`` flat indices in view i, ascending."""
    flow: Float32
    """``(M, 2)``"""
    weight: Float32
    """``(M,)`` in [0, 1]"""


@dataclass(frozen=True)
class _Layout:
    """Of the file of an array."""

    header_bytes: int
    shape: tuple[int, ...]
    """``(h, w)`` or ``(h, w, channels)`` of one image."""
    dtype: np.dtype[np.generic]

    @property
    def numbers(self) -> int:
        return math.prod(self.shape)

    def start(self, time: int) -> int:
        """Byte at which an image begins."""
        return self.header_bytes + time * self.numbers * self.dtype.itemsize


class Workspace:
    """Files of one refinement; opened anew by every worker process."""

    def __init__(self, folder: Path, views: tuple[DenseView, ...], frame_count: int) -> None:
        self.folder, self.views, self.frame_count = folder, views, frame_count
        self._layouts: dict[Path, _Layout] = {}
        self._arrays: dict[str, tuple[tuple[int, int], npt.NDArray[np.float64]]] = {}

    def prepare(self, settings: str) -> None:
        """Make the folder, or keep what an earlier run with the same ``settings`` left in it.

        Raises ResultError when that fails.
        """
        path = self.folder / "settings.txt"
        try:
            if not path.is_file() or path.read_text() != settings:
                self.remove()
            (self.folder / "flow").mkdir(parents=True, exist_ok=True)
            path.write_text(settings)
        except OSError as error:
            raise ResultError(f"{self.folder}: cannot be made ({error.strerror})") from error

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def finished(self) -> list[str]:
        """Names of the finished steps."""
        path = self.folder / JOURNAL
        return [str(step) for step in json.loads(path.read_text())] if path.is_file() else []

    def finish(self, step: str) -> None:
        """Note a step as finished."""
        temporary = self.folder / f".{JOURNAL}.part"
        with _writing(self.folder / JOURNAL):
            temporary.write_text(json.dumps([*self.finished(), step]))
            temporary.replace(self.folder / JOURNAL)

    def create(
        self, name: str, dtype: type = np.float32, full_size: bool = False, channels: tuple[int, ...] = ()
    ) -> None:
        """Make an array per camera, one image per frame, filled with zeros; ``channels`` are the lengths of
        its axes besides height and width."""
        for camera, view in enumerate(self.views):
            shape = ((view.camera.height, view.camera.width) if full_size else view.shape) + channels
            path = self._path(name, camera)
            if not path.is_file():
                with _writing(path):
                    _write_zeros(path, np.dtype(dtype), (self.frame_count, *shape))

    def read(self, name: str, frame: Frame) -> npt.NDArray[np.generic]:
        """One image of an array."""
        path = self._path(name, frame[0])
        layout = self._layout(path)
        numbers = np.fromfile(path, layout.dtype, layout.numbers, offset=layout.start(frame[1]))
        return numbers.reshape(layout.shape)

    def write(self, name: str, frame: Frame, image: npt.NDArray[np.generic]) -> None:
        """Set one image of an array."""
        path = self._path(name, frame[0])
        layout = self._layout(path)
        with _writing(path), path.open("r+b") as file:
            file.seek(layout.start(frame[1]))
            file.write(np.broadcast_to(image, layout.shape).astype(layout.dtype).tobytes())

    def write_table(self, name: str, frame: Frame, table: npt.NDArray[np.generic]) -> None:
        """Keep an array of a frame that has no fixed size."""
        path = self._table_path(name, frame)
        with _writing(path):
            path.parent.mkdir(exist_ok=True)
            np.save(path, table)

    def read_table(self, name: str, frame: Frame) -> npt.NDArray[np.generic]:
        """What ``write_table`` kept."""
        return np.asarray(np.load(self._table_path(name, frame)))

    def write_array(self, name: str, array: npt.NDArray[np.float64]) -> None:
        """Keep one array of its own, such as the poses; the old one stays until the new one is whole."""
        temporary, path = self.folder / f".{name}.part.npy", self.folder / f"{name}.npy"
        with _writing(path):
            np.save(temporary, array)
            temporary.replace(path)

    def read_array(self, name: str) -> npt.NDArray[np.float64]:
        """What ``write_array`` kept; not to be written to."""
        path = self.folder / f"{name}.npy"
        state = path.stat()
        # every write makes a new file: most tasks ask for the poses, which seldom change
        version = (state.st_ino, state.st_mtime_ns)
        if name not in self._arrays or self._arrays[name][0] != version:
            array = np.asarray(np.load(path))
            array.setflags(write=False)
            self._arrays[name] = (version, array)
        return self._arrays[name][1]

    def _layout(self, path: Path) -> _Layout:
        """Where the images of an array lie; its header is parsed once, not with every image."""
        if path not in self._layouts:
            with path.open("rb") as file:
                np.lib.format.read_magic(file)
                shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                self._layouts[path] = _Layout(file.tell(), shape[1:], dtype)
        return self._layouts[path]

    def _table_path(self, name: str, frame: Frame) -> Path:
        return self.folder / name / f"{frame[0]}_{frame[1]:06d}.npy"

    def _path(self, name: str, camera: int) -> Path:
        return self.folder / f"{name}_{camera}.npy"

    def has_flow(self, i: Frame, j: Frame) -> bool:
        """Whether the pair was measured, in this order."""
        return self._flow_path(i, j).is_file()

    def write_flow(self, i: Frame, j: Frame, pair: FlowPair) -> None:
        """Keep both directions of a pair measured on full images, averaged down to the views."""
        path = self._flow_path(i, j)
        temporary = path.with_name(f".{path.name}.part")
        with _writing(path):
            with temporary.open("wb") as file:
                for frame, other, flow, weight in (
                    (i, j, pair.forward, pair.forward_weight),
                    (j, i, pair.backward, pair.backward_weight),
                ):
                    small, trust = self._shrunk(frame, other, flow, weight)
                    steps = min(float(STEPS_PER_PX), 32000.0 / max(1.0, float(np.abs(small).max())))
                    file.write(np.float64(steps).tobytes())
                    file.write(np.rint(small * np.float32(steps)).astype(np.int16).tobytes())
                    file.write(np.rint(trust * 255.0).astype(np.uint8).tobytes())
            temporary.replace(path)

    def read_flow(
        self,
        i: Frame,
        j: Frame,
        backward: bool = False,
        among: npt.NDArray[np.int64] | None = None,
        least: float = 0.0,
    ) -> DirectedFlow:
        """One direction of a measured pair: i to j, or with ``backward`` j to i.

        At the pixels ``among`` (flat indices, ascending) or all, of those where its weight is ``least``
        or more.
        """
        sizes = [shape[0] * shape[1] for shape in (self.views[i[0]].shape, self.views[j[0]].shape)]
        count = sizes[1] if backward else sizes[0]
        # a direction is the steps per px, the flow and its weight, one after the other
        start = FLOW_HEADER_BYTES + FLOW_BYTES_PER_PIXEL * sizes[0] if backward else 0
        length = FLOW_HEADER_BYTES + FLOW_BYTES_PER_PIXEL * count
        raw = np.fromfile(self._flow_path(i, j), np.uint8, length, offset=start)
        steps = raw[:FLOW_HEADER_BYTES].view(np.float64)[0]
        flow, weight = raw[FLOW_HEADER_BYTES:-count].view(np.int16).reshape(count, 2), raw[-count:]
        if among is None:
            pixels = np.flatnonzero(weight >= 255.0 * least)
        else:
            pixels = among[weight[among] >= 255.0 * least]
        ends = (j, i) if backward else (i, j)
        return DirectedFlow(
            *ends,
            pixels,
            # take: indexing rows takes several times as long
            np.divide(np.take(flow, pixels, axis=0), steps, dtype=np.float32),
            weight[pixels].astype(np.float32) / np.float32(255.0),
        )

    def _shrunk(self, i: Frame, j: Frame, flow: Float32, weight: Float32) -> tuple[Float32, Float32]:
        """Flow in the pixels of view j at the pixels of view i, and its weight."""
        view_i, view_j = self.views[i[0]], self.views[j[0]]
        small = np.asarray(view_i.shrink(flow), np.float32)
        trust = np.asarray(view_i.shrink(weight), np.float32)
        height, width = view_i.shape
        # x_i + f in full pixels, each resized by its own camera's scale: x' = (x + 0.5) s - 0.5
        own = np.array([view_i.camera.width / width, view_i.camera.height / height], np.float32)
        other = np.array(
            [view_j.shape[1] / view_j.camera.width, view_j.shape[0] / view_j.camera.height], np.float32
        )
        raster = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        full = (raster + np.float32(0.5)) * own - np.float32(0.5) + small
        return (full + np.float32(0.5)) * other - np.float32(0.5) - raster, trust

    def _flow_path(self, i: Frame, j: Frame) -> Path:
        return self.folder / "flow" / f"{i[0]}_{i[1]:06d}_{j[0]}_{j[1]:06d}.bin"


def _write_zeros(path: Path, dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> None:
    """A whole ``.npy`` or none. It takes space as its images are written: zeros would take as long."""
    temporary = path.with_name(f".{path.name}.part")
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.truncate(file.tell() + math.prod(shape) * dtype.itemsize)
    temporary.replace(path)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Name the file that cannot be written. Raises ResultError."""
    try:
        yield
    except OSError as error:
        raise ResultError(
            f"{path}: cannot be written ({error.strerror or error}); what was finished is kept, continue with"
            " --resume when that is mended"
        ) from error
