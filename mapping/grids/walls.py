"""Which cells of a finished map are walls, where poses scatter by more than a cell (S27, for maps made offline).

A wall seen from poses that scatter by 5 cm has its ends in three rows of cells. Counting hits and misses cell by cell
calls the front row occupied as well as the middle one, and every beam that grazes the wall crosses it. Seen as a
whole the question is another: which cells explain where beams end, and are crossed by as few beams as can be?

- Each beam counts one end in the cell where it ends and one pass in every cell before. Both are spread over the
  neighbours as far as a beam's end may lie from where it was measured (`blur_cells`).
- Cells in which beams end, more than half as many as pass (`wall_per_pass`), are walls: thick ones, without gaps.
- They are made thin: cells go, first those that more beams pass than end in, as long as the walls around hang together
  without them and other walls are near the ends (within two cells). The end of a row in which many beams ended
  (`tip_per_pass`) stays.
- Ends that lie farther than two cells from these walls are explained by single cells: chosen one after the other, each
  time the one with most such ends for the beams that pass it (a weighted cover, greedy), until the best is worth less
  than `ends_per_pass`.
- A cell in which no beam ended is no wall: else walls would move behind the surface, where beams pass seldom, and
  robots that localise by them with them.

So a smeared wall becomes a thin one in the middle of its ends or a little behind, and what was seen once and looked
through ever after is none. Costs: a walk along every beam, and sorting the cells with ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.tiles import TILE
from mapping.kernels import walls as kernels
from mapping.kernels.grids import TILE_BITS, TILE_CELLS, TILE_MASK

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

AROUND = np.array([(row, col) for row in (-1, 0, 1) for col in (-1, 0, 1)], dtype=np.int64)
NEAR = np.array(
    [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 2), (2, 0), (0, -2), (-2, 0), (0, 0)],
    dtype=np.int64,
)  # the eight around a cell in turn, those two away, itself: whose ends a wall explains
PIECE = 1 << 16
FULL = 65535
NEIGHBOURS = 2  # cells from an end whose counts matter: a wall may lie beside it, and is blurred over its neighbours
HALF_A_BEAM = 0.5  # the cost of a cell that nothing passed


@dataclass(frozen=True, slots=True)
class WallRules:
    """wall_per_pass: a cell in which so many beams ended for each that passed belongs to a wall, which is made thin.

    ends_per_pass: a cell explains at least so many ends for each beam that passes it; else it goes where walls are made
    thin, if that opens no gap, and does not come where ends lie far from walls.
    tip_per_pass: a cell in which so many ended does not go from the end of a row.
    blur_cells: standard deviation of where a beam ends, in cells, at most 0.5 (more needs more than the neighbours).
    """

    wall_per_pass: float = 0.6
    ends_per_pass: float = 1.05
    tip_per_pass: float = 2.0
    blur_cells: float = 0.5

    def __post_init__(self) -> None:
        for name in ("wall_per_pass", "ends_per_pass", "tip_per_pass"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is above 0 and finite, got {getattr(self, name)}")
        if not 0.0 < self.blur_cells <= 0.5:
            raise ValueError(f"blur_cells is above 0, at most 0.5, got {self.blur_cells}")


def rule_row(rules: WallRules) -> F64:
    """(3,) as the kernels take them."""
    return np.array([rules.ends_per_pass, rules.wall_per_pass, rules.tip_per_pass])


def blur_weights(rules: WallRules) -> F64:
    """(3, 3) shares of a count that belong to a cell and those around it."""
    side = math.exp(-0.5 / rules.blur_cells**2)
    weights = np.array([side, 1.0, side]) / (1.0 + 2.0 * side)
    return np.outer(weights, weights)


@dataclass(frozen=True, slots=True)
class TileTable:
    """Tiles by place: places (T, 2); index (R, C) which of them lies at (row0 + row, col0 + column), -1 none."""

    places: I64
    row0: int
    col0: int
    index: NDArray[np.int32]

    @staticmethod
    def of(places: I64) -> TileTable:
        """The table of tiles (T, 2), T may be 0."""
        row0, col0 = (int(k) for k in places.min(axis=0)) if len(places) else (0, 0)
        at = places - (row0, col0)
        rows, cols = (int(k) + 1 for k in at.max(axis=0)) if len(at) else (0, 0)
        index = np.full((rows, cols), -1, dtype=np.int32)
        index[at[:, 0], at[:, 1]] = np.arange(len(at))
        return TileTable(places, row0, col0, index)


class EndTiles:
    """Which tiles of a grid matter to its walls: those near which beams end. In the open most have none."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self.resolution_m = grid.resolution_m
        self._table = TileTable.of(np.array(grid.places(), dtype=np.int64).reshape(-1, 2))
        self._marked = np.zeros(len(self._table.places), dtype=np.bool_)

    def add(self, map_from_sensor: Pose2, bearing_rad: F64, range_m: F64, *, range_max_m: float) -> None:
        """One sweep, as BeamCounts.add."""
        per_m, table = 1.0 / self.resolution_m, self._table
        bearing = np.asarray(bearing_rad, dtype=np.float64) + map_from_sensor.yaw_rad
        kernels.mark_ends(
            map_from_sensor.x_m * per_m, map_from_sensor.y_m * per_m, bearing, np.array(range_m, dtype=np.float64),
            per_m, float(range_max_m), table.row0, table.col0, table.index, NEIGHBOURS, self._marked,
        )  # fmt: skip

    def places(self) -> I64:
        """(T, 2) of those tiles."""
        return self._table.places[self._marked]


