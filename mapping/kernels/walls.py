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

from mapping.kernels.grids import TILE, TILE_BITS, TILE_MASK


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
    from_x: Any, from_y: Any, bearing: Any, range_m: Any, per_m: float, range_max_m: float, row0: int, col0: int,
    index: Any, ends: Any, passes: Any, full: int,
) -> None:  # fmt: skip
    """Count every beam with an end: one end where it ends, one pass in each cell that it crosses before.

    from_x, from_y: (N,) where the sensor was at each beam, or (1,) at all, in cells.  bearing: (N,) in the map.
    ends, passes: (cells of all tiles,) counts, added to. Where one of both has reached full both are halved: what
    counts is how many ends there are to a pass.
    Beams without echo, too close or not measured count nowhere, nor does what lies where no tile is.
    """
    for i in range(range_m.size):
        if not 0.0 <= range_m[i] <= range_max_m:  # catches NaN and infinities
            continue
        ox, oy = from_x[min(i, from_x.size - 1)], from_y[min(i, from_y.size - 1)]
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
                    if ends[at] >= full or passes[at] >= full:
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


@njit(cache=True, nogil=True)
def explain(near: Any, ended: Any, passed: Any, ends: Any, cost: Any, rule: Any, wall: Any) -> None:
    """Which of N cells are walls: those in which beams end, made thin, and those that explain the ends far from them.

    near: (N, 13) numbers of the cells NEAR each one, -1 none, the first eight around it in turn from +col on, the last
    itself.  ended, passed: (N,) counts of each cell, the second and `cost` with half a beam more.  ends, cost: (N,)
    the same spread over the neighbours.  rule: ends_per_pass, wall_per_pass, tip_per_pass of WallRules.
    wall: (N,) bool, written.
    """
    stays = np.zeros(len(wall), dtype=np.bool_)
    for k in range(len(wall)):
        wall[k] = ended[k] > 0.0 and ended[k] >= rule[1] * passed[k]
        stays[k] = wall[k] and ended[k] >= rule[2] * passed[k]
    make_thin(near, ends, cost, rule[0], stays, wall)
    left, price = ends.copy(), cost.copy()
    for k in range(len(wall)):
        if ended[k] == 0.0:
            price[k] = np.inf
        if wall[k]:
            for j in range(near.shape[1]):
                if near[k, j] >= 0:
                    left[near[k, j]] = 0.0
    cover(near, left, price, rule[0], wall)


@njit(cache=True, nogil=True)
def make_thin(near: Any, ends: Any, cost: Any, least: float, stays: Any, wall: Any) -> None:
    """Take cells out of walls where that opens no gap, first those that more beams pass than end in.

    near, ends, cost, wall: as in `explain`.  A cell goes unless the ends that no other wall is near are `least` of its
    cost, and only if the walls around it hang together without it (8-connected). The last cell of a row of walls goes
    only if it is not one that stays.
    """
    walls_near = np.zeros(len(wall), dtype=np.int16)
    asked = [(0.0, 0) for _ in range(0)]
    for k in range(len(wall)):
        if wall[k]:
            asked.append((ends[k] - cost[k], k))
            for j in range(near.shape[1]):
                if near[k, j] >= 0:
                    walls_near[near[k, j]] += 1
    heapq.heapify(asked)
    while len(asked) > 0:
        worth, k = heapq.heappop(asked)
        if not wall[k]:
            continue
        alone = 0.0
        for j in range(near.shape[1]):
            if near[k, j] >= 0 and walls_near[near[k, j]] == 1:
                alone += ends[near[k, j]]
        if alone >= least * cost[k] or not _may_go(near[k], stays[k], wall):
            continue
        wall[k] = False
        for j in range(near.shape[1]):
            if near[k, j] >= 0:
                walls_near[near[k, j]] -= 1
        for j in range(8):  # those of less worth were asked before: now they may go
            beside: Any = np.int64(near[k, j])
            if beside >= 0 and wall[beside] and ends[beside] - cost[beside] <= worth:
                heapq.heappush(asked, (ends[beside] - cost[beside], beside))


