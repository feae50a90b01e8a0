"""Compiled loops of planning round corners (S44): the shortest way from place to place between two points.

What a search asks of a place lies side by side in one line of the cache, seen as numbers of four kinds:

    i16  (N, 32) int16     ROW, COL its cell; END 1 + which of the places around the goal it is, 0 else; COUNT of links
    i32  (N, 16) int32     STATE and VIA of the search; FIRST of its links
    f32  (N, 16) float32   BEST of the search
    mark (N, 32) uint16    from MARK on, the shortest way from each of MARKS landmarks in steps of `grain` cells,
                           FAR_MARK where there is none

    link (M,) int32        places that are joined, of each place in a row
    at, outward            of mapping.kernels.corners, in the order of tiles: place and outward
    tile (tiles + 1,)      of mapping.kernels.corners: first
    room, by_row, by_col   of mapping.kernels.sight

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.corners import ROUND, SECTORS, TILE, beyond, look_around, sector_of
from mapping.kernels.paths import _FAR_AWAY, describe, pop, push
from mapping.kernels.sight import pull_from_both_ends, sees_open

ROW, COL, END, COUNT = range(4)
STATE, VIA, FIRST, BEST = 2, 3, 4, 5
MARK, MARKS, ACTIVE = 12, 20, 8
FAR_MARK = 65535
NEAREST = 4  # places in sight that stand for what a point sees, with all that they are joined with
_AROUND = 16  # of the places around, the nearest, are looked for
_EAGER = 1.02  # what is still to go counts so much more: fewer places are looked at for a way of about the same length


@njit(cache=True, nogil=True)
def distances(source: int, first: Any, link: Any, cost: Any, best: Any, heap: Any, key: Any) -> None:
    """best: (N,) float32 out, shortest way from a place to each; huge where there is none.

    first: (N + 1,) of the links.  cost: (M,) float32 of each link.  heap, key: work, for all links and one more.
    """
    size = np.zeros(1, dtype=np.int64)
    best[:] = _FAR_AWAY
    best[source] = 0.0
    push(heap, key, size, 0.0, source)
    while size[0] > 0:
        here = key[0]
        n = pop(heap, key, size)
        if here > best[n]:
            continue
        for i in range(first[n], first[n + 1]):
            m = link[i]
            reached = here + cost[i]
            if reached < best[m]:
                best[m] = reached
                push(heap, key, size, float(best[m]), m)  # as rounded: it is compared with that


@njit(cache=True, nogil=True)
def needed_links(first: Any, link: Any, cost: Any, longer: float, kept: Any) -> None:
    """kept: (M,) bool out, whether a link is needed: two shorter ones over one place are not nearly as short.

    longer: how much longer than the link they may be. link (i, j) is kept if and only if (j, i) is.
    """
    away = np.full(first.size - 1, np.float32(_FAR_AWAY))
    for n in range(first.size - 1):
        for i in range(first[n], first[n + 1]):
            away[link[i]] = cost[i]
        for i in range(first[n], first[n + 1]):
            here = cost[i]
            kept[i] = True
            m = link[i]
            for j in range(first[m], first[m + 1]):
                first_part = away[link[j]]
                if first_part < here and cost[j] < here and first_part + cost[j] <= longer * here:
                    kept[i] = False
                    break
        for i in range(first[n], first[n + 1]):
            away[link[i]] = _FAR_AWAY


@njit(cache=True, nogil=True)
def nearest_in_sight(by_row: Any, by_col: Any, at: Any, tile: Any, across: int, r: float, c: float, which: Any) -> Any:
    """The NEAREST places in sight of the _AROUND nearest in the tiles around: how many. which: (NEAREST,) out."""
    down = (tile.size - 1) // across
    near, square = np.empty(_AROUND, dtype=np.int32), np.empty(_AROUND)
    n = 0
    tr, tc = int(r) // TILE, int(c) // TILE
    for a in range(max(tr - 1, 0), min(tr + 2, down)):
        begin = tile[a * across + max(tc - 1, 0)]
        end = tile[a * across + min(tc + 1, across - 1) + 1]
        for j in range(begin, end):
            dr, dc = at[j, 0] - r, at[j, 1] - c
            away = dr * dr + dc * dc
            if n == _AROUND:
                if away >= square[n - 1]:
                    continue
                n -= 1
            k = n
            while k > 0 and square[k - 1] > away:
                near[k], square[k] = near[k - 1], square[k - 1]
                k -= 1
            near[k], square[k] = j, away
            n += 1
    m = 0
    for k in range(n):
        j = near[k]
        if sees_open(by_row, by_col, r, c, float(at[j, 0]), float(at[j, 1])):
            which[m] = j
            m += 1
            if m == NEAREST:
                break
    return m


@njit(cache=True, nogil=True)
def places_around(
    room: Any, at: Any, outward: Any, tile: Any, across: int, step: float, r: float, c: float, which: Any
) -> Any:
    """Places that may be seen from a point and that a way from there may go round, as far as one sees: how many.

    step: of rays.  which: (M,) int32 out; what does not fit is left out.
    """
    n, down = 0, (tile.size - 1) // across
    span, box = np.empty(SECTORS), np.empty(4)
    look_around(room, r, c, 0.0, 0.0, step, span, box)
    left, right = max(int(box[2]) // TILE, 0), min(int(box[3]) // TILE, across - 1)
    for a in range(max(int(box[0]) // TILE, 0), min(int(box[1]) // TILE, down - 1) + 1):
        for b in range(left, right + 1):
            if tile[a * across + b] == tile[a * across + b + 1] or beyond(span, r, c, a, b):
                continue
            for j in range(tile[a * across + b], tile[a * across + b + 1]):
                dr, dc = at[j, 0] - r, at[j, 1] - c
                length = math.sqrt(dr * dr + dc * dc)
                if -dr * outward[j, 0] - dc * outward[j, 1] > ROUND * length:
                    continue
                if length <= span[sector_of(dr, dc)] and n < which.size:
                    which[n] = j
                    n += 1
    return n


@njit(cache=True, nogil=True)
def places_of(
    room: Any, by_row: Any, by_col: Any, i16: Any, i32: Any, link: Any, at: Any, outward: Any, tile: Any, across: int,
    step: float, r: float, c: float, which: Any, far: Any,
) -> Any:  # fmt: skip
    """Places that a way from or to a point may go to first: those in sight that are nearest and what these are joined
    with; where there are none, all around. How many. Not all are in sight.

    which: (M,) int32, far: (M,) float64, out: their numbers and how far they are.
    """
    near = np.empty(NEAREST, dtype=np.int32)
    m = nearest_in_sight(by_row, by_col, at, tile, across, r, c, near)
    n = 0
    if m == 0:
        n = places_around(room, at, outward, tile, across, step, r, c, which)
    for k in range(m):
        begin = i32[near[k], FIRST]
        for i in range(begin - 1, begin + i16[near[k], COUNT]):
            j = near[k] if i < begin else link[i]
            known = False
            for other in range(n):
                known |= which[other] == j
            if not known and n < which.size:
                which[n] = j
                n += 1
    for k in range(n):
        dr, dc = i16[which[k], ROW] - r, i16[which[k], COL] - c
        far[k] = math.sqrt(dr * dr + dc * dc)
    return n


@njit(cache=True, nogil=True)
def marks_of(
    by_row: Any, by_col: Any, i16: Any, mark: Any, grain: float, r: float, c: float, n: int, which: Any, far: Any,
    from_mark: Any,
) -> None:  # fmt: skip
    """from_mark: (MARKS,) int32 out, shortest way from each landmark to a point by what it sees of n places.

    far: of those found to be out of sight it becomes huge. Only the nearest by way of a landmark are looked for.
    """
    looked = np.zeros(n, dtype=np.bool_)
    for k in range(MARKS):
        while True:
            nearest, least = -1, _FAR_AWAY
            for i in range(n):
                there = grain * mark[which[i], MARK + k] + far[i]
                if there < least:
                    nearest, least = i, there
            from_mark[k] = FAR_MARK
            if nearest < 0:
                break
            j = which[nearest]
            if not looked[nearest] and not sees_open(by_row, by_col, r, c, float(i16[j, ROW]), float(i16[j, COL])):
                far[nearest] = 2.0 * _FAR_AWAY
                continue
            looked[nearest] = True
            if mark[j, MARK + k] < FAR_MARK:
                from_mark[k] = int(least / grain + 0.5)
            break


@njit(cache=True, nogil=True)
def choose_marks(mark: Any, n: int, from_mark: Any, active: Any) -> None:
    """active: (ACTIVE, 2) int32 out, the landmarks by which place n is farthest from a point: columns of mark, and how
    far the point is from them. from_mark: of the point, from marks_of; those chosen are gone from it."""
    for k in range(active.shape[0]):
        best, most = 0, -1
        for i in range(MARKS):
            apart = abs(from_mark[i] - np.int32(mark[n, MARK + i])) if from_mark[i] >= 0 else -1
            if apart > most:
                best, most = i, apart
        active[k, 0], active[k, 1] = MARK + best, from_mark[best]
        from_mark[best] = -1


@njit(cache=True, nogil=True)
def eager_bound(i16: Any, mark: Any, grain: float, n: int, r: float, c: float, active: Any) -> float:
    """What is still to go from place n to a point, at least (straight, or by the triangle of both and each landmark);
    _EAGER times that. active: from choose_marks."""
    most = 1
    for k in range(active.shape[0]):
        most = max(most, abs(active[k, 1] - np.int32(mark[n, active[k, 0]])))
    dr, dc = i16[n, ROW] - r, i16[n, COL] - c
    return _EAGER * max(math.sqrt(dr * dr + dc * dc), grain * (most - 1))  # less what rounding may have added


@njit(cache=True, nogil=True)
def way_round(
    room: Any, by_row: Any, by_col: Any, mark: Any, link: Any, at: Any, outward: Any, tile: Any, across: int,
    step: float, grain: float, heap: Any, key: Any, which: Any, far: Any, point: Any, work: Any, rounds: int,
    stamp: Any, r0: float, c0: float, r1: float, c1: float,
) -> Any:  # fmt: skip
    """The shortest way from place to place between two points, pulled taut; how many points it has, 0 if there is none.

    stamp: (1,) int64, moved on by two; STATE of this search is stamp or one less, all others are less, END is 0 before
    and after.  heap, key, which (2, M), far (2, M), work: work.  r0, c0, r1, c1: begin and end, open.
    point: (N + 2, 2) out.

    Whether the ends see a place is looked at only where a shortest way would begin or end with it.
    """
    point[0, 0], point[0, 1], point[1, 0], point[1, 1] = r0, c0, r1, c1
    if sees_open(by_row, by_col, r0, c0, r1, c1):
        return 2
    i16, i32, f32 = mark.view(np.int16), mark.view(np.int32), mark.view(np.float32)
    stamp[0] += 2
    met, done = stamp[0] - 1, stamp[0]
    size = np.zeros(1, dtype=np.int64)
    from_mark = np.empty(MARKS, dtype=np.int32)
    ends = places_of(
        room, by_row, by_col, i16, i32, link, at, outward, tile, across, step, r1, c1, which[1], far[1]
    )  # fmt: skip
    marks_of(by_row, by_col, i16, mark, grain, r1, c1, ends, which[1], far[1], from_mark)
    seeds = places_of(
        room, by_row, by_col, i16, i32, link, at, outward, tile, across, step, r0, c0, which[0], far[0]
    )  # fmt: skip
    if seeds == 0 or ends == 0:
        return 0
    active = np.empty((ACTIVE, 2), dtype=np.int32)
    choose_marks(mark, which[0, 0], from_mark, active)
    for i in range(ends):
        i16[which[1, i], END] = i + 1
    for i in range(seeds):
        push(heap, key, size, far[0, i] + eager_bound(i16, mark, grain, which[0, i], r1, c1, active), -1 - i)
    last, total = -1, _FAR_AWAY
    while size[0] > 0 and key[0] < total:
        n = pop(heap, key, size)
        if n < 0:  # straight from the beginning
            i = -1 - n
            n = which[0, i]
            if i32[n, STATE] == done or not sees_open(by_row, by_col, r0, c0, float(i16[n, ROW]), float(i16[n, COL])):
                continue
            f32[n, BEST], i32[n, VIA] = far[0, i], -1
        elif i32[n, STATE] == done:
            continue
        i32[n, STATE] = done
        here = np.float64(f32[n, BEST])
        r, c = i16[n, ROW], i16[n, COL]
        if i16[n, END] > 0:
            whole = here + far[1, i16[n, END] - 1]
            if whole < total and sees_open(by_row, by_col, float(r), float(c), r1, c1):
                last, total = n, whole
        for i in range(i32[n, FIRST], i32[n, FIRST] + i16[n, COUNT]):
            m = link[i]
            dr, dc = i16[m, ROW] - r, i16[m, COL] - c
            reached = here + math.sqrt(float(dr * dr + dc * dc))
            if i32[m, STATE] < met or (i32[m, STATE] == met and reached < f32[m, BEST]):
                f32[m, BEST], i32[m, STATE], i32[m, VIA] = reached, met, n
                promise = reached + eager_bound(i16, mark, grain, m, r1, c1, active)
                if promise < total:
                    push(heap, key, size, promise, m)
    for i in range(ends):
        i16[which[1, i], END] = 0
    if last < 0:
        return 0
    n = 2
    k = last
    while i32[k, VIA] >= 0:
        n += 1
        k = i32[k, VIA]
    point[n, 0], point[n, 1] = r1, c1
    k = last
    for i in range(n - 1, 0, -1):
        point[i, 0], point[i, 1] = i16[k, ROW], i16[k, COL]
        k = i32[k, VIA]
    return pull_from_both_ends(by_row, by_col, point, n + 1, rounds, work)


@njit(cache=True, nogil=True)
def plan_round(
    part: Any, squared: Any, need2: int, near: float, detour: float, spacing: float, cell_m: float, row0: float,
    col0: float, less: float, pose: Any, clear: Any, room: Any, by_row: Any, by_col: Any, mark: Any,
    link: Any, at: Any, outward: Any, tile: Any, across: int, step: float, grain: float, heap: Any, key: Any,
    which: Any, far: Any, point: Any, work: Any, rounds: int, stamp: Any, x0: float, y0: float, x1: float, y1: float,
) -> Any:  # fmt: skip
    """A whole plan in one call: what way_round finds between two positions (metres, on the map), and of it what
    paths.describe tells.

    part: (R, C) int32, cells of one number hang together.  need2: squared distance of the cells that a way may cross.
    near, detour: ends nearer than this (cells) whose way is so much longer than straight on need another look.
    Number of corners (0 if none is known, an end is not open, or another look is needed), number of poses, length and
    least clearance in metres.
    """
    rows, cols = squared.shape
    r0, c0 = y0 / cell_m - row0 - 0.5, x0 / cell_m - col0 - 0.5
    r1, c1 = y1 / cell_m - row0 - 0.5, x1 / cell_m - col0 - 0.5
    inside = r0 >= 0.0 and c0 >= 0.0 and r1 >= 0.0 and c1 >= 0.0  # not so NaN
    if not (inside and max(r0, r1) < rows - 1.0 and max(c0, c1) < cols - 1.0):
        return 0, 0, 0.0, 0.0
    begin, end = (int(r0 + 0.5), int(c0 + 0.5)), (int(r1 + 0.5), int(c1 + 0.5))
    if squared[begin] < need2 or squared[end] < need2 or part[begin] != part[end]:
        return 0, 0, 0.0, 0.0
    n = way_round(
        room, by_row, by_col, mark, link, at, outward, tile, across, step, grain, heap, key, which, far,
        point, work, rounds, stamp, r0, c0, r1, c1,
    )  # fmt: skip
    if n == 0:
        return 0, 0, 0.0, 0.0
    m, length, least = describe(squared, point, n, spacing, cell_m, row0, col0, less, pose, clear)
    straight = math.sqrt((r1 - r0) ** 2 + (c1 - c0) ** 2)
    if straight <= near and length > detour * straight * cell_m:
        return 0, 0, 0.0, 0.0
    return n, m, length, least
