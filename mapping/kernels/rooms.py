"""Compiled loops of the room decomposition (S44): basins of clearance, where they meet, what their passages look like.

    squared (R, C) int32    squared distance to the nearest obstacle in cells, 0 on obstacles
    site    (R, C) int32    that obstacle, row << 16 | column
    basin   (R, C) int32    number of the basin a cell belongs to, -1 on obstacles

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

NO_BASIN = -1

# Columns of a contact: the two basins, squared clearance, row and column of the first cell.
LOWER, UPPER, SQUARED, ROW, COL = range(5)


@njit(cache=True, nogil=True)
def root(parent: Any, i: Any) -> Any:
    """The set that i belongs to; shortens the way there."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def unite(parent: Any, i: Any, j: Any) -> Any:
    """Make two sets one, named by the smaller root; its name."""
    a, b = root(parent, i), root(parent, j)
    if a > b:
        a, b = b, a
    parent[b] = a
    return a


@njit(cache=True, nogil=True)
def connected(mask: Any, diagonal: bool, label: Any) -> Any:
    """label: (R, C) int32 out, from 0 by first cell in reading order, -1 outside of mask; how many components."""
    rows, cols = mask.shape
    parent = np.empty(rows * cols // 2 + 2, dtype=np.int32)
    n = 0
    for r in range(rows):
        for c in range(cols):
            if not mask[r, c]:
                label[r, c] = -1
                continue
            mine: Any = -1
            if c > 0 and label[r, c - 1] >= 0:
                mine = root(parent, label[r, c - 1])
            if r > 0:
                for cc in range(max(c - 1, 0), min(c + 2, cols)):
                    if (cc == c or diagonal) and label[r - 1, cc] >= 0:
                        other = root(parent, label[r - 1, cc])
                        mine = other if mine < 0 else unite(parent, mine, other)
            if mine < 0:
                mine = n
                parent[n] = n
                n += 1
            label[r, c] = mine
    name = np.full(n, -1, dtype=np.int32)
    count = 0
    for r in range(rows):
        for c in range(cols):
            if label[r, c] >= 0:
                k = root(parent, label[r, c])
                if name[k] < 0:
                    name[k] = count
                    count += 1
                label[r, c] = name[k]
    return count


@njit(cache=True, nogil=True)
def boxes(label: Any, box: Any) -> None:
    """box: (N, 4) out: first row, first column, last row, last column of each component."""
    rows, cols = label.shape
    for k in range(box.shape[0]):
        box[k, 0], box[k, 1], box[k, 2], box[k, 3] = rows, cols, -1, -1
    for r in range(rows):
        for c in range(cols):
            k = label[r, c]
            if k >= 0:
                box[k, 0] = min(box[k, 0], r)
                box[k, 1] = min(box[k, 1], c)
                box[k, 2] = max(box[k, 2], r)
                box[k, 3] = max(box[k, 3], c)


@njit(cache=True, nogil=True)
def sums_around(squared: Any, around: int) -> Any:
    """(R, C) int64: sum of the cells at most `around` rows and columns away, what is beyond the border 0."""
    rows, cols = squared.shape
    down = np.zeros((rows, cols), dtype=np.int64)
    for r in range(min(around, rows)):
        down[0] += squared[r]
    for r in range(rows):
        if r > 0:
            down[r] = down[r - 1]
            if r > around:
                down[r] -= squared[r - around - 1]
        if r + around < rows:
            down[r] += squared[r + around]
    sums = np.empty((rows, cols), dtype=np.int64)
    for r in range(rows):
        n = np.int64(0)
        for c in range(min(around, cols)):
            n += down[r, c]
        for c in range(cols):
            if c > around:
                n -= down[r, c - around - 1]
            if c + around < cols:
                n += down[r, c + around]
            sums[r, c] = n
    return sums


@njit(cache=True, nogil=True)
def widest_first(squared: Any, around: int) -> Any:
    """Free cells as row * C + col by falling distance, equal ones by falling sum of distances at most `around` cells
    away (else it would hang on how a map lies which of them is first), then in reading order."""
    rows, cols = squared.shape
    most = 0
    for r in range(rows):
        for c in range(cols):
            most = max(most, squared[r, c])
    begins = np.zeros(most + 2, dtype=np.int64)
    for r in range(rows):
        for c in range(cols):
            if squared[r, c] > 0:
                begins[most - squared[r, c] + 1] += 1
    for k in range(1, most + 2):
        begins[k] += begins[k - 1]
    order = np.empty(begins[most + 1], dtype=np.int32)
    for r in range(rows):
        for c in range(cols):
            if squared[r, c] > 0:
                k = most - squared[r, c]
                order[begins[k]] = r * cols + c
                begins[k] += 1
    if around > 0:
        sums = sums_around(squared, around).reshape(-1)
        begin = 0
        for k in range(most + 1):
            end = begins[k]  # moved on to the next one's begin
            if end - begin > 1:
                equal = order[begin:end].copy()
                order[begin:end] = equal[np.argsort(-sums[equal], kind="mergesort")]
            begin = end
    return order


@njit(cache=True, nogil=True)
def flood(squared: Any, order: Any, keep: float, slack: float, basin: Any) -> Any:
    """Cut free space at its narrow places; how many basins there are. basin: (R, C) int32 out.

    Cells are taken by falling clearance. One that touches no basin begins one; one that touches two is where both
    meet, at the narrowest point of the widest way between them: the critical point of [Thr98]. They become one there
    if that point is no narrower than keep * the lesser of the two greatest clearances - slack cells.
    """
    rows, cols = squared.shape
    size = order.size
    parent = np.empty(size + 1, dtype=np.int32)
    peak = np.empty(size + 1, dtype=np.float32)
    basin[:] = NO_BASIN
    n = 0
    for i in range(size):
        r, c = order[i] // cols, order[i] % cols
        clearance = np.sqrt(np.float32(squared[r, c]))
        here: Any = -1  # the basin of all that met here
        mine: Any = -1  # the basin uphill, to which the cell goes
        steepest = np.int64(-1)
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, cols)):
                if basin[rr, cc] < 0:
                    continue
                other = root(parent, basin[rr, cc])
                rise = 2 * np.int64(squared[rr, cc]) - (rr - r) * (rr - r) - (cc - c) * (cc - c)
                if rise > steepest:
                    steepest = rise
                    mine = other
                if here < 0:
                    here = other
                elif other != here and clearance >= keep * min(peak[other], peak[here]) - slack:
                    wider, narrower = (other, here) if peak[other] > peak[here] else (here, other)
                    parent[narrower] = wider
                    here = wider
        if mine < 0:
            mine = n
            parent[n] = n
            peak[n] = clearance
            n += 1
        basin[r, c] = mine
    name = np.full(n + 1, -1, dtype=np.int32)
    count = 0
    for i in range(size):
        r, c = order[i] // cols, order[i] % cols
        k = root(parent, basin[r, c])
        if name[k] < 0:
            name[k] = count
            count += 1
        basin[r, c] = name[k]
    return count


