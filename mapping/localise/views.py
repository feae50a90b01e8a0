"""Scans as the matcher sees them: one point and one surface normal for each of a fixed set of bearings.

What is kept is kept as its points: normals follow from them, to the last bit, when a view is looked at again.

A sensor's beams may come in any order and number, from one sweep to the next; the table of bearings is laid out once,
from the spacing and the field of view of its first sweep, and every later sweep is sorted into it. Its views are then
comparable by index, and memory is bounded by the number of views alone.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.kernels.localise_table import EMPTY, fill_table, grazing_normals, surface_normals
from mapping.scan import Scan

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]
K = TypeVar("K")
V = TypeVar("V")

MOST_BINS = 720
NARROWEST_RAD = math.radians(0.25)
WIDEST_RAD = math.radians(4.0)
MARGIN_RAD = math.radians(6.0)  # beams that de-skewing turns out of the first sweep's field of view
ROUGHNESS_M = 0.02
LEAST_GIVEN_UP = 64  # views, before they really go
OPEN_MOST = 64
_SIDES = 4


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
    """One sweep in a table's bins; arrays (B,) float32 as described in mapping.kernels.localise_table.

    grazed: walls that beams graze have normals, too.
    """

    table: BearingTable
    x: F32
    y: F32
    nx: F32
    ny: F32
    quality: F32
    points: int
    normals: int
    grazed: bool = False


def view_of(scan: Scan, table: BearingTable, *, farthest_m: float, grazed: bool = False) -> View:
    """A de-skewed sweep as a view: readings from range_min_m to farthest_m; no return and invalid leave bins empty."""
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
    return View(table, x, y, nx, ny, quality, points, normals, grazed)


def fill_normals(x: F32, y: F32, frame: F64, nx: F32, ny: F32, quality: F32, *, grazed: bool = False) -> int:
    """Set normals and quality of a view's points (B,); returns how many have one."""
    near = int(surface_normals(x, y, frame, nx, ny, quality, ROUGHNESS_M))
    return near + int(grazing_normals(x, y, frame, nx, ny, quality)) if grazed else near


@dataclass(frozen=True, slots=True)
class PackedView:
    """A view but for what follows from its points: two fifths of it. x, y: (B,) as in View."""

    table: BearingTable
    x: F32
    y: F32
    grazed: bool

    @property
    def memory_bytes(self) -> int:
        """What the arrays hold."""
        return self.x.nbytes + self.y.nbytes

    def opened(self) -> View:
        """The view again, to the last bit."""
        nx, ny = np.empty_like(self.x), np.empty_like(self.x)
        filled = (self.x != 0.0) | (self.y != 0.0)  # no point lies in the sensor
        quality = np.where(filled, np.float32(0.0), np.float32(EMPTY))
        normals = fill_normals(self.x, self.y, self.table.frame(), nx, ny, quality, grazed=self.grazed)
        return View(self.table, self.x, self.y, nx, ny, quality, int(filled.sum()), normals, self.grazed)


@dataclass(frozen=True, slots=True)
class OpenViews:
    """Views side by side, as kernels take them: (R, B) each, and their frames (R, 4)."""

    x: F32
    y: F32
    nx: F32
    ny: F32
    quality: F32
    frames: F64

    @property
    def rows(self) -> I64:
        """(R,) all of them."""
        return np.arange(len(self.frames))


class KeptViews:
    """Views 0 .. count - 1 of a store as they were at one moment: it never changes, so it may go to a thread."""

    __slots__ = ("_packed", "_shelf", "_there", "count")

    def __init__(self, packed: list[PackedView | None], there: Bools, count: int, shelf: _Shelf) -> None:
        """packed: of each view, None where it was given up; may grow behind count.  there: (count,) alike."""
        self._packed = packed
        self._there = there
        self._shelf = shelf
        self.count = count

    def is_there(self) -> Bools:
        """(count,) False for views that were given up; not to be written to."""
        return self._there

    def packed(self, number: int) -> PackedView | None:
        """A view as it is kept; None if it was given up."""
        if not 0 <= number < self.count:
            raise IndexError(number)
        return self._packed[number]

    def view(self, number: int) -> View:
        """A kept view; one without bins if it was given up."""
        packed = self.packed(number)
        return _NOTHING if packed is None else self._shelf.view(number, packed)

    def opened(self, numbers: I64) -> OpenViews:
        """Views (R,) side by side; ValueError if one of them was given up."""
        return self._shelf.side_by_side(numbers, self.view)


