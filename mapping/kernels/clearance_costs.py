"""What the clearance layer of a grid takes of each cell (S30): which are obstacles now, and what their distances cost.

cells    (R, C) int8, per cent occupied, -1 unknown    obstacle, squared  (R + 2, C + 2), a rim of a cell around
layer    (R, C) int8, costs, -1 where cells are unknown
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def changed_in_row(cells: Any, r: Any, part: Any, occupied: Any, unknown_too: bool, obstacle: Any) -> Any:
    """How many cells of a row of a part [row0, row1, col0, col1) became obstacles, and how many are none any more."""
    came, went = np.int32(0), np.int32(0)
    now, was = cells[r, part[2] : part[3]], obstacle[r + 1, part[2] + 1 : part[3] + 1]
    for i in range(now.size):
        is_one = (now[i] >= occupied) | (unknown_too & (now[i] < 0))
        came += np.int32(is_one & (was[i] == 0))
        went += np.int32((not is_one) & (was[i] != 0))
    return came, went


@njit(cache=True, nogil=True)
def count_changed(cells: Any, part: Any, occupied: Any, unknown_too: bool, obstacle: Any) -> Any:
    """`changed_in_row` of all rows of the part."""
    came, went = 0, 0
    for r in range(part[0], part[1]):
        came_here, went_here = changed_in_row(cells, r, part, occupied, unknown_too, obstacle)
        came += came_here
        went += went_here
    return came, went


@njit(cache=True, nogil=True)
def list_changed(
    cells: Any, part: Any, occupied: Any, unknown_too: bool, obstacle: Any, came: Any, went: Any
) -> None:  # fmt: skip
    """came, went: (N, 2) int64 as many as `count_changed` counted; cells of the rimmed arrays, row by row."""
    n, m = 0, 0
    for r in range(part[0], part[1]):
        came_here, went_here = changed_in_row(cells, r, part, occupied, unknown_too, obstacle)
        if came_here + went_here == 0:
            continue
        for c in range(part[2], part[3]):
            is_one = cells[r, c] >= occupied or (unknown_too and cells[r, c] < 0)
            was = obstacle[r + 1, c + 1] != 0
            if is_one and not was:
                came[n, 0], came[n, 1] = r + 1, c + 1
                n += 1
            elif was and not is_one:
                went[m, 0], went[m, 1] = r + 1, c + 1
                m += 1


@njit(cache=True, nogil=True)
def put_costs(cells: Any, squared: Any, costs: Any, spans: Any, layer: Any) -> None:
    """Set the layer anew in columns [spans[r, 0], spans[r, 1]) of each row r of the rimmed arrays, as far as they are
    cells. costs: (K,) int8 by squared distance, the last for all that is farther."""
    rows, cols = cells.shape
    last = np.int32(costs.size - 1)
    for r in range(rows):
        here = np.uint64(r)
        for c in range(np.uint64(max(spans[r + 1, 0] - 1, 0)), np.uint64(max(min(spans[r + 1, 1] - 1, cols), 0))):
            away = squared[here + np.uint64(1), c + np.uint64(1)]
            layer[here, c] = np.int8(-1) if cells[here, c] < 0 else costs[np.uint64(min(away, last))]


@njit(cache=True, nogil=True)
def put_seen(cells: Any, squared: Any, costs: Any, part: Any, layer: Any) -> None:
    """Set the layer anew where cells of a part [row0, row1, col0, col1) became known, or are unknown again."""
    last = np.int32(costs.size - 1)
    for r in range(part[0], part[1]):
        now, was, turned = cells[r, part[2] : part[3]], layer[r, part[2] : part[3]], np.int32(0)
        for i in range(now.size):
            turned += np.int32((now[i] < 0) != (was[i] < 0))
        if turned == 0:
            continue
        for c in range(part[2], part[3]):
            if (cells[r, c] < 0) != (layer[r, c] < 0):
                layer[r, c] = np.int8(-1) if cells[r, c] < 0 else costs[min(squared[r + 1, c + 1], last)]


@njit(cache=True, nogil=True)
def known_box(cells: Any) -> Any:
    """Rows and columns [row0, row1), [col0, col1) around what is known; all 0 if nothing is."""
    rows, cols = cells.shape
    row0, row1, col0, col1 = rows, 0, cols, 0
    for r in range(rows):
        first = 0
        while first < cols and cells[r, first] < 0:
            first += 1
        if first == cols:
            continue
        last = cols
        while last > col1 and cells[r, last - 1] < 0:
            last -= 1
        row0, row1 = min(row0, r), r + 1
        col0, col1 = min(col0, first), max(col1, last)
    return (row0, row1, col0, col1) if row1 > 0 else (0, 0, 0, 0)
