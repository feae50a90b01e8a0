"""Room around obstacles: the cell size that a safety distance asks for, distances, inflated maps (S30)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.geometry import check_resolution
from mapping.grids.patch import GridPatch
from mapping.kernels import clearance as kernels
from mapping.kernels import clearance_reach

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

MAX_SIDE_CELLS = kernels.MAX_SIDE


def cell_size_for_clearance(clearance_m: float) -> float:
    """The cell size d = n / sqrt(2) whose diagonal is the safety clearance n (0.07 m -> 0.0495 m).

    With it, a point in a cell next to an occupied one is at most n from the cell's far corner: marking the neighbours
    of occupied cells keeps n of free space. ValueError unless positive and finite.
    """
    return check_resolution(clearance_m) / math.sqrt(2.0)


def clearance_of_cell_size(resolution_m: float) -> float:
    """The safety clearance n = d sqrt(2) that cells of this size stand for."""
    return check_resolution(resolution_m) * math.sqrt(2.0)


def squared_cell_distances(obstacle: ArrayLike) -> I32:
    """(R, C) exact squared distance, in cells, from each cell's centre to the nearest obstacle cell's centre.

    obstacle: (R, C), anything but 0 is one.  kernels.FAR where there is no obstacle at all.  Time grows as R * C.
    Raises ValueError if it is not (R, C) or has a side above 20,000.
    """
    return DistanceField(obstacle).squared


class DistanceField:
    """Exact distances and nearest obstacles of a rectangle of cells, kept up to date as obstacles come and go.

    squared: (R, C) int32, squared distance in cells between centres; kernels.FAR where there is no obstacle at all.
    site: (R, C) int32, the nearest obstacle cell as row << 16 | column, -1 if there is none; of several the one in the
    smallest column, then in the smallest row. Both are views to read, changed by the next update.
    reach_cells: what is farther from every obstacle than this counts as if there were none, so that a change costs
    what lies within reach of it and not what it rules of the map; None: any distance is kept.
    Updated or made anew, the same obstacles give the same arrays. Memory: 9 bytes a cell, with a reach 11.
    Raises ValueError if obstacle is not (R, C) or has a side above 20,000, or for a reach below 0.
    """

    def __init__(self, obstacle: ArrayLike, *, reach_cells: int | None = None) -> None:
        if reach_cells is not None and reach_cells < 0:
            raise ValueError(f"reach_cells is a number of cells, got {reach_cells}")
        given = np.asarray(obstacle)
        if given.ndim != 2 or max(given.shape) > MAX_SIDE_CELLS:
            raise ValueError(f"obstacles are (R, C) with sides up to {MAX_SIDE_CELLS}, got {given.shape}")
        rows, cols = given.shape
        self.shape = (rows, cols)
        self.squared: I32 = np.empty((rows, cols), dtype=np.int32)
        self.site: I32 = np.empty((rows, cols), dtype=np.int32)
        self._obstacle: NDArray[np.uint8] = (given != 0).astype(np.uint8)  # NaN is one, too
        self._reach = kernels.UNLIMITED if reach_cells is None else min(int(reach_cells), kernels.UNLIMITED)
        self._half = clearance_reach.half_widths(self._reach) if self._reach < kernels.UNLIMITED else None
        self._nearest: NDArray[np.int16] | None = None
        self._columns: NDArray[np.uint64] | None = None
        self._spans: I32 = np.empty((rows, 2), dtype=np.int32)
        self._work = [np.empty(cols + 1, dtype=np.int32) for _ in range(4)]
        if self.squared.size:
            self._transform()

    def _transform(self) -> None:
        rows, cols = self.shape
        nearest = np.empty((rows, cols), dtype=np.int16)
        kernels.nearest_rows(self._obstacle, self._reach, nearest, np.empty(cols, dtype=np.int32))
        kernels.row_envelopes(nearest, 0, rows, self._reach, self.squared, self.site, *self._work[:3])
        if self._half is not None:
            self._nearest = nearest

    @property
    def obstacle(self) -> Bools:
        """(R, C) view of the obstacles the distances belong to."""
        return self._obstacle.view(np.bool_)

    def update(self, added: ArrayLike, removed: ArrayLike) -> I32:
        """Obstacles that came and obstacles that went: (N, 2) cells [row, col] each, N may be 0.

        Cells that are as said already are passed over; a cell in both lists ends as an obstacle.
        Returns (R, 2) first and end column of what changed in each row, or might have; first >= end: nothing.
        Time: the cells whose nearest obstacle changes, and some steps for each row between. A change that concerns
        half of the map (the first wall in a wide unknown) costs as much as a new transform.
        Raises ValueError for cells that are not (N, 2) whole numbers or not in the rectangle.
        """
        new, lost = self._sorted_out(_cells(added), _cells(removed))
        self._spans[:, 0], self._spans[:, 1] = self.shape[1], 0
        if len(new) + len(lost) == 0:
            return self._spans
        if self._half is not None:
            kept = (self._obstacle, self._nearest, self.squared, self.site, self._spans)
            clearance_reach.change_within(new, lost, self._half, *kept, *self._work[:3])
            return self._spans
        if self._columns is None:
            self._columns = np.zeros((self.shape[1], (self.shape[0] + 63) // 64), dtype=np.uint64)
            self._count = kernels.column_bits(self._obstacle, self._columns)
        self._count += len(new) - len(lost)
        if self._count == len(new) or self._count == 0:
            self._start_anew(new, lost)
            return self._spans
        layers = (self._obstacle, self._columns, self.squared, self.site, self._spans)
        kernels.add_obstacles(_scattered(new), *layers)
        kernels.remove_obstacles(_scattered(lost), np.empty_like(lost), *layers, *self._work)
        return self._spans

    def _start_anew(self, new: I32, lost: I32) -> None:
        """An update after which nothing is left of the obstacles there were."""
        self._obstacle[lost[:, 0], lost[:, 1]] = 0
        self._obstacle[new[:, 0], new[:, 1]] = 1
        self._columns = None
        self._transform()
        self._spans[:, 0], self._spans[:, 1] = 0, self.shape[1]

    def _sorted_out(self, added: I64, removed: I64) -> tuple[I32, I32]:
        """(N, 2) cells that become obstacles, and that are none any more, each once."""
        new = np.empty((len(added), 2), dtype=np.int32)
        lost = np.empty((len(removed), 2), dtype=np.int32)
        n_new, n_lost = kernels.sort_out(added, removed, self._obstacle, new, lost)
        if n_new < 0:
            raise ValueError(f"a cell is outside of the field's {self.shape[0]} x {self.shape[1]} cells")
        return new[:n_new], lost[:n_lost]


def _cells(cells: ArrayLike) -> I64:
    """(N, 2) whole numbers."""
    given = np.asarray(cells)
    if given.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    if given.ndim != 2 or given.shape[1] != 2 or not np.issubdtype(given.dtype, np.integer):
        raise ValueError(f"cells are (N, 2) whole numbers, got {given.dtype} {given.shape}")
    return np.ascontiguousarray(given, dtype=np.int64)


def _scattered(cells: I32) -> I32:
    """The cells, each far from the one before it: neighbours one after the other would take each other's land."""
    n = len(cells)
    step = max(1, round(0.618 * n))
    while math.gcd(step, n) != 1:
        step += 1
    return cells[np.arange(n, dtype=np.int64) * step % max(n, 1)]


