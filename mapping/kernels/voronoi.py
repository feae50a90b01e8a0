"""Compiled loops of the Voronoi abstraction (S44): nearest obstacle of every cell, and the cells between two of them.

Two passes as in [FH12], with the place of the nearest obstacle (the base point) kept beside its distance. First along
columns: row_near[r, c] is the row of the nearest obstacle of column c. Then along each row the lower envelope of the
parabolas (c - s)^2 + (r - row_near[r, s])^2: the s that rules at c is the base point's column. Of equally near ones
the one farther left is taken, in a column the one above: so the result is a function of the grid alone, and the
update of a part gives what a new start would give, to the last tie.

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

FAR = 1 << 29  # squared distance where there is no obstacle at all
NOWHERE = -1  # row or column of the base point of such a cell


@njit(cache=True, nogil=True)
def near_rows(obstacle: Any, row_near: Any) -> None:
    """row_near: (R, C) int16, NOWHERE in columns without an obstacle; row by row, so that it runs along memory."""
    rows, cols = obstacle.shape
    for c in range(cols):
        row_near[0, c] = np.int16(0) if obstacle[0, c] else np.int16(NOWHERE)
    for r in range(1, rows):
        for c in range(cols):
            row_near[r, c] = np.int16(r) if obstacle[r, c] else row_near[r - 1, c]
    for r in range(rows - 2, -1, -1):
        for c in range(cols):
            above, below = np.int32(row_near[r, c]), np.int32(row_near[r + 1, c])
            # What the row below knows is the obstacle below, unless it is the one above.
            if below > r and (above < 0 or below - r < r - above):
                row_near[r, c] = np.int16(below)


@njit(cache=True, nogil=True)
def envelope_of_row(
    row_near: Any, r: int, first: int, stop: int, left: int, right: int, squared: Any, base: Any, work: Any
) -> None:
    """Fill row r from column left to right - 1, given the obstacles of the columns first to stop - 1.

    squared: (R, C) int32.  base: (R, C, 2) int16, row and column.  work: (3, C + 1) int32: apex, height and first
    column of each parabola of the envelope.
    """
    top = -1
    for s in range(first, stop):
        near = np.int64(row_near[r, s])
        if near < 0:
            continue
        h = (near - r) * (near - r)
        begin: Any = np.int64(left)
        while top >= 0:
            a = np.int64(work[0, top])
            rise = h - np.int64(work[1, top]) + s * s - a * a
            # First column where the new parabola is strictly below. Exact: the numbers stay far below 2^53.
            begin = np.int64(np.floor(np.float64(rise) / np.float64(2 * (s - a)))) + 1
            if begin > work[2, top]:
                break
            top -= 1
            begin = np.int64(left)
        if begin >= right:
            continue
        top += 1
        work[0, top] = s
        work[1, top] = h
        work[2, top] = max(begin, left)
    if top < 0:
        for c in range(left, right):
            squared[r, c] = FAR
            base[r, c, 0] = NOWHERE
            base[r, c, 1] = NOWHERE
        return
    for k in range(top + 1):
        end = np.int64(work[2, k + 1]) if k < top else right
        s = np.int64(work[0, k])
        h = np.int64(work[1, k])
        near = np.int64(row_near[r, s])
        for c in range(np.int64(work[2, k]), end):
            squared[r, c] = np.int32((c - s) * (c - s) + h)
            base[r, c, 0] = np.int16(near)
            base[r, c, 1] = np.int16(s)


@njit(cache=True, nogil=True)
def nearest_obstacles(obstacle: Any, row_near: Any, squared: Any, base: Any, work: Any) -> None:
    """The row pass. Between two obstacles of a row only what lies between them matters: each free run for itself."""
    rows, cols = obstacle.shape
    for r in range(rows):
        c = 0
        while c < cols:
            if obstacle[r, c]:
                squared[r, c] = 0
                base[r, c, 0] = np.int16(r)
                base[r, c, 1] = np.int16(c)
                c += 1
                continue
            left = c
            while c < cols and not obstacle[r, c]:
                c += 1
            envelope_of_row(row_near, r, max(left - 1, 0), min(c + 1, cols), left, c, squared, base, work)


@njit(cache=True, nogil=True)
def update_columns(obstacle: Any, row_near: Any, span: Any, low: Any, high: Any) -> None:
    """Column pass where cells changed.

    span: (C, 2) first and last row that changed in each column, last < first where none did.  low, high: (R,) out,
    first and last column whose row_near changed in each row; low stays above high where none did.
    """
    rows, cols = obstacle.shape
    for c in range(cols):
        first, last = span[c, 0], span[c, 1]
        if last < first:
            continue
        # Beyond the next obstacle on either side nothing can have changed.
        top = first
        while top > 0:
            top -= 1
            if obstacle[top, c]:
                break
        bottom = last
        while bottom < rows - 1:
            bottom += 1
            if obstacle[bottom, c]:
                break
        above = np.int64(NOWHERE)
        below = np.int64(NOWHERE)
        for r in range(top, bottom + 1):
            if obstacle[r, c]:
                above = r
            if below <= r:
                below = r
                while below <= bottom and not obstacle[below, c]:
                    below += 1
            near = above
            if below <= bottom and (above < 0 or below - r < r - above):
                near = below
            if row_near[r, c] != near:
                row_near[r, c] = np.int16(near)
                low[r] = min(low[r], c)
                high[r] = max(high[r], c)


@njit(cache=True, nogil=True)
def update_rows(row_near: Any, low: Any, high: Any, squared: Any, base: Any, work: Any) -> Any:
    """Row pass where row_near changed; widens low and high to what may differ now. Returns the cells looked at.

    A cell k columns outside the changed ones is concerned only if its distance is at least k: then its base point may
    have gone, or a nearer one come. Along a row the distance changes by at most one a cell, so the first cell that is
    not concerned ends the search; and the base points beside the window bound those within.
    """
    rows, cols = squared.shape
    looked = 0
    for r in range(rows):
        if low[r] > high[r]:
            continue
        left, right = np.int64(low[r]), np.int64(high[r])
        while left > 0 and (low[r] - left + 1) * (low[r] - left + 1) <= squared[r, left - 1]:
            left -= 1
        while right < cols - 1 and (right + 1 - high[r]) * (right + 1 - high[r]) <= squared[r, right + 1]:
            right += 1
        first: Any = np.int64(0)
        stop: Any = np.int64(cols)
        if left > 0:
            first = np.int64(base[r, left - 1, 1])
        if right < cols - 1:
            stop = np.int64(base[r, right + 1, 1]) + 1
        envelope_of_row(row_near, r, first, stop, left, right + 1, squared, base, work)
        looked += right + 1 - left
        low[r] = left
        high[r] = right
    return looked


@njit(cache=True, nogil=True)
def mark_axis(base: Any, r: int, c: int, rr: int, cc: int, gap2: int) -> Any:
    """Whether the bisector of the base points of two neighbours passes: 1 through the first, 2 the second, 3 both.

    0 if the base points are within a distance of sqrt(gap2) of each other.
    """
    br, bc = np.int64(base[r, c, 0]), np.int64(base[r, c, 1])
    dr, dc = br - np.int64(base[rr, cc, 0]), bc - np.int64(base[rr, cc, 1])
    if dr * dr + dc * dc <= gap2:
        return 0
    side = dr * (2 * br - dr - r - rr) + dc * (2 * bc - dc - c - cc)
    return 3 if side == 0 else 1 if side > 0 else 2


@njit(cache=True, nogil=True)
def axis_cells(squared: Any, base: Any, gap2: int, top: int, bottom: int, low: Any, high: Any, axis: Any) -> None:
    """axis: (R, C) bool: free cells on the Voronoi diagram, for rows top to bottom - 1 and columns low[r] to high[r].

    A cell is on it if the bisector between its base point and that of one of its four neighbours passes through it:
    the integer medial axis of Hesselink and Roerdink, which needs no more than the cells beside each cell.
    """
    rows, cols = squared.shape
    for r in range(top, bottom):
        for c in range(low[r], high[r] + 1):
            on = False
            if 0 < squared[r, c] < FAR:
                if c > 0 and squared[r, c - 1] > 0:
                    on = mark_axis(base, r, c - 1, r, c, gap2) >= 2
                if not on and c + 1 < cols and squared[r, c + 1] > 0:
                    on = mark_axis(base, r, c, r, c + 1, gap2) & 1 == 1
                if not on and r > 0 and squared[r - 1, c] > 0:
                    on = mark_axis(base, r - 1, c, r, c, gap2) >= 2
                if not on and r + 1 < rows and squared[r + 1, c] > 0:
                    on = mark_axis(base, r, c, r + 1, c, gap2) & 1 == 1
            axis[r, c] = on