@njit(cache=True, nogil=True)
def measure_basins(basin: Any, squared: Any, area: Any, clearance_sum: Any, wall: Any) -> None:
    """area, clearance_sum, wall: (N,) float64 out, zero before: cells, sum of their distances, outline in cell edges
    (walls and other basins)."""
    rows, cols = basin.shape
    for r in range(rows):
        for c in range(cols):
            k = basin[r, c]
            if k < 0:
                continue
            area[k] += 1.0
            clearance_sum[k] += np.sqrt(np.float64(squared[r, c]))
            if r == 0 or basin[r - 1, c] != k:
                wall[k] += 1.0
            if c == 0 or basin[r, c - 1] != k:
                wall[k] += 1.0
            if r == rows - 1 or basin[r + 1, c] != k:
                wall[k] += 1.0
            if c == cols - 1 or basin[r, c + 1] != k:
                wall[k] += 1.0


@njit(cache=True, nogil=True)
def contacts(basin: Any, squared: Any, found: Any) -> Any:
    """Pairs of cells side by side in different basins; how many. found: (M, 5) int32 out, columns LOWER to COL; what
    does not fit is counted only."""
    rows, cols = basin.shape
    n = 0
    for r in range(rows):
        for c in range(cols):
            a = basin[r, c]
            if a < 0:
                continue
            for down in range(2):
                rr, cc = r + down, c + 1 - down
                if rr >= rows or cc >= cols:
                    continue
                b = basin[rr, cc]
                if b < 0 or b == a:
                    continue
                if n < found.shape[0]:
                    found[n, LOWER], found[n, UPPER] = min(a, b), max(a, b)
                    found[n, SQUARED] = min(squared[r, c], squared[rr, cc])
                    found[n, ROW], found[n, COL] = r, c
                n += 1
    return n


