"""Scans as the matcher sees them: one point and one surface normal for each of a fixed set of bearings.

A sensor's beams may come in any order and number, from one sweep to the next; the table of bearings is laid out once,
from the spacing and the field of view of its first sweep, and every later sweep is sorted into it. Its views are then
comparable by index, and memory is bounded by the number of views alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.kernels.localise_table import EMPTY, fill_table, grazing_normals, surface_normals
from mapping.scan import Scan

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MOST_BINS = 720
NARROWEST_RAD = math.radians(0.25)
WIDEST_RAD = math.radians(4.0)
MARGIN_RAD = math.radians(6.0)  # beams that de-skewing turns out of the first sweep's field of view
ROUGHNESS_M = 0.02
LEAST_GIVEN_UP = 64  # views, before the arrays are made anew without them


@dataclass(frozen=True, slots=True)
class BearingTable:
    """Which bearings a sensor's views have: `bins` bins of width_rad from first_rad on, counter-clockwise."""

    first_rad: float
    width_rad: float
    bins: int
    closed: bool

    def frame(self) -> F64:
        """(4,) as the kernels take it."""
        return np.array([self.first_rad, self.width_rad, float(self.bins), float(self.closed)])


def table_for(bearing_rad: F64) -> BearingTable:
    """A table that fits a first sweep (N,), whatever the order of its beams.

    Width: the median spacing of the sorted bearings, in [0.25, 4] degrees and wide enough for 720 bins. Field of view:
    all but the largest gap, if that is wider than 20 degrees and four bins; else the whole turn. ValueError if there
    are fewer than 3 finite bearings.
    """
    turn = 2.0 * math.pi
    # Bins lie centred on the first sweep's beams, so that rounding never moves a beam into its neighbour's.
    sorted_rad = np.unique(np.mod(bearing_rad[np.isfinite(bearing_rad)], turn))
    if len(sorted_rad) < 3:
        raise ValueError("a scan needs at least three beams to be matched")
    gaps = np.diff(np.append(sorted_rad, sorted_rad[0] + turn))
    widest = int(np.argmax(gaps))
    inner = np.delete(gaps, widest)
    width = float(np.clip(np.median(inner), NARROWEST_RAD, WIDEST_RAD))
    open_rad = float(gaps[widest])
    if open_rad < max(math.radians(20.0), 4.0 * width):
        bins = min(MOST_BINS, max(8, round(turn / width)))
        return BearingTable(float(sorted_rad[0]) - 0.5 * turn / bins, turn / bins, bins, True)
    field = turn - open_rad
    width = max(width, (field + 2.0 * MARGIN_RAD) / (MOST_BINS - 2))
    margin = math.ceil(min(MARGIN_RAD, 0.4 * open_rad) / width)
    first = float(sorted_rad[(widest + 1) % len(sorted_rad)]) - (margin + 0.5) * width
    return BearingTable(first, width, round(field / width) + 1 + 2 * margin, False)


def table_of(frame: F64) -> BearingTable:
    """The table that a frame (4,) describes, as BearingTable.frame() made it."""
    first, width, bins, closed = (float(v) for v in frame)
    return BearingTable(first, width, int(bins), closed > 0.0)


NO_TABLE = BearingTable(0.0, 0.0, 0, False)
"""Of a view that was given up."""


@dataclass(frozen=True, slots=True)
class View:
    """One sweep in a table's bins; arrays (B,) float32 as described in mapping.kernels.localise_table."""

    table: BearingTable
    x: F32
    y: F32
    nx: F32
    ny: F32
    quality: F32
    points: int
    normals: int


def view_of(scan: Scan, table: BearingTable, *, farthest_m: float, grazed: bool = False) -> View:
    """A de-skewed sweep as a view: readings from range_min_m to farthest_m; no return and invalid leave bins empty.

    grazed: walls that beams graze have normals, too.
    """
    x, y, nx, ny, quality = (np.empty(table.bins, dtype=np.float32) for _ in range(5))
    frame = table.frame()
    farthest = min(farthest_m, scan.range_max_m if scan.range_max_m > 0.0 else farthest_m)
    nearest = max(scan.range_min_m, 0.05) if math.isfinite(scan.range_min_m) else 0.05
    bearing = np.ascontiguousarray(scan.bearing_rad, dtype=np.float64)
    distance = np.ascontiguousarray(scan.range_m, dtype=np.float64)
    if bearing.shape != distance.shape or bearing.ndim != 1:
        raise ValueError(f"bearings {bearing.shape} and ranges {distance.shape} of a scan must be rows of one length")
    points = fill_table(bearing, distance, nearest, farthest, frame, x, y, quality)
    normals = fill_normals(x, y, frame, nx, ny, quality, grazed=grazed)
    return View(table, x, y, nx, ny, quality, points, normals)


