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
def close_cracks(free: Any, wide: int, deep: int, thick: int, out: Any) -> None:
    """Close cracks that run along columns through walls that run along rows, and (given transposed arrays) the others.

    A crack is at most `wide` free cells in a row with at least `deep` obstacle cells on both sides, and no more than
    `thick` such cells in a column: what is longer is a gap between two things, not a hole in one.  free: (R, C) is
    read, out: (R, C) made False there.
    """
    rows, cols = free.shape
    high = np.zeros(cols, dtype=np.int32)  # of the crack that ends in this row
    mark = np.zeros(cols, dtype=np.bool_)
    for r in range(rows + 1):
        mark[:] = False
        if r < rows:
            wall, gap = 0, 0  # obstacle cells before the gap, cells of the gap
            run = 0
            for c in range(cols):
                if free[r, c]:
                    if run > 0:
                        wall, gap = run, 0
                        run = 0
                    gap += 1
                else:
                    run += 1
                    if run == deep and 0 < gap <= wide and wall >= deep:
                        mark[c - deep + 1 - gap : c - deep + 1] = True
        for c in range(cols):
            if mark[c]:
                high[c] += 1
            else:
                if 0 < high[c] <= thick:
                    out[r - high[c] : r, c] = False
                high[c] = 0


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
def flood(squared: Any, order: Any, keep: float, slack: float, less: float, basin: Any) -> Any:
    """Cut free space at its narrow places; how many basins there are. basin: (R, C) int32 out.

    Cells are taken by falling clearance. One that touches no basin begins one; one that touches two is where both
    meet, at the narrowest point of the widest way between them: the critical point of [Thr98]. They become one there
    if that point is no narrower than keep * the lesser of the two greatest clearances - slack cells, all clearances
    being distances less `less` cells.
    """
    rows, cols = squared.shape
    size = order.size
    parent = np.empty(size + 1, dtype=np.int32)
    peak = np.empty(size + 1, dtype=np.float32)
    basin[:] = NO_BASIN
    n = 0
    for i in range(size):
        r, c = order[i] // cols, order[i] % cols
        clearance = np.sqrt(np.float32(squared[r, c])) - np.float32(less)
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
def door_lines(site: Any, squared: Any, points: Any, first: Any, apart: int, least: float, most: float) -> Any:
    """(D, 4) row, column, row, column of the ends of critical lines as long as a door is wide, one for each passage."""
    lines = np.empty((first.size - 1, 4), dtype=np.int64)
    n = 0
    for i in range(first.size - 1):
        p = (first[i] + first[i + 1]) // 2
        line = critical_line(site, squared, np.int64(points[p, 0]), np.int64(points[p, 1]), apart)
        if least <= math.hypot(line[2] - line[0], line[3] - line[1]) <= most:
            lines[n, 0], lines[n, 1], lines[n, 2], lines[n, 3] = line
            n += 1
    return lines[:n]


@njit(cache=True, nogil=True)
def obstacle_near(squared: Any, row: float, col: float, around: int) -> bool:
    """Whether there is one at most so many rows and columns away."""
    rows, cols = squared.shape
    r, c = math.floor(row + 0.5), math.floor(col + 0.5)
    for rr in range(max(r - around, 0), min(r + around + 1, rows)):
        for cc in range(max(c - around, 0), min(c + around + 1, cols)):
            if squared[rr, cc] == 0:
                return True
    return False


