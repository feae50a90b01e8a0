"""The map-fixed grid: unbounded, growing by tiles as the robot drives (S26 to S29); to publish and to keep."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.evidence import (
    FREE,
    OCCUPIED,
    PARTLY_FREE,
    UNKNOWN,
    CellRules,
    CellState,
    EvidenceGrid,
    Model,
)
from mapping.grids.patch import GridPatch
from mapping.grids.sonar_model import SonarRules
from mapping.grids.tiles import TILE, TO_PUBLISH, TO_STORE, TilePool, Window
from mapping.kernels import grids as kernels
from mapping.kernels import walls as wall_kernels

__all__ = [
    "FREE",
    "OCCUPIED",
    "PARTLY_FREE",
    "UNKNOWN",
    "CellRules",
    "CellState",
    "GridTile",
    "OccupancyGrid",
    "SonarRules",
]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
I8 = NDArray[np.int8]

# A stored tile: magic, version, model, side of a tile, resolution, whether a sonar layer follows, CRC-32 of what
# follows unpacked; then zlib: side * side uint16 cells, little endian, row by row, and as many uint8 of the sonar.
TILE_HEADER: Final = struct.Struct("<4sBBHd?I")
TILE_MAGIC: Final = b"UGRT"
TILE_VERSION: Final = 1
MAX_TILE_ROW: Final = 1 << 33

WALL_FROM_PERCENT: Final = 15  # a wall that the laser has all but looked away is shown no more
BY_A_WALL_CELLS: Final = 2


@dataclass(frozen=True, slots=True)
class GridTile:
    """A copy of one tile, taken quickly; `payload` does the slow part, in whichever thread.

    Covers the cells [tile_row * 128, (tile_row + 1) * 128), columns alike.
    """

    tile_row: int
    tile_col: int
    resolution_m: float
    model: Model
    cells: U16
    sonar: U8 | None
    walls: U8 | None = None  # as in OccupancyGrid.show_walls

    def payload(self) -> bytes:
        """Bytes for OccupancyGrid.load_tile; the same cells always give the same bytes."""
        body = self.cells.astype("<u2").tobytes() + (b"" if self.sonar is None else self.sonar.tobytes())
        model = kernels.COUNTERS if self.model == "counters" else kernels.LOG_ODDS
        header = TILE_HEADER.pack(
            TILE_MAGIC, TILE_VERSION, model, TILE, self.resolution_m, self.sonar is not None, zlib.crc32(body)
        )
        return header + zlib.compress(body, 1)


class OccupancyGrid(EvidenceGrid):
    """The map of a building or a field, cell by cell.

    resolution_m: edge of a cell.  model: "counters" (hits and misses, eq. 5.46) or "log-odds".
    max_tiles: bound of its memory, 32 KB a tile, 48 with sonars; 4096 tiles of 6.4 m are 168,000 m2 at 5 cm. What
    finds no room stays unknown (refused_tiles, refused_insertions count it).
    fill_gap_m: neighbouring beams farther apart than this free only the cells they pass.
    use_max_m: beams are cut to this length; what is beyond is left alone.
    Coordinates are those of the map frame, any distance from its origin.
    """

    def __init__(
        self,
        *,
        resolution_m: float = 0.05,
        model: Model = "counters",
        rules: CellRules | None = None,
        sonar_rules: SonarRules | None = None,
        fill_gap_m: float = 0.15,
        use_max_m: float = float("inf"),
        max_tiles: int = 4096,
    ) -> None:
        super().__init__(
            TilePool(max_tiles),
            resolution_m=resolution_m,
            model=model,
            rules=rules if rules is not None else CellRules(),
            sonar_rules=sonar_rules if sonar_rules is not None else SonarRules(),
            fill_gap_m=fill_gap_m,
            use_max_m=use_max_m,
        )
        self._published: dict[int, I8] = {}
        self._walls: dict[int, U8] = {}  # by slot: which cells are walls, packed, eight columns a byte

    # ------------------------------------------------------------------ publishing

    def patch(self, *, whole_tiles: bool = False) -> GridPatch:
        """Everything observed so far, in its bounding rectangle; (0, 0) cells if nothing was.

        whole_tiles: the rectangle is made of whole tiles (6.4 m at 5 cm), so that it grows seldom: for publishing.
        """
        slots = self._pool.slots()
        if slots.size == 0:
            return GridPatch(self.resolution_m, 0, 0, np.zeros((0, 0), dtype=np.int8))
        low, high = self._pool.tile_at[slots].min(axis=0) * TILE, (self._pool.tile_at[slots].max(axis=0) + 1) * TILE
        patch = self._patch_of(Window(int(low[0]), int(high[0]), int(low[1]), int(high[1])))
        return patch if whole_tiles else trimmed(patch)

    def take_changes(self) -> list[GridPatch]:
        """Rectangles whose published values changed since the last call, at most one a tile (16 KB).

        Evidence that changes no percentage changes nothing here.
        """
        changes = []
        rectangle = np.zeros(4, dtype=np.int64)
        image = np.empty((TILE, TILE), dtype=np.int8)
        for slot in self._pool.flagged(TO_PUBLISH):
            self._pool.flags[slot] &= ~TO_PUBLISH & np.uint8(0xFF)
            self._tile_percent(int(slot), image)
            known = self._published.get(int(slot))
            if known is None:
                known = self._published[int(slot)] = np.full((TILE, TILE), -1, dtype=np.int8)
            if kernels.changed_rectangle(image, known, rectangle):
                row0, row1, col0, col1 = (int(k) for k in rectangle)
                known[:] = image
                tile_row, tile_col = (int(k) for k in self._pool.tile_at[slot])
                cells = image[row0:row1, col0:col1].copy()
                changes.append(GridPatch(self.resolution_m, tile_row * TILE + row0, tile_col * TILE + col0, cells))
        return changes

    # ------------------------------------------------------------------ the store

    def tiles(self) -> Iterator[tuple[int, int, bytes]]:
        """Every tile as (tile row, tile column, payload), in order of rows."""
        for slot in self._pool.slots():
            tile = self._copy_of(int(slot))
            yield tile.tile_row, tile.tile_col, tile.payload()

    def changed_tiles(self) -> list[GridTile]:
        """Copies of the tiles touched since the last call (whatever take_changes has seen): for the next snapshot.

        About 5 us a tile; call payload() of each in the thread that writes.
        """
        slots = self._pool.flagged(TO_STORE)
        self._pool.flags[slots] &= ~TO_STORE & np.uint8(0xFF)
        return [self._copy_of(int(slot)) for slot in slots]

    def _copy_of(self, slot: int) -> GridTile:
        pool = self._pool
        tile_row, tile_col = (int(k) for k in pool.tile_at[slot])
        sonar = pool.sonar_of_slot(slot).copy() if pool.sonar_seen[slot] else None
        cells, walls = pool.cells_of_slot(slot).copy(), self._walls.get(slot)
        return GridTile(tile_row, tile_col, self.resolution_m, self.model, cells, sonar, walls)

    def load_tile(self, tile_row: int, tile_col: int, payload: bytes, *, sonars: bool = True) -> None:
        """Put a stored tile in its place, replacing what is there; it counts as changed for publishing only.

        sonars: with what they heard as well, not what lasers saw alone.
        Raises ValueError, and changes nothing, if the payload is torn, of a later version, of another model or
        resolution, if the tile is absurdly far out, or if no room is left.
        """
        cells, sonar = self._unpack(payload)
        sonar = sonar if sonars else None
        if max(abs(tile_row), abs(tile_col)) > MAX_TILE_ROW:
            raise ValueError(f"tile ({tile_row}, {tile_col}) is too far from the origin")
        slot = self._pool.slot_for(tile_row, tile_col)
        if slot == 0:
            raise ValueError(f"no room for tile ({tile_row}, {tile_col}): raise max_tiles ({self._pool.max_tiles})")
        self._pool.cells_of_slot(slot)[:] = cells
        if sonar is not None or self._pool.sonar_seen[slot]:
            self._pool.need_sonar()
            self._pool.sonar_of_slot(slot)[:] = 0 if sonar is None else sonar
            self._pool.sonar_seen[slot] = sonar is not None
        self._walls.pop(slot, None)
        self._pool.flags[slot] |= ~TO_STORE & np.uint8(0xFF)
        self._pool.flags[slot] &= ~TO_STORE & np.uint8(0xFF)

    def _unpack(self, payload: bytes) -> tuple[U16, U8 | None]:
        if len(payload) < TILE_HEADER.size:
            raise ValueError("a stored grid tile is shorter than its header")
        magic, version, model, side, resolution_m, with_sonar, crc = TILE_HEADER.unpack_from(payload)
        if magic != TILE_MAGIC:
            raise ValueError("this is no stored grid tile")
        if version != TILE_VERSION or side != TILE:
            raise ValueError(f"a stored grid tile of version {version}, side {side}: this program reads 1, {TILE}")
        if model != self._model_number:
            raise ValueError(f'a stored grid tile of another model than this grid ("{self.model}")')
        if resolution_m != self.resolution_m:
            raise ValueError(f"a stored grid tile of {resolution_m} m cells, this grid has {self.resolution_m} m")
        size = kernels.TILE_CELLS * (3 if with_sonar else 2)
        unpacker = zlib.decompressobj()
        try:
            body = unpacker.decompress(payload[TILE_HEADER.size :], size + 1)
        except zlib.error as error:
            raise ValueError(f"a stored grid tile is torn: {error}") from error
        if len(body) != size or zlib.crc32(body) != crc:
            raise ValueError("a stored grid tile is torn: its checksum does not fit")
        cells = np.frombuffer(body, dtype="<u2", count=kernels.TILE_CELLS).astype(np.uint16).reshape(TILE, TILE)
        self._check_cells(cells)
        if not with_sonar:
            return cells, None
        return cells, np.frombuffer(body, dtype=np.uint8, offset=2 * kernels.TILE_CELLS).reshape(TILE, TILE)

    def _check_cells(self, cells: U16) -> None:
        """Contents that kernels can go on from, whatever the settings the tile was made with."""
        if self.model == "counters":
            sound = bool(np.all((cells & 0xFF) < 0xFF) and np.all((cells >> 8) < 0xFF))
        else:
            sound = bool(np.all((cells == 0) | (np.abs(cells.astype(np.int64) - kernels.ODDS_ZERO) <= 8000)))
        if not sound:
            raise ValueError("a stored grid tile holds impossible cells")

    def places(self) -> list[tuple[int, int]]:
        """(tile row, tile column) of every tile, in order of rows."""
        return [(int(row), int(col)) for row, col in self._pool.tile_at[self._pool.slots()]]

    def empty_copy(self) -> OccupancyGrid:
        """A grid of the same kind that knows nothing."""
        return OccupancyGrid(
            resolution_m=self.resolution_m,
            model=self.model,
            rules=self.rules,
            sonar_rules=self._sonar_rules,
            fill_gap_m=self._fill_gap_m,
            use_max_m=self._use_max_m,
            max_tiles=self._pool.max_tiles,
        )

    def take_tiles(self, other: OccupancyGrid, places: Iterable[tuple[int, int]]) -> None:
        """Replace whole tiles by those of another grid of the same kind; what it does not know there is unknown then.

        They count as changed, for publishing and for the store. Raises ValueError if the grids differ in kind.
        """
        if other.model != self.model or other.resolution_m != self.resolution_m:
            raise ValueError("tiles are taken from a grid of the same model and resolution only")
        theirs = {tuple(other._pool.tile_at[slot].tolist()): int(slot) for slot in other._pool.slots()}
        ours = {tuple(self._pool.tile_at[slot].tolist()) for slot in self._pool.slots()}
        for place in places:
            source = theirs.get(place)
            if source is None and place not in ours:
                continue
            slot = self._pool.slot_for(*place)
            if slot == 0:
                continue  # no room: it stays unknown, and is counted
            self._pool.cells_of_slot(slot)[:] = 0 if source is None else other._pool.cells_of_slot(source)
            with_sonar = source is not None and bool(other._pool.sonar_seen[source])
            if with_sonar or self._pool.sonar_seen[slot]:
                self._pool.need_sonar()
                self._pool.sonar_of_slot(slot)[:] = (
                    other._pool.sonar_of_slot(source) if with_sonar and source is not None else 0
                )
                self._pool.sonar_seen[slot] = with_sonar
            self._walls.pop(slot, None)
            self._pool.flags[slot] = 0xFF

    def call_occupied(self, cells: ArrayLike) -> tuple[int, int]:
        """Let the laser layer call just these cells occupied: (N, 2) [row, col], N may be 0.

        One that is not gets the least evidence that makes it so; others that are become undecided, so neither
        occupied nor free. No cell becomes free, and what is free or unknown stays so but for the cells named.
        Cells in no tile are passed over. Returns how many became occupied, how many undecided.
        Raises ValueError if the rules have no cell that is neither (free_below above 0.5 or occupied_from not).
        """
        if not self.rules.free_below <= 0.5 < self.rules.occupied_from:
            raise ValueError("a cell of probability 0.5 is free or occupied by these rules")
        occupied = self._laser_probability >= self.rules.occupied_from
        published = self._laser_percent >= math.ceil(100.0 * self.rules.occupied_from)  # rounded: a few more
        least = int(np.flatnonzero(occupied)[0])
        undecided = 0x0101 if self.model == "counters" else kernels.ODDS_ZERO
        pool = self._pool
        slot, at = pool.look_up(np.asarray(cells, dtype=np.int64).reshape(-1, 2))
        named = np.unique(at[slot > 0])
        added = named[~occupied[pool.cells[named]]]
        lowered = 0
        for each in pool.slots():
            start = int(each) * kernels.TILE_CELLS
            tile = pool.cells[start : start + kernels.TILE_CELLS]
            lower = occupied[tile] | published[tile]
            first, last = np.searchsorted(named, (start, start + kernels.TILE_CELLS))
            lower[named[first:last] - start] = False
            tile[lower] = undecided
            lowered += int(np.count_nonzero(lower))
            pool.flags[each] = 0xFF
        pool.cells[added] = least
        return len(added), lowered

    def show_walls(self, tile_row: int, tile_col: int, walls: U8 | None) -> None:
        """Publish and export a tile seen through the walls found in it; what its cells hold stays as counted.

        walls: (TILE, TILE) 0 or 1, or as in GridTile; None: as counted. A wall that is WALL_FROM_PERCENT occupied or
        more is shown occupied; an occupied cell that is no wall and has one shown within BY_A_WALL_CELLS, in this tile,
        as just less. So no cell is shown freer than it was counted, but from occupied to undecided beside a wall that
        is shown; what was not seen before is shown at once; and what the laser looks away goes. Sonars keep their say.
        It lasts until the tile is loaded, taken or cleared. Nothing happens where there is no tile.
        """
        slot = int(self._pool.look_up(np.array([[tile_row, tile_col]], dtype=np.int64) * TILE)[0][0])
        if slot == 0:
            return
        packed = None if walls is None or not walls.any() else walls
        if packed is not None and packed.shape == (TILE, TILE):
            packed = np.packbits(packed, axis=1)
        before = self._walls.pop(slot, None)
        if packed is not None:
            self._walls[slot] = packed
        if before is not packed and (before is None or packed is None or not np.array_equal(before, packed)):
            self._pool.flags[slot] |= TO_PUBLISH | TO_STORE

    def _tile_percent(self, slot: int, out: I8) -> None:
        walls, pool = self._walls.get(slot), self._pool
        if walls is None:
            super()._tile_percent(slot, out)
            return
        wall_kernels.percent_by_walls(
            slot, pool.cells, self._laser_percent, pool.sonar, bool(pool.sonar_seen[slot]), self._sonar_percent,
            np.unpackbits(walls, axis=1), math.ceil(100.0 * self.rules.occupied_from), WALL_FROM_PERCENT,
            BY_A_WALL_CELLS, out,
        )  # fmt: skip

    def clear(self) -> None:
        """Forget everything; the next changes say so."""
        self._walls.clear()
        for slot in self._pool.slots():
            self._pool.cells_of_slot(int(slot))[:] = 0
            if self._pool.sonar_seen[slot]:
                self._pool.sonar_of_slot(int(slot))[:] = 0
            self._pool.flags[slot] = 0xFF

    def start_anew(self) -> None:
        """Forget everything, the tiles as well; no change says so: whoever publishes sends the grid whole."""
        self._pool.drop_all()
        self._published.clear()
        self._walls.clear()


def trimmed(patch: GridPatch) -> GridPatch:
    """The same cells without unknown rows and columns at the rim."""
    known = patch.cells >= 0
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if rows.size == 0:
        return GridPatch(patch.resolution_m, 0, 0, np.zeros((0, 0), dtype=np.int8))
    row0, row1, col0, col1 = int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1
    cells = np.ascontiguousarray(patch.cells[row0:row1, col0:col1])
    return GridPatch(patch.resolution_m, patch.row0 + row0, patch.col0 + col0, cells)
