"""The connection graph's rules: kinds, budget, even shares, oldest first."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mvdyn_gtsam.graph.connections import ConnectionGraph, Edge, EdgeKind, Frame, balance


def edge(camera_i: int, time_i: int, camera_j: int, time_j: int) -> Edge:
    same = camera_i == camera_j
    return Edge(
        (camera_i, time_i), (camera_j, time_j), EdgeKind.TEMPORAL if same else EdgeKind.SPATIO_TEMPORAL
    )


def test_nothing_is_removed_within_the_budget() -> None:
    edges = [edge(0, t, 1, t) for t in range(5)]
    kept, removed = balance(edges[:3], edges[3:], budget=5)
    assert set(kept) == set(edges)
    assert removed == ()


def test_the_oldest_go_first() -> None:
    edges = [edge(0, t, 1, 0) for t in (4, 2, 7, 5)]
    kept, removed = balance(edges, [edge(0, 9, 1, 0)], budget=2)
    assert sorted(e.i[1] for e in kept) == [7, 9]
    assert [e.i[1] for e in removed] == [2, 4, 5]


def test_camera_pairs_share_the_budget_evenly() -> None:
    crowded = [edge(0, t, 1, 0) for t in range(30)]
    others = [edge(0, t, 2, 0) for t in range(10)] + [edge(1, t, 2, 0) for t in range(10)]
    kept, _ = balance(crowded, others, budget=12)
    assert Counter(e.pair for e in kept) == {(0, 1): 4, (0, 2): 4, (1, 2): 4}


def test_what_a_pair_does_not_use_goes_to_the_others() -> None:
    crowded = [edge(0, t, 1, 0) for t in range(30)]
    kept, _ = balance(crowded, [edge(0, 0, 2, 0)], budget=10)
    assert Counter(e.pair for e in kept) == {(0, 1): 9, (0, 2): 1}


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 40)), max_size=60),
    st.integers(1, 40),
)
def test_balance_keeps_as_much_as_fits_and_never_an_older_one_of_a_pair(
    raw: list[tuple[int, int, int]], budget: int
) -> None:
    edges = [edge(i, t, j, 0) for i, j, t in raw if i != j]
    kept, removed = balance(edges, [], budget)
    assert len(kept) == min(len(edges), budget)
    assert Counter(kept) + Counter(removed) == Counter(edges)
    for pair in {e.pair for e in edges}:
        ages_kept = [e.i[1] for e in kept if e.pair == pair]
        ages_removed = [e.i[1] for e in removed if e.pair == pair]
        assert not ages_removed or not ages_kept or max(ages_removed) <= min(ages_kept)
    shares = Counter(e.pair for e in kept)
    wanted = Counter(e.pair for e in edges)
    cut = [pair for pair in wanted if shares[pair] < wanted[pair]]
    # nobody who was cut has clearly less than anybody else
    assert all(shares[other] <= shares[pair] + 1 for pair in cut for other in wanted)


def test_a_connection_is_made_once_whichever_end_is_new() -> None:
    graph = ConnectionGraph(max_active_edges=10)
    graph.add([edge(0, 5, 1, 3)])
    graph.add([edge(1, 3, 0, 5)])
    assert len(graph.edges) == 1
    assert graph.connected((1, 3), (0, 5))
    assert not graph.connected((1, 3), (0, 6))


def test_removed_connections_stay_known() -> None:
    graph = ConnectionGraph(max_active_edges=2)
    removed = graph.add([edge(0, t, 1, t) for t in range(5)])
    assert [e.i[1] for e in removed] == [0, 1, 2]
    assert len(graph.active) == 2
    assert len(graph.edges) == 5
    assert graph.connected((0, 0), (1, 0))


def test_temporal_connections_do_not_use_the_budget() -> None:
    graph = ConnectionGraph(max_active_edges=1)
    graph.add([edge(0, t, 0, t - 1) for t in range(1, 6)] + [edge(0, 5, 1, 5)])
    counts = graph.record(5)
    assert (counts.temporal, counts.spatio_temporal, counts.inactive) == (5, 1, 0)


def test_leaving_the_window_is_counted() -> None:
    graph = ConnectionGraph(max_active_edges=10)
    graph.add([edge(0, t, 0, t - 1) for t in range(1, 6)])
    graph.add([Edge((0, 2), (1, 2), EdgeKind.SPATIAL), Edge((0, 5), (1, 5), EdgeKind.SPATIAL)])
    removed = graph.leave_window({0: 4})
    assert {e.i[1] for e in removed} == {1, 2, 3}
    counts = graph.record(5)
    assert (counts.temporal, counts.spatial, counts.inactive) == (2, 1, 4)
    assert graph.counts == (counts,)


@pytest.mark.parametrize("pair", [((0, 1), (1, 0)), ((2, 7), (0, 3))])
def test_pair_is_ascending_and_frames_unordered(pair: tuple[Frame, Frame]) -> None:
    a, b = pair
    forward, backward = (Edge(i, j, EdgeKind.SPATIO_TEMPORAL) for i, j in ((a, b), (b, a)))
    assert forward.pair == backward.pair == tuple(sorted((a[0], b[0])))
    assert forward.frames == backward.frames
