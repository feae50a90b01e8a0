"""Exact Euclidean distance of every cell to the nearest obstacle cell (S30), in two passes [FH12].

First along columns, row by row (a running count, vector code), then along each row the lower envelope of the
parabolas (c - c')^2 + g(c')^2, in whole numbers: the result is the exact squared distance in cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

FAR = 1 << 29  # squared distance where there is no obstacle at all


@njit(cache=True, nogil=True)
def column_distances(obstacle: Any, down: Any) -> None:
    """down: (R, C) int32, distance of each cell to the nearest obstacle of its column, at most R + C."""
    rows, cols = obstacle.shape
    limit = np.int32(rows + cols)
    for c in range(cols):
        down[0, c] = np.int32(0) if obstacle[0, c] else limit
    for r in range(1, rows):
        for c in range(cols):
            down[r, c] = np.int32(0) if obstacle[r, c] else min(np.int32(down[r - 1, c] + np.int32(1)), limit)
    for r in range(rows - 2, -1, -1):
        for c in range(cols):
            down[r, c] = min(down[r, c], np.int32(down[r + 1, c] + np.int32(1)))


@njit(cache=True, nogil=True)
def row_envelopes(down: Any, squared: Any, apex: Any, height: Any, begins: Any) -> None:
    """squared: (R, C) int32 from column_distances; apex, height, begins: (C + 1,) int32 work arrays.

    Parabola k of the envelope has its apex at column apex[k] with height height[k] and rules from column begins[k] on.
    """
    rows, cols = down.shape
    limit = rows + cols
    for r in range(rows):
        top = -1
        for c in range(cols):
            g = np.int64(down[r, c])
            if g >= limit:
                continue  # no obstacle in this column
            h = g * g
            start: Any = np.int64(0)
            while top >= 0:
                a = np.int64(apex[top])
                # First column at which the new parabola is below the old one.
                rise = h - np.int64(height[top]) + c * c - a * a
                gap = 2 * (c - a)
                start = rise // gap + 1 if rise >= 0 else np.int64(0)
                if start <= begins[top]:
                    top -= 1
                    start = np.int64(0)
                else:
                    break
            if top >= 0 and start >= cols:
                continue
            top += 1
            apex[top] = c
            height[top] = h
            begins[top] = start if top > 0 else 0
        if top < 0:
            for c in range(cols):
                squared[r, c] = FAR
            continue
        for k in range(top + 1):
            stop = np.int64(begins[k + 1]) if k < top else cols
            here = np.int32(apex[k])
            base = np.int32(height[k])
            for c in range(np.uint64(begins[k]), np.uint64(stop)):
                away = np.int32(np.int32(c) - here)
                squared[r, c] = np.int32(away * away + base)
