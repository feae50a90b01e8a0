"""The robot-centred grid: a square window that follows the robot, in fixed memory (S26, S27: the window option).

Cells keep their place in the map (or odometry) frame; only the window moves, by whole cells, so nothing is resampled.
What leaves the window is forgotten at once, what enters is unknown. Cells outside are never written.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.grids.evidence import CellRules, EvidenceGrid, Model
from mapping.grids.patch import GridPatch
from mapping.grids.sonar_model import SonarRules
from mapping.grids.tiles import TILE, TilePool, Window

I64 = NDArray[np.int64]
MAX_SIDE_CELLS = 1 << 13


class RollingGrid(EvidenceGrid):
    """A window of side_m x side_m around the robot; take it whole with patch().

    The window begins around (0, 0); call centre_on before each insertion. Other arguments as in OccupancyGrid.
    """

    def __init__(
        self,
        *,
        side_m: float = 10.0,
        resolution_m: float = 0.05,
        model: Model = "counters",
        rules: CellRules | None = None,
        sonar_rules: SonarRules | None = None,
        fill_gap_m: float = 0.15,
        use_max_m: float = float("inf"),
    ) -> None:
        if not 0.0 < side_m <= MAX_SIDE_CELLS * resolution_m:
            raise ValueError(f"side_m is above 0 and at most {MAX_SIDE_CELLS} cells, got {side_m}")
        self._side = max(1, math.ceil(side_m / resolution_m - 1e-9))
        self._tiles_across = (self._side + TILE - 2) // TILE + 1
        super().__init__(
            TilePool(self._tiles_across**2),
            resolution_m=resolution_m,
            model=model,
            rules=rules if rules is not None else CellRules(),
            sonar_rules=sonar_rules if sonar_rules is not None else SonarRules(),
            fill_gap_m=fill_gap_m,
            use_max_m=use_max_m,
        )
        self._window = self._window_centred(0, 0)
        self._lay_table()

    @property
    def window(self) -> Window:
        """The cells that exist now."""
        return self._window

    def centre_on(self, x_m: float, y_m: float) -> None:
        """Move the window so that the cell of this point is its middle; ValueError if it is not finite."""
        row, col = self.cell_at(x_m, y_m)
        new = self._window_centred(row, col)
        if new == self._window:
            return
        self._window = new
        for slot in self._pool.slots():
            self._forget_outside(int(slot))
        self._lay_table()

    def clear(self) -> None:
        """Forget everything in the window."""
        for slot in self._pool.slots():
            self._pool.drop(int(slot))

    def patch(self) -> GridPatch:
        """The whole window, always the same shape."""
        return self._patch_of(self._window)

    def _window_centred(self, row: int, col: int) -> Window:
        half = self._side // 2
        return Window(row - half, row - half + self._side, col - half, col - half + self._side)

    def _forget_outside(self, slot: int) -> None:
        """Drop a tile that the window left, or those of its rows and columns."""
        w = self._window
        row0, col0 = (int(k) * TILE for k in self._pool.tile_at[slot])
        top, bottom = w.row0 - row0, w.row1 - row0
        left, right = w.col0 - col0, w.col1 - col0
        if top >= TILE or bottom <= 0 or left >= TILE or right <= 0:
            self._pool.drop(slot)
            return
        layers = [self._pool.cells_of_slot(slot)]
        if self._pool.has_sonar:
            layers.append(self._pool.sonar_of_slot(slot))  # type: ignore[arg-type]
        for layer in layers:
            layer[: max(top, 0)] = 0
            layer[min(bottom, TILE) :] = 0
            layer[:, : max(left, 0)] = 0
            layer[:, min(right, TILE) :] = 0

    def _lay_table(self) -> None:
        row, col = self._window.row0 // TILE, self._window.col0 // TILE
        self._pool.rebase(row, row + self._tiles_across, col, col + self._tiles_across)

    def _window_of(self, wanted: Window) -> I64 | None:
        """Only cells of the window may be written."""
        w = self._window
        row0, row1 = max(wanted.row0, w.row0), min(wanted.row1, w.row1)
        col0, col1 = max(wanted.col0, w.col0), min(wanted.col1, w.col1)
        if row0 >= row1 or col0 >= col1:
            return None
        return np.array([row0, row1, col0, col1], dtype=np.int64)
