"""An ONNX model that the user brings: opened with clear errors, described in one line, told from others."""

from __future__ import annotations

import hashlib
import mmap
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import MvdynError

NUMPY_TYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(float16)": np.dtype(np.float16),
    "tensor(int64)": np.dtype(np.int64),
    "tensor(int32)": np.dtype(np.int32),
}
"""By the name that onnxruntime gives the type."""
LOCATION = re.compile(rb"\n\x08location\x12([\x01-\x7f])")
"""Key and length of the entry that names a file of weights beside the model:
https://github.com/onnx/onnx/blob/main/docs/ExternalData.md, in protobuf's wire format."""


@dataclass(frozen=True)
class Tensor:
    """One input or output of a model."""

    name: str
    type: str
    """As onnxruntime calls it, e.g. ``tensor(float)``."""
    shape: tuple[int | str | None, ...]
    """A number where the model fixes a side, otherwise its name or None."""

    def __str__(self) -> str:
        sides = ", ".join("?" if side is None else str(side) for side in self.shape)
        return f"{self.name} {self.type.removeprefix('tensor(').removesuffix(')')} ({sides})"


@dataclass(frozen=True)
class Signature:
    """What a model takes and gives."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]

    def __str__(self) -> str:
        return f"takes {_listed(self.inputs)} and gives {_listed(self.outputs)}"


class OnnxModel:
    """A session on the CPU with ``threads`` threads (onnxruntime's own choice where that is not positive).

    What goes wrong is raised as ``failure``, in one line that names the file.
    """

    def __init__(self, path: Path, threads: int, failure: type[MvdynError]) -> None:
        self.path, self._failure = path, failure
        if not path.is_file():
            raise failure(f"{path}: there is no such ONNX model; check the path")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # what it would print is in the exceptions
        if threads > 0:
            options.intra_op_num_threads = threads
        # Its threads would burn the processors in between, while others work:
        # https://onnxruntime.ai/docs/performance/tune-performance/threading.html
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's own exceptions have no common base but this
            raise failure(f"{path}: cannot be read as an ONNX model ({_reason(error)})") from error
        self.signature = Signature(
            _tensors(self._session.get_inputs()), _tensors(self._session.get_outputs())
        )

    def run(
        self, feeds: Mapping[str, npt.NDArray[Any]], outputs: Sequence[str] | None, frame: str
    ) -> list[npt.NDArray[Any]]:
        """The named ``outputs`` (None: all) for the inputs ``feeds``; ``frame`` names the image in errors."""
        try:
            return [np.asarray(one) for one in self._session.run(outputs, dict(feeds))]
        except Exception as error:  # as above
            raise self._failure(f"{self.path}: fails on {frame} ({_reason(error)})") from error


def fingerprint(path: Path, *more: bytes) -> str:
    """Twelve hexadecimal digits of the SHA-256 of a readable model, of its weights in other files, and of
    ``more``.

    Models above 2 GB, and many below, keep their weights beside: two such may differ there alone.
    """
    digest = hashlib.sha256()
    for file in (path, *_external_data(path)):
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    for content in more:
        digest.update(content)
    return digest.hexdigest()[:12]


def _external_data(path: Path) -> list[Path]:
    """Files that hold weights of the model, as the model names them."""
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        names = {
            content[match.end() : match.end() + match[1][0]].decode(errors="replace")
            for match in LOCATION.finditer(content)
        }
    files = [path.parent / name for name in sorted(names) if "\0" not in name]
    return [file for file in files if file.is_file()]


def _tensors(nodes: Sequence[Any]) -> tuple[Tensor, ...]:
    return tuple(Tensor(node.name, node.type, tuple(node.shape)) for node in nodes)


def _listed(tensors: Sequence[Tensor]) -> str:
    return ", ".join(map(str, tensors)) or "nothing"


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
