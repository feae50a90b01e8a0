"""Distances up to a reach, kept up to date as obstacles come and go (S30).

Distances beyond the reach are not kept: such cells have FAR and NO_SITE. What one obstacle rules then lies in a disc,
and in a row of it between two bisectors: with the next obstacle's column to its left, and to its right. A new obstacle
is held against the cells between; where a lost one ruled, its neighbours and the columns between them are asked. Row
after row, away from the obstacle, until the bisectors have crossed: a Voronoi region is convex, so it has ended.
Work: the cells that change, and some steps for each row of them; the discs at most, whatever the size of the map.

    obstacle (R, C) uint8    nearest (R, C) int16, row of the nearest obstacle of the cell's column, NO_ROW beyond reach
    squared  (R, C) int32    FAR where nothing is within reach
    site     (R, C) int32    the nearest obstacle cell, row << 16 | column; NO_SITE where nothing is within reach
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.clearance import FAR, NO_ROW, NO_SITE, note_span, push_parabola

SIDEWAYS = 6  # columns that are asked for a bisector: the next obstacle of a wall that beams have met here and there


@njit(cache=True, nogil=True)
def half_widths(reach: int) -> Any:
    """(reach + 1,) int32: how far a disc of that radius extends along a row that is so many rows from its centre."""
    half = np.empty(reach + 1, np.int32)
    width = reach
    for away in range(reach + 1):
        while width * width + away * away > reach * reach:
            width -= 1
        half[away] = width
    return half


@njit(cache=True, nogil=True)
def rows_of(nearest: Any, row: Any, a: Any) -> Any:
    """First and last row in which the obstacle (row, a) is the nearest of its column."""
    first, last = row, row
    while first > 0 and nearest[first - 1, a] == row:
        first -= 1
    while last + 1 < nearest.shape[0] and nearest[last + 1, a] == row:
        last += 1
    return first, last


@njit(cache=True, nogil=True)
def put_into_column(nearest: Any, row: Any, a: Any, reach: Any) -> None:
    """Let the new obstacle (row, a) be the nearest of its column where it is; of two the one in the smaller row."""
    for r in range(row, max(row - reach, 0) - 1, -1):
        other = np.int64(nearest[r, a])
        if other != NO_ROW and abs(r - other) <= row - r:
            break
        nearest[r, a] = row
    for r in range(row + 1, min(row + reach, nearest.shape[0] - 1) + 1):
        other = np.int64(nearest[r, a])
        if other != NO_ROW and abs(r - other) < r - row:
            break
        nearest[r, a] = row


@njit(cache=True, nogil=True)
def take_from_column(nearest: Any, row: Any, a: Any, reach: Any) -> None:
    """Leave the rows of the lost obstacle (row, a) to the obstacles of its column above and below."""
    first, last = rows_of(nearest, row, a)
    above = np.int64(nearest[first - 1, a]) if first > 0 else np.int64(NO_ROW)
    below = np.int64(nearest[last + 1, a]) if last + 1 < nearest.shape[0] else np.int64(NO_ROW)
    for r in range(first, last + 1):
        to_above = r - above if above != NO_ROW else reach + 1
        to_below = below - r if below != NO_ROW else reach + 1
        if min(to_above, to_below) > reach:
            nearest[r, a] = NO_ROW
        else:
            nearest[r, a] = above if to_above <= to_below else below


@njit(cache=True, nogil=True)
def between_bisectors(nearest: Any, r: Any, h: Any, a: Any, wide: Any) -> Any:
    """Columns [first, stop) of row r that the parabola (a, h) can rule at most, and whether its region goes on.

    wide: half the width of the disc in this row. The obstacle counts as the nearest of its column in this row.
    """
    cols = nearest.shape[1]
    left, right = np.float64(-wide), np.float64(wide)
    for step in range(1, min(SIDEWAYS, a) + 1):
        other = np.int64(nearest[r, a - step])
        if other != NO_ROW:
            # (x + step)^2 + g = x^2 + h, x from column a
            left = max(left, (h - (r - other) * (r - other) - step * step) / (2.0 * step))
            break
    for step in range(1, min(SIDEWAYS, cols - 1 - a) + 1):
        other = np.int64(nearest[r, a + step])
        if other != NO_ROW:
            right = min(right, ((r - other) * (r - other) - h + step * step) / (2.0 * step))
            break
    first = max(a + np.int64(np.ceil(left)), 0)
    stop = min(a + np.int64(np.floor(right)) + 1, cols)
    return first, stop, left <= right


@njit(cache=True, nogil=True)
def claim(row: Any, a: Any, half: Any, nearest: Any, squared: Any, site: Any, spans: Any) -> None:
    """Give the new obstacle (row, a), which its column knows of, what it rules."""
    name, order = np.int32(row << 16 | a), np.int32(a << 16 | row)
    for way in (-1, 1):
        r = row if way < 0 else row + 1
        while 0 <= r < nearest.shape[0] and nearest[r, a] == row:
            h = (r - row) * (r - row)
            first, stop, goes_on = between_bisectors(nearest, r, h, a, np.int64(half[abs(r - row)]))
            if not goes_on:
                break
            here, height, middle = np.uint64(r), np.int32(h), np.int32(a)
            for c in range(np.uint64(first), np.uint64(max(first, stop))):
                away = np.int32(np.int32(c) - middle)
                value = np.int32(height + np.int32(away * away))
                was, its = squared[here, c], site[here, c]
                by_column = np.int32(np.int32(its << np.int32(16)) | np.int32(its >> np.int32(16)))
                nearer = (value < was) | ((value == was) & (order < by_column))
                squared[here, c] = value if nearer else was
                site[here, c] = name if nearer else its
            if first < stop:
                note_span(spans, r, first, stop)
            r += way


@njit(cache=True, nogil=True)
def find_ruled(row: Any, a: Any, half: Any, nearest: Any, site: Any, runs: Any, n: Any) -> Any:
    """Write what the obstacle (row, a) rules into runs from the n-th on: row, first column, end; how many there are."""
    name = np.int32(row << 16 | a)
    for way in (-1, 1):
        r = row if way < 0 else row + 1
        while 0 <= r < nearest.shape[0] and nearest[r, a] == row:
            h = (r - row) * (r - row)
            first, stop, goes_on = between_bisectors(nearest, r, h, a, np.int64(half[abs(r - row)]))
            if not goes_on:
                break
            while first < stop and site[r, first] != name:
                first += 1
            while first < stop and site[r, stop - 1] != name:
                stop -= 1
            if first < stop:
                runs[n, 0], runs[n, 1], runs[n, 2] = r, first, stop
                n += 1
            r += way
    return n


@njit(cache=True, nogil=True)
def is_orphan(name: Any, obstacle: Any) -> bool:
    """Whether the obstacle that a cell names is none any more."""
    return bool(name >= 0 and obstacle[name >> 16, name & 0xFFFF] == 0)


@njit(cache=True, nogil=True)
def refill(
    r: Any, p: Any, q: Any, reach: Any, nearest: Any, squared: Any, site: Any, apex: Any, height: Any, begins: Any
) -> None:
    """Cells [p, q) of row r have lost their obstacles: their neighbours' and those in columns between are left."""
    cols = site.shape[1]
    first_col: Any = max(0, p - reach)
    last_col: Any = min(cols - 1, q - 1 + reach)
    farthest = np.int64(reach * reach)
    bound = farthest
    if p > 0 and site[r, p - 1] >= 0:
        left = np.int64(site[r, p - 1])
        first_col = max(first_col, left & 0xFFFF)
        away = max(abs(p - (left & 0xFFFF)), abs(q - 1 - (left & 0xFFFF)))
        bound = min(bound, away * away + (r - (left >> 16)) * (r - (left >> 16)))
    if q < cols and site[r, q] >= 0:
        right = np.int64(site[r, q])
        last_col = min(last_col, right & 0xFFFF)
        away = max(abs(p - (right & 0xFFFF)), abs(q - 1 - (right & 0xFFFF)))
        bound = min(bound, away * away + (r - (right >> 16)) * (r - (right >> 16)))
    top: Any = -1
    for c in range(first_col, last_col + 1):
        row = np.int64(nearest[r, c])
        if row == NO_ROW:
            continue
        h = (r - row) * (r - row)
        aside = max(max(p - c, c - (q - 1)), 0)
        if h + aside * aside <= bound:
            top = push_parabola(c, h, top, p, q, apex, height, begins)
    if top < 0:
        squared[r, p:q] = FAR
        site[r, p:q] = NO_SITE
        return
    for k in range(top + 1):
        stop = np.int64(begins[k + 1]) if k < top else q
        here, base = np.int64(apex[k]), np.int64(height[k])
        name = np.int32(np.int32(nearest[r, here]) << 16 | np.int32(here))
        for c in range(np.int64(begins[k]), stop):
            value = (c - here) * (c - here) + base
            squared[r, c] = value if value <= farthest else FAR
            site[r, c] = name if value <= farthest else np.int32(NO_SITE)