class BeamCounts:
    """Ends and passes of beams in the cells of a grid's tiles; 4 bytes a cell, as long as it lives.

    grid: one that holds the scans already; what lies in no tile of it is not counted.  places: (T, 2) of its tiles, if
    not all are to be counted in; those of `EndTiles` are enough.
    """

    def __init__(self, grid: OccupancyGrid, places: I64 | None = None) -> None:
        self.resolution_m = grid.resolution_m
        chosen = np.array(grid.places(), dtype=np.int64).reshape(-1, 2) if places is None else places
        self._table = TileTable.of(chosen)
        self._ends, self._passes = np.zeros((2, len(chosen) * TILE_CELLS), dtype=np.uint16)

    def add(self, map_from_sensor: Pose2, bearing_rad: F64, range_m: F64, *, range_max_m: float) -> None:
        """One sweep; bearing_rad, range_m: (N,) as in mapping.scan.Scan."""
        per_m, table = 1.0 / self.resolution_m, self._table
        bearing = np.asarray(bearing_rad, dtype=np.float64) + map_from_sensor.yaw_rad
        from_x, from_y = np.array([[map_from_sensor.x_m], [map_from_sensor.y_m]]) * per_m
        kernels.count_beams(
            from_x, from_y, bearing, np.array(range_m, dtype=np.float64), per_m, float(range_max_m),
            table.row0, table.col0, table.index, self._ends, self._passes, FULL,
        )  # fmt: skip

    def walls(self, rules: WallRules | None = None) -> I64:
        """(N, 2) cells [row, col] that are walls, by rows."""
        rules = rules if rules is not None else WallRules()
        cells = self._cells_near_ends()
        if len(cells) == 0:
            return cells
        weight = blur_weights(rules).ravel()
        ends, passes = (self._blurred(counts, cells, weight) for counts in (self._ends, self._passes))
        ended, passed = self._at(self._ends, cells), self._at(self._passes, cells)
        wall = np.zeros(len(cells), dtype=np.bool_)
        kernels.explain(
            _numbers_of(cells, NEAR), ended, passed + HALF_A_BEAM, ends, passes + HALF_A_BEAM, rule_row(rules), wall
        )
        return cells[wall]

    def _blurred(self, counts: NDArray[np.uint16], cells: I64, weight: F64) -> F64:
        """Counts (N,) of cells (N, 2) and those AROUND them, by weight (9,)."""
        out = np.zeros(len(cells))
        for some in _pieces(len(cells)):
            for w, offset in zip(weight, AROUND):
                out[some] += w * self._at_some(counts, cells[some] + offset)
        return out

    def _cells_near_ends(self) -> I64:
        """(N, 2) cells in or beside which beams end, by rows and columns."""
        at = np.flatnonzero(self._ends)
        tile, local = self._table.places[at // TILE_CELLS], at % TILE_CELLS
        hit = tile * TILE + np.stack((local // TILE, local % TILE), axis=-1)
        keys = np.unique(_keys(hit))
        for step in (_key_step(1, 0), _key_step(0, 1)):
            keys = np.unique(np.concatenate((keys - step, keys, keys + step)))
        return _cells_of_keys(keys)

    def _at(self, counts: NDArray[np.uint16], cells: I64) -> F64:
        """Counts (N,) of cells (N, 2), 0 where no tile is."""
        out = np.empty(len(cells))
        for some in _pieces(len(cells)):
            out[some] = self._at_some(counts, cells[some])
        return out

    def _at_some(self, counts: NDArray[np.uint16], cells: I64) -> NDArray[np.uint16]:
        index = self._table.index
        at = (cells >> TILE_BITS) - (self._table.row0, self._table.col0)
        inside = np.all((at >= 0) & (at < index.shape), axis=1)
        tile = np.full(len(cells), -1, dtype=np.int64)
        tile[inside] = index[at[inside, 0], at[inside, 1]]
        local = cells & TILE_MASK
        cell = tile * TILE_CELLS + local[:, 0] * TILE + local[:, 1]
        return np.where(tile >= 0, counts[np.maximum(cell, 0)], 0)


def _pieces(count: int) -> Iterator[slice]:
    """A row of so many, PIECE at a time: there may be millions, and a step takes several times their memory."""
    return (slice(first, first + PIECE) for first in range(0, count, PIECE))


def _keys(cells: I64) -> I64:
    """One whole number for each cell, in order of rows and columns; cells lie within 2^30 of the origin."""
    return np.asarray((cells[:, 0] << 32) + cells[:, 1] + (1 << 31))


def _key_step(rows: int, columns: int) -> int:
    """What so many rows and columns add to a cell's key."""
    return (rows << 32) + columns


def _cells_of_keys(keys: I64) -> I64:
    return np.stack((keys >> 32, (keys & 0xFFFFFFFF) - (1 << 31)), axis=-1)


def _numbers_of(cells: I64, offsets: I64) -> NDArray[np.int32]:
    """(N, K) number of the cell at each offset from each cell, -1 where it is none of them. cells: by rows."""
    keys = _keys(cells)
    numbers = np.empty((len(cells), len(offsets)), dtype=np.int32)
    for some in _pieces(len(cells)):
        for k, (row, column) in enumerate(offsets.tolist()):
            wanted = keys[some] + _key_step(row, column)
            found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            numbers[some, k] = np.where(keys[found] == wanted, found, -1)
    return numbers