@njit(cache=True, nogil=True)
def is_leaf(squared: Any, row: Any, col: Any, lines: Any, least: float, most: float, beside: float) -> bool:
    """Whether an obstacle cell is the tip of a leaf that hangs at one of those openings and stands open.

    lines: (D, 4) of door_lines: one end is the jamb, the other on the leaf. The hinge is where, from the tip through
    the latter, the way back is as long as that on to the jamb: so long, `least` to `most`, is the leaf, and so wide the
    opening. It stands open by 40 to 160 degrees, is free on both sides at `beside`, but for its ends, and behind its
    hinge the wall goes on. At `beside` around its tip there is nothing but the leaf: else the jamb that a leaf hangs at
    would be a tip for an opening behind it. All lengths in cells.
    """
    for k in range(lines.shape[0]):
        for e in range(2):
            jamb_down, jamb_right = float(lines[k, 2 * e] - row), float(lines[k, 2 * e + 1] - col)
            down, right = float(lines[k, 2 - 2 * e] - row), float(lines[k, 3 - 2 * e] - col)
            seen = math.hypot(down, right)
            if seen < 1.0 or seen > 1.3 * most:
                continue
            down, right = down / seen, right / seen
            ahead = jamb_down * down + jamb_right * right
            if ahead <= 0.0:
                continue
            length = (jamb_down**2 + jamb_right**2) / (2.0 * ahead)
            if not (least <= length <= most and 0.4 * length <= seen <= 1.3 * length):
                continue
            open_cos = (length - ahead) / length
            if not (-0.94 <= open_cos <= 0.77 and _is_free_end(squared, row, col, down, right, beside)):
                continue
            if _is_thin_wall(squared, row, col, down, right, length, beside):
                behind_down = row + down * length + (down * length - jamb_down) * 0.75 * beside / length
                behind_right = col + right * length + (right * length - jamb_right) * 0.75 * beside / length
                if obstacle_near(squared, behind_down, behind_right, 1):
                    return True
    return False


@njit(cache=True, nogil=True)
def _is_free_end(squared: Any, row: Any, col: Any, down: float, right: float, beside: float) -> bool:
    """Whether nothing is `beside` from (row, col) but within 60 degrees of that direction, in which its wall goes."""
    rows, cols = squared.shape
    for step in range(4, 21):
        c, s = math.cos(math.radians(15.0 * step)), math.sin(math.radians(15.0 * step))
        r = math.floor(row + beside * (c * down - s * right) + 0.5)
        k = math.floor(col + beside * (s * down + c * right) + 0.5)
        if not (0 <= r < rows and 0 <= k < cols) or squared[r, k] == 0:
            return False
    return True


@njit(cache=True, nogil=True)
def _is_thin_wall(squared: Any, row: Any, col: Any, down: float, right: float, length: float, beside: float) -> bool:
    """Whether there is one from (row, col) on in that direction, so long, and free at `beside` on both sides, from two
    to seven tenths of it; nine of ten places have to be so."""
    rows, cols = squared.shape
    wall, thin, sides, steps = 0, 0, 0, math.ceil(length)
    for i in range(steps + 1):
        r, c = row + down * length * i / steps, col + right * length * i / steps
        wall += obstacle_near(squared, r, c, 1)
        if 2 * steps <= 10 * i <= 7 * steps:
            for side in (-1, 1):
                rr, cc = math.floor(r - side * beside * right + 0.5), math.floor(c + side * beside * down + 0.5)
                sides += 1
                thin += 0 <= rr < rows and 0 <= cc < cols and squared[rr, cc] > 0
    return wall >= 0.9 * (steps + 1) and thin >= 0.9 * sides


