"""The borders of occupied space in a grid, as straight pieces along the cells: a map for programs that draw lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def occupied_borders(occupied: NDArray[np.bool_]) -> F64:
    """(N, 4) x0, y0, x1, y1 in cells from the lower left corner: every stretch of an edge between an occupied cell and
    one that is not, as long as it goes straight, with the occupied cells to the left (free space to the right).

    occupied: (R, C), row 0 lowest; beyond it nothing is occupied. Raises ValueError for another shape.
    """
    mask = np.asarray(occupied, dtype=np.bool_)
    if mask.ndim != 2:
        raise ValueError(f"a grid has rows and columns, got shape {mask.shape}")
    level = _runs(mask)
    upright = _runs(mask.T)[:, [1, 0, 3, 2]]
    return np.concatenate((level, upright[:, [2, 3, 0, 1]]))


def _runs(mask: NDArray[np.bool_]) -> F64:
    """(N, 4) the level borders, occupied cells to the left: to the east below them, to the west above."""
    padded = np.pad(mask, 1).astype(np.int8)
    change = np.diff(padded, axis=0)[:, 1:-1]  # row y: from the cells below the line y to those above
    found = []
    for sign in (1, -1):
        ends = np.diff(np.pad(change == sign, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        y, first = np.nonzero(ends == 1)
        _, last = np.nonzero(ends == -1)
        x0, x1 = (first, last) if sign == 1 else (last, first)
        found.append(np.stack((x0, y, x1, y), axis=-1))
    return np.concatenate(found).astype(np.float64)