def clearance_layer(patch: GridPatch, *, occupied_percent: int = 65, unknown_is_obstacle: bool = False) -> F32:
    """(R, C) distance in metres from each cell to the nearest occupied cell, exact Euclid between centres.

    inf where no cell of the patch is occupied. An obstacle can stand at the near side of its cell and the robot at
    the near side of its own: subtract clearance_of_cell_size for what is surely free.
    unknown_is_obstacle: for planners that must not come near what was never seen.
    """
    obstacle = patch.cells >= occupied_percent
    if unknown_is_obstacle:
        obstacle = obstacle | (patch.cells < 0)
    squared = squared_cell_distances(obstacle)
    metres = np.sqrt(squared, dtype=np.float32) * np.float32(patch.resolution_m)
    metres[squared == kernels.FAR] = np.inf
    return metres


def inflated(patch: GridPatch, radius_m: float, *, occupied_percent: int = 65) -> GridPatch:
    """The patch with every cell that comes within radius_m of an occupied cell occupied too (100).

    Distances are between the nearest points of the two cells, so that a disc of that radius, wherever it stands in a
    cell left free, touches no occupied cell. Unknown cells within the radius become occupied as well, others stay.
    Raises ValueError for a radius that is negative or not finite.
    """
    if not (math.isfinite(radius_m) and radius_m >= 0.0):
        raise ValueError(f"radius_m is a length, got {radius_m}")
    obstacle = patch.cells >= occupied_percent
    if radius_m == 0.0 or not obstacle.any():
        return patch
    squared = squared_cell_distances(obstacle)
    # Two cells whose centres are D apart come as near as D - sqrt(2) cells.
    reach = radius_m / patch.resolution_m + math.sqrt(2.0)
    cells = np.where(squared < reach * reach, np.int8(100), patch.cells)
    return GridPatch(patch.resolution_m, patch.row0, patch.col0, cells.astype(np.int8))
