"""Tiny media whose frames can be told apart after lossy compression."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mvdyn_gtsam.capture.streams import Image

WIDTH, HEIGHT = 64, 48
_BITS = 8


def numbered_frame(index: int, width: int = WIDTH, height: int = HEIGHT) -> Image:
    """A frame that carries ``index`` (0..255) as black and white columns."""
    columns = [255 * (index >> bit & 1) for bit in range(_BITS)]
    row = np.repeat(np.array(columns, dtype=np.uint8), width // _BITS)
    return np.ascontiguousarray(np.broadcast_to(row[None, :, None], (height, width, 3)))


def frame_number(frame: Image) -> int:
    """The index that ``numbered_frame`` wrote."""
    columns = frame.reshape(frame.shape[0], _BITS, -1).mean(axis=(0, 2)) > 127
    return int(sum(1 << bit for bit in range(_BITS) if columns[bit]))


def write_video(
    path: Path, count: int, fps: float = 30.0, codec: str = "mp4v", size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
    assert writer.isOpened()
    for index in range(count):
        writer.write(numbered_frame(index, *size))
    writer.release()
    return path


def write_images(
    folder: Path, numbers: Iterable[int], pattern: str = "{:06d}.png", size: tuple[int, int] = (WIDTH, HEIGHT)
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number in numbers:
        paths.append(folder / pattern.format(number))
        assert cv2.imwrite(str(paths[-1]), numbered_frame(number, *size))
    return paths


def camera_entry(name: str, source: str, /, **changes: Any) -> dict[str, Any]:
    """One camera of ``capture.json``, for media of the default size."""
    entry = {"name": name, "source": source, "width": WIDTH, "height": HEIGHT}
    entry |= {"fx": 60.0, "fy": 60.0, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    return entry | changes


def write_capture_json(folder: Path, *cameras: dict[str, Any], **content: Any) -> Path:
    """``capture.json`` in ``folder``; a key given as None is left out."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = {"name": "tiny", "fps": 30.0, "cameras": list(cameras)} | content
    text = json.dumps({key: value for key, value in whole.items() if value is not None})
    (folder / "capture.json").write_text(text)
    return folder