@njit(cache=True, nogil=True)
def count_ruled(site: Any, squared: Any, ruled: Any) -> None:
    """ruled: (R, C) int32, zero before: free cells whose base point each obstacle cell is."""
    rows, cols = site.shape
    for r in range(rows):
        for c in range(cols):
            if squared[r, c] > 0 and site[r, c] >= 0:
                ruled[site[r, c] >> 16, site[r, c] & 0xFFFF] += 1


@njit(cache=True, nogil=True)
def critical_line(site: Any, squared: Any, r: Any, c: Any, reach: int) -> Any:
    """The base points (row, col, row, col) of a critical point: its own, and the farthest from it that a cell within
    `reach` cells has."""
    rows, cols = site.shape
    own = np.int64(site[r, c])
    ar, ac = own >> 16, own & 0xFFFF
    br, bc = ar, ac
    farthest = np.int64(-1)
    for rr in range(max(r - reach, 0), min(r + reach + 1, rows)):
        for cc in range(max(c - reach, 0), min(c + reach + 1, cols)):
            if squared[rr, cc] == 0 or site[rr, cc] < 0:
                continue
            other = np.int64(site[rr, cc])
            d = ((other >> 16) - ar) ** 2 + ((other & 0xFFFF) - ac) ** 2
            if d > farthest:
                farthest = d
                br, bc = other >> 16, other & 0xFFFF
    return ar, ac, br, bc


@njit(cache=True, nogil=True)
def jambs(site: Any, squared: Any, ruled: Any, points: Any, first: Any, reach: int, sharpness: Any) -> None:
    """What stands at the ends of critical lines.

    points: (K, 2) the critical points of passages, those of passage i, all equally wide, from first[i] to
    first[i + 1].  reach: cells around an end that belong to it.  sharpness: (N, 2) out, means over a passage's cells:
    cells that rule from the obstacle cells around each end, over the squared clearance: about nothing before a straight
    wall, 0.8 before a corner of 90 degrees, 1.6 and more before the end of a wall; the lesser first.
    """
    rows, cols = site.shape
    for i in range(first.size - 1):
        sharpness[i, 0] = sharpness[i, 1] = 0.0
        for p in range(first[i], first[i + 1]):
            r, c = np.int64(points[p, 0]), np.int64(points[p, 1])
            line = critical_line(site, squared, r, c, reach)
            blunt, sharp = np.inf, 0.0
            for e in range(2):
                row, col = line[2 * e], line[2 * e + 1]
                n = 0
                for rr in range(max(row - reach, 0), min(row + reach + 1, rows)):
                    for cc in range(max(col - reach, 0), min(col + reach + 1, cols)):
                        n += ruled[rr, cc]
                sharp = max(sharp, n / squared[r, c])
                blunt = min(blunt, n / squared[r, c])
            sharpness[i, 0] += blunt
            sharpness[i, 1] += sharp
        sharpness[i] /= first[i + 1] - first[i]


@njit(cache=True, nogil=True)
def walk(basin: Any, owner: Any, r: Any, c: Any, step: Any, most: float) -> Any:
    """Cells from (r, c) on in the direction step (row, col), up to `most`: how many until an obstacle, and how many
    until another piece than the first cell's."""
    rows, cols = basin.shape
    own: Any = -1
    n, inside = 0, -1
    while n < most:
        row, col = math.floor(r + step[0] * n + 0.5), math.floor(c + step[1] * n + 0.5)
        if row < 0 or col < 0 or row >= rows or col >= cols or basin[row, col] < 0:
            break
        if n == 0:
            own = owner[basin[row, col]]
        if inside < 0 and owner[basin[row, col]] != own:
            inside = n
        n += 1
    return n, inside if inside >= 0 else n


