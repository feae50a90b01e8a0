"""Storage of a grid: a pool of square tiles and a table that finds them (S26).

Tiles are taken from the pool when the first cell in them is written; nothing else costs memory (the pool is one
zeroed mapping whose pages the system supplies when they are touched). The table grows with the driven area. Both are
bounded: what finds no room is not recorded, stays unknown, and is counted in `refused`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import grids as kernels

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

TILE: Final = kernels.TILE
MAX_TABLE = 1 << 22  # entries of the table: 16 MB, and 13 km x 13 km at 5 cm
TO_PUBLISH = np.uint8(1)
TO_STORE = np.uint8(2)
TO_CLEAR_MAP = np.uint8(4)


@dataclass(frozen=True, slots=True)
class Window:
    """Cells that may be written: rows [row0, row1), columns [col0, col1)."""

    row0: int
    row1: int
    col0: int
    col1: int


class TilePool:
    """Tiles of TILE x TILE cells, found by tile row and column (floor division of the cell's by TILE)."""

    def __init__(self, max_tiles: int) -> None:
        if max_tiles < 1 or max_tiles > 1 << 20:
            raise ValueError(f"max_tiles is 1 to {1 << 20}, got {max_tiles}")
        slots = max_tiles + 1  # slot 0 is scrap
        self.max_tiles = max_tiles
        self.cells: U16 = np.zeros(slots * kernels.TILE_CELLS, dtype=np.uint16)
        self.sonar: U8 = np.zeros(1, dtype=np.uint8)  # same slots, made when the first cone arrives
        self.sonar_seen: U8 = np.zeros(slots, dtype=np.uint8)
        self.tile_at: I64 = np.zeros((slots, 2), dtype=np.int64)
        self.flags: U8 = np.zeros(slots, dtype=np.uint8)
        self.free_slots: NDArray[np.int32] = np.arange(max_tiles, 0, -1, dtype=np.int32)
        self.state: I64 = np.zeros(kernels.STATE_LENGTH, dtype=np.int64)
        self.state[kernels.FREE_COUNT] = max_tiles
        self.index: NDArray[np.int32] = np.zeros((0, 0), dtype=np.int32)
        self.tile_row0 = 0
        self.tile_col0 = 0

    @property
    def used(self) -> int:
        """How many tiles hold cells."""
        return self.max_tiles - int(self.state[kernels.FREE_COUNT])

    @property
    def refused(self) -> int:
        """How often a tile was wanted and the pool was full."""
        return int(self.state[kernels.REFUSED])

    def cover(self, window: Window) -> bool:
        """Make the table reach over a rectangle of cells; False (nothing changed) if it would pass MAX_TABLE."""
        low_row, high_row = window.row0 // TILE, (window.row1 - 1) // TILE + 1
        low_col, high_col = window.col0 // TILE, (window.col1 - 1) // TILE + 1
        rows, cols = self.index.shape
        if rows > 0:
            if (
                low_row >= self.tile_row0
                and low_col >= self.tile_col0
                and high_row <= self.tile_row0 + rows
                and high_col <= self.tile_col0 + cols
            ):
                return True
            low_row, high_row = min(low_row, self.tile_row0), max(high_row, self.tile_row0 + rows)
            low_col, high_col = min(low_col, self.tile_col0), max(high_col, self.tile_col0 + cols)
        needed = (high_row - low_row) * (high_col - low_col)
        if needed > MAX_TABLE:
            return False
        margin = 8 if needed < MAX_TABLE // 4 else 0
        if (high_row - low_row + 2 * margin) * (high_col - low_col + 2 * margin) > MAX_TABLE:
            margin = 0
        self.rebase(low_row - margin, high_row + margin, low_col - margin, high_col + margin)
        return True

    def rebase(self, low_row: int, high_row: int, low_col: int, high_col: int) -> None:
        """A table over just these tiles; tiles outside must have been dropped before."""
        table = np.zeros((high_row - low_row, high_col - low_col), dtype=np.int32)
        old_rows, old_cols = np.nonzero(self.index)
        table[old_rows + self.tile_row0 - low_row, old_cols + self.tile_col0 - low_col] = self.index[old_rows, old_cols]
        self.index, self.tile_row0, self.tile_col0 = table, low_row, low_col

    def whole_table(self) -> Window:
        """All cells that the table reaches."""
        rows, cols = self.index.shape
        return Window(
            self.tile_row0 * TILE, (self.tile_row0 + rows) * TILE, self.tile_col0 * TILE, (self.tile_col0 + cols) * TILE
        )

    def slots(self) -> I64:
        """Slots in use, ordered by tile row, then column."""
        slots: I64 = self.index[self.index > 0].astype(np.int64)
        return slots

    def flagged(self, flag: np.uint8) -> I64:
        """Slots in use with this flag, in the same order."""
        slots = self.slots()
        flagged: I64 = slots[(self.flags[slots] & flag) != 0]
        return flagged

    def slot_for(self, tile_row: int, tile_col: int) -> int:
        """Slot of a tile, new if need be; 0 if there is no room."""
        if not self.cover(
            Window(tile_row * TILE, (tile_row + 1) * TILE, tile_col * TILE, (tile_col + 1) * TILE),
        ):
            self.state[kernels.REFUSED] += 1
            return 0
        row, col = tile_row - self.tile_row0, tile_col - self.tile_col0
        if self.index[row, col] == 0:
            kernels.new_slot(
                row, col, self.tile_row0, self.tile_col0, self.index, self.tile_at, self.free_slots, self.state
            )
        return int(self.index[row, col])

    def drop(self, slot: int) -> None:
        """Forget a tile: its cells become unknown and its slot free."""
        row, col = self.tile_at[slot]
        self.index[row - self.tile_row0, col - self.tile_col0] = 0
        self.cells_of_slot(slot)[:] = 0
        if self.has_sonar:
            self.sonar_of_slot(slot)[:] = 0
        self.sonar_seen[slot] = 0
        self.flags[slot] = 0
        count = int(self.state[kernels.FREE_COUNT])
        self.free_slots[count] = slot
        self.state[kernels.FREE_COUNT] = count + 1

    def drop_all(self) -> None:
        """Forget every tile, and the table."""
        for slot in self.slots():
            self.drop(int(slot))
        self.index, self.tile_row0, self.tile_col0 = np.zeros((0, 0), dtype=np.int32), 0, 0

    @property
    def has_sonar(self) -> bool:
        """Whether a cone was ever inserted."""
        return self.sonar.size > 1

    def need_sonar(self) -> None:
        """Make the second layer."""
        if not self.has_sonar:
            self.sonar = np.zeros(self.cells.size, dtype=np.uint8)

    def cells_of_slot(self, slot: int) -> U16:
        """(TILE, TILE) view of a tile's cells."""
        return self.cells[slot * kernels.TILE_CELLS : (slot + 1) * kernels.TILE_CELLS].reshape(TILE, TILE)

    def sonar_of_slot(self, slot: int) -> U8:
        """(TILE, TILE) view of a tile's sonar layer."""
        return self.sonar[slot * kernels.TILE_CELLS : (slot + 1) * kernels.TILE_CELLS].reshape(TILE, TILE)

    def look_up(self, cells: I64) -> tuple[I64, I64]:
        """Slot (0: none) and flat place in the pool of (N, 2) cells [row, col]."""
        table = (cells >> kernels.TILE_BITS) - np.array([self.tile_row0, self.tile_col0])
        inside = np.all((table >= 0) & (table < np.array(self.index.shape)), axis=1)
        slot = np.zeros(len(cells), dtype=np.int64)
        slot[inside] = self.index[table[inside, 0], table[inside, 1]]
        local = cells & kernels.TILE_MASK
        return slot, slot * kernels.TILE_CELLS + local[:, 0] * TILE + local[:, 1]
