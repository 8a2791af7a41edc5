from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.capture.images import image_size, images_in, natural_key, read_image
from mvdyn_gtsam.errors import CaptureError

_NOISE = np.random.default_rng(0).integers(0, 255, (37, 53, 3), dtype=np.uint8)


def _encoded(suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, _NOISE)[1].tobytes())


def test_natural_order_counts_instead_of_spelling() -> None:
    names = ["f10.png", "f9.png", "f1.png", "a2b10.png", "a2b9.png"]
    assert [p.name for p in sorted(map(Path, names), key=natural_key)] == [
        "a2b9.png",
        "a2b10.png",
        "f1.png",
        "f9.png",
        "f10.png",
    ]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp"])
def test_size_without_and_with_decoding(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"image{suffix}"
    path.write_bytes(_encoded(suffix))
    assert image_size(path) == (53, 37)
    assert read_image(path).shape == (37, 53, 3)


def test_progressive_jpeg_and_trailing_bytes(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    data = cv2.imencode(".jpg", _NOISE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    path.write_bytes(data + b"vendor trailer")
    assert image_size(path) == (53, 37)


@given(suffix=st.sampled_from([".png", ".jpg"]), fraction=st.floats(0.05, 0.98))
def test_any_cut_is_noticed(tmp_path_factory: pytest.TempPathFactory, suffix: str, fraction: float) -> None:
    path = tmp_path_factory.mktemp("cut") / f"cut{suffix}"
    data = _encoded(suffix)
    path.write_bytes(data[: int(fraction * len(data))])
    with pytest.raises(CaptureError, match=f"cut{suffix}: the image is cut short"):
        image_size(path)


def test_a_thumbnail_does_not_hide_the_cut(tmp_path: Path) -> None:
    thumbnail = _encoded(".jpg")
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    data = _encoded(".jpg")
    path = tmp_path / "photo.jpg"
    path.write_bytes(data[:2] + segment + data[2:])
    assert image_size(path) == (53, 37)
    path.write_bytes((data[:2] + segment + data[2:])[:-20])
    with pytest.raises(CaptureError, match="cut short"):
        image_size(path)


def test_png_is_read_exactly_and_as_rgb(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(_encoded(".png"))
    assert np.array_equal(read_image(path), _NOISE[..., ::-1])


def test_grey_becomes_three_channels(tmp_path: Path) -> None:
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), _NOISE[..., 0])
    assert np.array_equal(read_image(path), np.repeat(_NOISE[..., :1], 3, axis=2))


@pytest.mark.parametrize(
    ("content", "message"), [(b"", "the file is empty"), (b"not an image at all", "not an image")]
)
def test_what_is_no_image_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.png"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=f"bad.png: {message}"):
        image_size(path)


def test_missing_image_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"gone\.png: cannot be read \(No such file"):
        read_image(tmp_path / "gone.png")


def test_only_images_are_listed(tmp_path: Path) -> None:
    for name in ("b2.jpg", "b10.JPG", "notes.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in images_in(tmp_path)] == ["b2.jpg", "b10.JPG"]
