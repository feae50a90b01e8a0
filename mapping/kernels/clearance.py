"""Exact Euclidean distance of every cell to the nearest obstacle cell (S30), whole [FH12] and after a change.

Along columns the nearest obstacle's row is a running value; along a row the squared distance is the lower envelope of
the parabolas (c - a)^2 + g(a)^2, one for each column a with an obstacle, g its distance along the column. Whole
numbers throughout: the results are exact.

Of obstacles equally near, the one in the smaller column counts, in one column the one in the smaller row. So the
column of the nearest obstacle never falls along a row, and what one obstacle rules there is an interval. The update
lives on that: in each row the place where a new or lost obstacle's interval must lie is found by bisection; row after
row, away from the obstacle, until its Voronoi region (which is convex) has ended. Work: the cells that change, a few
steps for each row in which that region is alive.

Distances up to a reach are kept up to date by `clearance_reach`.

    obstacle (R, C) uint8    columns (C, W) uint64, bit r of a column's W words: an obstacle in row r
    squared  (R, C) int32    FAR where there is no obstacle at all
    site     (R, C) int32    the nearest obstacle cell, row << 16 | column; NO_SITE where there is none
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

FAR = 1 << 30  # squared distance where there is no obstacle at all
NO_SITE = -1
NO_ROW = -30_000  # in `nearest_rows`: no obstacle in this column, or none within reach
_NONE_BELOW = 90_000
_LOST, _NEW = 2, 3  # in `sort_out`, while it is at work
MAX_SIDE = 20_000  # squares of distances fit 32 bits, rows and columns 16
UNLIMITED = 1 << 15  # a reach that no distance exceeds: its square is FAR


@njit(cache=True, nogil=True)
def sort_out(added: Any, removed: Any, obstacle: Any, new: Any, lost: Any) -> Any:
    """Write cells that become obstacles to new, that are none any more to lost, each once; how many of both.

    added, removed: (N, 2) int64 cells; of both lists: added.  obstacle is as before when this is done.
    Returns -1, -1 if a cell lies outside.
    """
    rows, cols = obstacle.shape
    for cells in (added, removed):
        for k in range(cells.shape[0]):
            if not (0 <= cells[k, 0] < rows and 0 <= cells[k, 1] < cols):
                return -1, -1
    n_new, n_lost, n_left = 0, 0, 0
    for k in range(removed.shape[0]):
        r, c = removed[k, 0], removed[k, 1]
        if obstacle[r, c] == 1:
            obstacle[r, c] = _LOST
            lost[n_lost, 0], lost[n_lost, 1] = r, c
            n_lost += 1
    for k in range(added.shape[0]):
        r, c = added[k, 0], added[k, 1]
        if obstacle[r, c] == 0:
            obstacle[r, c] = _NEW
            new[n_new, 0], new[n_new, 1] = r, c
            n_new += 1
        elif obstacle[r, c] == _LOST:
            obstacle[r, c] = 1
    for k in range(n_lost):
        r, c = lost[k, 0], lost[k, 1]
        if obstacle[r, c] == _LOST:
            obstacle[r, c] = 1
            lost[n_left, 0], lost[n_left, 1] = r, c
            n_left += 1
    for k in range(n_new):
        obstacle[new[k, 0], new[k, 1]] = 0
    return n_new, n_left


@njit(cache=True, nogil=True)
def nearest_rows(obstacle: Any, reach: int, nearest: Any, below: Any) -> None:
    """nearest: (R, C) int16, row of the nearest obstacle in each cell's column, or NO_ROW if it is beyond reach.
    below: (C,) int32, work."""
    farthest = np.int32(min(reach, MAX_SIDE))
    rows, cols = obstacle.shape
    for c in range(cols):
        nearest[0, c] = np.int16(0) if obstacle[0, c] else np.int16(NO_ROW)
        below[c] = np.int32(_NONE_BELOW)
    for r in range(1, rows):
        for c in range(cols):
            nearest[r, c] = np.int16(r) if obstacle[r, c] else nearest[r - 1, c]
    for r in range(rows - 1, -1, -1):
        for c in range(cols):
            under = np.int32(r) if obstacle[r, c] else below[c]
            below[c] = under
            above = np.int32(nearest[r, c])
            to_above, to_below = np.int32(np.int32(r) - above), np.int32(under - np.int32(r))
            row = np.int16(above if to_above <= to_below else under)
            nearest[r, c] = row if min(to_above, to_below) <= farthest else np.int16(NO_ROW)


@njit(cache=True, nogil=True)
def row_envelopes(
    nearest: Any, row0: int, row1: int, reach: int, squared: Any, site: Any, apex: Any, height: Any, begins: Any
) -> None:
    """squared, site of rows [row0, row1) from nearest_rows; apex, height, begins: (C + 1,) int32 work arrays."""
    cols = nearest.shape[1]
    bound = np.int32(min(reach * reach, FAR - 1))
    for r in range(row0, row1):
        top = -1
        for c in range(cols):
            if nearest[r, c] == NO_ROW:
                continue
            g = np.int64(r - np.int64(nearest[r, c]))
            top = push_parabola(c, g * g, top, 0, cols, apex, height, begins)
        if top < 0:
            for c in range(cols):
                squared[r, c] = FAR
                site[r, c] = NO_SITE
            continue
        for k in range(top + 1):
            stop = np.int64(begins[k + 1]) if k < top else cols
            here = np.int32(apex[k])
            base = np.int32(height[k])
            name = np.int32(np.int32(nearest[r, here]) << 16 | here)
            for c in range(np.uint64(begins[k]), np.uint64(stop)):
                away = np.int32(np.int32(c) - here)
                value = np.int32(away * away + base)
                squared[r, c] = value if value <= bound else np.int32(FAR)
                site[r, c] = name if value <= bound else np.int32(NO_SITE)


@njit(cache=True, nogil=True)
def push_parabola(
    c: Any, h: Any, top: Any, first: Any, end: Any, apex: Any, height: Any, begins: Any
) -> Any:  # fmt: skip
    """Add the parabola (c, h) to an envelope over [first, end) whose apexes lie to the left; its new top.

    Parabola k has its apex at column apex[k] and rules from column begins[k] on. A parabola that is no lower than
    those before it, anywhere left of `end`, is not kept.
    """
    start: Any = np.int64(first)
    while top >= 0:
        a = np.int64(apex[top])
        # First column at which the new parabola is below the old one.
        rise = h - np.int64(height[top]) + c * c - a * a
        gap = 2 * (c - a)
        start = max(np.int64(first), rise // gap + 1)
        if start > begins[top]:
            break
        top -= 1
        start = np.int64(first)
    if start >= end:
        return top
    top += 1
    apex[top], height[top], begins[top] = c, h, start
    return top


@njit(cache=True, nogil=True)
def column_bits(obstacle: Any, columns: Any) -> int:
    """Set the bits of `columns`, all 0 before; how many obstacles there are."""
    rows, cols = obstacle.shape
    count = 0
    for r in range(rows):
        bit = np.uint64(1) << np.uint64(r & 63)
        for c in range(cols):
            if obstacle[r, c]:
                columns[c, r >> 6] |= bit
                count += 1
    return count


@njit(cache=True, nogil=True)
def highest_bit(word: Any) -> Any:
    """Number of the highest bit set; word is not 0."""
    at = 0
    for step in (32, 16, 8, 4, 2, 1):
        if word >> np.uint64(step):
            word >>= np.uint64(step)
            at += step
    return at


@njit(cache=True, nogil=True)
def obstacle_above(columns: Any, c: Any, r: Any, stop: Any) -> Any:
    """The last row in [stop, r] with an obstacle in this column; NO_ROW if there is none."""
    if r < stop:
        return NO_ROW
    word = r >> 6
    bits = columns[c, word] & (~np.uint64(0) >> np.uint64(63 - (r & 63)))
    while bits == 0:
        word -= 1
        if word < stop >> 6:
            return NO_ROW
        bits = columns[c, word]
    row = (word << 6) + highest_bit(bits)
    return row if row >= stop else NO_ROW


@njit(cache=True, nogil=True)
def obstacle_below(columns: Any, c: Any, r: Any, last: Any) -> Any:
    """The first row in [r, last] with an obstacle in this column; NO_ROW if there is none."""
    if r > last:
        return NO_ROW
    word = r >> 6
    bits = columns[c, word] & (~np.uint64(0) << np.uint64(r & 63))
    while bits == 0:
        word += 1
        if word > last >> 6:
            return NO_ROW
        bits = columns[c, word]
    row = (word << 6) + highest_bit(bits & (~bits + np.uint64(1)))
    return row if row <= last else NO_ROW


@njit(cache=True, nogil=True)
def nearest_in_column(columns: Any, c: Any, r: Any, reach: Any, rows: int) -> Any:
    """Row of the nearest obstacle of a column, at most `reach` away, the smaller of two; NO_ROW if there is none."""
    above = obstacle_above(columns, c, r, max(r - reach, 0))
    if above != NO_ROW:
        reach = r - above - 1
    below = obstacle_below(columns, c, r + 1, min(r + reach, rows - 1))
    return above if below == NO_ROW else below


@njit(cache=True, nogil=True)
def rows_ruled(columns: Any, r: Any, c: Any, rows: int) -> Any:
    """First and last row in which (r, c) is, or would be, the nearest obstacle of its column."""
    above = obstacle_above(columns, c, r - 1, 0)
    below = obstacle_below(columns, c, r + 1, rows - 1)
    first = 0 if above == NO_ROW else ((above + r) >> 1) + 1
    last = rows - 1 if below == NO_ROW else (r + below) >> 1
    return first, last


@njit(cache=True, nogil=True)
def interval_start(site: Any, r: Any, a: Any, guess: Any) -> Any:
    """First cell of row r whose nearest obstacle is in column a or beyond, sought outwards from a guess."""
    cols = site.shape[1]
    low, high, step = 0, cols, 1
    guess = min(guess, cols - 1)
    if (site[r, guess] & 0xFFFF) < a:
        low = guess + 1
        at = low
        while at < cols:
            if (site[r, at] & 0xFFFF) >= a:
                high = at
                break
            low = at + 1
            at += step
            step *= 2
    else:
        high = guess
        at = guess - 1
        while at >= 0:
            if (site[r, at] & 0xFFFF) < a:
                low = at + 1
                break
            high = at
            at -= step
            step *= 2
    while low < high:
        middle = (low + high) >> 1
        if (site[r, middle] & 0xFFFF) < a:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def is_region_alive(squared: Any, site: Any, r: Any, a: Any, h: Any, p: Any) -> bool:
    """Whether the parabola (a, h), which rules no cell of row r, rules a point between cells p - 1 and p.

    If not, its Voronoi region has ended: it is convex, so it does not come back in rows farther away.
    """
    cols = site.shape[1]
    if p == 0:
        return bool(h + a * a <= np.int64(squared[r, 0]))
    if p == cols:
        return bool(h + (cols - 1 - a) * (cols - 1 - a) <= np.int64(squared[r, cols - 1]))
    left, right = np.int64(site[r, p - 1]), np.int64(site[r, p])
    lc, rc = left & 0xFFFF, right & 0xFFFF
    if rc == a:
        return True
    lh, rh = r - (left >> 16), r - (right >> 16)
    of_left, of_right = lc * lc + lh * lh, rc * rc + rh * rh
    return bool((a * a + h - of_left) * (rc - lc) <= (of_right - of_left) * (a - lc))


@njit(cache=True, nogil=True)
def note_span(spans: Any, r: Any, first: Any, stop: Any) -> None:
    """Widen what changed in row r. spans: (R, 2) first and end column."""
    spans[r, 0] = min(spans[r, 0], first)
    spans[r, 1] = max(spans[r, 1], stop)


@njit(cache=True, nogil=True)
def claim_row(r: Any, row: Any, a: Any, guess: Any, squared: Any, site: Any, spans: Any) -> Any:
    """Give the new obstacle (row, a) the cells of row r that are nearer to it; where they begin, -1: region ended."""
    cols = site.shape[1]
    h = np.int64(r - row) * np.int64(r - row)
    name = np.int32(np.int32(row) << 16 | np.int32(a))
    p = interval_start(site, r, a, guess)
    stop = p
    while stop < cols:
        value = h + (stop - a) * (stop - a)
        if (site[r, stop] & 0xFFFF) != a and value > np.int64(squared[r, stop]):
            break
        squared[r, stop] = value
        site[r, stop] = name
        stop += 1
    first = p
    while first > 0:
        value = h + (first - 1 - a) * (first - 1 - a)
        if value >= np.int64(squared[r, first - 1]):
            break
        first -= 1
        squared[r, first] = value
        site[r, first] = name
    if first < stop:
        note_span(spans, r, first, stop)
        return first
    return p if is_region_alive(squared, site, r, a, h, p) else -1


@njit(cache=True, nogil=True)
def add_obstacles(new: Any, obstacle: Any, columns: Any, squared: Any, site: Any, spans: Any) -> None:
    """new: (N, 2) int32 cells, free before, at least one obstacle elsewhere. Work adds up if each rules what the next
    takes: hand them in scattered order."""
    rows = obstacle.shape[0]
    for k in range(new.shape[0]):
        row, a = np.int64(new[k, 0]), np.int64(new[k, 1])
        first_row, last_row = rows_ruled(columns, row, a, rows)
        guess = a
        for r in range(row, last_row + 1):
            guess = claim_row(r, row, a, guess, squared, site, spans)
            if guess < 0:
                break
        guess = a
        for r in range(row - 1, first_row - 1, -1):
            guess = claim_row(r, row, a, guess, squared, site, spans)
            if guess < 0:
                break
        obstacle[row, a] = 1
        columns[a, row >> 6] |= np.uint64(1) << np.uint64(row & 63)


@njit(cache=True, nogil=True)
def refill_run(
    r: Any, p: Any, q: Any, columns: Any, squared: Any, site: Any, apex: Any, height: Any, begins: Any, rows: Any
) -> None:
    """Cells [p, q) of row r have lost their obstacles: their neighbours' and those in columns between are left.

    rows: (C + 1,) int32 work, the row of each apex.
    """
    total_rows, cols = site.shape
    first_col: Any = 0
    last_col: Any = cols - 1
    bound: Any = np.int64(FAR - 1)
    if p > 0:
        left = np.int64(site[r, p - 1])
        first_col = max(first_col, left & 0xFFFF)
        away = max(abs(p - (left & 0xFFFF)), abs(q - 1 - (left & 0xFFFF)))
        bound = min(bound, away * away + (r - (left >> 16)) * (r - (left >> 16)))
    if q < cols:
        right = np.int64(site[r, q])
        last_col = min(last_col, right & 0xFFFF)
        away = max(abs(p - (right & 0xFFFF)), abs(q - 1 - (right & 0xFFFF)))
        bound = min(bound, away * away + (r - (right >> 16)) * (r - (right >> 16)))
    top = -1
    for c in range(first_col, last_col + 1):
        aside = max(max(p - c, c - (q - 1)), 0)
        left_over = bound - aside * aside
        if left_over < 0:
            continue
        row = nearest_in_column(columns, c, r, min(np.int64(np.sqrt(left_over)) + 1, total_rows), total_rows)
        if row == NO_ROW:
            continue
        top = push_parabola(c, np.int64(r - row) * np.int64(r - row), top, p, q, apex, height, begins)
        if apex[top] == c:
            rows[top] = row
    for k in range(top + 1):
        stop = np.int64(begins[k + 1]) if k < top else q
        here, base = np.int64(apex[k]), np.int64(height[k])
        name = np.int32(np.int32(rows[k]) << 16 | np.int32(here))
        for c in range(np.int64(begins[k]), stop):
            squared[r, c] = (c - here) * (c - here) + base
            site[r, c] = name


@njit(cache=True, nogil=True)
def release_row(
    r: Any, row: Any, a: Any, guess: Any, obstacle: Any, columns: Any, squared: Any, site: Any, spans: Any, apex: Any,
    height: Any, begins: Any, rows: Any,
) -> Any:  # fmt: skip
    """Find the cells of row r that the lost obstacle (row, a) ruled, and refill the run of orphans they are part of.

    Returns where they began, -1: its region has ended.
    """
    cols = site.shape[1]
    p = interval_start(site, r, a, guess)
    if p == cols or site[r, p] != np.int32(np.int32(row) << 16 | np.int32(a)):
        h = np.int64(r - row) * np.int64(r - row)
        return p if is_region_alive(squared, site, r, a, h, p) else -1
    first, stop = p, p + 1
    while first > 0 and not obstacle[site[r, first - 1] >> 16, site[r, first - 1] & 0xFFFF]:
        first -= 1
    while stop < cols and not obstacle[site[r, stop] >> 16, site[r, stop] & 0xFFFF]:
        stop += 1
    refill_run(r, first, stop, columns, squared, site, apex, height, begins, rows)
    note_span(spans, r, first, stop)
    return p


@njit(cache=True, nogil=True)
def remove_obstacles(
    lost: Any, ruled: Any, obstacle: Any, columns: Any, squared: Any, site: Any, spans: Any, apex: Any, height: Any,
    begins: Any, rows: Any,
) -> None:  # fmt: skip
    """lost: (N, 2) int32 cells with obstacles, others are left.  ruled: (N, 2) int32, work."""
    total_rows = obstacle.shape[0]
    for k in range(lost.shape[0]):
        ruled[k, 0], ruled[k, 1] = rows_ruled(columns, np.int64(lost[k, 0]), np.int64(lost[k, 1]), total_rows)
    for k in range(lost.shape[0]):
        row, a = np.int64(lost[k, 0]), np.int64(lost[k, 1])
        obstacle[row, a] = 0
        columns[a, row >> 6] &= ~(np.uint64(1) << np.uint64(row & 63))
    for k in range(lost.shape[0]):
        row, a = np.int64(lost[k, 0]), np.int64(lost[k, 1])
        guess = a
        for r in range(row, ruled[k, 1] + 1):
            guess = release_row(
                r, row, a, guess, obstacle, columns, squared, site, spans, apex, height, begins, rows
            )  # fmt: skip
            if guess < 0:
                break
        guess = a
        for r in range(row - 1, ruled[k, 0] - 1, -1):
            guess = release_row(
                r, row, a, guess, obstacle, columns, squared, site, spans, apex, height, begins, rows
            )  # fmt: skip
            if guess < 0:
                break
