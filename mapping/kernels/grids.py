"""Compiled loops of the occupancy grids (S26 to S28): fans of beams, single lines, runs of cells, tiles.

Cells are uint16 and live in square tiles of one pool, so that a kernel walks from tile to tile without going back to
Python. `cells` is the pool flattened: slot s, row r and column c within the tile stand at s * T * T + r * T + c. Slot
0 is scrap paper: tiles that found no room in the pool share it, it is written and never read.

    index      (R, C) int32    slot of each tile of the table, 0 none; table cell (0, 0) is tile (tile_row0, tile_col0)
    tile_at    (S, 2) int64    tile row and column of each slot
    free_slots (S,) int32      a stack of empty slots; state[FREE_COUNT] of them are left
    flags      (S,) uint8      bits set when a cell of the slot changes; who consumes a change clears its own bit
    window     (4,) int64      first row, end row, first column, end column that may be written, in map cells

Coordinates of kernels are in cells: x / resolution, so that cell (row, col) is [col, col + 1) x [row, row + 1).
Two models share the pool: COUNTERS keeps hits << 8 | misses (0: never observed), LOG_ODDS keeps ODDS_ZERO + value.
A cell that this scan has already dealt with holds MARK until the scan ends; its old content waits in `saved_*`.

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own: the cache does not tell the two apart)
and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.no_echo import reach_without_echo

TILE_BITS = 7
TILE = 1 << TILE_BITS
TILE_MASK = TILE - 1
TILE_CELLS = TILE * TILE

MARK = 0xFFFF
COUNTERS = 0
LOG_ODDS = 1
ODDS_ZERO = 0x4000  # a log-odds cell that was observed and is undecided

FREE_COUNT = 0
REFUSED = 1
STATE_LENGTH = 2

SPIKE_CELLS = 2.0  # a beam that looks this much farther than both neighbours gets a line of its own
SAVED_MISS = 0
SAVED_HIT = 1


@njit(cache=True, nogil=True)
def new_slot(
    table_row: Any, table_col: Any, tile_row0: int, tile_col0: int, index: Any, tile_at: Any, free_slots: Any,
    state: Any,
) -> Any:  # fmt: skip
    """A slot from the stack for a tile that has none; 0, the scrap slot, when the pool is full."""
    if state[FREE_COUNT] == 0:
        state[REFUSED] += 1
        return 0
    state[FREE_COUNT] -= 1
    slot = free_slots[state[FREE_COUNT]]
    index[table_row, table_col] = slot
    tile_at[slot, 0] = table_row + tile_row0
    tile_at[slot, 1] = table_col + tile_col0
    return slot


@njit(cache=True, nogil=True)
def miss_value(value: Any, model: int, rule: Any) -> Any:
    """A cell after one more miss; the inner loops of fill_spans do the same to whole runs.

    rule: COUNTERS: (limit,); LOG_ODDS: (hit step, miss step, lowest, highest), the last two with ODDS_ZERO added.
    """
    if model == COUNTERS:
        if (value & 0xFF) >= rule[0]:
            value = (value >> 1) & 0x7F7F
        return value + 1
    if value == 0:
        value = ODDS_ZERO
    return max(value - rule[1], rule[2])


@njit(cache=True, nogil=True)
def hit_value(value: Any, model: int, rule: Any) -> Any:
    """A cell after one more hit; see miss_value."""
    if model == COUNTERS:
        if (value >> 8) >= rule[0]:
            value = (value >> 1) & 0x7F7F
        return value + 256
    if value == 0:
        value = ODDS_ZERO
    return min(value + rule[0], rule[3])


@njit(cache=True, nogil=True)
def mark_cells(
    count: int, hits: int, todo_row: Any, todo_col: Any, saved_at: Any, saved_value: Any, saved_kind: Any,
    window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any,
    state: Any,
) -> int:  # fmt: skip
    """Put each listed cell aside, once, and MARK it: the first `hits` of them as hit, the others as missed.

    Cells outside the window are passed over. Returns how many were put aside; settle_cells ends what this begins.
    """
    row_lo, row_hi, col_lo, col_hi = window[0], window[1], window[2], window[3]
    saved = 0
    for k in range(count):
        row, col = np.int64(todo_row[k]), np.int64(todo_col[k])
        if row < row_lo or row >= row_hi or col < col_lo or col >= col_hi:
            continue
        table_row = (row >> TILE_BITS) - tile_row0
        table_col = (col >> TILE_BITS) - tile_col0
        slot: Any = np.int64(index[table_row, table_col])
        if slot == 0:
            slot = new_slot(table_row, table_col, tile_row0, tile_col0, index, tile_at, free_slots, state)
        at = (slot << (2 * TILE_BITS)) + ((row & TILE_MASK) << TILE_BITS) + (col & TILE_MASK)
        value = cells[at]
        if value == MARK:
            continue
        saved_at[saved] = at
        saved_value[saved] = value
        saved_kind[saved] = SAVED_HIT if k < hits else SAVED_MISS
        saved += 1
        cells[at] = MARK
        flags[slot] = 0xFF
    return saved


@njit(cache=True, nogil=True)
def settle_cells(
    saved: int, saved_at: Any, saved_value: Any, saved_kind: Any, cells: Any, model: int, rule: Any
) -> None:
    """End of a scan: every cell put aside gets its old content plus one hit or one miss."""
    for k in range(saved):
        value = np.int64(saved_value[k])
        if saved_kind[k] == SAVED_HIT:
            cells[saved_at[k]] = hit_value(value, model, rule)
        else:
            cells[saved_at[k]] = miss_value(value, model, rule)


@njit(cache=True, nogil=True)
def line_length(x0: float, y0: float, x1: float, y1: float) -> int:
    """How many cells a line from one point to another passes."""
    return int(abs(math.floor(x1) - math.floor(x0)) + abs(math.floor(y1) - math.floor(y0))) + 1


@njit(cache=True, nogil=True)
def mark_lines(
    lines: int, from_x: Any, from_y: Any, to_x: Any, to_y: Any, saved: int, saved_at: Any, saved_value: Any,
    saved_kind: Any, window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any,
    free_slots: Any, flags: Any, state: Any,
) -> int:  # fmt: skip
    """Put aside as missed, once each, the cells that lines pass, the same ones in both directions [AW87].

    A walk takes exactly as many steps as there are borders between its two end cells, so rounding can at worst swap
    two steps at a cell's corner; it cannot run past the end. Returns how many cells are put aside in all.
    """
    row_lo, row_hi, col_lo, col_hi = window[0], window[1], window[2], window[3]
    for k in range(lines):
        x0, y0, x1, y1 = from_x[k], from_y[k], to_x[k], to_y[k]
        if x1 < x0 or (x1 == x0 and y1 < y0):
            x0, y0, x1, y1 = x1, y1, x0, y0
        col, row = math.floor(x0), math.floor(y0)
        cols_left = math.floor(x1) - col
        row_step = 1 if y1 >= y0 else -1
        rows_left = abs(math.floor(y1) - row)
        per_col = 1.0 / (x1 - x0) if cols_left > 0 else 0.0
        per_row = 1.0 / abs(y1 - y0) if rows_left > 0 else 0.0
        to_col = (col + 1 - x0) * per_col
        to_row = (row + 1 - y0 if row_step > 0 else y0 - row) * per_row
        in_row, in_col = 0, 0  # the tile of the last cell
        slot: Any = np.int64(0)  # none
        while True:
            if row_lo <= row < row_hi and col_lo <= col < col_hi:
                if slot == 0 or row >> TILE_BITS != in_row or col >> TILE_BITS != in_col:
                    in_row, in_col = row >> TILE_BITS, col >> TILE_BITS
                    table_row, table_col = in_row - tile_row0, in_col - tile_col0
                    slot = np.int64(index[table_row, table_col])
                    if slot == 0:
                        slot = new_slot(table_row, table_col, tile_row0, tile_col0, index, tile_at, free_slots, state)
                    flags[slot] = 0xFF
                at = (slot << (2 * TILE_BITS)) + ((row & TILE_MASK) << TILE_BITS) + (col & TILE_MASK)
                value = cells[at]
                if value != MARK:
                    saved_at[saved] = at
                    saved_value[saved] = value
                    saved_kind[saved] = SAVED_MISS
                    saved += 1
                    cells[at] = MARK
            if cols_left + rows_left == 0:
                break
            if rows_left == 0 or (cols_left > 0 and to_col < to_row):
                col += 1
                cols_left -= 1
                to_col += per_col
            else:
                row += row_step
                rows_left -= 1
                to_row += per_row
    return saved


@njit(cache=True, nogil=True)
def fill_spans(
    found: int, cross_row: Any, cross_col: Any, sorted_col: Any, row_start: Any, row_lo: int, n_rows: int, oy: float,
    window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any,
    state: Any, model: int, rule: Any,
) -> None:  # fmt: skip
    """One miss for every cell whose centre lies inside the outline (even-odd rule), row by row.

    The outline comes counter-clockwise from bearing 0, so crossings above the sensor arrive from right to left and
    those below from left to right: laid down accordingly they are sorted already, but for rounding.
    """
    for k in range(n_rows + 1):
        row_start[k] = 0
    for k in range(found):
        row_start[cross_row[k] + 1] += 1
    for k in range(n_rows):
        row_start[k + 1] += row_start[k]
    first_above = math.ceil(oy - 0.5) - row_lo  # rows from here on have their centre at or above the sensor
    for k in range(found):
        row = cross_row[k]
        if row < first_above:
            sorted_col[row_start[row]] = cross_col[k]
            row_start[row] += 1
    for j in range(found):
        k = found - 1 - j
        row = cross_row[k]
        if row >= first_above:
            sorted_col[row_start[row]] = cross_col[k]
            row_start[row] += 1
    # From here on row_start[row] is the end of that row's crossings.

    limit = np.uint16(rule[0] & 0xFF)
    step, lowest = np.int32(rule[1]), np.int32(rule[2])
    col_lo, col_hi = window[2], window[3]
    begin = 0
    for row in range(n_rows):
        end = row_start[row]
        for a in range(begin + 1, end):
            value = sorted_col[a]
            b = a - 1
            while b >= begin and sorted_col[b] > value:
                sorted_col[b + 1] = sorted_col[b]
                b -= 1
            sorted_col[b + 1] = value
        table_row = ((row + row_lo) >> TILE_BITS) - tile_row0
        in_tile = ((row + row_lo) & TILE_MASK) << TILE_BITS
        for a in range(begin, end - 1, 2):
            col = max(np.int64(sorted_col[a]), col_lo)
            stop = min(np.int64(sorted_col[a + 1]), col_hi)
            while col < stop:
                table_col = (col >> TILE_BITS) - tile_col0
                tile_stop = min(stop, (col | TILE_MASK) + 1)
                slot: Any = np.int64(index[table_row, table_col])
                if slot == 0:
                    slot = new_slot(table_row, table_col, tile_row0, tile_col0, index, tile_at, free_slots, state)
                # Unsigned: a test for negative indices would keep these loops from becoming vector code.
                first = np.uint64((slot << (2 * TILE_BITS)) + in_tile + (col & TILE_MASK))
                last = first + np.uint64(tile_stop - col)
                if model == COUNTERS:
                    for at in range(first, last):
                        v = cells[at]
                        halved = (v >> np.uint16(1)) & np.uint16(0x7F7F)
                        cells[at] = (halved if (v & np.uint16(0xFF)) >= limit else v) + np.uint16(1)
                else:
                    for at in range(first, last):
                        w = np.int32(cells[at])
                        w = np.int32(ODDS_ZERO) if w == 0 else w
                        cells[at] = np.uint16(max(np.int32(w - step), lowest))
                flags[slot] = 0xFF
                col = tile_stop
        begin = end


@njit(cache=True, nogil=True)
def insert_fan(
    ox: float, oy: float, cos_yaw: float, sin_yaw: float, dir_x: Any, dir_y: Any, wedge: Any, free_len: Any,
    hit_len: Any, ray_x: Any, ray_y: Any, from_x: Any, from_y: Any, to_x: Any, to_y: Any,
    cross_row: Any, cross_col: Any, sorted_col: Any, row_start: Any,
    todo_row: Any, todo_col: Any, saved_at: Any, saved_value: Any, saved_kind: Any, needed: Any,
    window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any,
    state: Any, model: int, rule: Any,
) -> bool:  # fmt: skip
    """All beams of one scan from one origin: hits, lines of lone beams, and the star between neighbours (S28).

    ox, oy: the sensor, in cells.  dir_x, dir_y: (N,) unit vectors of the beams in the sensor frame, by bearing.
    wedge: (N,) how far the wedge between beam i and i + 1 (the last: and 0) may be called looked through, in cells;
    0: not neighbours.  free_len: (N,) length known to be free, in cells, negative: nothing known.
    hit_len: (N,) where the obstacle is, negative: none.
    Returns False, with nothing changed, if the work arrays are too small; needed: (crossings, listed cells, rows).
    """
    n = dir_x.size
    first = 0
    top = 0.0
    for i in range(n):
        ray_x[i] = cos_yaw * dir_x[i] - sin_yaw * dir_y[i]
        ray_y[i] = sin_yaw * dir_x[i] + cos_yaw * dir_y[i]
        top = max(top, free_len[i])
    for i in range(1, n):
        if ray_y[i] >= 0.0 and ray_y[i - 1] < 0.0 and ray_x[i] > 0.0:
            first = i
            break
    row_lo = max(window[0], math.floor(oy - top) - 1)
    row_hi = max(row_lo, min(window[1], math.floor(oy + top) + 2))

    # Crossings of the outline with the centre lines of the rows. At bearing i it steps from the reach of the wedge
    # before to the reach of the wedge after; a wedge that does not exist has reach 0, so its sides lead to the sensor.
    room = cross_row.size
    found = 0
    lines = 0
    to_save = n
    before = first - 1 if first > 0 else n - 1
    inner = max(0.0, min(free_len[before], min(free_len[first], wedge[before])))
    i = first
    for _ in range(n):
        nxt = i + 1 if i + 1 < n else 0
        outer = max(0.0, min(free_len[i], min(free_len[nxt], wedge[i])))
        reach = max(inner, outer)
        if reach > 0.0:
            x0, y0 = ox + inner * ray_x[i], oy + inner * ray_y[i]
            x1, y1 = ox + outer * ray_x[i], oy + outer * ray_y[i]
            x2, y2 = ox + outer * ray_x[nxt], oy + outer * ray_y[nxt]
            k0, k1, k2 = math.ceil(y0 - 0.5), math.ceil(y1 - 0.5), math.ceil(y2 - 0.5)
            if k0 != k1:
                lo, hi = max(min(k0, k1), row_lo), min(max(k0, k1), row_hi)
                slope = (x1 - x0) / (y1 - y0)
                for k in range(lo, hi):
                    if found < room:
                        cross_row[found] = k - row_lo
                        cross_col[found] = math.ceil(x0 + (k + 0.5 - y0) * slope - 0.5)
                    found += 1
            if k1 != k2:
                lo, hi = max(min(k1, k2), row_lo), min(max(k1, k2), row_hi)
                slope = (x2 - x1) / (y2 - y1)
                for k in range(lo, hi):
                    if found < room:
                        cross_row[found] = k - row_lo
                        cross_col[found] = math.ceil(x1 + (k + 0.5 - y1) * slope - 0.5)
                    found += 1
        if free_len[i] - reach > SPIKE_CELLS:
            start = max(0.0, reach - 1.0)
            from_x[lines], from_y[lines] = ox + start * ray_x[i], oy + start * ray_y[i]
            to_x[lines], to_y[lines] = ox + free_len[i] * ray_x[i], oy + free_len[i] * ray_y[i]
            to_save += line_length(from_x[lines], from_y[lines], to_x[lines], to_y[lines])
            lines += 1
        inner = outer
        i = nxt
    needed[0], needed[1], needed[2] = found, to_save, row_hi - row_lo + 1
    if found > room or to_save > saved_at.size or needed[2] > row_start.size:
        return False

    hits = 0
    for i in range(n):
        if hit_len[i] >= 0.0:
            todo_row[hits] = math.floor(oy + hit_len[i] * ray_y[i])
            todo_col[hits] = math.floor(ox + hit_len[i] * ray_x[i])
            hits += 1
    saved = mark_cells(
        hits, hits, todo_row, todo_col, saved_at, saved_value, saved_kind, window, tile_row0, tile_col0, cells,
        index, tile_at, free_slots, flags, state,
    )  # fmt: skip
    if lines > 0:
        saved = mark_lines(
            lines, from_x, from_y, to_x, to_y, saved, saved_at, saved_value, saved_kind, window, tile_row0, tile_col0,
            cells, index, tile_at, free_slots, flags, state,
        )  # fmt: skip
    if found > 0:
        fill_spans(
            found, cross_row, cross_col, sorted_col, row_start, row_lo, row_hi - row_lo, oy, window, tile_row0,
            tile_col0, cells, index, tile_at, free_slots, flags, state, model, rule,
        )  # fmt: skip
    settle_cells(saved, saved_at, saved_value, saved_kind, cells, model, rule)
    return True


@njit(cache=True, nogil=True)
def beam_lengths(
    bearing: Any, gap_max: float, range_m: Any, per_m: float, range_min_m: float, range_max_m: float, use_max_m: float,
    clear_no_return: bool, silent_m: Any, free_len: Any, hit_len: Any,
) -> bool:  # fmt: skip
    """What each beam proves, in cells: free up to free_len, an obstacle at hit_len; negative: nothing.

    +inf is free as far as mapping.no_echo has it if clear_no_return; silent_m: (N,) room for that. -inf frees nothing
    and is an obstacle at range_min_m if that is positive. NaN, negative numbers and numbers beyond range_max_m prove
    nothing. use_max_m cuts everything short. Returns whether any beam proves anything.
    """
    reach = min(range_max_m, use_max_m)
    some = False
    if clear_no_return:
        reach_without_echo(bearing, range_m, range_max_m, gap_max, silent_m)
    for i in range(range_m.size):
        r = range_m[i]
        free, hit = -1.0, -1.0
        if 0.0 <= r <= range_max_m:
            free = min(r, reach) * per_m
            if r <= reach:
                hit = r * per_m
        elif r == np.inf:
            if clear_no_return and silent_m[i] > 0.0:
                free = min(silent_m[i], use_max_m) * per_m
        elif r == -np.inf and range_min_m > 0.0:
            hit = range_min_m * per_m
        free_len[i] = free
        hit_len[i] = hit
        some = some or free >= 0.0 or hit >= 0.0
    return some


@njit(cache=True, nogil=True)
def insert_scan(
    ox: float, oy: float, cos_yaw: float, sin_yaw: float, bearing: Any, gap_max: float, range_m: Any, per_m: float,
    range_min_m: float, range_max_m: float, use_max_m: float, clear_no_return: bool, silent_m: Any,
    dir_x: Any, dir_y: Any, wedge: Any, free_len: Any,
    hit_len: Any, ray_x: Any, ray_y: Any, from_x: Any, from_y: Any, to_x: Any, to_y: Any,
    cross_row: Any, cross_col: Any, sorted_col: Any, row_start: Any,
    todo_row: Any, todo_col: Any, saved_at: Any, saved_value: Any, saved_kind: Any, needed: Any,
    window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any,
    state: Any, model: int, rule: Any,
) -> bool:  # fmt: skip
    """beam_lengths, then insert_fan."""
    if not beam_lengths(
        bearing, gap_max, range_m, per_m, range_min_m, range_max_m, use_max_m, clear_no_return, silent_m, free_len,
        hit_len,
    ):  # fmt: skip
        return True
    return bool(
        insert_fan(
            ox, oy, cos_yaw, sin_yaw, dir_x, dir_y, wedge, free_len, hit_len, ray_x, ray_y, from_x, from_y,
            to_x, to_y, cross_row, cross_col,
            sorted_col, row_start, todo_row, todo_col, saved_at, saved_value, saved_kind, needed, window, tile_row0,
            tile_col0, cells, index, tile_at, free_slots, flags, state, model, rule,
        )
    )  # fmt: skip


@njit(cache=True, nogil=True)
def insert_lines(
    lines: int, from_x: Any, from_y: Any, to_x: Any, to_y: Any, hits: int, todo_row: Any, todo_col: Any,
    saved_at: Any, saved_value: Any, saved_kind: Any, needed: Any,
    window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any,
    state: Any, model: int, rule: Any,
) -> bool:  # fmt: skip
    """One scan whose beams start at different places: `hits` listed cells, and misses along `lines` lines, in cells.

    Returns False, with nothing changed, if the work arrays are too small; needed[1]: cells to put aside.
    """
    to_save = hits
    for k in range(lines):
        to_save += line_length(from_x[k], from_y[k], to_x[k], to_y[k])
    needed[0], needed[1], needed[2] = 0, to_save, 0
    if to_save > saved_at.size:
        return False
    saved = mark_cells(
        hits, hits, todo_row, todo_col, saved_at, saved_value, saved_kind, window, tile_row0, tile_col0, cells,
        index, tile_at, free_slots, flags, state,
    )  # fmt: skip
    saved = mark_lines(
        lines, from_x, from_y, to_x, to_y, saved, saved_at, saved_value, saved_kind, window, tile_row0, tile_col0,
        cells, index, tile_at, free_slots, flags, state,
    )  # fmt: skip
    settle_cells(saved, saved_at, saved_value, saved_kind, cells, model, rule)
    return True


@njit(cache=True, nogil=True)
def insert_listed(
    count: int, hits: int, todo_row: Any, todo_col: Any, saved_at: Any, saved_value: Any, saved_kind: Any,
    window: Any, tile_row0: int, tile_col0: int, cells: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any,
    state: Any, model: int, rule: Any,
) -> None:  # fmt: skip
    """One observation given as cells: the first `hits` of them hit, the rest missed, each once, a hit before a miss."""
    saved = mark_cells(
        count, hits, todo_row, todo_col, saved_at, saved_value, saved_kind, window, tile_row0, tile_col0, cells,
        index, tile_at, free_slots, flags, state,
    )  # fmt: skip
    settle_cells(saved, saved_at, saved_value, saved_kind, cells, model, rule)


@njit(cache=True, nogil=True)
def halve_cells(cells: Any, start: int, stop: int, model: int) -> None:
    """Forget half of what was counted; a cell with nothing left becomes unknown. None becomes freer by rounding."""
    for at in range(np.uint64(start), np.uint64(stop)):
        v: Any = np.int32(cells[at])
        if model == COUNTERS:
            hits, misses = v >> 8, v & 0xFF
            total = (hits + misses) >> 1
            left = min((hits + 1) >> 1, total)
            if total == 1 and hits > 0 and misses > 0:
                total = left = 0  # one count cannot tell what two that disagree have told
            cells[at] = np.uint16(left << 8 | (total - left))
        elif v != 0:
            odds = v - np.int32(ODDS_ZERO)
            half = (abs(odds) >> 1) * (1 if odds > 0 else -1)
            cells[at] = np.uint16(0 if half == 0 else half + ODDS_ZERO)


@njit(cache=True, nogil=True)
def percent_of_tile(
    slot: int, cells: Any, laser_percent: Any, sonar: Any, with_sonar: bool, sonar_percent: Any, occupied: int, out: Any
) -> None:
    """(T, T) int8 of one tile as published: -1 unknown, 0 to 100.

    The sonar layer speaks where the laser knows nothing, and where it holds an obstacle the laser looks through
    (glass, table edges); it never makes freer what the laser knows.
    """
    base = np.uint64(slot << (2 * TILE_BITS))
    for row in range(TILE):
        for col in range(TILE):
            at = base + np.uint64((row << TILE_BITS) + col)
            value = laser_percent[cells[at]]
            if with_sonar:
                other = sonar_percent[sonar[at]]
                if value < 0 or (other >= occupied and other > value):
                    value = other
            out[row, col] = value


@njit(cache=True, nogil=True)
def changed_rectangle(new: Any, old: Any, rectangle: Any) -> bool:
    """Smallest rectangle (row, end row, column, end column) in which two arrays differ; False if nowhere."""
    rows, cols = new.shape
    row0, row1, col0, col1 = rows, 0, cols, 0
    for row in range(rows):
        for col in range(cols):
            if new[row, col] != old[row, col]:
                row0 = min(row0, row)
                row1 = row + 1
                col0 = min(col0, col)
                col1 = max(col1, col + 1)
    rectangle[0], rectangle[1], rectangle[2], rectangle[3] = row0, row1, col0, col1
    return bool(row1 > row0)


@njit(cache=True, nogil=True)
def measure_lines(origin: Any, end: Any, some: Any, out: Any) -> bool:
    """Of the lines that prove something: place of the middle one's origin, its farthest fellow, the longest line.

    origin, end: (N, 2).  some: (N,).  out: (4,) x, y, spread of the origins, longest.
    False if none proves anything. Not finite where a place is not.
    """
    count = 0
    for i in range(some.size):
        count += some[i]
    if count == 0:
        return False
    to_skip = count // 2
    for i in range(some.size):
        if some[i]:
            if to_skip == 0:
                out[0], out[1] = origin[i, 0], origin[i, 1]
                break
            to_skip -= 1
    spread, longest, sound = 0.0, 0.0, 0.0
    for i in range(some.size):
        if some[i]:
            x, y = origin[i, 0] - out[0], origin[i, 1] - out[1]
            spread = max(spread, x * x + y * y)
            x, y = end[i, 0] - origin[i, 0], end[i, 1] - origin[i, 1]
            longest = max(longest, x * x + y * y)
            sound += 0.0 * (origin[i, 0] + origin[i, 1] + end[i, 0] + end[i, 1])  # NaN from NaN and from inf
    out[2], out[3] = math.sqrt(spread) + sound, math.sqrt(longest) + sound
    return True


@njit(cache=True, nogil=True)
def fan_of_lines(
    x0: float, y0: float, spread: float, end: Any, free: Any, hit: Any, dir_x: Any, dir_y: Any, gap: Any,
    adjacent: Any, free_len: Any, hit_len: Any,
) -> int:  # fmt: skip
    """Lines as seen from (x0, y0), counter-clockwise; the fast way of mapping.grids.beam_model.fan_of_beams.

    gap, adjacent: (N,) angle to the next line (the last: to the first), and whether none was left out in between.
    Other outputs as in insert_fan, in metres. Returns how many lines there are; 0 if they are fewer than three or do
    not all run one way round, in less than a turn and in steps of less than a right angle: then they must be sorted.
    """
    count, before, start = 0, -1, -1
    turn, way = 0.0, 0.0
    for i in range(free.size):
        if not (free[i] or hit[i]):
            continue
        x, y = end[i, 0] - x0, end[i, 1] - y0
        length = math.sqrt(x * x + y * y)
        if length == 0.0:
            return 0
        x, y = x / length, y / length
        if count > 0:
            sine = dir_x[count - 1] * y - dir_y[count - 1] * x
            if sine * way < 0.0 or sine == 0.0 or dir_x[count - 1] * x + dir_y[count - 1] * y <= 0.0:
                return 0
            way = sine
            gap[count - 1] = math.asin(min(abs(sine), 1.0))
            turn += gap[count - 1]
            adjacent[count - 1] = i == before + 1
        else:
            start = i
        dir_x[count], dir_y[count] = x, y
        free_len[count] = -1.0 if not free[i] else length if hit[i] else max(length - spread, 0.0)
        hit_len[count] = length if hit[i] else -1.0
        before = i
        count += 1
    if count < 3 or turn > 2.0 * math.pi - 1e-6:
        return 0
    last = count - 1
    closing = (dir_x[last] * dir_y[0] - dir_y[last] * dir_x[0]) * (1.0 if way > 0.0 else -1.0)
    closes = turn > math.pi and closing > 0.0 and dir_x[last] * dir_x[0] + dir_y[last] * dir_y[0] > 0.0
    gap[last] = math.asin(min(closing, 1.0)) if closes else math.pi
    adjacent[last] = closes and start == 0 and before == free.size - 1
    if way < 0.0:
        for k in range(count // 2):
            j = last - k
            dir_x[k], dir_x[j] = dir_x[j], dir_x[k]
            dir_y[k], dir_y[j] = dir_y[j], dir_y[k]
            free_len[k], free_len[j] = free_len[j], free_len[k]
            hit_len[k], hit_len[j] = hit_len[j], hit_len[k]
        for k in range(last // 2):
            j = last - 1 - k
            gap[k], gap[j] = gap[j], gap[k]
            adjacent[k], adjacent[j] = adjacent[j], adjacent[k]
    return count
