"""Compiled loops of planning (S44): straight lines over open cells, and ways pulled taut.

    room          (R, C) uint8   0 where a way may not go, else how far it may go on from there without looking
    by_row        uint32         a bit for each cell, 1 where a way may go, in blocks of 16 rows of 32 columns, each of
                                 which is a line of the cache: of cell (r, c) bit c % 32 of [r // 16, c // 32, r % 16]
    by_col        uint32         the same with rows and columns exchanged

Lengths are in cells, a cell's centre is at whole numbers.

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

BLOCK_ROWS, BLOCK_COLS = 16, 32
_PULL_CELLS = 1.0  # how exactly the farthest place in sight is sought, at most
_PULL_GAIN = 0.1  # cells by which a way would become shorter, at most, if it were sought more exactly
_TOUCH = 1e-9  # a line through the corner of a cell does not cross it


@njit(cache=True, nogil=True)
def measure_room(squared: Any, need: float, room: Any) -> None:
    """room: (R, C) uint8 out, 0 where the distance is below `need`, else 1 + how many whole cells a way may go on from
    anywhere in the cell without looking."""
    need2 = need * need
    told = np.empty(1 << 16, dtype=np.uint8)
    for value in range(told.size):
        more = math.sqrt(value) - need - 1.4143
        told[value] = 0 if value < need2 else min(1 + max(int(more), 0), 255)
    rows, cols = squared.shape
    for r in range(rows):
        for c in range(cols):
            room[r, c] = told[min(squared[r, c], told.size - 1)]


@njit(cache=True, nogil=True)
def pack_open(room: Any, by_row: Any) -> None:
    """by_row: out, of a table of room, or of its transpose for by_col."""
    rows, cols = room.shape
    by_row[:] = 0
    for r in range(rows):
        for block in range(by_row.shape[1]):
            word = 0
            for k in range(min(BLOCK_COLS, cols - block * BLOCK_COLS)):
                word |= int(room[r, block * BLOCK_COLS + k] > 0) << k
            by_row[r >> 4, block, r & 15] = word


@njit(cache=True, nogil=True)
def run_is_open(bits: Any, r: int, begin: float, end: float) -> bool:
    """Whether the cells of row r from the one that column `begin` lies in to that of `end` are all open."""
    first, last = int(min(begin, end) + 0.5), int(max(begin, end) + 0.5)
    a, b = first >> 5, last >> 5
    above, row = r >> 4, r & 15
    from_first, to_last = -(1 << (first & 31)), (2 << (last & 31)) - 1
    if a == b:
        mask = from_first & to_last
        return bool((np.int64(bits[above, a, row]) & mask) == mask)
    mask = from_first & 0xFFFFFFFF
    if (np.int64(bits[above, a, row]) & mask) != mask or (np.int64(bits[above, b, row]) & to_last) != to_last:
        return False
    k = a + 1
    while k < b and np.int64(bits[above, k, row]) == 0xFFFFFFFF:
        k += 1
    return k == b


@njit(cache=True, nogil=True)
def runs_are_open(bits: Any, r0: float, c0: float, r1: float, c1: float) -> bool:
    """sees_open for a line that goes at least as far along columns as along rows, row by row."""
    if r0 > r1:
        r0, c0, r1, c1 = r1, c1, r0, c0
    first, last = int(r0 + 0.5), int(r1 + 0.5)
    per_row = (c1 - c0) / (r1 - r0) if last > first else 0.0
    on = _TOUCH if c1 >= c0 else -_TOUCH
    here = c0
    for r in range(first, last):
        there = min(max(c0 + (r + 0.5 - r0) * per_row, min(c0, c1)), max(c0, c1))
        if not run_is_open(bits, r, here, there - on):
            return False
        here = there + on
    return run_is_open(bits, last, here, c1)


@njit(cache=True, nogil=True)
def sees_open(by_row: Any, by_col: Any, r0: float, c0: float, r1: float, c1: float) -> bool:
    """Whether all cells that the straight line between two points crosses are open; both lie within the grid. A point
    on a border of cells lies in the one with more rows or columns before it, as everywhere here."""
    if abs(r1 - r0) > abs(c1 - c0):
        return runs_are_open(by_col, c0, r0, c1, r1)
    return runs_are_open(by_row, r0, c0, r1, c1)


@njit(cache=True, nogil=True)
def straighten(by_row: Any, by_col: Any, point: Any, n: int, out: Any) -> Any:
    """Leave out every point that is not needed: from each, on to the farthest that it sees, sought in doubling steps.

    point: (N, 2) float64, each seeing the next.  out: (N, 2) float64 out; returns how many points are left.
    """
    out[0] = point[0]
    m, i = 1, 0
    while i < n - 1:
        good, step = i + 1, 2
        while True:
            ahead = min(i + step, n - 1)
            if ahead <= good:
                break
            if not sees_open(by_row, by_col, point[i, 0], point[i, 1], point[ahead, 0], point[ahead, 1]):
                bad = ahead
                while bad - good > 1:
                    middle = (good + bad) >> 1
                    if sees_open(by_row, by_col, point[i, 0], point[i, 1], point[middle, 0], point[middle, 1]):
                        good = middle
                    else:
                        bad = middle
                break
            good = ahead
            step *= 2
        i = good
        out[m] = point[i]
        m += 1
    return m


@njit(cache=True, nogil=True)
def length_of(point: Any, n: int) -> float:
    """Of a way of n points."""
    total = 0.0
    for i in range(n - 1):
        total += math.hypot(point[i + 1, 0] - point[i, 0], point[i + 1, 1] - point[i, 1])
    return total


@njit(cache=True, nogil=True)
def pull(by_row: Any, by_col: Any, point: Any, n: int, out: Any) -> Any:
    """From each place straight on to the farthest of the way that it sees, on to the next corner and as far into the
    run behind it as can be; how many corners are left.

    point: (N, 2) float64, each seeing the next.  out: (M, 2) float64 out, as long as point.
    """
    out[0] = point[0]
    m, ahead = 1, 1
    r, c = point[0, 0], point[0, 1]
    while True:
        while ahead + 1 < n and sees_open(by_row, by_col, r, c, point[ahead + 1, 0], point[ahead + 1, 1]):
            ahead += 1
        r0, c0 = point[ahead, 0], point[ahead, 1]
        if ahead == n - 1:
            out[m, 0], out[m, 1] = r0, c0
            return m + 1
        dr, dc = point[ahead + 1, 0] - r0, point[ahead + 1, 1] - c0
        length = math.sqrt(dr * dr + dc * dc)
        seen, hidden = 0.0, 1.0
        to_r, to_c = r0 - r, c0 - c
        straight_on = (to_r * dr + to_c * dc) / max(math.sqrt(to_r * to_r + to_c * to_c) * length, 1e-9)
        exactly = max(_PULL_CELLS, _PULL_GAIN / max(1.0 - straight_on, 1e-9))
        while (hidden - seen) * length > exactly:
            middle = 0.5 * (seen + hidden)
            if sees_open(by_row, by_col, r, c, r0 + middle * dr, c0 + middle * dc):
                seen = middle
            else:
                hidden = middle
        r, c = r0 + seen * dr, c0 + seen * dc
        out[m, 0], out[m, 1] = r, c
        m += 1
        ahead += 1


@njit(cache=True, nogil=True)
def turned_round(point: Any, n: int) -> None:
    """The way backwards, in place."""
    for i in range(n // 2):
        for k in range(2):
            point[i, k], point[n - 1 - i, k] = point[n - 1 - i, k], point[i, k]


@njit(cache=True, nogil=True)
def pull_from_both_ends(by_row: Any, by_col: Any, point: Any, n: int, rounds: int, work: Any) -> Any:
    """Pull a way straight, from one end and then the other, `rounds` times each, until it gets no shorter; in place,
    and how many points it has.

    point, work: (M, 2) float64, M at least n.
    """
    before = length_of(point, n)
    for _ in range(rounds):
        turned_round(point, n)
        n = pull(by_row, by_col, point, n, work)
        turned_round(work, n)
        n = pull(by_row, by_col, work, n, point)
        now = length_of(point, n)
        if now > before * 0.999:
            break
        before = now
    return n


@njit(cache=True, nogil=True)
def taut(by_row: Any, by_col: Any, point: Any, n: int, rounds: int, work: Any) -> Any:
    """The same with a way of many points, most of which are left out first."""
    n = straighten(by_row, by_col, point, n, work)
    point[:n] = work[:n]
    return pull_from_both_ends(by_row, by_col, point, n, rounds, work)
