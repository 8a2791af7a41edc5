"""The start as arrays and back."""

from __future__ import annotations

import io

import numpy as np

from mvdyn_gtsam.frontend.start.model import Start, StartFrame, start_from_arrays, start_to_arrays


def frame(time: int, points: int, random: np.random.Generator) -> StartFrame:
    wTc = np.eye(4)
    wTc[:3, 3] = random.normal(size=3)
    return StartFrame(time, wTc, random.uniform(0, 500, (points, 2)), random.uniform(1, 5, points))


def test_arrays_and_back_through_a_file() -> None:
    random = np.random.default_rng(0)
    start = Start(
        groups=((0, 2), (1,)),
        frames=(
            (frame(0, 5, random), frame(7, 0, random), frame(12, 3, random)),
            (frame(0, 0, random),),  # a camera that saw no depth
            (frame(3, 4, random),),
        ),
    )
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **start_to_arrays(start))
    buffer.seek(0)
    with np.load(buffer, allow_pickle=False) as arrays:
        again = start_from_arrays(dict(arrays))
    assert again.groups == start.groups
    assert [len(own) for own in again.frames] == [3, 1, 1]
    for own, expected in zip(again.frames, start.frames, strict=True):
        for one, other in zip(own, expected, strict=True):
            assert one.time == other.time and isinstance(one.time, int)
            np.testing.assert_array_equal(one.wTc, other.wTc)
            np.testing.assert_array_equal(one.pixels, other.pixels)
            np.testing.assert_array_equal(one.depth, other.depth)
            assert one.pixels.shape == (len(one.depth), 2)
