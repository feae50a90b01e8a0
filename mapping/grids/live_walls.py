"""Walls of a map that is being made: ends and passes of beams, tile by tile as they come, judged again and again.

The same question as in mapping.grids.walls, asked of a map that grows. What differs:

- Counts are a byte each and are halved where one is full, so that they follow a changed world.
- Tiles are judged one at a time, each with a rim of its neighbours. A wall's place depends on little beyond.
- A tile is worth judging again when it was given many more beams (`worth`), so that all judging together costs a share
  of the counting, however long it goes on.

What is found are walls only. How a grid is seen through them, and why no cell becomes free by it, tells
`OccupancyGrid.show_walls`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mapping.grids.geometry import check_resolution
from mapping.grids.tiles import TILE
from mapping.grids.walls import HALF_A_BEAM, NEAR, TileTable, WallRules, blur_weights, rule_row
from mapping.kernels import walls as kernels
from mapping.kernels.grids import TILE_BITS, TILE_CELLS

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Place = tuple[int, int]

FULL: Final = 255
RIM: Final = 8  # cells of the neighbours that are judged along with a tile
GROWTH: Final = 1.25  # of the room for tiles
MANY: Final = 30_000  # beams that ended in a tile: beyond, more make it no harder to be worth judging again
MAX_TABLE: Final = 1 << 22  # entries, as of a grid's table
KEPT: Final = struct.Struct("<4sBHdqI")  # magic, version, side of a tile, resolution, beams, CRC-32 of the counts
MAGIC: Final = b"UWLC"
VERSION: Final = 1


class LiveWalls:
    """Counts of beams in tiles, and which cells are walls by them. 32 KB a tile in which a beam has ended."""

    def __init__(self, *, resolution_m: float, rules: WallRules | None = None, max_tiles: int = 4096) -> None:
        """max_tiles: beyond, what ends elsewhere is not counted (`refused` does)."""
        self.resolution_m = check_resolution(resolution_m)
        self.refused = 0
        self._max_tiles = max_tiles
        rules = rules if rules is not None else WallRules()
        self._weight = np.ascontiguousarray(blur_weights(rules))
        self._rule = rule_row(rules)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._numbers: dict[Place, int] = {}
        self._table = TileTable.of(np.zeros((0, 2), dtype=np.int64))
        self._ends: U8 = np.zeros(0, dtype=np.uint8)
        self._passes: U8 = np.zeros(0, dtype=np.uint8)
        self._beams: I64 = np.zeros(0, dtype=np.int64)  # that ended in each tile, and of these those judged
        self._judged: I64 = np.zeros(0, dtype=np.int64)

    @property
    def places(self) -> list[Place]:
        """(tile row, tile column) of every tile, in the order in which they came."""
        return list(self._numbers)

    def add(self, map_from_sensor: F64, bearing_rad: F64, range_m: F64, *, range_max_m: float) -> None:
        """One sweep. map_from_sensor: x, y, yaw of the sensor at every beam (N, 3), or once for all (3,).

        bearing_rad, range_m: (N,) as in mapping.scan.Scan. Beams without echo, too close or not measured do not count.
        """
        pose = np.atleast_2d(np.asarray(map_from_sensor, dtype=np.float64))
        ranges = np.array(range_m, dtype=np.float64)
        per_m = 1.0 / self.resolution_m
        bearing = np.asarray(bearing_rad, dtype=np.float64) + pose[:, 2]
        from_x, from_y = np.ascontiguousarray(pose[:, 0] * per_m), np.ascontiguousarray(pose[:, 1] * per_m)
        self._make_room(from_x, from_y, bearing, ranges * per_m, range_max_m * per_m)
        kernels.count_beams(
            from_x, from_y, bearing, ranges, per_m, float(range_max_m), self._table.row0, self._table.col0,
            self._table.index, self._ends, self._passes, FULL,
        )  # fmt: skip

    def _make_room(self, from_x: F64, from_y: F64, bearing: F64, length: F64, longest: float) -> None:
        """Have a tile wherever a beam ends, and note how many do; all in cells."""
        ended = (length >= 0.0) & (length <= longest)
        way, heading = length[ended], bearing[ended]
        x, y = (np.broadcast_to(each, ended.shape)[ended] for each in (from_x, from_y))
        col = np.floor(x + way * np.cos(heading)).astype(np.int64) >> TILE_BITS
        row = np.floor(y + way * np.sin(heading)).astype(np.int64) >> TILE_BITS
        tiles, counts = np.unique((row << 32) + col + (1 << 31), return_counts=True)
        places = zip((tiles >> 32).tolist(), ((tiles & 0xFFFFFFFF) - (1 << 31)).tolist())
        for place, count in zip(places, counts.tolist()):
            number = self._number_for(place)
            if number is None:
                self.refused += 1
            else:
                self._beams[number] += count

    def _number_for(self, place: Place) -> int | None:
        number = self._numbers.get(place)
        if number is not None:
            return number
        number = len(self._numbers)
        rows, cols = ([each[axis] for each in (*self._numbers, place)] for axis in (0, 1))
        if number >= self._max_tiles or (max(rows) - min(rows) + 1) * (max(cols) - min(cols) + 1) > MAX_TABLE:
            return None
        if number == len(self._beams):
            room = min(max(16, round(number * GROWTH)), self._max_tiles)
            self._ends, self._passes = (_longer(each, room * TILE_CELLS) for each in (self._ends, self._passes))
            self._beams, self._judged = (_longer(each, room) for each in (self._beams, self._judged))
        self._numbers[place] = number
        self._table = TileTable.of(np.array(list(self._numbers), dtype=np.int64))
        return number

    # ------------------------------------------------------------------ judging

    def worth(self, share: float) -> list[Place]:
        """Tiles that were given more beams since they were judged than this share of those before, most first.

        Of those before MANY count at most, so that a place that is seen for days goes on being judged.
        """
        n = len(self._numbers)
        new = self._beams[:n] - self._judged[:n]
        chosen = np.flatnonzero(new > share * np.minimum(self._judged[:n], MANY))
        places = self.places
        return [places[k] for k in chosen[np.argsort(-new[chosen], kind="stable")].tolist()]

    def judge(self, place: Place) -> U8:
        """(TILE, TILE) 0 or 1: the walls in a tile by now; it counts as judged."""
        number = self._numbers.get(place)
        if number is None:
            return np.zeros((TILE, TILE), dtype=np.uint8)
        self._judged[number] = self._beams[number]
        ends, passes = (self._around(counts, place) for counts in (self._ends, self._passes))
        wall = np.zeros(ends.shape, dtype=np.bool_)
        kernels.judge_window(ends, passes, self._weight, NEAR, self._rule, HALF_A_BEAM, wall)
        return wall[RIM:-RIM, RIM:-RIM].astype(np.uint8)

    def _around(self, counts: U8, place: Place) -> U8:
        """(TILE + 2 RIM, TILE + 2 RIM) counts of a tile and its rim."""
        side = TILE + 2 * RIM
        around = np.zeros((side, side), dtype=np.uint8)
        parts = (
            (slice(0, RIM), slice(-RIM, None)),
            (slice(RIM, -RIM), slice(None)),
            (slice(-RIM, None), slice(0, RIM)),
        )
        for i, (rows_into, rows_of) in enumerate(parts):
            for j, (cols_into, cols_of) in enumerate(parts):
                number = self._numbers.get((place[0] + i - 1, place[1] + j - 1))
                if number is not None:
                    tile = counts[number * TILE_CELLS : (number + 1) * TILE_CELLS].reshape(TILE, TILE)
                    around[rows_into, cols_into] = tile[rows_of, cols_of]
        return around

    # ------------------------------------------------------------------ keeping

    def payload(self, place: Place) -> bytes:
        """The counts of a tile, for `load`."""
        number = self._numbers[place]
        body = b"".join(
            each[number * TILE_CELLS : (number + 1) * TILE_CELLS].tobytes() for each in (self._ends, self._passes)
        )
        head = KEPT.pack(MAGIC, VERSION, TILE, self.resolution_m, int(self._beams[number]), zlib.crc32(body))
        return head + zlib.compress(body, 1)

    def load(self, tiles: Iterable[tuple[int, int, bytes]]) -> None:
        """Go on from these tiles, and nothing else. ValueError, and empty, if one is torn or of another resolution."""
        self.clear()
        try:
            for row, col, payload in tiles:
                self._load(row, col, payload)
        except ValueError:
            self.clear()
            raise

    def _load(self, row: int, col: int, payload: bytes) -> None:
        if len(payload) < KEPT.size:
            raise ValueError("stored counts of beams are shorter than their header")
        magic, version, side, resolution_m, beams, crc = KEPT.unpack_from(payload)
        if magic != MAGIC or version != VERSION or side != TILE:
            raise ValueError("these are no stored counts of beams that this program reads")
        if resolution_m != self.resolution_m:
            raise ValueError(
                f"stored counts of beams are of {resolution_m} m cells, this grid has {self.resolution_m} m"
            )
        unpacker = zlib.decompressobj()
        try:
            body = unpacker.decompress(payload[KEPT.size :], 2 * TILE_CELLS + 1)
        except zlib.error as error:
            raise ValueError(f"stored counts of beams are torn: {error}") from error
        if len(body) != 2 * TILE_CELLS or zlib.crc32(body) != crc or beams < 0:
            raise ValueError("stored counts of beams are torn: their checksum does not fit")
        if max(abs(row), abs(col)) >= 1 << 30:
            raise ValueError(f"tile ({row}, {col}) is too far from the origin")
        number = self._number_for((row, col))
        if number is None:
            raise ValueError(f"no room for the counts of tile ({row}, {col})")
        ends, passes = np.frombuffer(body, dtype=np.uint8).reshape(2, TILE_CELLS)
        self._ends[number * TILE_CELLS : (number + 1) * TILE_CELLS] = ends
        self._passes[number * TILE_CELLS : (number + 1) * TILE_CELLS] = passes
        self._beams[number], self._judged[number] = beams, 0


def _longer(array: NDArray[Any], length: int) -> NDArray[Any]:
    """The same and zeros behind."""
    longer = np.zeros(length, dtype=array.dtype)
    longer[: len(array)] = array
    return longer