@njit(cache=True, nogil=True)
def _may_go(near: Any, stays: bool, wall: Any) -> bool:
    """Whether walls around a cell, near (13,), hang together without it (Yokoi's number for 8-connected figures)."""
    count, parts = 0, 0
    for j in range(8):
        count += near[j] >= 0 and wall[near[j]]
    for j in range(0, 8, 2):
        if not (near[j] >= 0 and wall[near[j]]):
            corner, side = near[j + 1], near[(j + 2) % 8]
            parts += (corner >= 0 and wall[corner]) or (side >= 0 and wall[side])
    return count == 0 or (parts == 1 and not (count == 1 and stays))


@njit(cache=True, nogil=True)
def judge_window(
    ends: Any, passes: Any, weight: Any, offsets: Any, rule: Any, half_a_beam: float, wall: Any
) -> None:  # fmt: skip
    """Which cells of a rectangle are walls, as BeamCounts.walls says it, what lies outside not being known.

    ends, passes: (R, C) counts.  weight: (3, 3) of a cell and those around it.  offsets: (13, 2) of the cells NEAR one.
    rule: as in `explain`.  wall: (R, C) bool, written; its outermost rows and columns are none.
    """
    rows, cols = ends.shape
    number = np.full((rows, cols), -1, dtype=np.int32)
    count = 0
    for row in range(1, rows - 1):
        for col in range(1, cols - 1):
            wall[row, col] = False
            if np.any(ends[row - 1 : row + 2, col - 1 : col + 2]):
                number[row, col] = count
                count += 1
    near = np.full((count, len(offsets)), -1, dtype=np.int32)
    ended, passed, spread, cost = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    for row in range(1, rows - 1):
        for col in range(1, cols - 1):
            k = number[row, col]
            if k < 0:
                continue
            ended[k], passed[k] = ends[row, col], passes[row, col] + half_a_beam
            cost[k] = half_a_beam
            for i in range(3):
                for j in range(3):
                    spread[k] += weight[i, j] * ends[row + i - 1, col + j - 1]
                    cost[k] += weight[i, j] * passes[row + i - 1, col + j - 1]
            for j in range(len(offsets)):
                at_row, at_col = row + offsets[j, 0], col + offsets[j, 1]
                if 0 <= at_row < rows and 0 <= at_col < cols:
                    near[k, j] = number[at_row, at_col]
    chosen = np.zeros(count, dtype=np.bool_)
    explain(near, ended, passed, spread, cost, rule, chosen)
    for row in range(1, rows - 1):
        for col in range(1, cols - 1):
            if number[row, col] >= 0:
                wall[row, col] = chosen[number[row, col]]


@njit(cache=True, nogil=True)
def percent_by_walls(
    slot: int, cells: Any, laser_percent: Any, sonar: Any, with_sonar: bool, sonar_percent: Any, wall: Any,
    occupied: int, least: int, reach: int, out: Any,
) -> None:  # fmt: skip
    """(T, T) int8 of one tile as published, what the laser says seen through the walls that were found in it.

    wall: (T, T) 0 or 1.  A wall that the laser calls at least `least` per cent occupied is shown as `occupied`; what it
    calls occupied, is no wall and has one shown within `reach` cells, in this tile, is shown as just less than that.
    The sonar layer speaks as in percent_of_tile.
    """
    base = slot << (2 * TILE_BITS)
    for row in range(TILE):
        for col in range(TILE):
            out[row, col] = laser_percent[cells[base + (row << TILE_BITS) + col]]
    for row in range(TILE):
        for col in range(TILE):
            value = out[row, col]
            if wall[row, col]:
                if least <= value < occupied:
                    out[row, col] = occupied
            elif value >= occupied and _is_by_a_wall(row, col, out, wall, least, reach):
                out[row, col] = occupied - 1
    if with_sonar:
        for row in range(TILE):
            for col in range(TILE):
                other = sonar_percent[sonar[base + (row << TILE_BITS) + col]]
                if out[row, col] < 0 or (other >= occupied and other > out[row, col]):
                    out[row, col] = other


@njit(cache=True, nogil=True)
def _is_by_a_wall(row: int, col: int, percent: Any, wall: Any, least: int, reach: int) -> bool:
    for i in range(max(0, row - reach), min(TILE, row + reach + 1)):
        for j in range(max(0, col - reach), min(TILE, col + reach + 1)):
            if wall[i, j] and percent[i, j] >= least:
                return True
    return False