_NO_POINTS: F32 = np.zeros(0, dtype=np.float32)
_NOTHING = View(NO_TABLE, _NO_POINTS, _NO_POINTS, _NO_POINTS, _NO_POINTS, _NO_POINTS, 0, 0)


class _Shelf:
    """Views of one store that were opened lately, for all threads. Opening one costs 0.1 ms, a match takes eight."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._views: dict[int, View] = {}
        self._sides: dict[bytes, OpenViews] = {}
        self._lock = threading.Lock()

    def __deepcopy__(self, _memo: dict[int, object]) -> _Shelf:
        """An empty one: what is opened again is the same."""
        return _Shelf(self._most)

    def view(self, number: int, packed: PackedView) -> View:
        view = self._taken(self._views, number)
        return self.put(number, packed.opened()) if view is None else view

    def put(self, number: int, view: View) -> View:
        return self._put(self._views, number, view, self._most)

    def side_by_side(self, numbers: I64, view: Callable[[int], View]) -> OpenViews:
        key = numbers.tobytes()
        views = self._taken(self._sides, key)
        if views is None:
            views = self._put(self._sides, key, side_by_side([view(number) for number in numbers.tolist()]), _SIDES)
        return views

    def _taken(self, shelf: dict[K, V], key: K) -> V | None:
        with self._lock:
            found = shelf.pop(key, None)
            if found is not None:
                shelf[key] = found  # the newest
            return found

    def _put(self, shelf: dict[K, V], key: K, value: V, most: int) -> V:
        with self._lock:
            shelf[key] = value
            while len(shelf) > most:
                del shelf[next(iter(shelf))]
        return value


def side_by_side(views: Sequence[View]) -> OpenViews:
    """Views in arrays that kernels take. ValueError if one of them has no bins: it was given up."""
    bins = [view.table.bins for view in views]
    if 0 in bins:
        raise ValueError("a view that was given up cannot be looked at")
    shape = (len(views), max(bins, default=0))
    x, y, nx, ny = (np.zeros(shape, dtype=np.float32) for _ in range(4))
    quality = np.full(shape, EMPTY, dtype=np.float32)
    for row, (width, view) in enumerate(zip(bins, views)):
        x[row, :width], y[row, :width], quality[row, :width] = view.x, view.y, view.quality
        nx[row, :width], ny[row, :width] = view.nx, view.ny
    frames = np.array([view.table.frame() for view in views]).reshape(-1, 4)
    return OpenViews(x, y, nx, ny, quality, frames)


class ViewStore:
    """Views that are kept, in the order they came; packed, but for some that were used lately.

    Views may be given up; the numbers of the others stay.
    """

    def __init__(self, *, open_most: int = OPEN_MOST) -> None:
        """open_most: so many are kept open."""
        self._packed: list[PackedView | None] = []
        self._there: Bools = np.zeros(64, dtype=np.bool_)
        self._given_up: set[int] = set()  # and still here
        self._shelf = _Shelf(open_most)

    def __len__(self) -> int:
        return len(self._packed)

    @property
    def memory_bytes(self) -> int:
        """What the packed views hold."""
        return sum(each.memory_bytes for each in self._packed if each is not None)

    def add(self, view: View) -> int:
        """Keep a view, made by `view_of`; returns its number. One without bins is given up from the start."""
        if not view.table.bins:
            return self.add_packed(None)
        self._shelf.put(len(self), view)
        return self.add_packed(PackedView(view.table, view.x, view.y, view.grazed))

    def add_packed(self, packed: PackedView | None) -> int:
        """Keep a view that is packed already; None: it was given up."""
        number = len(self)
        if number == len(self._there):
            self._there = np.concatenate((self._there, np.zeros_like(self._there)))
        self._there[number] = packed is not None
        self._packed.append(packed)
        return number

    def give_up(self, numbers: Iterable[int]) -> None:
        """Forget views; they may stay for a while, till they are worth a new list."""
        self._given_up.update(number for number in numbers if self._there[number])
        here = int(self._there[: len(self)].sum())
        if len(self._given_up) >= max(LEAST_GIVEN_UP, (here - len(self._given_up)) // 4):
            self._packed, self._there = self._packed.copy(), self._there.copy()  # others have the ones before
            for number in self._given_up:
                self._packed[number], self._there[number] = None, False
            self._given_up.clear()

    def kept(self) -> KeptViews:
        """What is kept so far; later views appear in later calls only."""
        count = len(self)
        return KeptViews(self._packed, self._there[:count], count, self._shelf)


def alone(view: View) -> KeptViews:
    """A store's view 0."""
    store = ViewStore()
    store.add(view)
    return store.kept()
