"""Compiled loops of planning round corners (S44): which places ways go round, which see each other.

    squared (R, C) int32    squared distance to the nearest obstacle in cells, 0 on obstacles
    site    (R, C) int32    that obstacle, row << 16 | column
    room    (R, C) uint8    of mapping.kernels.sight, as by_row and by_col
    total   (R+1, C+1) int32  how many cells above and left of a corner of cells may be gone
    place   (N, 2) int32    cells that ways go round or through, sorted by tiles of TILE cells
    outward (N, 2) float64  away from what a way goes round there, 0 in the middle of a narrow passage
    first   (tiles + 1,) int32  the places of tile t are first[t] to first[t + 1]

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.rooms import critical_line
from mapping.kernels.sight import sees_open

TILE = 50
SECTORS = 64
ROUND = 0.9  # a way that comes from straight in front of a corner (cosine above this) need not go round it
_FAILS = 12  # so many places of a sector out of sight, and the others are not looked at
_SLACK, _SLACK_CELLS = 1.1, 10.0  # how much farther than a ray of the sector one looks for places


@njit(cache=True, nogil=True)
def count_open(room: Any, total: Any) -> None:
    """total: out."""
    rows, cols = room.shape
    total[0, :] = 0
    for r in range(rows):
        here = 0
        total[r + 1, 0] = 0
        for c in range(cols):
            here += room[r, c] > 0
            total[r + 1, c + 1] = total[r, c + 1] + here


@njit(cache=True, nogil=True)
def within(total: Any, top: int, left: int, bottom: int, right: int) -> Any:
    """Open cells of rows top to bottom - 1 and columns left to right - 1, as far as the grid goes."""
    rows, cols = total.shape
    a, b, c, d = max(top, 0), min(bottom, rows - 1), max(left, 0), min(right, cols - 1)
    return total[b, d] - total[a, d] - total[b, c] + total[a, c]


@njit(cache=True, nogil=True)
def bulges(room: Any, total: Any, reach: int, least: float, cell: Any, score: Any) -> Any:
    """Open cells beside closed ones with more than `least` of the window around them open: how many.

    cell: row * C + col, score: open cells of the window, (M,) int32 out; what does not fit is counted only.
    """
    rows, cols = room.shape
    n, enough = 0, least * (2 * reach + 1) ** 2
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            if room[r, c] == 0:
                continue
            if room[r - 1, c] > 0 and room[r + 1, c] > 0 and room[r, c - 1] > 0 and room[r, c + 1] > 0:
                continue
            k = within(total, r - reach, c - reach, r + reach + 1, c + reach + 1)
            if k > enough:
                if n < cell.size:
                    cell[n], score[n] = r * cols + c, k
                n += 1
    return n


@njit(cache=True, nogil=True)
def choose_corners(
    room: Any, total: Any, reach: int, cell: Any, apart: float, pushed: float, place: Any, outward: Any
) -> Any:
    """Of cells, the most bulging first, those that lie `apart` from all chosen before that look the same way; each is
    moved outward by `pushed` cells as far as is open, to where straight ways round the corner meet. How many.

    place, outward: out.
    """
    rows, cols = room.shape
    side = max(math.ceil(apart), 1)
    height, width = rows // side + 1, cols // side + 1
    newest = np.full((height, width), -1, dtype=np.int32)
    older = np.empty(cell.size, dtype=np.int32)
    at = np.empty((cell.size, 2), dtype=np.int32)
    n = 0
    for i in range(cell.size):
        r, c = cell[i] // cols, cell[i] % cols
        top, left, bottom, right = r - reach, c - reach, r + reach + 1, c + reach + 1
        dr = float(within(total, r + 1, left, bottom, right) - within(total, top, left, r, right))
        dc = float(within(total, top, c + 1, bottom, right) - within(total, top, left, bottom, c))
        length = max(math.sqrt(dr * dr + dc * dc), 1e-9)
        dr, dc = dr / length, dc / length
        alone = True
        for a in range(max(r // side - 1, 0), min(r // side + 2, height)):
            for b in range(max(c // side - 1, 0), min(c // side + 2, width)):
                k = newest[a, b]
                while k >= 0 and alone:
                    near = (at[k, 0] - r) ** 2 + (at[k, 1] - c) ** 2 < apart * apart
                    alone = not (near and dr * outward[k, 0] + dc * outward[k, 1] > 0.5)
                    k = older[k]
        if not alone:
            continue
        at[n, 0], at[n, 1] = r, c
        older[n] = newest[r // side, c // side]
        newest[r // side, c // side] = n
        t = 0.0
        while t <= pushed:
            row, col = int(r + t * dr + 0.5), int(c + t * dc + 0.5)
            if room[row, col] == 0:
                break
            place[n, 0], place[n, 1] = row, col
            t += 0.5
        outward[n, 0], outward[n, 1] = dr, dc
        n += 1
    return n


@njit(cache=True, nogil=True)
def choose_passages(
    squared: Any, site: Any, edge: Any, chain: Any, first: Any, need2: int, wide2: float, step: int, place: Any
) -> Any:
    """Cells of the diagram in the middle of narrow passages, `step` chain cells apart, one where each is narrowest:
    how many. edge, chain, first: of a DiagramGraph.  place: (M, 2) out; what does not fit is counted only.

    A passage has its base points on two sides (a right angle between them at least). What narrows up to a blind end of
    the diagram is none.
    """
    cols, flat = squared.shape[1], squared.reshape(-1)
    n = 0
    for e in range(edge.shape[0]):
        a, b, i, end = edge[e, 0], edge[e, 1], edge[e, 2], edge[e, 3]
        blind = (first[a + 1] - first[a] == 1, first[b + 1] - first[b] == 1)
        begin = i
        while i < end:
            j = i
            narrowest = i
            while j < end and need2 <= flat[chain[j]] < wide2:
                if flat[chain[j]] < flat[chain[narrowest]]:
                    narrowest = j
                j += 1
            if not ((i == begin and blind[0]) or (j == end and blind[1])):
                for k in range(narrowest - (narrowest - i) // step * step, j, step):
                    r, c = chain[k] // cols, chain[k] % cols
                    r0, c0, r1, c1 = critical_line(site, squared, r, c, 1)
                    if (r0 - r1) ** 2 + (c0 - c1) ** 2 >= 2 * flat[chain[k]]:
                        if n < place.shape[0]:
                            place[n, 0], place[n, 1] = r, c
                        n += 1
            i = max(j, i + 1)
    return n


@njit(cache=True, nogil=True)
def ray(room: Any, r: float, c: float, ur: float, uc: float, step: float) -> float:
    """How far open cells go from a place in a direction, about. step: less than the clearance, so that neither what is
    closed around an obstacle nor the border is stepped over."""
    t = 0.0
    while True:
        more = room[int(r + t * ur + 0.5), int(c + t * uc + 0.5)]
        if more == 0:
            return t
        t += max(more - 1.0, step)


@njit(cache=True, nogil=True)
def sector_of(dr: float, dc: float) -> Any:
    """Number of the sector that a direction lies in: as its line cuts the square |r| + |c| = 1 into equal runs."""
    around = abs(dr) + abs(dc)
    along = 1.0 - dc / around if around > 0.0 else 0.0
    return int((along if dr >= 0.0 else 4.0 - along) * (0.25 * SECTORS)) % SECTORS


@njit(cache=True, nogil=True)
def direction_of(sector: int) -> Any:
    """Where a sector begins, (r, c) of length 1."""
    along = 4.0 * sector / SECTORS
    c = 1.0 - along if along < 2.0 else along - 3.0
    r = 1.0 - abs(c) if along < 2.0 else abs(c) - 1.0
    length = math.sqrt(r * r + c * c)
    return r / length, c / length


@njit(cache=True, nogil=True)
def beyond(span: Any, r: float, c: float, tile_r: int, tile_c: int) -> bool:
    """Whether all of a tile is farther away than is looked for places."""
    dr, dc = (tile_r + 0.5) * TILE - r, (tile_c + 0.5) * TILE - c
    length = math.sqrt(dr * dr + dc * dc)
    if length < 4.0 * TILE:  # nearer it fills several sectors
        return False
    k = sector_of(dr, dc)
    most = max(span[k], max(span[k - 1], span[(k + 1) % SECTORS]))
    return bool(length - 0.75 * TILE > most)


@njit(cache=True, nogil=True)
def look_around(
    room: Any, r: float, c: float, outward_r: float, outward_c: float, step: float, span: Any, box: Any
) -> None:
    """span: (SECTORS,) out, how far to look for places in each sector, from rays along both its sides.
    box: (4,) out, first and last row and column of what is looked at. Straight outward of a corner nobody looks."""
    reach = np.empty(SECTORS)
    box[0] = box[1] = r
    box[2] = box[3] = c
    for k in range(SECTORS):
        ur, uc = direction_of(k)
        reach[k] = 0.0
        if ur * outward_r + uc * outward_c <= ROUND + 0.1:
            reach[k] = _SLACK * ray(room, r, c, ur, uc, step) + _SLACK_CELLS
        box[0], box[1] = min(box[0], r + reach[k] * ur), max(box[1], r + reach[k] * ur)
        box[2], box[3] = min(box[2], c + reach[k] * uc), max(box[3], c + reach[k] * uc)
    for k in range(SECTORS):
        span[k] = max(reach[k], reach[(k + 1) % SECTORS])


@njit(cache=True, nogil=True)
def link_places(
    room: Any, by_row: Any, by_col: Any, place: Any, outward: Any, first: Any, across: int, step: float,
    pair: Any,
) -> Any:  # fmt: skip
    """Pairs of places that see each other and that a way might join, the nearest of each sector: how many.

    across: tiles side by side.  step: of rays.  pair: (M, 2) int32 out; what does not fit is counted only.
    """
    m, down = 0, (first.size - 1) // across
    linked = np.zeros((place.shape[0], SECTORS // 2), dtype=np.bool_)  # by pairs of sectors
    fails = np.empty(SECTORS, dtype=np.int32)
    span, box = np.empty(SECTORS), np.empty(4)
    for i in range(place.shape[0]):
        r, c, ni, mi = float(place[i, 0]), float(place[i, 1]), outward[i, 0], outward[i, 1]
        look_around(room, r, c, ni, mi, step, span, box)
        fails[:] = 0
        top, bottom = max(int(box[0]) // TILE, 0), min(int(box[1]) // TILE, down - 1)
        left, right = max(int(box[2]) // TILE, 0), min(int(box[3]) // TILE, across - 1)
        tr, tc = place[i, 0] // TILE, place[i, 1] // TILE
        for ring in range(max(max(tr - top, bottom - tr), max(tc - left, right - tc)) + 1):
            for a in range(max(tr - ring, top), min(tr + ring, bottom) + 1):
                skip = 1 if abs(a - tr) == ring else 2 * ring
                for b in range(tc - ring, tc + ring + 1, skip):
                    if b < left or b > right or beyond(span, r, c, a, b):
                        continue
                    for j in range(max(first[a * across + b], i + 1), first[a * across + b + 1]):
                        dr, dc = place[j, 0] - r, place[j, 1] - c
                        length = math.sqrt(dr * dr + dc * dc)
                        if length == 0.0 or dr * ni + dc * mi > ROUND * length:
                            continue
                        if -dr * outward[j, 0] - dc * outward[j, 1] > ROUND * length:
                            continue
                        k = sector_of(dr, dc)
                        back = (k + SECTORS // 2) % SECTORS
                        if length > span[k] or fails[k] >= _FAILS:
                            continue
                        if linked[i, k // 2] and linked[j, back // 2]:
                            continue
                        if not sees_open(by_row, by_col, r, c, float(place[j, 0]), float(place[j, 1])):
                            fails[k] += 1
                            continue
                        if m < pair.shape[0]:
                            pair[m, 0], pair[m, 1] = i, j
                        m += 1
                        linked[i, k // 2] = linked[j, back // 2] = True
    return m
