"""The Voronoi diagram of a grid, exact and kept up to date (S44, first half; [Thr98]).

Each free cell knows its nearest obstacle cell, the base point; cells whose neighbour has another, far from their own,
lie on the diagram. What is not surely free is an obstacle, and so is everything beyond the border of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import voronoi as kernels

Bools = NDArray[np.bool_]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

MAX_SIDE_CELLS = 20_000


@dataclass(frozen=True, slots=True)
class Touched:
    """What an update changed: the box of rows and columns looked at (half open), and how many cells that were."""

    top: int
    left: int
    bottom: int
    right: int
    cells: int


class VoronoiGrid:
    """Distances, base points and Voronoi cells of a grid of free cells, current after every change.

    squared: (R, C) int32 squared distance in cells between the centres of a cell and its base point, 0 on obstacles.
    base: (R, C, 2) int16 row and column of the base point.  axis: (R, C) cells on the diagram.  free: (R, C).
    All four are views to read, valid until the next change.
    """

    def __init__(self, free: ArrayLike, *, gap_cells: float = 4.0) -> None:
        """From scratch, in time proportional to the cells.

        free: (R, C), True where a robot may be: seen and empty. The cells of the border count as obstacles.
        gap_cells: two base points closer than this are one obstacle; passages narrower than this have no diagram.
        Raises ValueError if free is not (R, C), has a side below 3 or above 20,000, or gap_cells is negative.
        """
        given = np.asarray(free, dtype=np.bool_)
        if given.ndim != 2 or min(given.shape) < 3 or max(given.shape) > MAX_SIDE_CELLS:
            raise ValueError(f"free cells are (R, C) with sides from 3 to {MAX_SIDE_CELLS}, got {given.shape}")
        if not gap_cells >= 0.0:
            raise ValueError(f"gap_cells is a length, got {gap_cells}")
        rows, cols = given.shape
        self.gap_cells = float(gap_cells)
        self._gap2 = int(self.gap_cells * self.gap_cells)
        self._obstacle = np.ones((rows, cols), dtype=np.bool_)
        np.logical_not(given[1:-1, 1:-1], out=self._obstacle[1:-1, 1:-1])
        self._row_near: I16 = np.empty((rows, cols), dtype=np.int16)
        self.squared: I32 = np.empty((rows, cols), dtype=np.int32)
        self.base: I16 = np.empty((rows, cols, 2), dtype=np.int16)
        self.axis: Bools = np.empty((rows, cols), dtype=np.bool_)
        self._work = np.empty((3, cols + 1), dtype=np.int32)
        self._low = np.zeros(rows, dtype=np.int64)
        self._high = np.full(rows, cols - 1, dtype=np.int64)
        kernels.near_rows(self._obstacle, self._row_near)
        kernels.nearest_obstacles(self._obstacle, self._row_near, self.squared, self.base, self._work)
        kernels.axis_cells(self.squared, self.base, self._gap2, 0, rows, self._low, self._high, self.axis)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._obstacle.shape[0], self._obstacle.shape[1]

    @property
    def free(self) -> Bools:
        """Cells that are no obstacles; a new array."""
        return ~self._obstacle

    def update(self, free: ArrayLike) -> Touched | None:
        """Take over a grid of the same shape, looking again only at cells whose base point may have changed.

        The result is what a new start would give, bit for bit. None if nothing changed.
        Raises ValueError for another shape.
        """
        given = np.asarray(free, dtype=np.bool_)
        if given.shape != self._obstacle.shape:
            raise ValueError(f"the grid has the shape {self._obstacle.shape}, got {given.shape}")
        changed = given[1:-1, 1:-1] == self._obstacle[1:-1, 1:-1]
        rows, cols = np.nonzero(changed)
        return self.set_cells(rows + 1, cols + 1, given[rows + 1, cols + 1])

    def set_cells(self, rows: ArrayLike, cols: ArrayLike, free: ArrayLike) -> Touched | None:
        """Make single cells free or obstacles: rows, cols, free are (N,). Cells of the border stay obstacles.

        As update, for callers that know what changed. Raises ValueError for cells outside, or unequal lengths.
        """
        r, c, wanted = np.asarray(rows, dtype=np.int64), np.asarray(cols, dtype=np.int64), np.asarray(free, dtype=bool)
        if not (r.ndim == 1 and r.shape == c.shape == wanted.shape):
            raise ValueError("rows, cols and free are (N,) of one length")
        height, width = self.shape
        if r.size and not (r.min() >= 0 and r.max() < height and c.min() >= 0 and c.max() < width):
            raise ValueError(f"a cell is outside of the grid of {height} x {width}")
        within = (r > 0) & (r < height - 1) & (c > 0) & (c < width - 1)
        before = self._obstacle[r, c]
        self._obstacle[r[within], c[within]] = ~wanted[within]
        differs = before != self._obstacle[r, c]
        if not differs.any():
            return None
        span = np.empty((width, 2), dtype=np.int64)
        span[:, 0], span[:, 1] = height, -1
        np.minimum.at(span[:, 0], c[differs], r[differs])
        np.maximum.at(span[:, 1], c[differs], r[differs])
        low, high = self._low, self._high
        low[:], high[:] = width, -1
        kernels.update_columns(self._obstacle, self._row_near, span, low, high)
        looked = int(kernels.update_rows(self._row_near, low, high, self.squared, self.base, self._work))
        concerned = np.flatnonzero(high >= low)
        top, bottom = int(concerned[0]), int(concerned[-1]) + 1
        left, right = int(low[concerned].min()), int(high[concerned].max()) + 1
        # A cell's place on the diagram hangs on its four neighbours, so look one cell farther.
        near_low, near_high = _spread(low, high, width)
        kernels.axis_cells(
            self.squared, self.base, self._gap2, max(top - 1, 0), min(bottom + 1, height), near_low, near_high, self.axis
        )
        return Touched(max(top - 1, 0), max(left - 1, 0), min(bottom + 1, height), min(right + 1, width), looked)


def _spread(low: I64, high: I64, width: int) -> tuple[I64, I64]:
    """Spans of columns by row, one cell wider in all four directions."""
    wide_low, wide_high = np.maximum(low - 1, 0), np.minimum(high + 1, width - 1)
    wide_low[1:], wide_high[1:] = np.minimum(wide_low[1:], low[:-1]), np.maximum(wide_high[1:], high[:-1])
    wide_low[:-1], wide_high[:-1] = np.minimum(wide_low[:-1], low[1:]), np.maximum(wide_high[:-1], high[1:])
    return wide_low, wide_high
