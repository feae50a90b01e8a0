"""The map of lines of a whole run, fused while driving (S10).

    line_map = LineMap()
    line_map.insert(extractor.extract(range_m), map_from_sensor)
    walls = line_map.lines(min_seen=2)

Lines stand in an index of square cells, so the cost of a scan goes with what is near it, not with the map.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2
from mapping.kernels import lines as kernels
from mapping.lines.fuse import FusionRules
from mapping.lines.lines import Lines, as_points, no_lines, segment_distance

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Cell = tuple[int, int]

CELL_M: Final = 4.0
_FARTHEST_M: Final = 1e7
_LONGEST_M: Final = 1e5
_FIRST_ROOM: Final = 64
_HEAD: Final = struct.Struct("<4sII")
_MAGIC: Final = b"LNS1"
_RMS_STEPS: Final = 4000.0  # a metre
_PACKED: Final = np.dtype([("start", "<i4", 2), ("end", "<i4", 2), ("count", "<u2"), ("seen", "u1"), ("rms", "u1")])


class LineMap:
    """Lines in the map frame that grow together as scans come in. Same scans in the same order, same map."""

    def __init__(self, rules: FusionRules | None = None) -> None:
        self.rules = rules or FusionRules()
        self.scans = 0
        self._angle_cos = math.cos(min(self.rules.angle_rad, math.pi))
        self._table: F64 = np.empty((_FIRST_ROOM, kernels.ROW))
        self._free: list[int] = list(range(_FIRST_ROOM - 1, -1, -1))
        self._cells_of: dict[int, list[Cell]] = {}
        self._in_cell: dict[Cell, set[int]] = {}
        self._born: dict[int, int] = {}  # order of appearance, so that answers do not depend on slots
        self._births = 0
        self.version = 0

    def __len__(self) -> int:
        return len(self._cells_of)

    def insert(self, lines: Lines, map_from_sensor: Pose2) -> None:
        """Take in the lines of one scan, given in the sensor's frame.

        Raises ValueError if the pose or a line is not finite or absurdly far; the map is then unchanged.
        """
        rows = lines.transformed(map_from_sensor).rows
        ends = rows[:, : kernels.WEIGHT]
        if not np.all(np.isfinite(rows)) or (ends.size and float(np.abs(ends).max()) > _FARTHEST_M):
            raise ValueError(f"lines and poses must be finite and within {_FARTHEST_M:g} m of the map's origin")
        if len(lines) and float(lines.length_m.max()) > _LONGEST_M:
            raise ValueError(f"a line is at most {_LONGEST_M:g} m long")
        self.scans += 1
        for row in rows:
            self._insert_row(row.copy())
        self.version += bool(len(rows))

    def lines(self, *, min_seen: int = 1, min_count: int = 0, min_length_m: float = 0.0) -> Lines:
        """The lines that at least so many scans saw, with so many points and so long; oldest first."""
        if not self._cells_of:
            return no_lines()
        rows = self._table[sorted(self._cells_of, key=self._born.__getitem__)]
        chosen = Lines(rows, np.full((len(rows), 2), -1, dtype=np.int64))
        kept = (chosen.seen >= min_seen) & (chosen.count >= min_count) & (chosen.length_m >= min_length_m)
        return chosen.chosen(kept)

    def prune(self, *, min_seen: int = 1, min_count: int = 0, min_length_m: float = 0.0) -> int:
        """Forget the lines that `lines` with these limits would leave out; returns how many."""
        doomed = []
        for index in self._cells_of:
            row = self._table[index]
            length = math.hypot(row[kernels.END_X] - row[kernels.START_X], row[kernels.END_Y] - row[kernels.START_Y])
            if row[kernels.SEEN] < min_seen or row[kernels.COUNT] < min_count or length < min_length_m:
                doomed.append(index)
        for index in doomed:
            self._remove(index)
        self.version += bool(doomed)
        return len(doomed)

    def around(self, x_m: float, y_m: float, reach_m: float) -> I64:
        """Numbers of the lines in the index cells within reach of a place, oldest first; good until the next change."""
        found: set[int] = set()
        for column in _span(x_m - reach_m, x_m + reach_m):
            for at in _span(y_m - reach_m, y_m + reach_m):
                found |= self._in_cell.get((column, at), set())
        return np.array(sorted(found, key=self._born.__getitem__), dtype=np.int64)

    def ends(self, numbers: I64) -> F64:
        """Starts and ends (L, 4) of lines by their numbers."""
        return np.ascontiguousarray(self._table[numbers, : kernels.WEIGHT])

    def keep_pieces(self, number: int, pieces: Sequence[tuple[float, float]]) -> None:
        """Keep of a line only the pieces from one way to another, metres from its start. Each takes its share of the
        points, taken as spread evenly; none: the line is forgotten."""
        row, born = self._table[number : number + 1].copy(), self._born[number]
        line = Lines(row, np.full((1, 2), -1, dtype=np.int64))
        length = float(line.length_m[0])
        self._remove(number)
        for begin, end in pieces:
            ways = np.array([[begin], [end]]) / max(length, 1e-9)
            start_m, end_m = line.start_m + ways * (line.end_m - line.start_m)
            share = (end - begin) / max(length, 1e-9)
            count = np.maximum(np.rint(share * line.count), 2.0)
            rms = np.maximum(line.rms_m, 0.5 / _RMS_STEPS)
            made = rows_of_ends(start_m[None], end_m[None], count, line.seen.astype(np.float64), rms)
            self._add(made[0], born)
        self.version += 1

    # ---------------------------------------------------------------------------------------------------- the index

    def _insert_row(self, row: F64) -> None:
        """Fuse a row with what it is one with, until nothing is, and keep the result."""
        rules = self.rules
        born = self._births
        while True:
            near = self._near(row, rules.gap_m + rules.offset_m)
            partner = int(kernels.best_partner(row, self._table, near, self._angle_cos, rules.offset_m, rules.gap_m))
            if partner < 0:
                break
            born = min(born, self._born[partner])
            kernels.fuse_rows(self._table[partner], row, row)
            self._remove(partner)
        self._add(row, born)

    def _near(self, row: F64, margin_m: float) -> I64:
        """Lines in the cells that a row passes, oldest first."""
        found: set[int] = set()
        for cell in cells_along(row, margin_m):
            found |= self._in_cell.get(cell, set())
        return np.array(sorted(found, key=self._born.__getitem__), dtype=np.int64)

    def _add(self, row: F64, born: int) -> None:
        if not self._free:
            room = len(self._table)
            self._table = np.concatenate((self._table, np.empty_like(self._table)))
            self._free = list(range(2 * room - 1, room - 1, -1))
        index = self._free.pop()
        self._table[index] = row
        self._born[index] = born
        self._births += 1
        cells = cells_along(row, 0.0)
        self._cells_of[index] = cells
        for cell in cells:
            self._in_cell.setdefault(cell, set()).add(index)

    def _remove(self, index: int) -> None:
        for cell in self._cells_of.pop(index):
            inside = self._in_cell[cell]
            inside.discard(index)
            if not inside:
                del self._in_cell[cell]
        del self._born[index]
        self._free.append(index)

    # ------------------------------------------------------------------------------------------------------ queries

    def nearest(self, point: ArrayLike, count: int = 1, *, within_m: float = math.inf) -> list[tuple[float, int]]:
        """(distance in metres, index into lines()) of the nearest lines to a point, nearest first.

        Looks at every line: one numpy pass, 20 us for 500. ValueError if the point is not (2,) and finite.
        """
        place = as_points(np.asarray(point, dtype=np.float64).reshape(1, -1))
        lines = self.lines()
        if not len(lines) or count <= 0:
            return []
        distance = segment_distance(place, lines.start_m, lines.end_m)[0]
        order = np.argsort(distance, kind="stable")[:count]
        return [(float(distance[k]), int(k)) for k in order if distance[k] <= within_m]

    def raycast(self, origin: ArrayLike, bearing_rad: ArrayLike, *, reach_m: float = 100.0) -> tuple[F64, I64]:
        """What a perfect laser would measure here: distance (N,) to the first line along each bearing and its index
        into lines(); +inf and -1 where there is none within reach_m. A line is hit from either side.

        Every ray meets every line within reach: rays * lines. ValueError if anything is not finite.
        """
        ends, place, bearing = self.lines().rows[:, : kernels.WEIGHT], np.asarray(origin, dtype=np.float64), bearing_rad
        angle = np.atleast_1d(np.asarray(bearing, dtype=np.float64))
        if place.shape != (2,) or angle.ndim != 1 or not (np.all(np.isfinite(place)) and np.all(np.isfinite(angle))):
            raise ValueError("a ray has an origin (2,) and bearings (N,), all finite")
        if not (math.isfinite(reach_m) and reach_m >= 0.0):
            raise ValueError(f"reach_m must be a number >= 0, got {reach_m}")
        distance, hit = np.full(angle.size, np.inf), np.full(angle.size, -1, dtype=np.int64)
        if len(ends):
            near = np.flatnonzero(segment_distance(place[None, :], ends[:, :2], ends[:, 2:])[0] <= reach_m)
            kernels.cast_rays(
                np.ascontiguousarray(ends[near]), float(place[0]), float(place[1]), np.cos(angle), np.sin(angle),
                float(reach_m), distance, hit,
            )  # fmt: skip
            hit = np.where(hit >= 0, near[hit], -1) if len(near) else hit
        return distance, hit

    # -------------------------------------------------------------------------------------------------------- bytes

    def to_bytes(self, *, min_seen: int = 1, min_count: int = 0) -> bytes:
        """The lines with so many scans and points, in 20 bytes a line and 12 in all: ends in tenths of a millimetre,
        supporting points (up to 65,535), scans (up to 255), rms distance (in quarters of a millimetre, up to 64 mm).
        How the points lay is lost: `from_bytes` spreads them evenly.
        """
        lines = self.lines(min_seen=min_seen, min_count=min_count)
        packed = np.empty(len(lines), dtype=_PACKED)
        scaled = np.rint(lines.rows[:, : kernels.WEIGHT] * 1e4)
        if len(lines) and float(np.abs(scaled).max()) > np.iinfo(np.int32).max:
            raise ValueError("lines farther than 214 km from the origin do not fit: choose a nearer origin")
        packed["start"], packed["end"] = scaled[:, :2], scaled[:, 2:]
        packed["count"] = np.minimum(lines.count, np.iinfo(np.uint16).max)
        packed["seen"] = np.minimum(lines.seen, np.iinfo(np.uint8).max)
        packed["rms"] = np.minimum(np.rint(lines.rms_m * _RMS_STEPS), np.iinfo(np.uint8).max)
        return _HEAD.pack(_MAGIC, self.scans, len(lines)) + packed.tobytes()

    @staticmethod
    def from_bytes(data: bytes, rules: FusionRules | None = None) -> LineMap:
        """The map of `to_bytes`. Raises ValueError if the bytes are not one, whole."""
        if len(data) < _HEAD.size:
            raise ValueError("no line map: too short")
        magic, scans, count = _HEAD.unpack_from(data)
        if magic != _MAGIC or len(data) != _HEAD.size + count * _PACKED.itemsize:
            raise ValueError("no line map, or not all of it")
        packed = np.frombuffer(data, dtype=_PACKED, offset=_HEAD.size)
        made = LineMap(rules)
        made.scans = int(scans)
        for row in rows_of_ends(
            packed["start"] / 1e4, packed["end"] / 1e4, packed["count"].astype(np.float64),
            packed["seen"].astype(np.float64), np.maximum(packed["rms"], 0.5) / _RMS_STEPS,
        ):  # fmt: skip
            made._add(row, made._births)
        return made


def rows_of_ends(start_m: F64, end_m: F64, count: F64, seen: F64, rms_m: F64) -> F64:
    """Rows of lines of which only this is known: points spread evenly between the ends, with that scatter across."""
    way = end_m - start_m
    length = np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
    ux, uy = way[:, 0] / length, way[:, 1] / length
    weight = count / rms_m**2
    along, across = weight * length**2 / 12.0, count
    rows = np.empty((len(start_m), kernels.ROW))
    rows[:, kernels.START_X : kernels.END_X], rows[:, kernels.END_X : kernels.WEIGHT] = start_m, end_m
    rows[:, kernels.WEIGHT] = weight
    rows[:, kernels.CX : kernels.SXX] = 0.5 * (start_m + end_m)
    rows[:, kernels.SXX] = along * ux * ux + across * uy * uy
    rows[:, kernels.SXY] = (along - across) * ux * uy
    rows[:, kernels.SYY] = along * uy * uy + across * ux * ux
    rows[:, kernels.COUNT], rows[:, kernels.SEEN] = count, seen
    return rows


def cells_along(row: F64, margin_m: float) -> list[Cell]:
    """The index cells within margin_m of a line: its columns of cells, in each the rows between which it passes."""
    x0, y0, x1, y1 = row[: kernels.WEIGHT].tolist()
    if x0 > x1:
        x0, y0, x1, y1 = x1, y1, x0, y0
    slope = (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0
    cells: list[Cell] = []
    for column in _span(x0 - margin_m, x1 + margin_m):
        a, b = y0, y1
        if x1 > x0:
            left = column * CELL_M - margin_m
            right = (column + 1) * CELL_M + margin_m
            a = y0 + slope * ((left if left > x0 else x0) - x0)
            b = y0 + slope * ((right if right < x1 else x1) - x0)
        if a > b:
            a, b = b, a
        cells += [(column, at) for at in _span(a - margin_m, b + margin_m)]
    return cells


def _span(low: float, high: float) -> range:
    return range(math.floor(low / CELL_M), math.floor(high / CELL_M) + 1)
