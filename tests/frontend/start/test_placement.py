"""Hypotheses for one map in another, on maps whose placement is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.errors import ConfigError
from mvdyn_gtsam.frontend.start.placement import (
    PlacementConfig,
    PointMatches,
    _fit_three,
    agreeing_pairs,
    match_maps,
    propose_placements,
    same_placement,
)
from mvdyn_gtsam.frontend.start.single_camera import CameraMap
from mvdyn_gtsam.geometry import Similarity, invert_pose, project, rotation_angle_deg, transform_points
from tests.frontend.start.synthetic_maps import CAMERA, Cloud, camera_map, cloud, poses, similarity

Array = npt.NDArray[np.float64]
K = CAMERA.intrinsics
CONFIG = PlacementConfig(samples=8000)
WORLD_A = similarity(1.0, (0.0, 0.1, 0.0), (0.1, 0.0, 0.05))
WORLD_B = similarity(1.6, (0.2, -0.3, 0.1), (0.4, -0.2, 0.3))
TRUTH = WORLD_A.compose(WORLD_B.inverse())


def two_maps(scene: Cloud) -> tuple[CameraMap, CameraMap]:
    return (
        camera_map(0, scene, poses((0.0, 0.0, 0.0), 5), WORLD_A, noise_px=0.4),
        camera_map(1, scene, poses((0.3, 0.05, -0.05), 5, turn_deg=-12.0), WORLD_B, noise_px=0.4),
    )


def matches_between(map_a: CameraMap, map_b: CameraMap, rows: npt.NDArray[np.int64]) -> PointMatches:
    """Each pair of rows matched once, in the first frames that see the two points."""

    def seen(camera: CameraMap, points: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        pixels, cTm = [], []
        for point in points:
            frame = next(f for f, own in enumerate(camera.point_of_keypoint) if point in own)
            pixels.append(camera.features[frame].pixels[camera.point_of_keypoint[frame] == point][0])
            cTm.append(invert_pose(camera.mTc[frame]))
        return np.array(cTm), np.array(pixels)

    (aTm, pixel_a), (bTm, pixel_b) = seen(map_a, rows[:, 0]), seen(map_b, rows[:, 1])
    point_a, point_b = map_a.points[rows[:, 0]], map_b.points[rows[:, 1]]
    return PointMatches(rows, point_a, point_b, aTm, bTm, pixel_a, pixel_b, np.ones(len(rows)))


def visible(*maps: CameraMap) -> npt.NDArray[np.int64]:
    seen = [np.unique(np.concatenate(one.point_of_keypoint)) for one in maps]
    return seen[0] if len(seen) == 1 else np.intersect1d(seen[0], seen[1])


def assert_precise(
    found: Similarity, scale: float = 0.01, angle_deg: float = 0.3, shift: float = 0.01
) -> None:
    assert found.scale == pytest.approx(TRUTH.scale, rel=scale)
    assert rotation_angle_deg(found.rotation.T @ TRUTH.rotation) < angle_deg
    assert np.linalg.norm(found.translation - TRUTH.translation) < shift


@pytest.mark.parametrize("wrong", [0.6, 0.75, 0.9])
def test_the_truth_is_found_among_wrong_matches_and_refined(wrong: float) -> None:
    random = np.random.default_rng(int(100 * wrong))
    map_a, map_b = two_maps(cloud(400))
    common = visible(map_a, map_b)
    right = random.choice(common, 60, replace=False)
    count = round(60 * wrong / (1.0 - wrong))
    others = np.column_stack([random.choice(visible(map_a), count), random.choice(visible(map_b), count)])
    others = others[others[:, 0] != others[:, 1]]
    rows = np.concatenate([np.column_stack([right, right]), others])
    matches = matches_between(map_a, map_b, rows)
    best = propose_placements(matches, K, K, CONFIG)[0]
    assert_precise(best.aSb)
    assert best.inliers >= 57
    agreeing = agreeing_pairs(matches, best.aSb, K, K, CONFIG)
    assert (agreeing[:, 0] == agreeing[:, 1]).sum() >= 57
    assert (agreeing[:, 0] == agreeing[:, 1]).mean() > 0.9


def repeated_patch(
    map_a: CameraMap, map_b: CameraMap, random: np.random.Generator
) -> tuple[PointMatches, Similarity]:
    """120 matches, each with three votes, of a small flat patch with its look-alike elsewhere."""
    offset = np.array([-0.35, 0.1, 0.05])  # from the patch that b sees to the one that a sees
    w_patch_b = np.array([0.3, 0.0, 1.05]) + random.uniform(-0.08, 0.08, (120, 3)) * [1.0, 1.0, 0.05]
    point_a = WORLD_A.transform_points(w_patch_b + offset)
    point_b = WORLD_B.transform_points(w_patch_b)
    aTm, bTm = invert_pose(map_a.mTc[0]), invert_pose(map_b.mTc[0])
    rows = 1000 + np.column_stack([np.arange(120), np.arange(120)])
    pixel_a, _ = project(transform_points(aTm, point_a), K)
    pixel_b, _ = project(transform_points(bTm, point_b), K)
    assert np.isfinite(pixel_a).all() and np.isfinite(pixel_b).all()
    false = WORLD_A.compose(Similarity(1.0, np.eye(3), offset)).compose(WORLD_B.inverse())
    tile = np.tile(aTm, (120, 1, 1)), np.tile(bTm, (120, 1, 1))
    return PointMatches(rows, point_a, point_b, *tile, pixel_a, pixel_b, np.full(120, 3.0)), false


def joined(first: PointMatches, second: PointMatches) -> PointMatches:
    return PointMatches(
        *(np.concatenate([a, b]) for a, b in zip(vars(first).values(), vars(second).values(), strict=True))
    )


def test_a_repeated_texture_that_outvotes_the_truth_does_not_outrank_it() -> None:
    random = np.random.default_rng(1)
    map_a, map_b = two_maps(cloud(400))
    right = random.choice(visible(map_a, map_b), 60, replace=False)
    wrong = np.column_stack([random.choice(visible(map_a), 60), random.choice(visible(map_b), 60)])
    true = matches_between(map_a, map_b, np.concatenate([np.column_stack([right, right]), wrong]))
    patch, false = repeated_patch(map_a, map_b, random)
    found = propose_placements(joined(true, patch), K, K, CONFIG)
    assert_precise(found[0].aSb)
    repeated = [h for h in found if same_placement(h.aSb, false)]
    assert repeated and repeated[0].inliers > found[0].inliers  # it has the count, not the coverage
    assert repeated[0].support < found[0].support


def test_hypotheses_are_distinct_sorted_few_and_repeat_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(2)
    map_a, map_b = two_maps(cloud(400))
    rows = np.column_stack([random.choice(visible(map_a), 150), random.choice(visible(map_b), 150)])
    matches = matches_between(map_a, map_b, rows)
    config = replace(CONFIG, samples=4000, hypotheses=5)
    runs = []
    for threads in ("1", "4"):  # one after the other, and side by side
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        runs.append(propose_placements(matches, K, K, config))
    found, again = runs
    assert 1 <= len(found) <= 5
    assert [h.support for h in found] == sorted((h.support for h in found), reverse=True)
    assert not any(same_placement(a.aSb, b.aSb) for a in found for b in found if a is not b)
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.aSb.matrix(), other.aSb.matrix())


def test_too_few_matches_give_no_hypothesis() -> None:
    map_a, map_b = two_maps(cloud(400))
    rows = np.column_stack([visible(map_a, map_b)[:3]] * 2)
    assert propose_placements(matches_between(map_a, map_b, rows), K, K, CONFIG) == []


def test_maps_without_a_common_point_match_nothing() -> None:
    map_a = two_maps(cloud(60))[0]
    map_b = two_maps(Cloud(cloud(60).points, cloud(60, seed=5).descriptors))[1]
    matches = match_maps(map_a, map_b, replace(CONFIG, match_ratio=0.6))
    assert len(matches) == 0
    assert propose_placements(matches, K, K, CONFIG) == []
    assert agreeing_pairs(matches, TRUTH, K, K, CONFIG).shape == (0, 2)


def test_maps_are_matched_over_all_frames_by_their_points() -> None:
    scene = cloud(200)
    map_a, map_b = two_maps(scene)
    # The first 50 points were seen by b but never triangulated.
    unknown = tuple(np.where(rows < 50, -1, rows) for rows in map_b.point_of_keypoint)
    matches = match_maps(map_a, replace(map_b, point_of_keypoint=unknown), CONFIG)
    common = visible(map_a, map_b)
    assert set(map(tuple, matches.rows)) == {(row, row) for row in common[common >= 50]}
    assert matches.votes.max() == 25  # five frames each, every pair of them
    in_a, _ = project(transform_points(matches.aTm[0], matches.point_a[:1]), K)
    np.testing.assert_allclose(in_a[0], matches.pixel_a[0], atol=2.0)
    errors = agreeing_pairs(matches, TRUTH, K, K, CONFIG)
    assert len(errors) == len(matches)


def test_agreeing_pairs_leaves_out_what_the_placement_does_not_explain() -> None:
    map_a, map_b = two_maps(cloud(300))
    common = visible(map_a, map_b)
    rows = np.column_stack([common, common])
    rows[::3, 1] = np.roll(rows[::3, 1], 1)
    agreeing = agreeing_pairs(matches_between(map_a, map_b, rows), TRUTH, K, K, CONFIG)
    assert (agreeing[:, 0] == agreeing[:, 1]).mean() > 0.97
    assert len(agreeing) >= (rows[:, 0] == rows[:, 1]).sum()


def umeyama(points_a: Array, points_b: Array) -> tuple[float, Array, Array]:
    """The paper's formulas, one sample, no shortcuts (Umeyama 1991, equations 34 to 43)."""
    mean_a, mean_b = points_a.mean(0), points_b.mean(0)
    variance_b = ((points_b - mean_b) ** 2).sum(1).mean()
    covariance = (points_a - mean_a).T @ (points_b - mean_b) / len(points_a)
    left, singular, right = np.linalg.svd(covariance)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ sign @ right
    scale = float(np.trace(np.diag(singular) @ sign) / variance_b)
    return scale, rotation, mean_a - scale * rotation @ mean_b