def fill_normals(x: F32, y: F32, frame: F64, nx: F32, ny: F32, quality: F32, *, grazed: bool = False) -> int:
    """Set normals and quality of a view's points (B,); returns how many have one."""
    near = int(surface_normals(x, y, frame, nx, ny, quality, ROUGHNESS_M))
    return near + int(grazing_normals(x, y, frame, nx, ny, quality)) if grazed else near


@dataclass(frozen=True, slots=True)
class ViewArrays:
    """Views 0 .. count - 1 of a store, as kernels take them: (K, B) each, and their frames (K, 4).

    row: (count,) where each view stands in the arrays, -1 if it was given up; None: where its number says.
    """

    count: int
    x: F32
    y: F32
    nx: F32
    ny: F32
    quality: F32
    frames: F64
    row: I64 | None = None

    def rows(self, numbers: I64) -> I64:
        """Where views (R,) stand in the arrays; none of them may be given up."""
        return numbers if self.row is None else self.row[numbers]

    def is_there(self) -> NDArray[np.bool_]:
        """(count,) False for views that were given up."""
        return np.ones(self.count, dtype=np.bool_) if self.row is None else self.row >= 0

    def view(self, number: int) -> View:
        """A kept view again; one without bins if it was given up."""
        row = number if self.row is None else int(self.row[number])
        if row < 0:
            nothing = np.zeros(0, dtype=np.float32)
            return View(NO_TABLE, nothing, nothing, nothing, nothing, nothing, 0, 0)
        table = table_of(self.frames[row])
        x, y, nx, ny, quality = (a[row, : table.bins] for a in (self.x, self.y, self.nx, self.ny, self.quality))
        return View(table, x, y, nx, ny, quality, int(np.sum(quality > EMPTY)), int(np.sum(quality > 0.0)))


class ViewStore:
    """Views that are kept, in the order they came. What `arrays()` handed out never changes, so it may go to a thread.

    Views may be given up; the numbers of the others stay.
    """

    def __init__(self) -> None:
        self._rows = 0  # in use
        self._arrays = [np.zeros((0, 0), dtype=np.float32) for _ in range(5)]
        self._frames: F64 = np.zeros((0, 4))
        self._row: I64 = np.zeros(64, dtype=np.int64)  # of each view
        self._count = 0
        self._given_up: set[int] = set()  # still in the arrays
        self._has_gaps = False

    def __len__(self) -> int:
        return self._count

    @property
    def memory_bytes(self) -> int:
        """What the arrays hold."""
        return sum(a.nbytes for a in self._arrays) + self._frames.nbytes

    def add(self, view: View) -> int:
        """Keep a view; returns its number. One without bins is given up from the start."""
        number = self._count
        if number == len(self._row):
            self._row = np.concatenate((self._row, np.zeros_like(self._row)))
        self._row[number] = self._put(view) if view.table.bins else -1
        self._has_gaps = self._has_gaps or not view.table.bins
        self._count += 1
        return number

    def _put(self, view: View) -> int:
        rows, bins = self._arrays[0].shape
        if self._rows == rows or view.table.bins > bins:
            self._grow(rows if self._rows < rows else max(64, rows + rows // 4), max(bins, view.table.bins))
        row, width = self._rows, view.table.bins
        for kept, new in zip(self._arrays, (view.x, view.y, view.nx, view.ny, view.quality)):
            kept[row, :width] = new
        self._frames[row] = view.table.frame()
        self._rows += 1
        return row

    def give_up(self, numbers: Iterable[int]) -> None:
        """Forget views; they may stay in the arrays for a while, till it is worth making new ones."""
        self._given_up.update(number for number in numbers if self._row[number] >= 0)
        if len(self._given_up) >= max(LEAST_GIVEN_UP, (self._rows - len(self._given_up)) // 4):
            self._close_up()

    def _close_up(self) -> None:
        row = self._row.copy()
        row[list(self._given_up)] = -1
        self._given_up.clear()
        stays = np.flatnonzero(row[: self._count] >= 0)
        chosen = row[stays]
        row[stays] = np.arange(len(stays))
        self._arrays = [a[chosen] for a in self._arrays]
        self._frames = self._frames[chosen]
        self._row, self._rows, self._has_gaps = row, len(stays), True

    def arrays(self) -> ViewArrays:
        """What is kept so far; later views appear in later calls only."""
        x, y, nx, ny, quality = self._arrays
        row = self._row[: self._count].copy() if self._has_gaps else None
        return ViewArrays(self._count, x, y, nx, ny, quality, self._frames, row)

    def _grow(self, rows: int, bins: int) -> None:
        """Into new arrays: what was handed out stays as it is."""
        grown = []
        for index, old in enumerate(self._arrays):
            new = np.full((rows, bins), EMPTY if index == 4 else 0.0, dtype=np.float32)
            new[: self._rows, : old.shape[1]] = old[: self._rows]
            grown.append(new)
        frames = np.zeros((rows, 4))
        frames[: self._rows] = self._frames[: self._rows]
        self._arrays, self._frames = grown, frames