@njit(cache=True, nogil=True)
def jambs(
    site: Any,
    squared: Any,
    ruled: Any,
    points: Any,
    first: Any,
    apart: int,
    around: float,
    less: float,
    lines: Any,
    least: float,
    most: float,
    beside: float,
    sharpness: Any,
) -> None:
    """What stands at the ends of critical lines.

    points: (K, 2) the critical points of passages, those of passage i, all equally wide, from first[i] to
    first[i + 1].  apart: critical_line's reach.  around: half the side of a square around an end, in cells; what is in
    it belongs to the end, of a cell at its edge a share.  less: of a distance, as in flood.  lines, least, most,
    beside: as in is_leaf.  sharpness: (N, 3) out, means over a passage's cells: cells that rule from the obstacle cells
    around each end, over the squared clearance: about nothing before a straight wall, 0.8 before a corner of 90
    degrees, 1.6 and more before the end of a wall; the lesser first. Nothing before the tip of a door's leaf; last, how
    many such tips there are.
    """
    rows, cols = site.shape
    reach = math.ceil(around - 0.5)
    for i in range(first.size - 1):
        sharpness[i] = 0.0
        for p in range(first[i], first[i + 1]):
            r, c = np.int64(points[p, 0]), np.int64(points[p, 1])
            line = critical_line(site, squared, r, c, apart)
            clearance = math.sqrt(squared[r, c]) - less
            blunt, sharp = np.inf, 0.0
            for e in range(2):
                row, col = line[2 * e], line[2 * e + 1]
                n = 0.0
                for rr in range(max(row - reach, 0), min(row + reach + 1, rows)):
                    down = min(around + 0.5 - abs(rr - row), 1.0)
                    for cc in range(max(col - reach, 0), min(col + reach + 1, cols)):
                        n += ruled[rr, cc] * down * min(around + 0.5 - abs(cc - col), 1.0)
                n /= clearance * clearance
                if n > 0.0 and is_leaf(squared, row, col, lines, least, most, beside):
                    n = 0.0
                    sharpness[i, 2] += 1.0
                sharp, blunt = max(sharp, n), min(blunt, n)
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
def beyond(basin: Any, owner: Any, row: Any, col: Any, along: Any, cut: float, beside: Any, most: float) -> Any:
    """What is free beyond the end (row, col) of a cut, so long, in the direction along (row, col).

    On all lines beside it, on both sides, to at most `most`: how far it is free; how far on the better side without
    leaving the piece there; how far it is free on half of the lines of the better side.
    """
    seen = np.empty(beside.size)
    free, within, half = most, 0.0, 0.0
    for side in (-1, 1):
        own = most
        for k in range(beside.size):  # from a quarter of the cut inside, lest the wall's rough end be hit
            r = row - 0.25 * cut * along[0] - side * beside[k] * along[1]
            c = col - 0.25 * cut * along[1] + side * beside[k] * along[0]
            n, inside = walk(basin, owner, r, c, along, most + 0.25 * cut)
            seen[k] = n - 0.25 * cut
            own = min(own, inside - 0.25 * cut)
        free, within, half = min(free, seen.min()), max(within, own), max(half, np.median(seen))
    return free, within, half


@njit(cache=True, nogil=True)
def stubs(
    basin: Any, owner: Any, cells: Any, first: Any, beside: Any, turns: Any, most: float, bend: float, length: Any
) -> None:
    """How long a wall that a cut ends at runs on in about the cut's direction, free on both sides.

    owner: (N,) the piece of each basin.  cells: (K, 3) row, column and squared clearance of the contacts of cut i, from
    first[i] to first[i + 1], widest first.  beside: (M,) how far from the cut, on each side of it and parallel with it,
    is looked along, to at most `most` beyond its end.  turns: (T,) radians, by which the wall may stand otherwise than
    the cut: cuts are crooked by as much, in other ways where a map lies otherwise.  length: (N,) out, cells, of the
    longest of both walls in all these directions: as far as it is free on all of these lines, on one side at least
    without leaving the piece there. 0 if at the other end it is free by less than `bend` on half of the lines of either
    side: a wall that goes straight on, as of a corridor that something juts out into.
    """
    longest, turned = np.empty(2), np.empty(2)
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
            down, right = (cells[tip, 0] - cells[other, 0]) / cut, (cells[tip, 1] - cells[other, 1]) / cut
            longest[e] = turned[e] = 0.0
            for turn in turns:
                c, s = math.cos(turn), math.sin(turn)
                along = (c * down - s * right, s * down + c * right)
                free, within, half = beyond(basin, owner, cells[tip, 0], cells[tip, 1], along, cut, beside, most)
                longest[e] = max(longest[e], min(free, within))
                if turn == 0.0:
                    turned[e] = half
        for e in range(2):
            if turned[1 - e] >= bend:
                length[i] = max(length[i], longest[e])


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