@njit(cache=True, nogil=True)
def farthest(cells: Any, begin: Any, end: Any, r: Any, c: Any, middle: Any, reach: float) -> Any:
    """Which of cells[begin:end] is farthest from (r, c), within reach of cells[middle]; the first of equals."""
    best, at = -1.0, begin
    for k in range(begin, end):
        if math.hypot(cells[k, 0] - cells[middle, 0], cells[k, 1] - cells[middle, 1]) > reach:
            continue
        d = math.hypot(cells[k, 0] - r, cells[k, 1] - c)
        if d > best:
            best, at = d, k
    return at


@njit(cache=True, nogil=True)
def stubs(basin: Any, owner: Any, cells: Any, first: Any, beside: Any, most: float, bend: float, length: Any) -> None:
    """How long a wall that a cut ends at runs on in the cut's direction, free on both sides.

    owner: (N,) the piece of each basin.  cells: (K, 3) row, column and squared clearance of the contacts of cut i, from
    first[i] to first[i + 1], widest first.  beside: (M,) how far from the cut, on each side of it and parallel with it,
    is looked along, to at most `most` beyond its end.  length: (N,) out, cells, of the longer of both walls: as far as
    it is free on all of these lines, on one side at least without leaving the piece there. 0 if at the other end it is
    free by less than `bend` on half of the lines of either side: a wall that goes straight on, as of a corridor that
    something juts out into.
    """
    free, within, turned = np.empty(2), np.empty(2), np.empty(2)
    seen = np.empty(beside.size)
    for i in range(first.size - 1):
        length[i] = 0.0
        begin, end = first[i], first[i + 1]
        reach = 1.5 * math.sqrt(cells[begin, 2]) + 3.0  # a cut is slanted; the same two pieces may meet elsewhere, too
        a = farthest(cells, begin, end, cells[begin, 0], cells[begin, 1], begin, reach)
        b = farthest(cells, begin, end, cells[a, 0], cells[a, 1], begin, reach)
        cut = math.hypot(cells[a, 0] - cells[b, 0], cells[a, 1] - cells[b, 1])
        if cut < 1.0:
            continue
        for e in range(2):
            tip, other = (a, b) if e == 0 else (b, a)
            down, right = float(cells[tip, 0] - cells[other, 0]), float(cells[tip, 1] - cells[other, 1])
            along = (down / cut, right / cut)
            free[e], within[e], turned[e] = most, 0.0, 0.0
            for side in (-1, 1):
                own = most
                for k in range(beside.size):  # from a quarter of the cut inside, lest the wall's rough end be hit
                    r = cells[tip, 0] - 0.25 * down - side * beside[k] * along[1]
                    c = cells[tip, 1] - 0.25 * right + side * beside[k] * along[0]
                    n, inside = walk(basin, owner, r, c, along, most + 0.25 * cut)
                    seen[k] = n - 0.25 * cut
                    own = min(own, inside - 0.25 * cut)
                free[e], within[e] = min(free[e], seen.min()), max(within[e], own)
                turned[e] = max(turned[e], np.median(seen))
        for e in range(2):
            if turned[1 - e] >= bend:
                length[i] = max(length[i], min(free[e], within[e]))


@njit(cache=True, nogil=True)
def rename(basin: Any, name: Any) -> None:
    """Put name[k] in the place of every k >= 0, and name[-1] in that of what is no basin."""
    rows, cols = basin.shape
    for r in range(rows):
        for c in range(cols):
            basin[r, c] = name[basin[r, c]]


@njit(cache=True, nogil=True)
def widest_cells(label: Any, squared: Any, widest: Any) -> None:
    """widest: (N,) int64 out: of each label below N its cell of greatest distance as row * C + col, first in reading
    order; -1 if it has none."""
    widest[:] = -1
    rows, cols = label.shape
    flat = squared.reshape(-1)
    for r in range(rows):
        for c in range(cols):
            k = label[r, c]
            i = r * cols + c
            if 0 <= k < len(widest) and (widest[k] < 0 or squared[r, c] > flat[widest[k]]):
                widest[k] = i
