"""How the points of a moving region lie about its depth, made one over time."""

from __future__ import annotations

import numpy as np

from mvdyn_gtsam.refinement.edges import FlowTargets
from mvdyn_gtsam.refinement.moving.relief import relief_over_time

SHAPE = (12, 16)
REGION = np.zeros(SHAPE, bool)
REGION[3:9, 4:12] = True
LABELS = REGION.astype(np.int32)
INDEX = np.arange(REGION.size, dtype=np.int32)


def moved_right(steps: int) -> np.ndarray:
    """Where flow to the right finds every pixel; -1 outside."""
    row, column = np.divmod(INDEX, SHAPE[1])
    return np.where(column + steps < SHAPE[1], row * SHAPE[1] + column + steps, -1).astype(np.int32)


def shape_of_thing() -> np.ndarray:
    bulge = np.fromfunction(lambda row, column: 0.02 * row - 0.01 * column, SHAPE, dtype=np.float32)
    return np.where(REGION, bulge, np.nan).astype(np.float32)


def shifted(image: np.ndarray, steps: int) -> np.ndarray:
    return np.roll(image, steps, axis=1)


def test_what_one_frame_alone_says_is_outvoted() -> None:
    """The thing moves to the right by two pixels per frame; one frame errs on a patch of it."""
    truth, steps = shape_of_thing(), (-2, 2, 4)
    wrong = truth.copy()
    wrong[4:6, 5:8] += 0.2
    found = relief_over_time(
        wrong,
        LABELS,
        FlowTargets(np.array([0, 2, 3], np.int32), np.stack([moved_right(k) for k in steps])),
        [shifted(truth, k) for k in steps],
        [shifted(LABELS, k) for k in steps],
    )
    np.testing.assert_allclose(found[REGION], truth[REGION], atol=1e-6)
    assert np.isnan(found[~REGION]).all()


def test_a_frame_in_which_two_things_are_one_region_has_no_say() -> None:
    """There the label is that of a region four times as large."""
    truth = shape_of_thing()
    both = np.ones(SHAPE, np.int32)
    targets = FlowTargets(np.array([2, 3], np.int32), np.stack([INDEX, INDEX]))
    others = [np.full(SHAPE, 0.5, np.float32)] * 2
    kept = relief_over_time(truth, LABELS, targets, others, [both, both])
    np.testing.assert_array_equal(kept, truth)
    # the same frames, with the thing alone
    changed = relief_over_time(truth, LABELS, targets, others, [LABELS, LABELS])
    np.testing.assert_allclose(changed[REGION], 0.5)


def test_pixels_that_flow_does_not_find_keep_their_relief() -> None:
    truth = shape_of_thing()
    lost = np.full((1, REGION.size), -1, np.int32)
    # the last pixel of a frame moves, too: -1 must not stand for it
    there = LABELS.copy()
    there[-1, -1] = 1
    found = relief_over_time(
        truth, LABELS, FlowTargets(np.array([2], np.int32), lost), [truth + np.float32(1.0)], [there]
    )
    np.testing.assert_array_equal(found, truth)


def test_no_frames_around_change_nothing() -> None:
    truth = shape_of_thing()
    none = FlowTargets(np.zeros(0, np.int32), np.zeros((0, REGION.size), np.int32))
    np.testing.assert_array_equal(relief_over_time(truth, LABELS, none, [], []), truth)
