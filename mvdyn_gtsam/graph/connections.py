"""The spatio-temporal connection graph: which frames are connected, of which kind, and the edge budget.

Pure bookkeeping after the paper's "Spatio-temporal connection graph" and "connection balance" paragraphs: a
frame is ``(camera, time)``, a connection joins two frames and stands for flow measured in both directions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

Frame = tuple[int, int]
"""``(camera, time)``"""


class EdgeKind(StrEnum):
    """The three kinds of the paper, and the long-range ones of the polish."""

    TEMPORAL = "temporal"
    """Same camera, a few keyframes apart."""
    SPATIAL = "spatial"
    """Same instant, other camera, most of the view shared."""
    SPATIO_TEMPORAL = "spatio_temporal"
    """Other camera at another time, or at the same instant with less of the view shared."""
    LONG_RANGE = "long_range"
    """Same camera, far apart in time; against drift."""


@dataclass(frozen=True)
class Edge:
    """A connection of two keyframes; ``i`` is the one that was new when it was made."""

    i: Frame
    j: Frame
    kind: EdgeKind

    @property
    def pair(self) -> tuple[int, int]:
        """The two cameras, ascending."""
        a, b = self.i[0], self.j[0]
        return (a, b) if a <= b else (b, a)

    @property
    def frames(self) -> frozenset[Frame]:
        """Both ends; two connections of the same frames are the same measurement."""
        return frozenset((self.i, self.j))


@dataclass(frozen=True)
class EdgeCounts:
    """Active connections after a time step (the paper's edge-count figure)."""

    time: int
    temporal: int
    spatial: int
    spatio_temporal: int
    inactive: int
    """Connections that left the active window so far; they keep their measurement."""


def balance(
    active: Iterable[Edge], new: Iterable[Edge], budget: int
) -> tuple[tuple[Edge, ...], tuple[Edge, ...]]:
    """``(kept, removed)`` of the inter-camera connections, at most ``budget`` kept.

    The budget is shared evenly over the camera pairs that have connections; what a pair does not use goes
    to the others. Within a pair the oldest are removed first, age being the time of the frame that was new.
    """
    by_pair: dict[tuple[int, int], list[Edge]] = {}
    for edge in (*active, *new):
        by_pair.setdefault(edge.pair, []).append(edge)
    quota = _even_shares({pair: len(edges) for pair, edges in by_pair.items()}, budget)
    kept: list[Edge] = []
    removed: list[Edge] = []
    for pair in sorted(by_pair):
        # stable: among equally old ones those added first go first
        edges = sorted(by_pair[pair], key=lambda edge: edge.i[1])
        surplus = len(edges) - quota[pair]
        removed += edges[:surplus]
        kept += edges[surplus:]
    return tuple(kept), tuple(removed)


def _even_shares(wanted: dict[tuple[int, int], int], budget: int) -> dict[tuple[int, int], int]:
    """Max-min fair shares of ``budget``; a remainder goes to the first pairs."""
    shares: dict[tuple[int, int], int] = {}
    left = budget
    for position, pair in enumerate(sorted(wanted, key=lambda pair: (wanted[pair], pair))):
        remaining_pairs = len(wanted) - position
        shares[pair] = min(wanted[pair], -(-left // remaining_pairs))
        left -= shares[pair]
    return shares


class ConnectionGraph:
    """Active and inactive connections of one tracker, and their counts over time."""

    def __init__(self, max_active_edges: int) -> None:
        self._budget = max_active_edges
        self._temporal: list[Edge] = []
        self._inter_camera: tuple[Edge, ...] = ()
        self._inactive: list[Edge] = []
        self._known: set[frozenset[Frame]] = set()
        self._counts: list[EdgeCounts] = []

    @property
    def active(self) -> tuple[Edge, ...]:
        """Connections of the active window."""
        return (*self._temporal, *self._inter_camera)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All connections ever made, the inactive ones first."""
        return (*self._inactive, *self.active)

    @property
    def counts(self) -> tuple[EdgeCounts, ...]:
        """One entry per recorded time step."""
        return tuple(self._counts)

    def connected(self, a: Frame, b: Frame) -> bool:
        """Whether the two frames ever got a connection."""
        return frozenset((a, b)) in self._known

    def add(self, new: Iterable[Edge]) -> tuple[Edge, ...]:
        """Add connections that do not exist yet; returns those that had to leave the active window.

        Temporal connections are bounded by the window; the budget is for the inter-camera ones.
        """
        fresh: list[Edge] = []
        for edge in new:
            if edge.frames not in self._known:
                self._known.add(edge.frames)
                fresh.append(edge)
        self._temporal += [edge for edge in fresh if edge.i[0] == edge.j[0]]
        inter_camera = [edge for edge in fresh if edge.i[0] != edge.j[0]]
        self._inter_camera, removed = balance(self._inter_camera, inter_camera, self._budget)
        self._inactive += removed
        return removed

    def leave_window(self, oldest: dict[int, int]) -> tuple[Edge, ...]:
        """Make inactive what was new before ``oldest[camera]``, the first time of each camera's window."""

        def inside(edge: Edge) -> bool:
            return edge.i[1] >= oldest.get(edge.i[0], 0)

        removed = tuple(edge for edge in self.active if not inside(edge))
        self._temporal = [edge for edge in self._temporal if inside(edge)]
        self._inter_camera = tuple(edge for edge in self._inter_camera if inside(edge))
        self._inactive += removed
        return removed

    def record(self, time: int) -> EdgeCounts:
        """Count the connections at the end of a time step."""
        kinds = Counter(edge.kind for edge in self.active)
        counts = EdgeCounts(
            time,
            kinds[EdgeKind.TEMPORAL],
            kinds[EdgeKind.SPATIAL],
            kinds[EdgeKind.SPATIO_TEMPORAL],
            len(self._inactive),
        )
        self._counts.append(counts)
        return counts
