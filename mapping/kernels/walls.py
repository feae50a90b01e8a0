"""Compiled loops of mapping.grids.walls: ends and passes of beams, cell by cell, and the cells that explain the ends.

Counts live in tiles of TILE x TILE cells: number k of the tile of cell (row, col) is index[row >> TILE_BITS - row0,
col >> TILE_BITS - col0], -1 none; the cell stands at k * TILE_CELLS + row in tile * TILE + col in tile.
"""

from __future__ import annotations

import heapq
import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.grids import TILE_BITS, TILE_MASK

FULL = 65535


@njit(cache=True, nogil=True)
def mark_ends(
    ox: float, oy: float, bearing: Any, range_m: Any, per_m: float, range_max_m: float, row0: int, col0: int,
    index: Any, margin: int, marked: Any,
) -> None:  # fmt: skip
    """Mark the tiles (T,) that lie within `margin` cells, less than a tile, of where a beam ends; as count_beams."""
    for i in range(range_m.size):
        if not 0.0 <= range_m[i] <= range_max_m:
            continue
        length = range_m[i] * per_m
        col, row = math.floor(ox + length * math.cos(bearing[i])), math.floor(oy + length * math.sin(bearing[i]))
        for near_row in (row - margin, row + margin):
            for near_col in (col - margin, col + margin):
                table_row, table_col = (near_row >> TILE_BITS) - row0, (near_col >> TILE_BITS) - col0
                if 0 <= table_row < index.shape[0] and 0 <= table_col < index.shape[1]:
                    tile = np.int64(index[table_row, table_col])
                    if tile >= 0:
                        marked[tile] = True


@njit(cache=True, nogil=True)
def count_beams(
    ox: float, oy: float, bearing: Any, range_m: Any, per_m: float, range_max_m: float, row0: int, col0: int,
    index: Any, ends: Any, passes: Any,
) -> None:  # fmt: skip
    """Count every beam with an end: one end where it ends, one pass in each cell that it crosses before.

    ox, oy: the sensor, in cells.  bearing: (N,) in the map.  ends, passes: (cells of all tiles,) counts, added to.
    Where one of both has reached FULL both are halved: what counts is how many ends there are to a pass.
    Beams without echo, too close or not measured count nowhere, nor does what lies where no tile is.
    """
    for i in range(range_m.size):
        if not 0.0 <= range_m[i] <= range_max_m:  # catches NaN and infinities
            continue
        length = range_m[i] * per_m
        x, y = ox + length * math.cos(bearing[i]), oy + length * math.sin(bearing[i])
        col, row = math.floor(ox), math.floor(oy)
        col_step, row_step = (1 if x >= ox else -1), (1 if y >= oy else -1)
        cols_left, rows_left = abs(math.floor(x) - col), abs(math.floor(y) - row)
        per_col = 1.0 / abs(x - ox) if cols_left > 0 else 0.0
        per_row = 1.0 / abs(y - oy) if rows_left > 0 else 0.0
        to_col = (col + 1 - ox if col_step > 0 else ox - col) * per_col
        to_row = (row + 1 - oy if row_step > 0 else oy - row) * per_row
        while True:
            table_row, table_col = (row >> TILE_BITS) - row0, (col >> TILE_BITS) - col0
            if 0 <= table_row < index.shape[0] and 0 <= table_col < index.shape[1]:
                tile = np.int64(index[table_row, table_col])
                if tile >= 0:
                    at = (tile << (2 * TILE_BITS)) + ((row & TILE_MASK) << TILE_BITS) + (col & TILE_MASK)
                    if ends[at] == FULL or passes[at] == FULL:
                        ends[at] >>= 1
                        passes[at] >>= 1
                    if cols_left + rows_left == 0:
                        ends[at] += 1
                    else:
                        passes[at] += 1
            if cols_left + rows_left == 0:
                break
            if rows_left == 0 or (cols_left > 0 and to_col < to_row):
                col += col_step
                cols_left -= 1
                to_col += per_col
            else:
                row += row_step
                rows_left -= 1
                to_row += per_row


@njit(cache=True, nogil=True)
def cover(near: Any, ends: Any, cost: Any, least: float, chosen: Any) -> None:
    """Greedy cover with costs: again and again the cell that explains most ends for its cost, until it is below least.

    near: (N, K) cells whose ends a cell explains, itself among them, -1 none.  ends: (N,) weights.  cost: (N,) above
    0.  chosen: (N,) bool, set.  What a cell is worth can only fall, so the greatest old value is looked at first and
    is right if it is still the greatest when worked out anew (lazy greedy). Equals go by number.
    """
    left = ends.copy()
    worth = [(0.0, 0) for _ in range(0)]
    for k in range(near.shape[0]):
        value = 0.0
        for j in range(near.shape[1]):
            if near[k, j] >= 0:
                value += left[near[k, j]]
        if value >= least * cost[k]:
            worth.append((-value / cost[k], k))
    heapq.heapify(worth)
    while len(worth) > 0:
        k = worth[0][1]
        value = 0.0
        for j in range(near.shape[1]):
            if near[k, j] >= 0:
                value += left[near[k, j]]
        value /= cost[k]
        old = -worth[0][0]
        heapq.heappop(worth)
        if value < least:
            continue
        if value < old:
            heapq.heappush(worth, (-value, k))
            continue
        chosen[k] = True
        for j in range(near.shape[1]):
            if near[k, j] >= 0:
                left[near[k, j]] = 0.0
