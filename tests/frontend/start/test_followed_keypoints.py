"""Keypoints followed along flow that is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.dense_flow import FlowPair
from mvdyn_gtsam.frontend.start.features import Features
from mvdyn_gtsam.frontend.start.followed_keypoints import follow_keypoints, joined_matches

SHAPE = (60, 80)
STEP = np.array([3.0, -2.0])


class Shift:
    """Everything moves by ``STEP`` from each image to the next; images are their number."""

    def __init__(self, unsure_right_of: float = np.inf) -> None:
        self.unsure = np.mgrid[: SHAPE[0], : SHAPE[1]][1] >= unsure_right_of

    def measure(self, image_i: npt.NDArray[np.uint8], image_j: npt.NDArray[np.uint8], *_: object) -> FlowPair:
        assert image_j[0, 0] == image_i[0, 0] + 1  # from one frame to the next only
        forward = np.broadcast_to(STEP, (*SHAPE, 2)).astype(np.float32)
        weight = np.where(self.unsure, 0.0, 1.0).astype(np.float32)
        return FlowPair(forward, -forward, weight, weight)


def image(row: int) -> npt.NDArray[np.uint8]:
    return np.full(SHAPE, row, np.uint8)


def features(pixels: npt.NDArray[np.float64]) -> Features:
    """All look alike: as the tiles of a wallpaper do."""
    return Features(pixels, np.full((len(pixels), 128), 128**-0.5, np.float32))


def moved(count: int) -> list[Features]:
    """The same points in ``count`` frames, numbered the other way round in every other one."""
    points = np.random.default_rng(0).uniform([10.0, 25.0], [50.0, 50.0], (12, 2))
    return [features((points + k * STEP)[:: 1 if k % 2 == 0 else -1]) for k in range(count)]


def test_each_keypoint_is_found_where_flow_leads_however_alike_they_look() -> None:
    matches = follow_keypoints(image, moved(4), 2, Shift())
    assert sorted(matches) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    turned = np.column_stack([np.arange(12), np.arange(12)[::-1]])
    straight = np.column_stack([np.arange(12), np.arange(12)])
    np.testing.assert_array_equal(matches[0, 1], turned)
    np.testing.assert_array_equal(matches[0, 2], straight)
    np.testing.assert_array_equal(matches[2, 3], turned)


def test_what_is_not_near_is_not_the_same() -> None:
    first, second = features(np.array([[20.0, 30.0]])), features(np.array([[20.0, 30.0]]) + STEP + [1.6, 0.0])
    assert follow_keypoints(image, [first, second], 2, Shift())[0, 1].shape == (0, 2)


def test_of_two_that_lead_to_one_keypoint_the_nearer_is_it() -> None:
    first = features(np.array([[20.0, 30.0], [21.0, 30.0]]))
    second = features(np.array([[20.9, 30.0]]) + STEP)
    assert follow_keypoints(image, [first, second], 2, Shift())[0, 1].tolist() == [[1, 0]]


def test_flow_that_is_not_trusted_is_not_followed_nor_what_leaves_the_image() -> None:
    first = features(np.array([[20.0, 30.0], [40.0, 30.0], [79.0, 1.0]]))
    frames = [features(first.pixels + k * STEP) for k in range(3)]
    matches = follow_keypoints(image, frames, 2, Shift(unsure_right_of=42.0))
    assert matches[0, 1].tolist() == [[0, 0], [1, 1]]
    assert matches[0, 2].tolist() == [[0, 0]]


def test_frames_without_keypoints_match_nothing() -> None:
    none = features(np.zeros((0, 2)))
    found = follow_keypoints(image, [none, moved(1)[0], none], 2, Shift())
    assert {pair: len(rows) for pair, rows in found.items()} == {(0, 1): 0, (0, 2): 0, (1, 2): 0}


def test_matches_found_both_ways_count_once() -> None:
    one, other = {(0, 1): np.array([[0, 3], [2, 1]])}, {(0, 1): np.array([[2, 1], [4, 4]]), (1, 2): np.eye(2)}
    joined = joined_matches(one, other)
    assert joined[0, 1].tolist() == [[0, 3], [2, 1], [4, 4]]
    assert joined[1, 2].tolist() == [[0, 1], [1, 0]]
