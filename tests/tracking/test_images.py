"""Which frames the image store holds, and what it does when it must let some go."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.tracking.images import MOST_FRAMES, Image, ImageStore


def image(value: int) -> Image:
    return np.full((4, 6), value, np.uint8)


def test_small_frames_are_limited_in_number() -> None:
    store = ImageStore(2**30)
    for time in range(MOST_FRAMES + 2):
        store.put((0, time), image(time % 256))
    assert [store.available((0, time)) for time in (0, 1, 2, MOST_FRAMES + 1)] == [False, False, True, True]


def test_large_frames_are_limited_in_bytes() -> None:
    store = ImageStore(3 * 24)
    for time in range(4):
        store.put((0, time), image(time))
    assert [store.available((0, time)) for time in range(4)] == [False, True, True, True]


def test_room_is_made_only_where_frames_can_be_read_again() -> None:
    alone = ImageStore(1000)
    alone.put((0, 0), image(1))
    alone.make_room()
    assert alone.get((0, 0))[0, 0] == 1
    read: list[tuple[int, int]] = []

    def again(camera: int, time: int) -> Image:
        read.append((camera, time))
        return image(7)

    store = ImageStore(1000, again)
    store.put((0, 0), image(1))
    store.make_room()
    assert store.get((0, 0))[0, 0] == 7
    assert read == [(0, 0)]
    with pytest.raises(KeyError):
        alone.get((1, 1))
