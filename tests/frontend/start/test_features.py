"""Sparse keypoints and their matching."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from mvdyn_gtsam.frontend.start.features import (
    Features,
    extract_features,
    extract_tilted_features,
    match_features,
)
from tests.frontend.textures import texture, warped

SHAPE = (160, 200)


def colour(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, axis=2)


def test_a_shifted_image_is_matched_at_the_shift() -> None:
    shift = np.array([7.0, -4.0])
    jHi = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])
    first = extract_features(colour(texture(SHAPE)), 500, 0.01)
    second = extract_features(colour(warped(jHi, SHAPE)), 500, 0.01)
    pairs = match_features(first, second, 0.8)
    assert len(pairs) > 50
    error = second.pixels[pairs[:, 1]] - first.pixels[pairs[:, 0]] - shift
    assert (np.linalg.norm(error, axis=1) < 0.5).mean() > 0.95


def test_pixel_centres_are_at_integers() -> None:
    image = np.zeros((101, 121), np.uint8)
    y, x = np.mgrid[:101, :121]
    image[:] = np.rint(200 * np.exp(-((x - 60.0) ** 2 + (y - 40.0) ** 2) / (2 * 4.0**2)))
    found = extract_features(colour(image), 10, 0.01).pixels
    np.testing.assert_allclose(found[np.linalg.norm(found - [60, 40], axis=1).argmin()], [60, 40], atol=0.1)


def test_descriptors_are_unit_and_pixels_distinct() -> None:
    features = extract_features(colour(texture(SHAPE)), 500, 0.01)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    assert len(np.unique(features.pixels, axis=0)) == len(features.pixels) <= 500
    assert features.descriptors.shape == (len(features.pixels), 128)


def test_a_flat_image_has_no_features_and_matches_nothing() -> None:
    flat = extract_features(np.full((*SHAPE, 3), 90, np.uint8), 500, 0.01)
    assert flat.pixels.shape == (0, 2)
    assert flat.descriptors.shape == (0, 128)
    some = extract_features(colour(texture(SHAPE)), 500, 0.01)
    assert match_features(flat, some, 0.8).shape == match_features(some, flat, 0.8).shape == (0, 2)


def at_angles(*degrees: float) -> Features:
    """Descriptors in one plane, so that their distances are plain to see."""
    descriptors = np.zeros((len(degrees), 128), np.float32)
    descriptors[:, 0], descriptors[:, 1] = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return Features(np.zeros((len(degrees), 2)), descriptors)


def test_lowes_ratio_decides() -> None:
    first, second = at_angles(0.0, 180.0), at_angles(6.0, -10.0, 181.0)
    ratio = np.sin(np.radians(3.0)) / np.sin(np.radians(5.0))  # of the chords to 6 and to -10 degrees
    assert match_features(first, second, ratio - 0.01).tolist() == [[1, 2]]
    assert match_features(first, second, ratio + 0.01).tolist() == [[0, 0], [1, 2]]


def test_only_mutual_neighbours_match() -> None:
    # 0 and 8 degrees both like 7 best; 7 likes 8 best.
    pairs = match_features(at_angles(0.0, 8.0), at_angles(7.0, 120.0), 0.99)
    assert pairs.tolist() == [[1, 0]]


def test_matches_are_those_of_comparing_all_at_once() -> None:
    random = np.random.default_rng(0)
    descriptors = random.random((700, 128)).astype(np.float32)
    seen = np.concatenate([descriptors[::2], descriptors[:1]]) + np.float32(0.1) * random.random((351, 128))
    first, second = (
        Features(np.zeros((len(rows), 2)), (rows / np.linalg.norm(rows, axis=1)[:, None]).astype(np.float32))
        for rows in (np.concatenate([descriptors, descriptors[5:6]]), seen)
    )
    similarity = first.descriptors.astype(np.float64) @ second.descriptors.T
    best, back = similarity.argmax(1), similarity.argmax(0)
    ordered = np.sort(similarity, axis=1)
    distinct = (1.0 - ordered[:, -1]) < 0.8**2 * (1.0 - ordered[:, -2])
    expected = [(i, best[i]) for i in range(len(best)) if back[best[i]] == i and distinct[i]]
    assert len(expected) > 300
    np.testing.assert_array_equal(match_features(first, second, 0.8), expected)


def test_what_is_seen_from_far_aside_is_matched_by_tilted_features_alone() -> None:
    # as a wall seen at 65 degrees from its normal: 2.4 times narrower
    narrow = np.diag([1.0 / 2.4, 1.0, 1.0])
    images = colour(texture(SHAPE)), colour(warped(narrow, SHAPE))

    def right(extract: Callable[[npt.NDArray[np.uint8], int, float], Features]) -> int:
        first, second = (extract(image, 300, 0.01) for image in images)
        pairs = match_features(first, second, 0.8, apart_px=4.0)
        error = second.pixels[pairs[:, 1]] - first.pixels[pairs[:, 0]] * [1.0 / 2.4, 1.0]
        return int((np.linalg.norm(error, axis=1) < 2.0).sum())

    assert right(extract_tilted_features) > max(20, 3 * right(extract_features))


def test_a_keypoint_found_twice_is_no_rival_of_itself() -> None:
    first, second = at_angles(0.0, 180.0), at_angles(6.0, -6.5, 181.0)
    close = replace(second, pixels=np.array([[10.0, 10.0], [12.0, 10.0], [90.0, 90.0]]))
    assert match_features(first, second, 0.8).tolist() == [[1, 2]]
    assert match_features(first, close, 0.8, apart_px=1.0).tolist() == [[1, 2]]
    assert match_features(first, close, 0.8, apart_px=3.0).tolist() == [[0, 0], [1, 2]]
