"""From verified links to groups of cameras."""

from __future__ import annotations

import numpy as np
import pytest

from mvdyn_gtsam.frontend.start.groups import Placement, balance, connect
from mvdyn_gtsam.frontend.start.verification import Verdict
from mvdyn_gtsam.geometry import Similarity
from tests.frontend.start.synthetic_maps import similarity

STRONG, WEAK = Verdict(5.0, 0.1, 10), Verdict(3.0, 2.5, 10)
WORLD = {  # the world in each camera's map
    0: similarity(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    1: similarity(2.0, (0.0, 0.4, 0.0), (1.0, 0.0, 0.0)),
    2: similarity(0.5, (0.2, 0.0, 0.1), (0.0, 1.0, 0.3)),
    3: similarity(1.5, (0.0, -0.3, 0.2), (0.4, 0.0, 2.0)),
}


def link(first: int, second: int, verdict: Verdict = STRONG, error: Similarity | None = None) -> Placement:
    aSb = WORLD[first].compose(WORLD[second].inverse())
    return Placement(first, second, aSb if error is None else error.compose(aSb), verdict)


def assert_true(group: dict[int, Similarity]) -> None:
    """Every map where it truly stands in the map of the group's lowest camera."""
    for camera, wSm in group.items():
        expected = WORLD[min(group)].compose(WORLD[camera].inverse())
        np.testing.assert_allclose(wSm.matrix(), expected.matrix(), atol=1e-12)


@pytest.mark.parametrize(
    "links",
    [[(0, 1), (1, 2), (2, 3)], [(2, 3), (0, 1), (1, 3)], [(1, 3), (2, 3), (0, 3)]],
    ids=["chain", "two pairs joined", "star around the last"],
)
def test_links_join_all_in_the_world_of_the_lowest(links: list[tuple[int, int]]) -> None:
    groups = connect([0, 1, 2, 3], [link(*pair) for pair in links])
    assert [sorted(group) for group in groups] == [[0, 1, 2, 3]]
    assert_true(groups[0])
    np.testing.assert_array_equal(groups[0][0].matrix(), np.eye(4))


def test_unlinked_cameras_stay_apart() -> None:
    groups = connect([0, 1, 2, 3], [link(1, 3)])
    assert [sorted(group) for group in groups] == [[0], [1, 3], [2]]
    for group in groups:
        assert_true(group)
    assert [sorted(group) for group in connect([2, 3], [])] == [[2], [3]]
    assert connect([], []) == []


def test_a_weak_link_that_contradicts_strong_ones_loses() -> None:
    wrong = similarity(1.0, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    links = [link(0, 2, WEAK, wrong), link(0, 1), link(1, 2)]
    for order in (links, links[::-1]):
        (group,) = connect([0, 1, 2], order)
        assert_true(group)


def test_a_repeated_texture_that_satisfies_one_pair_loses_against_what_all_pairs_say() -> None:
    wrong = similarity(1.0, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    favour = {(0, 1): 2.0, (1, 2): 0.5, (0, 2): 1.0}
    links = [link(0, 1, Verdict(2.0, 0.0, 4)), link(1, 2, WEAK), link(0, 2, Verdict(1.2, 0.0, 4), wrong)]

    def judge(a: int, b: int, aSb: Similarity) -> float:
        a, b, aSb = (a, b, aSb) if a < b else (b, a, aSb.inverse())
        true = WORLD[a].compose(WORLD[b].inverse())
        if np.allclose(aSb.matrix(), true.matrix(), atol=1e-9):
            return favour[a, b]
        return 1.2 if (a, b) == (0, 2) else -3.0  # the shifted texture suits 0 and 2 better than the truth

    (group,) = connect([0, 1, 2], links, judge)
    assert_true(group)
    # Without the third camera's word it wins.
    (misled,) = connect([0, 2], [link(0, 2, Verdict(1.0, 0.0, 4)), links[2]], judge)
    assert not np.allclose(misled[2].matrix(), group[2].matrix())


def test_a_link_with_more_against_it_than_for_it_joins_nothing() -> None:
    against = Verdict(1.0, 1.1, 4)
    groups = connect([0, 1], [link(0, 1, against)], lambda a, b, aSb: 1.0)
    assert [sorted(group) for group in groups] == [[0], [1]]
    # The third camera's word counts as well.
    links = [link(0, 1), link(1, 2, WEAK)]
    groups = connect([0, 1, 2], links, lambda a, b, aSb: -1.0)
    assert [sorted(group) for group in groups] == [[0, 1], [2]]


def test_balance_weighs_both_sides() -> None:
    assert balance(Verdict(2.0, 0.5, 4)) == 1.5
    assert balance(Verdict(1.0, 3.0, 4)) == -2.0
