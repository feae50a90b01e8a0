"""Shortest ways through a graph by Dijkstra's method, with a binary heap.

The same lengths, bit for bit, as any other implementation gives that adds up edges from the start: the least sum over
the last edge, of sums that are the least themselves.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def lengths_from(starts: Any, begin: Any, end: Any, length: Any, count: int) -> Any:
    """(K, N) length of the shortest way from each start (K,) to each of `count` nodes, inf where there is none.

    begin, end: (E,) nodes of edges that lead both ways, parallel ones allowed.  length: (E,), not negative.
    """
    first = np.zeros(count + 1, dtype=np.int64)
    for edge in range(len(begin)):
        first[begin[edge] + 1] += 1
        first[end[edge] + 1] += 1
    for node in range(count):
        first[node + 1] += first[node]
    room = first[:-1].copy()
    beside, step = np.empty(2 * len(begin), dtype=np.int64), np.empty(2 * len(begin))
    for edge in range(len(begin)):
        for here, there in ((begin[edge], end[edge]), (end[edge], begin[edge])):
            beside[room[here]], step[room[here]] = there, length[edge]
            room[here] += 1
    found = np.full((len(starts), count), math.inf)
    far, what = np.empty(2 * len(begin) + 1), np.empty(2 * len(begin) + 1, dtype=np.int64)
    for row in range(len(starts)):
        way = found[row]
        way[starts[row]] = 0.0
        waiting = push(far, what, 0, 0.0, starts[row])
        while waiting > 0:
            so_far, node = far[0], what[0]
            waiting = pop(far, what, waiting)
            if so_far > way[node]:
                continue  # it was reached on a shorter way since
            for k in range(first[node], first[node + 1]):
                longer = so_far + step[k]
                if longer < way[beside[k]]:
                    way[beside[k]] = longer
                    waiting = push(far, what, waiting, longer, beside[k])
    return found


@njit(cache=True, nogil=True)
def push(far: Any, what: Any, waiting: int, key: float, node: int) -> int:
    """Add to a heap of `waiting`, the least first; its new size."""
    at = waiting
    while at > 0 and far[(at - 1) >> 1] > key:
        far[at], what[at] = far[(at - 1) >> 1], what[(at - 1) >> 1]
        at = (at - 1) >> 1
    far[at], what[at] = key, node
    return waiting + 1


@njit(cache=True, nogil=True)
def pop(far: Any, what: Any, waiting: int) -> int:
    """Take the first away; the heap's new size."""
    last = waiting - 1
    key, node = far[last], what[last]
    at = 0
    while 2 * at + 1 < last:
        child = 2 * at + 1
        if child + 1 < last and far[child + 1] < far[child]:
            child += 1
        if far[child] >= key:
            break
        far[at], what[at] = far[child], what[child]
        at = child
    far[at], what[at] = key, node
    return last