@njit(cache=True, nogil=True)
def change_within(
    new: Any, lost: Any, half: Any, obstacle: Any, nearest: Any, squared: Any, site: Any, spans: Any, apex: Any,
    height: Any, begins: Any,
) -> None:  # fmt: skip
    """new: (N, 2) int32 cells, free before.  lost: (M, 2) int32, obstacles before.  half: `half_widths` of the reach.

    What the lost ones ruled is found before anything changes. Then columns are brought up to date, so that nobody looks
    at what another of the same change rules: orphans first, who may go to a new obstacle at once.
    """
    cols = site.shape[1]
    reach = half.size - 1
    runs = np.empty((lost.shape[0] * (2 * reach + 1), 3), np.int32)
    n: Any = np.int64(0)
    for k in range(lost.shape[0]):
        n = find_ruled(np.int64(lost[k, 0]), np.int64(lost[k, 1]), half, nearest, site, runs, n)
    for k in range(lost.shape[0]):
        row, a = np.int64(lost[k, 0]), np.int64(lost[k, 1])
        obstacle[row, a] = 0
        take_from_column(nearest, row, a, reach)
    for k in range(new.shape[0]):
        row, a = np.int64(new[k, 0]), np.int64(new[k, 1])
        obstacle[row, a] = 1
        put_into_column(nearest, row, a, reach)
    for k in range(n):
        r, first, stop = np.int64(runs[k, 0]), np.int64(runs[k, 1]), np.int64(runs[k, 2])
        if not is_orphan(site[r, first], obstacle):
            continue  # found a home with the run beside it
        while first > 0 and is_orphan(site[r, first - 1], obstacle):
            first -= 1
        while stop < cols and is_orphan(site[r, stop], obstacle):
            stop += 1
        refill(r, first, stop, reach, nearest, squared, site, apex, height, begins)
        note_span(spans, r, first, stop)
    for k in range(new.shape[0]):
        claim(np.int64(new[k, 0]), np.int64(new[k, 1]), half, nearest, squared, site, spans)