@given(seed=st.integers(0, 10**6), noise=st.floats(0.0, 0.02))
def test_three_points_fit_as_umeyama_says(seed: int, noise: float) -> None:
    random = np.random.default_rng(seed)
    points_b = random.normal(size=(4, 3, 3))
    rotation = Rotation.random(4, rng=random).as_matrix()
    points_a = 1.7 * points_b @ np.swapaxes(rotation, 1, 2) + random.normal(size=(4, 1, 3))
    points_a += noise * random.normal(size=points_a.shape)
    scale, rotation, translation = _fit_three(points_a, points_b)
    for row in np.flatnonzero(scale > 0.0):
        expected = umeyama(points_a[row], points_b[row])
        assert scale[row] == pytest.approx(expected[0])
        np.testing.assert_allclose(rotation[row], expected[1], atol=1e-6)
        np.testing.assert_allclose(translation[row], expected[2], atol=1e-6)
    if noise == 0.0:
        np.testing.assert_allclose(scale, 1.7, rtol=1e-9)


def test_three_points_of_another_shape_or_all_one_do_not_fit() -> None:
    triangle = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    needle = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.1, 0.05, 1.0]])
    one = np.ones((3, 3))
    scale, _, _ = _fit_three(np.stack([triangle, triangle, one]), np.stack([triangle, needle, one]))
    assert scale[0] == pytest.approx(1.0)
    assert scale[1] == scale[2] == 0.0


@pytest.mark.parametrize(
    ("change", "same"),
    [
        (similarity(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), True),
        (similarity(1.05, (0.0, 0.05, 0.0), (0.05, 0.0, 0.0)), True),
        (similarity(1.15, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), False),
        (similarity(1.0, (0.0, 0.08, 0.0), (0.0, 0.0, 0.0)), False),
        (similarity(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.12)), False),
    ],
)
def test_same_placement(change: Similarity, same: bool) -> None:
    base = similarity(1.0, (0.1, 0.2, 0.3), (0.0, 0.0, 0.0))
    assert same_placement(change.compose(base), base) is same
    assert same_placement(base, change.compose(base)) is same


@pytest.mark.parametrize("values", [{"match_ratio": 0.0}, {"samples": 0}, {"inlier_px": 0.0}, {"cell": -1.0}])
def test_nonsense_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="frontend.placement"):
        PlacementConfig(**values)  # type: ignore[arg-type]
