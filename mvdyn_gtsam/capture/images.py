"""Image files: what can be known without decoding them, natural order, and decoding with clear errors."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.errors import CaptureError

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# JPEG markers that carry the size: every start-of-frame but DHT (C4), JPG (C8) and DAC (CC).
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def natural_key(path: Path) -> tuple[list[str | int], str]:
    """Sort key that puts ``frame2.jpg`` before ``frame10.jpg``."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], path.name


def images_in(folder: Path) -> list[Path]:
    """Image files directly in ``folder``, in natural order."""
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=natural_key)


def read_bytes(path: Path) -> bytes:
    """Content of ``path``. Raises CaptureError where it is missing, unreadable or empty."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from None
    if not data:
        raise CaptureError(f"{path}: the file is empty; copy it again from its source")
    return data


def image_size(path: Path) -> tuple[int, int]:
    """``(width, height)`` of an image and proof that it is whole, from PNG and JPEG structure alone.

    Other formats are decoded. The formats: https://www.w3.org/TR/png/#5DataRep, ITU-T T.81 annex B.
    Raises CaptureError where the file is missing, cut short or no image.
    """
    data = read_bytes(path)
    if data.startswith(_PNG_SIGNATURE):
        if len(data) < 33 or b"IEND" not in data[-64:]:
            raise _cut_short(path)
        width, height = struct.unpack(">II", data[16:24])
        return int(width), int(height)
    if data.startswith(b"\xff\xd8"):
        # Inside a scan 0xFF is always escaped, so an end marker must follow the last start of scan.
        if data.rfind(b"\xff\xd9") < max(data.rfind(b"\xff\xda"), 2):
            raise _cut_short(path)
        size = _jpeg_size(data)
        if size is not None:
            return size
    height, width = _decode(data, path).shape[:2]
    return int(width), int(height)


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """The image as ``(H, W, 3) uint8`` RGB; grey images are repeated over the three channels.

    Raises CaptureError where the file is missing or cannot be decoded.
    """
    return np.asarray(cv2.cvtColor(_decode(read_bytes(path), path), cv2.COLOR_BGR2RGB))


def _decode(data: bytes, path: Path) -> npt.NDArray[np.uint8]:
    # Orientation tags are ignored: the intrinsics are of the pixels as stored.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    if image is None:
        raise CaptureError(f"{path}: not an image that can be decoded; convert it to PNG or JPEG")
    return np.asarray(image)


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker in _JPEG_SIZE_MARKERS:
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return int(width), int(height)
        else:
            position += 2 + int(struct.unpack(">H", data[position + 2 : position + 4])[0])
    return None


def _cut_short(path: Path) -> CaptureError:
    return CaptureError(f"{path}: the image is cut short; copy it again from its source")
