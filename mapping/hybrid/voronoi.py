"""The Voronoi diagram of a grid, exact and kept up to date (S44, first half; [Thr98]).

Each free cell knows its nearest obstacle cell, the base point; cells whose neighbour has another, far from their own,
lie on the diagram. What is not surely free is an obstacle, and so is everything beyond the border of the grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.clearance import DistanceField
from mapping.kernels import voronoi as kernels

Bools = NDArray[np.bool_]
I32 = NDArray[np.int32]

GAP_CELLS = 3.0


class VoronoiGrid:
    """Distances, base points and Voronoi cells of a grid of free cells, current after every change.

    field: exact distances in cells and base points (a DistanceField).  axis: (R, C) cells on the diagram. Views to
    read, valid until the next change. The same free cells give the same arrays, updated or made anew.
    """

    def __init__(self, free: ArrayLike, *, gap_cells: float = GAP_CELLS) -> None:
        """From scratch, in time proportional to the cells.

        free: (R, C), True where a robot may be: seen and empty. The cells of the border count as obstacles.
        gap_cells: base points closer than this are one obstacle: passages narrower than this have no diagram, rough
        walls grow no more twigs than this makes them.
        Raises ValueError if free is not (R, C), has a side below 3 or above 20,000, or gap_cells is negative.
        """
        given = np.asarray(free, dtype=np.bool_)
        if given.ndim != 2 or min(given.shape) < 3:
            raise ValueError(f"free cells are (R, C) with sides of 3 at least, got {given.shape}")
        if not gap_cells >= 0.0:
            raise ValueError(f"gap_cells is a length, got {gap_cells}")
        self.gap_cells = float(gap_cells)
        self.field = DistanceField(_obstacles(given))
        self.axis: Bools = np.empty(given.shape, dtype=np.bool_)
        everywhere = np.tile(np.array([0, given.shape[1]], dtype=np.int32), (given.shape[0], 1))
        self._look_again(everywhere)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.field.shape

    @property
    def free(self) -> Bools:
        """(R, C) cells that are no obstacles; a new array."""
        return ~self.field.obstacle

    def update(self, free: ArrayLike) -> int:
        """Take over a grid of the same shape; only what hangs on changed cells is computed again. How many changed.

        Raises ValueError for another shape.
        """
        given = np.asarray(free, dtype=np.bool_)
        if given.shape != self.shape:
            raise ValueError(f"the grid has the shape {self.shape}, got {given.shape}")
        obstacle = _obstacles(given)
        changed = np.argwhere(obstacle != self.field.obstacle)
        became = obstacle[changed[:, 0], changed[:, 1]]
        return self.set_cells(changed[became], changed[~became])

    def set_cells(self, blocked: ArrayLike, cleared: ArrayLike) -> int:
        """Cells [row, col], (N, 2) each, that are obstacles from now on, and that are free; border cells stay.

        Returns how many cells were looked at again. Raises ValueError as DistanceField.update.
        """
        spans = self.field.update(blocked, self._inner(cleared))
        return self._look_again(_one_cell_wider(spans, self.shape[1]))

    def _inner(self, cells: ArrayLike) -> NDArray[np.integer]:
        """Cells but for those of the border."""
        given: NDArray[np.integer] = np.asarray(cells)
        if given.ndim != 2 or given.shape[1] != 2 or not given.size:
            return given
        on_border: Bools = ((given == 0) | (given == np.array(self.shape) - 1)).any(axis=1)
        return given[~on_border]

    def _look_again(self, spans: I32) -> int:
        gap2 = int(self.gap_cells * self.gap_cells)
        kernels.axis_cells(self.field.squared, self.field.site, gap2, spans, self.axis)
        return int(np.maximum(spans[:, 1] - spans[:, 0], 0).sum())


def _obstacles(free: Bools) -> Bools:
    """What is not free, and the border."""
    obstacle: Bools = np.ones(free.shape, dtype=np.bool_)
    np.logical_not(free[1:-1, 1:-1], out=obstacle[1:-1, 1:-1])
    return obstacle


def _one_cell_wider(spans: I32, cols: int) -> I32:
    """Columns [first, end) by row, widened by a cell on all four sides: a cell's place hangs on its neighbours."""
    first, end = spans[:, 0], spans[:, 1]
    some = end > first
    wide = np.empty_like(spans)
    wide[:, 0] = np.where(some, np.maximum(first - 1, 0), cols)
    wide[:, 1] = np.where(some, np.minimum(end + 1, cols), 0)
    result = wide.copy()
    for onto, from_ in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        result[onto, 0] = np.minimum(result[onto, 0], wide[from_, 0])
        result[onto, 1] = np.maximum(result[onto, 1], wide[from_, 1])
    return result
