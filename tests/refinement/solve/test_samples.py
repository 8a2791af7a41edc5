"""Samples on disk come back as they were, one after the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvdyn_gtsam.errors import ResultError
from mvdyn_gtsam.refinement.solve.samples import FrameSample, SampleStore
from tests.refinement.scenes import two_cameras


def sample_of(neighbours: int, pixels: int) -> FrameSample:
    rng = np.random.default_rng(neighbours)
    there = rng.random((neighbours, pixels))
    there[:, ::3] = np.nan
    return FrameSample(
        i=(1, 5),
        neighbours=tuple((0, time) for time in range(neighbours)),
        rays=rng.random((pixels, 3)),
        inverse_depth=rng.random(pixels),
        intrinsics=rng.random((neighbours, 3, 3)),
        target=rng.random((neighbours, pixels, 2)),
        weight=rng.random((neighbours, pixels)),
        inverse_depth_there=there,
    )


def test_samples_come_back_in_order_as_often_as_asked(tmp_path: Path) -> None:
    store = SampleStore(tmp_path / "samples.bin")
    written = [sample_of(3, 20), sample_of(0, 20), sample_of(2, 0), *two_cameras().samples()]
    store.write(written)
    for _ in range(2):
        found = list(store.read())
        assert [(one.i, one.neighbours) for one in found] == [(one.i, one.neighbours) for one in written]
        for one, other in zip(found, written, strict=True):
            for name in ("rays", "inverse_depth", "intrinsics", "target", "weight", "inverse_depth_there"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_is_named() -> None:
    with pytest.raises(ResultError, match="/dev/full.*--resume"):
        SampleStore(Path("/dev/full")).write([sample_of(3, 20)])
