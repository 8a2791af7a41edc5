"""Predicted overlap and the choice of whom to connect."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.geometry import pixel_rays
from mvdyn_gtsam.graph.selection import Overlap, View, choose_spread, edge_score, predicted_overlap

WIDTH, HEIGHT, STRIDE, FOCAL = 160, 120, 10, 150.0
K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
INTRINSICS = np.array([FOCAL, FOCAL, K[0, 2], K[1, 2]])
SHAPE = (HEIGHT // STRIDE, WIDTH // STRIDE)
ORIGIN = (5.0, 5.0)


def wall_points(depth: float) -> np.ndarray:
    x, y = np.meshgrid(ORIGIN[0] + STRIDE * np.arange(SHAPE[1]), ORIGIN[1] + STRIDE * np.arange(SHAPE[0]))
    return pixel_rays(np.stack([x, y], -1).reshape(-1, 2), K) * depth


def view(
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
    depth: float = 4.0,
    wRc: np.ndarray | None = None,
) -> View:
    wTc = np.eye(4)
    wTc[:3, 3] = translation
    if wRc is not None:
        wTc[:3, :3] = wRc
    return View(wTc, INTRINSICS, (WIDTH, HEIGHT), np.full(SHAPE, depth), ORIGIN, STRIDE)


def overlap_with(*views: View, depth: float = 4.0) -> Overlap:
    return predicted_overlap(wall_points(depth), np.zeros(3), views, occlusion_tolerance=0.1)


def overlap_one_by_one(points: np.ndarray, centre: np.ndarray, views: list[View]) -> Overlap:
    """``predicted_overlap`` as it reads in prose."""
    inside, visible, parallax = (np.zeros(len(views)) for _ in range(3))
    for index, one in enumerate(views):
        in_view = (points - one.wTc[:3, 3]) @ one.wTc[:3, :3]
        angles = []
        for point, (px, py, z) in zip(points, in_view, strict=True):
            if z <= 0:
                continue
            x, y = one.intrinsics[:2] * (px, py) / z + one.intrinsics[2:]
            if not (0 <= x <= one.size[0] - 1 and 0 <= y <= one.size[1] - 1):
                continue
            inside[index] += 1 / len(points)
            row = min(max(round((y - one.origin[1]) / one.stride), 0), one.depth.shape[0] - 1)
            col = min(max(round((x - one.origin[0]) / one.stride), 0), one.depth.shape[1] - 1)
            visible[index] += (abs(np.log(z / one.depth[row, col])) < 0.1) / len(points)
            first, second = point - centre, point - one.wTc[:3, 3]
            cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
            angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        parallax[index] = np.median(angles) if angles else np.nan
    return Overlap(inside, visible, parallax)


@given(st.integers(0, 2**32 - 1))
def test_all_candidates_at_once_are_each_as_alone(seed: int) -> None:
    random = np.random.default_rng(seed)
    views = []
    for _ in range(4):
        wRc = Rotation.from_rotvec(random.normal(0, 0.5, 3)).as_matrix()
        one = view(tuple(random.normal(0, 1, 3)), wRc=wRc)
        depth = random.uniform(2.0, 6.0, (SHAPE[0] + random.integers(3), SHAPE[1]))
        depth[random.random(depth.shape) < 0.1] = np.nan
        views.append(replace(one, depth=depth, size=(int(random.integers(80, 200)), HEIGHT)))
    views.append(view(wRc=np.diag([-1.0, 1.0, -1.0])))
    points = wall_points(4.0)[:: 1 + int(random.integers(3))] * random.uniform(0.5, 2.0)
    found = predicted_overlap(points, np.zeros(3), views, occlusion_tolerance=0.1)
    expected = overlap_one_by_one(points, np.zeros(3), views)
    np.testing.assert_allclose(found.inside, expected.inside, atol=1e-12)
    np.testing.assert_allclose(found.visible, expected.visible, atol=1e-12)
    np.testing.assert_allclose(found.parallax_deg, expected.parallax_deg, atol=1e-6)


def test_without_candidates_there_is_no_overlap() -> None:
    assert len(overlap_with().inside) == 0


def test_the_same_view_sees_everything_without_parallax() -> None:
    overlap = overlap_with(view())
    assert overlap.inside[0] == overlap.visible[0] == 1.0
    assert overlap.parallax_deg[0] == pytest.approx(0.0, abs=1e-5)


def test_a_shift_by_a_quarter_of_the_view_leaves_three_quarters() -> None:
    shift = 0.25 * WIDTH * 4.0 / FOCAL
    overlap = overlap_with(view((shift, 0, 0)))
    assert overlap.inside[0] == pytest.approx(0.75, abs=1.0 / SHAPE[1])
    assert overlap.parallax_deg[0] == pytest.approx(np.degrees(np.arctan2(shift, 4.0)), rel=0.15)


def test_points_hidden_behind_something_are_inside_but_not_visible() -> None:
    overlap = overlap_with(view(depth=2.0))
    assert overlap.inside[0] == 1.0
    assert overlap.visible[0] == 0.0


def test_points_behind_the_camera_are_outside() -> None:
    turned = np.diag([-1.0, 1.0, -1.0])
    overlap = overlap_with(view(wRc=turned))
    assert overlap.inside[0] == 0.0
    assert edge_score(overlap, 0.0, 60.0)[0] == 0.0


def test_score_needs_the_minimum_and_fades_with_the_angle() -> None:
    overlap = Overlap(np.ones(4), np.array([0.1, 0.5, 0.5, 0.5]), np.array([0.0, 0.0, 30.0, 60.0]))
    score = edge_score(overlap, minimum=0.2, max_parallax_deg=60.0)
    assert score[0] == 0.0
    assert score[1] == 0.5
    assert score[1] > score[2] > score[3] == pytest.approx(0.0, abs=1e-12)


def test_choice_takes_the_best_and_keeps_them_apart() -> None:
    times = np.arange(20)
    score = np.where(times == 10, 1.0, 0.5 - 0.01 * abs(times - 10))
    assert [int(times[k]) for k in choose_spread(score, times, separation=4, count=3)] == [10, 14, 6]


def test_choice_keeps_away_from_what_is_taken_and_skips_what_scores_nothing() -> None:
    times = np.arange(10)
    score = np.where(times >= 8, 1.0, 0.0)
    assert choose_spread(score, times, separation=3, count=5, taken=[9]) == []
    assert choose_spread(score, times, separation=3, count=5) == [9]


@given(
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 50)), min_size=1, max_size=40),
    st.integers(1, 8),
    st.integers(0, 6),
)
def test_choice_is_spread_and_maximal(raw: list[tuple[float, int]], separation: int, count: int) -> None:
    score, times = np.array([s for s, _ in raw]), np.array([t for _, t in raw])
    chosen = choose_spread(score, times, separation, count)
    assert len(chosen) <= count
    for a in chosen:
        assert score[a] > 0
        assert all(a == b or abs(times[a] - times[b]) >= separation for b in chosen)
    if len(chosen) < count:  # then every other candidate is too close to a chosen one
        for k in np.flatnonzero(score > 0):
            assert any(abs(times[k] - times[c]) < separation for c in chosen)
