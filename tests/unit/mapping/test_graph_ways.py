"""Shortest ways through a graph, against sums tried out edge by edge and against scipy's."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from mapping.kernels.graph_ways import lengths_from

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def slowly(start: int, begin: I64, end: I64, length: F64, count: int) -> list[float]:
    """Bellman and Ford: every edge again and again, until nothing becomes shorter."""
    way = [math.inf] * count
    way[start] = 0.0
    for _ in range(count):
        for a, b, step in zip(begin.tolist(), end.tolist(), length.tolist()):
            way[b] = min(way[b], way[a] + step)
            way[a] = min(way[a], way[b] + step)
    return way


@given(st.integers(1, 12), st.data())
@settings(max_examples=150, deadline=None)
def test_each_way_is_the_shortest_there_is(count: int, data: st.DataObject) -> None:
    node = st.integers(0, count - 1)
    edges = data.draw(st.lists(st.tuples(node, node, st.floats(0.0, 10.0)), max_size=30))
    begin, end = (np.array([edge[k] for edge in edges], dtype=np.int64) for k in range(2))
    length = np.array([edge[2] for edge in edges], dtype=np.float64)
    found = lengths_from(np.arange(count), begin, end, length, count)
    assert found.tolist() == [slowly(start, begin, end, length, count) for start in range(count)]


def test_a_long_way_with_shortcuts_is_what_scipy_finds_to_the_last_bit() -> None:
    rng = np.random.default_rng(7)
    count = 2000
    begin = np.concatenate((np.arange(count - 1), rng.choice(count - 200, 300, replace=False)))
    end = np.concatenate((np.arange(1, count), begin[count - 1 :] + 150))
    length = rng.uniform(0.01, 1.0, len(begin))
    starts = np.array([0, 777, count - 1])
    graph = csr_matrix((length, (begin, end)), shape=(count, count))
    np.testing.assert_array_equal(
        lengths_from(starts, begin, end, length, count), dijkstra(graph, directed=False, indices=starts)
    )


def test_what_no_edge_leads_to_is_infinitely_far() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert lengths_from(np.array([1]), none, none, np.zeros(0), 3).tolist() == [[math.inf, 0.0, math.inf]]
