"""The refinement graph as bookkeeping."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.graph.connections import Frame
from mvdyn_gtsam.refinement.connections import Pair, is_first, neighbours_of, refinement_pairs

frames = st.tuples(st.integers(0, 3), st.integers(0, 6))
omegas = st.lists(st.tuples(frames, frames).filter(lambda pair: pair[0] != pair[1]), max_size=12)


def test_offsets_join_every_frame_of_a_camera_to_later_ones() -> None:
    pairs = refinement_pairs([], [(0,)], 5, (2, 4))
    assert pairs == (((0, 0), (0, 2)), ((0, 0), (0, 4)), ((0, 1), (0, 3)), ((0, 2), (0, 4)))


def test_cameras_of_a_group_meet_at_every_instant() -> None:
    pairs = refinement_pairs([], [(2, 0, 1)], 2, ())
    together = [((0, t), (1, t)) for t in range(2)]
    together += [((0, t), (2, t)) for t in range(2)] + [((1, t), (2, t)) for t in range(2)]
    assert set(pairs) == set(together) and len(pairs) == 6


def test_groups_are_never_connected() -> None:
    pairs = refinement_pairs([((0, 0), (1, 3))], [(0, 1), (2, 3)], 4, (1, 2))
    group = {0: "a", 1: "a", 2: "b", 3: "b"}
    assert all(group[i[0]] == group[j[0]] for i, j in pairs)
    # and the second is as connected within itself as the first
    assert ((2, 1), (3, 1)) in pairs and ((0, 0), (1, 3)) in pairs


@pytest.mark.parametrize("frame_count", [0, 1, 2])
def test_offsets_longer_than_the_video_are_left_out(frame_count: int) -> None:
    assert refinement_pairs([], [(0,)], frame_count, (2, 8)) == ()


@given(omegas, st.integers(1, 7))
def test_every_pair_once_earlier_frame_first_and_in_time_order(omega: list[Pair], count: int) -> None:
    pairs = refinement_pairs(omega, [(0, 1), (2,), (3,)], count, (2, 4))
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)
    assert {frozenset(pair) for pair in omega} <= {frozenset(pair) for pair in pairs}
    for i, j in pairs:
        assert i[1] < j[1] or (i[1] == j[1] and i[0] < j[0])
        assert is_first(i, j) and not is_first(j, i)
    times = [(i[1], j[1]) for i, j in pairs]
    assert times == sorted(times)


@given(omegas)
def test_the_order_of_omega_does_not_matter(omega: list[Pair]) -> None:
    turned = [(j, i) for i, j in reversed(omega)]
    assert refinement_pairs(omega, [(0,)], 4, (2,)) == refinement_pairs(turned, [(0,)], 4, (2,))


@given(omegas)
def test_neighbours_are_mutual(omega: list[Pair]) -> None:
    pairs = refinement_pairs(omega, [(0, 1)], 5, (2,))
    neighbours = neighbours_of(pairs)
    assert sum(map(len, neighbours.values())) == 2 * len(pairs)
    for frame, partners in neighbours.items():
        assert len(set(partners)) == len(partners) and frame not in partners
        assert all(frame in neighbours[partner] for partner in partners)


def test_neighbours_come_in_the_order_of_the_pairs() -> None:
    a, b, c, d = (0, 0), (0, 2), (1, 0), (0, 4)
    found: dict[Frame, tuple[Frame, ...]] = neighbours_of([(a, c), (a, b), (b, d)])
    assert found == {a: (c, b), c: (a,), b: (a, d), d: (b,)}
