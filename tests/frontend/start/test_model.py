"""The start as arrays and back."""

from __future__ import annotations

import io

import numpy as np
import pytest

from mvdyn_gtsam.capture.model import Camera
from mvdyn_gtsam.errors import TrackingError
from mvdyn_gtsam.frontend.start.model import (
    FoundIntrinsics,
    Start,
    StartFrame,
    found_cameras,
    start_from_arrays,
    start_to_arrays,
)


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
        intrinsics={2: FoundIntrinsics(412.5, 31.0, 24.0, 0.75)},
    )
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **start_to_arrays(start))
    buffer.seek(0)
    with np.load(buffer, allow_pickle=False) as arrays:
        again = start_from_arrays(dict(arrays))
    assert again.groups == start.groups and again.intrinsics == start.intrinsics
    assert [len(own) for own in again.frames] == [3, 1, 1]
    for own, expected in zip(again.frames, start.frames, strict=True):
        for one, other in zip(own, expected, strict=True):
            assert one.time == other.time and isinstance(one.time, int)
            np.testing.assert_array_equal(one.wTc, other.wTc)
            np.testing.assert_array_equal(one.pixels, other.pixels)
            np.testing.assert_array_equal(one.depth, other.depth)
            assert one.pixels.shape == (len(one.depth), 2)


def test_a_start_of_earlier_versions_has_no_intrinsics() -> None:
    random = np.random.default_rng(0)
    arrays = start_to_arrays(Start(((0,),), ((frame(0, 5, random),),)))
    del arrays["intrinsics"]
    assert start_from_arrays(arrays).intrinsics == {}


def test_cameras_take_the_intrinsics_that_were_found() -> None:
    known = Camera("known", 64, 48, 50.0, 51.0, 31.5, 23.5)
    unknown = Camera("unknown", 64, 48, 48.0, 48.0, 31.5, 23.5, focal_known=False)
    start = Start(((0, 1),), ((), ()), intrinsics={1: FoundIntrinsics(52.0, 31.0, 24.0, 0.1)})
    assert found_cameras((known, unknown), start) == (
        known,
        Camera("unknown", 64, 48, 52.0, 52.0, 31.0, 24.0, focal_known=False),
    )
    # an initializer that does not look for it must not let the first guess pass for known
    with pytest.raises(TrackingError, match="unknown: the start did not find its focal length"):
        found_cameras((known, unknown), Start(((0, 1),), ((), ())))
