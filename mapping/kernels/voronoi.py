"""Compiled loops of the Voronoi abstraction (S44): which cells lie between two obstacles, and the lines they form.

    squared (R, C) int32    squared distance to the nearest obstacle, 0 on obstacles, FAR where there is none
    site    (R, C) int32    that obstacle (the base point), row << 16 | column
    axis    (R, C) bool     cells on the Voronoi diagram

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.clearance import FAR


@njit(cache=True, nogil=True)
def side_of_bisector(first: Any, second: Any, r: int, c: int, rr: int, cc: int, gap2: int) -> Any:
    """Where the bisector of two base points crosses the step from cell (r, c) to (rr, cc): 1 nearer to the first cell,
    2 to the second, 3 midway; 0 if the base points are within sqrt(gap2) of each other."""
    br, bc = np.int64(first) >> 16, np.int64(first) & 0xFFFF
    dr, dc = br - (np.int64(second) >> 16), bc - (np.int64(second) & 0xFFFF)
    if dr * dr + dc * dc <= gap2:
        return 0
    side = dr * (2 * br - dr - r - rr) + dc * (2 * bc - dc - c - cc)
    return 3 if side == 0 else 1 if side > 0 else 2


@njit(cache=True, nogil=True)
def axis_cells(squared: Any, site: Any, gap2: int, spans: Any, axis: Any) -> None:
    """Say anew which cells lie on the diagram, in the columns spans[r, 0] to spans[r, 1] - 1 of each row.

    A free cell does if the bisector between its base point and that of one of its four neighbours passes through it:
    the integer medial axis of Hesselink and Roerdink (2008). It needs no more than the cells beside each cell, so a
    change moves it only where base points change.
    """
    rows, cols = squared.shape
    for r in range(rows):
        for c in range(spans[r, 0], spans[r, 1]):
            on = False
            here = site[r, c]
            if 0 < squared[r, c] < FAR:
                if c > 0 and site[r, c - 1] != here and squared[r, c - 1] > 0:
                    on = side_of_bisector(site[r, c - 1], here, r, c - 1, r, c, gap2) >= 2
                if not on and c + 1 < cols and site[r, c + 1] != here and squared[r, c + 1] > 0:
                    on = side_of_bisector(here, site[r, c + 1], r, c, r, c + 1, gap2) & 1 == 1
                if not on and r > 0 and site[r - 1, c] != here and squared[r - 1, c] > 0:
                    on = side_of_bisector(site[r - 1, c], here, r - 1, c, r, c, gap2) >= 2
                if not on and r + 1 < rows and site[r + 1, c] != here and squared[r + 1, c] > 0:
                    on = side_of_bisector(here, site[r + 1, c], r, c, r + 1, c, gap2) & 1 == 1
            axis[r, c] = on
