"""Room around obstacles in the daemon: the grid in, `map/clearance` out (S30).

Each cell says how near the next occupied cell is, as a cost that falls evenly with the distance, so that the same
numbers can be shown, planned on, and turned back into metres: distance = (1 - cost / 100) * reach, to a hundredth of
the reach and never too far. Exact distances up to the reach are kept up to date from what changed in the grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mapping.grids.clearance import MAX_SIDE_CELLS, DistanceField
from mapping.grids.patch import GridPatch
from mapping.kernels import clearance_costs as kernels
from mapping.scan import Scan
from service.map_makers import MapView, Rect, Tile
from service.outputs import GridOut, Output

F64 = NDArray[np.float64]
I8 = NDArray[np.int8]
Bools = NDArray[np.bool_]

NAME = "clearance"
_OCCUPIED_PERCENT = 64  # also what is counted occupied and shown as undecided, beside a wall
_CELL_NS = 1000  # a map of more than a million cells is told less often than once a second


class ClearanceMaker:
    """A map maker that keeps distances to what the grid calls occupied, and to what it would by each cell alone.

    reach_m: farther away the cost is 0.  unknown_is_obstacle: distances also to what was never seen.
    Unknown cells stay unknown (-1), whatever lies beside them.
    """

    def __init__(
        self, *, reach_m: float = 2.0, unknown_is_obstacle: bool = False, period_ns: int = 1_000_000_000
    ) -> None:
        if not (math.isfinite(reach_m) and reach_m > 0.0):
            raise ValueError(f"reach_m is a length above 0, got {reach_m}")
        self.name = NAME
        self.sources: frozenset[str] = frozenset()
        self._period_ns = period_ns
        self._reach_m = reach_m
        self._unknown_is_obstacle = unknown_is_obstacle
        self._field: DistanceField | None = None
        self._place: tuple[float, int, int] | None = None
        self._costs: I8 = np.zeros(1, dtype=np.int8)
        self._layer: I8 = np.zeros((0, 0), dtype=np.int8)
        self._epoch = 0

    @property
    def period_ns(self) -> int:
        """Longer the larger the map: what is told stays about a million cells a second."""
        cells = 0 if self._field is None else self._field.squared.size
        return max(self._period_ns, cells * _CELL_NS)

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Everything it needs stands in the grid."""

    def make(self, view: MapView) -> list[Output]:
        """The layer as the grid is now, if that changed."""
        grid = view.grid
        if grid is None or not view.changed or grid.cells.size == 0 or max(grid.cells.shape) > MAX_SIDE_CELLS - 2:
            return []
        cells = np.ascontiguousarray(grid.cells)
        self._follow(grid, cells, view.changed)
        row0, row1, col0, col1 = kernels.known_box(cells)
        row1, col1 = max(row1, row0 + 1), max(col1, col0 + 1)  # one cell if nothing is known
        self._epoch += 1
        known = self._layer[row0:row1, col0:col1].copy()
        patch = GridPatch(grid.resolution_m, grid.row0 + row0, grid.col0 + col0, known)
        return [GridOut(view.stamp_ns, self._epoch, patch, name=NAME)]

    def _follow(self, grid: GridPatch, cells: I8, changed: tuple[Rect, ...]) -> None:
        """Bring distances and costs up to date."""
        place = (grid.resolution_m, grid.row0, grid.col0)
        field = self._field
        rows, cols = cells.shape
        if field is None or self._place != place or field.shape != (rows + 2, cols + 2):
            around = np.pad(self._obstacles(cells), 1, constant_values=self._unknown_is_obstacle)
            reach = math.ceil(self._reach_m / grid.resolution_m)
            field = self._field = DistanceField(around, reach_cells=reach)  # a rim of a cell: outside, nothing is known
            self._place, self._costs = place, self._costs_of(grid.resolution_m)
            self._layer = np.empty((rows, cols), dtype=np.int8)
            everywhere = np.tile(np.array([1, cols + 1], dtype=np.int32), (rows + 2, 1))
            kernels.put_costs(cells, field.squared, self._costs, everywhere, self._layer)
            return
        added, removed = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)]
        parts = [_part_of(rect, grid) for rect in changed]
        for part in parts:
            seen = (cells, part, _OCCUPIED_PERCENT, self._unknown_is_obstacle, field.obstacle)
            came, went = (np.empty((n, 2), dtype=np.int64) for n in kernels.count_changed(*seen))
            kernels.list_changed(*seen, came, went)
            added.append(came)
            removed.append(went)
        spans = field.update(np.concatenate(added), np.concatenate(removed))
        kernels.put_costs(cells, field.squared, self._costs, spans, self._layer)
        for part in parts:
            kernels.put_seen(cells, field.squared, self._costs, part, self._layer)

    def _obstacles(self, cells: I8) -> Bools:
        occupied = cells >= _OCCUPIED_PERCENT
        return occupied | (cells < 0) if self._unknown_is_obstacle else occupied

    def _costs_of(self, resolution_m: float) -> I8:
        """By squared distance in cells, the last for all that is farther; rounded so that no distance grows."""
        farthest = math.ceil((self._reach_m / resolution_m) ** 2)
        share = np.sqrt(np.arange(farthest + 1)) * (resolution_m / self._reach_m)
        return np.clip(np.ceil(100.0 * (1.0 - share) - 1e-9), 0, 100).astype(np.int8)

    def changed_tiles(self) -> list[Tile]:
        return []

    def restore(self, tiles: Iterable[Tile]) -> None:
        """It comes with the grid."""
        self._field = None


def _part_of(rect: Rect, grid: GridPatch) -> tuple[int, int, int, int]:
    """Rows and columns [row0, row1, col0, col1) of a grid's array that a rectangle of the map covers."""
    rows, cols = grid.cells.shape
    row, col = rect.row0 - grid.row0, rect.col0 - grid.col0
    row0, row1, col0, col1 = np.clip((row, row + rect.rows, col, col + rect.cols), 0, (rows, rows, cols, cols))
    return int(row0), int(row1), int(col0), int(col1)
