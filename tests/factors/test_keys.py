from __future__ import annotations

import gtsam
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors.keys import F, M, S, X, camera_and_time, key_kind, key_name

cameras = st.integers(0, 2**16 - 1)
times = st.integers(0, 2**40 - 1)


@given(cameras, times)
def test_round_trip(camera: int, time: int) -> None:
    assert camera_and_time(X(camera, time)) == (camera, time)
    assert camera_and_time(S(camera, time)) == (camera, time)
    assert (key_kind(X(camera, time)), key_kind(S(camera, time))) == ("x", "s")


@given(st.tuples(cameras, times), st.tuples(cameras, times))
def test_keys_sort_like_camera_and_time(first: tuple[int, int], second: tuple[int, int]) -> None:
    assert (X(*first) < X(*second)) == (first < second)


@pytest.mark.parametrize(("camera", "time"), [(-1, 0), (0, -1), (2**16, 0), (0, 2**40)])
def test_out_of_range_is_refused(camera: int, time: int) -> None:
    with pytest.raises(ValueError, match="outside"):
        X(camera, time)


def test_kinds_do_not_meet() -> None:
    keys = {kind(2, 0) for kind in (X, S, M)} | {F(2)}
    assert len(keys) == 4 and key_kind(F(2)) == "f" and F(1) != F(2)


def test_gtsam_accepts_the_largest_key() -> None:
    key = X(2**16 - 1, 2**40 - 1)
    values = gtsam.Values()
    values.insert(key, gtsam.Pose3())
    assert list(values.keys()) == [key]
    assert key_name(X(1, 25)) == "x(cam 1, t 25)"
