"""Rooms and doors of a grid, by its Voronoi diagram (S44; [Thr98]).

Free space is cut where clearance has a minimum along the diagram (critical points), along the line to the base points
on both sides (critical lines). That alone cuts far too often, at every cupboard: pieces are joined again, the least
convincing cut first, until what is left looks like doors. See docs/algorithms/rooms.md.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.clearance import DistanceField
from mapping.grids.geometry import check_resolution
from mapping.kernels import rooms as kernels

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


_CELL_M = (
    0.05  # cells that the rules were found with: distances between cells' middles are brought to what they are there
)
_END_M = 0.125  # around the end of a critical line: what stands there
_ENDS_APART_M = 0.1  # from a critical point: who else may say where its critical line ends
_SLACK_CELLS = 0.25
_CRACK_M, _CRACK_DEEP_M, _CRACK_THICK_M = 0.05, 0.25, 0.3  # wide, with so much wall on both sides, no thicker
_LEAF_M = (0.55, 1.2)  # wide are doors' leaves
_LEAF_FREE_M = 0.2  # from a leaf, on both sides, there is nothing
_AROUND_M = 0.15  # of two cells with as much clearance the one with more around it is wider
_BESIDE_M = (0.2, 1.0)  # from a cut: where the wall that it ends at must be free on both sides
_STUB_TURNS = np.radians([0.0, -8.0, -4.0, 4.0, 8.0])
_BEND_M = 0.2  # at a cut's other end: less free space than that beside it is a wall that goes straight on


@dataclass(frozen=True, slots=True)
class RoomRules:
    """When two pieces of free space are one room. One set for all maps.

    clutter_m: obstacles that stand alone and are no longer or wider are furniture and belong to the room around them.
    room_min_m2: smaller pieces join the neighbour they are most open to; alone they are no room.
    corner_m: how far beyond what a robot of the given width sweeps space belongs to the room: its corners.
    keep, slack_m: a narrowing to no less than keep of the clearance beyond it, less slack_m (and no less than a quarter
    of a cell, which is how much cells make up), is no cut at all.

    The other cuts are judged by a sum. It rises with the clearance in the passage, as a share of the mean clearance of
    the piece where that is less (narrow_weight) and more (wide_weight), and with the share of the smaller piece's
    outline that is open (open_weight). It falls with the clearance in metres (large_weight), and with the sharpness
    of the corners on both sides, of the blunter (jamb_weight, up to blunt_most) and the sharper one (edge_weight, up to
    sharp_most). And with the length of the wall that the cut ends at, free on both sides, beyond stub_m (stub_weight
    by the metre, up to stub_most_m). Above join it is no door. Where it is told what rooms there were before, the sum
    is greater by stay within one of them and less between two.
    """

    clutter_m: float = 1.0
    room_min_m2: float = 2.5
    corner_m: float = 0.3
    keep: float = 0.95
    slack_m: float = 0.0125
    narrow_weight: float = 0.38
    wide_weight: float = 0.75
    open_weight: float = 0.93
    large_weight: float = 0.96
    jamb_weight: float = 0.53
    blunt_most: float = 1.25
    edge_weight: float = 0.23
    sharp_most: float = 1.72
    stub_weight: float = 2.7
    stub_m: float = 0.3
    stub_most_m: float = 0.7
    join: float = 0.27
    stay: float = 0.2


@dataclass(frozen=True, slots=True)
class Door:
    """A passage between rooms a < b (numbers in RoomMap.rooms).

    centre: cell [row, col] of the critical point.  ends: (2, 2) cells of its base points.  width_m: between them.
    """

    a: int
    b: int
    centre: tuple[int, int]
    ends: tuple[tuple[int, int], tuple[int, int]]
    width_m: float


@dataclass(frozen=True, slots=True)
class Room:
    """number: from 1, as in the labels.  anchor: its cell [row, col] farthest from any obstacle, clearance_m that far.

    area_m2 counts furniture that stands alone in it.
    """

    number: int
    anchor: tuple[int, int]
    clearance_m: float
    area_m2: float


@dataclass(frozen=True, slots=True)
class RoomMap:
    """labels: (R, C) int32, number of the room or 0.  rooms: numbers 1 to N in order.  doors: by rooms and place."""

    resolution_m: float
    labels: I32
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]


def find_rooms(
    free: ArrayLike,
    resolution_m: float,
    rules: RoomRules | None = None,
    *,
    width_m: float = 0.0,
    inside: Bools | None = None,
    before: I32 | None = None,
) -> RoomMap:
    """Rooms and doors of a grid.

    free: (R, C), True where it was seen empty; all else, and what lies beyond the border, is an obstacle.
    width_m: of a robot: openings too narrow for it are no doors, and what lies behind them only is no room (in a grid
    that a robot draws, most often a beam that went past a corner or into the void).
    inside: (R, C), where it is or could come to once; None, or if none of it is wide enough: anywhere that it fits.
    before: (R, C), from 1 on the rooms that there were, 0 for none: what is about as good stays as it was.
    Time: some 100 ns a cell, twice that with a width. The same cells give the same rooms in the same order.
    Raises ValueError if free is not (R, C), has a side above 19,998, inside or before another shape, or a length is
    none.
    """
    rules, d = rules or RoomRules(), check_resolution(resolution_m)
    given = np.asarray(free, dtype=np.bool_)
    if given.ndim != 2 or given.size == 0:
        raise ValueError(f"free cells are (R, C), got {given.shape}")
    if not (math.isfinite(width_m) and width_m >= 0.0):
        raise ValueError(f"width_m is a length, got {width_m}")
    if inside is not None and inside.shape != given.shape:
        raise ValueError(f"inside has the shape of the free cells, {given.shape}, got {inside.shape}")
    if before is not None and before.shape != given.shape:
        raise ValueError(f"before has the shape of the free cells, {given.shape}, got {before.shape}")
    padded, side = np.pad(given, 1), round(rules.clutter_m / d)
    open_space = without_clutter(without_cracks(padded, d), side)
    beside = without_clutter(padded, side) & ~open_space  # cracks, and what stands alone but for them
    field = DistanceField(~open_space)
    if width_m > 0.0:
        open_space = _enterable(field, width_m / d, rules.corner_m / d, None if inside is None else np.pad(inside, 1))
        field = DistanceField(~open_space)
    basin = np.empty(open_space.shape, dtype=np.int32)
    order = kernels.widest_first(field.squared, round(_AROUND_M / d))
    slack = max(rules.slack_m / d, _SLACK_CELLS)
    count = kernels.flood(field.squared, order, rules.keep, slack, _less_in_cells(d), basin)
    pieces = _Pieces(field, basin, count, d)
    if before is not None:
        pieces.remember(basin, np.pad(before, 1))
    pieces.join_small(rules.room_min_m2 / (d * d))
    pieces.measure_stubs(basin, rules.stub_most_m)
    pieces.join_unconvincing(rules)
    labels = _number_rooms(basin, pieces, rules.room_min_m2 / (d * d))
    doors = tuple(door for door in find_doors(labels, field, d) if door.width_m - d >= width_m)
    _take_in(labels, beside)
    rooms = _describe(labels, field.squared, order, d)
    return RoomMap(d, np.ascontiguousarray(labels[1:-1, 1:-1]), rooms, doors)


def join_rooms(found: RoomMap, pairs: Iterable[tuple[int, int]]) -> tuple[RoomMap, list[int]]:
    """The same with rooms joined. pairs: numbers of rooms that are one.

    Also the new number of each old one (0 of 0); rooms are numbered in the order they had.
    """
    of = list(range(len(found.rooms) + 1))
    for a, b in pairs:
        into, other = sorted((of[a], of[b]))
        of = [into if number == other else number for number in of]
    numbers = {old: new for new, old in enumerate(sorted(set(of)))}
    of = [numbers[number] for number in of]
    rooms = []
    for number in range(1, len(numbers)):
        parts = [room for room in found.rooms if of[room.number] == number]
        widest = max(parts, key=lambda room: (room.clearance_m, -room.number))
        rooms.append(Room(number, widest.anchor, widest.clearance_m, sum(part.area_m2 for part in parts)))
    doors = [
        Door(min(of[door.a], of[door.b]), max(of[door.a], of[door.b]), door.centre, door.ends, door.width_m)
        for door in found.doors
        if of[door.a] != of[door.b]
    ]
    doors.sort(key=lambda door: (door.a, door.b))
    return RoomMap(found.resolution_m, np.array(of, dtype=np.int32)[found.labels], tuple(rooms), tuple(doors)), of


def without_cracks(free: Bools, cell_m: float) -> Bools:
    """free (R, C) less cracks through thin walls along rows or columns, what a robot or a painter left out.

    Else what is cut off by them stands alone, as clutter does. All of it where cells are larger than a crack is wide.
    """
    out = free.copy()
    wide, deep, thick = (int(length / cell_m + 1e-6) for length in (_CRACK_M, _CRACK_DEEP_M, _CRACK_THICK_M))
    kernels.close_cracks(free, wide, deep, thick, out)
    kernels.close_cracks(np.ascontiguousarray(free.T), wide, deep, thick, out.T)
    return out


def without_clutter(free: Bools, side_cells: int) -> Bools:
    """free (R, C) plus all obstacles, diagonally connected, that fit into a square of that many cells and do not touch
    the border."""
    label = np.empty(free.shape, dtype=np.int32)
    count = int(kernels.connected(~free, True, label))
    if count == 0:
        return free
    box = np.empty((count, 4), dtype=np.int32)
    kernels.boxes(label, box)
    inside = (box[:, :2] > 0).all(axis=1) & (box[:, 2:] < np.array(free.shape) - 1).all(axis=1)
    small = inside & (np.maximum(box[:, 2] - box[:, 0], box[:, 3] - box[:, 1]) < side_cells)
    return np.asarray(free | np.append(small, False)[label])


def _enterable(field: DistanceField, width: float, corner: float, inside: Bools | None) -> Bools:
    """Cells that a disc of that width sweeps on its ways from inside, and what is connected with them within corner.

    A passage of n cells between two obstacles has a clearance of (n + 1) / 2. All lengths in cells.
    """
    need = 0.5 * (width + 1.0)
    middle: Bools = field.squared >= need * need
    label = np.empty(field.shape, dtype=np.int32)
    count = int(kernels.connected(middle, True, label))
    if inside is not None and (reached := np.unique(label[inside & middle])).size:
        is_reached = np.zeros(count + 1, dtype=np.bool_)
        is_reached[reached] = True
        middle = is_reached[label]
    if not middle.any():
        return middle
    near: Bools = (DistanceField(middle).squared <= (need + corner) ** 2) & ~field.obstacle
    count = int(kernels.connected(near, False, label))
    holds_middle = np.zeros(count + 1, dtype=np.bool_)
    holds_middle[label[middle]] = True
    holds_middle[-1] = False  # the label of what is not near
    return np.asarray(holds_middle[label])


def _less_in_cells(cell_m: float) -> float:
    """What distances between cells' middles, in cells, are too long by, beside those of cells of _CELL_M: from the
    middle of a cell to the next obstacle's is a cell, to its edge half of one."""
    return 0.5 - 0.5 * _CELL_M / cell_m


@dataclass(slots=True)
class _Cut:
    """Between two pieces: clearance of the widest passage in cells, cells side by side, sharpness of its corners,
    whether it ends at the leaf of an open door, and how long a wall it ends at."""

    clearance: float
    length: float
    blunt: float
    sharp: float
    at_leaf: bool
    stub_m: float = 0.0

    def join(self, other: _Cut) -> None:
        """Both lead to the same piece now; the wider says what the passage looks like."""
        self.length += other.length
        if other.clearance > self.clearance:
            self.clearance, self.blunt, self.sharp = other.clearance, other.blunt, other.sharp
            self.stub_m, self.at_leaf = other.stub_m, other.at_leaf


class _Pieces:
    """Pieces of free space and the cuts between them, joined one by one. Deterministic: ties go to smaller numbers."""

    def __init__(self, field: DistanceField, basin: I32, count: int, resolution_m: float) -> None:
        self.area, self.clearance, self.outline = (np.zeros(count) for _ in range(3))
        kernels.measure_basins(basin, field.squared, self.area, self.clearance, self.outline)
        less = _less_in_cells(resolution_m)
        self.clearance -= less * self.area
        self.into = list(range(count))
        self.cuts: list[dict[int, _Cut]] = [{} for _ in range(count)]
        self.before: list[dict[int, float]] = [{} for _ in range(count)]
        self._cell_m = resolution_m
        self._contacts = _contacts(basin, field.squared)
        points, lengths, widest, first = _widest_contacts(self._contacts, count)
        ruled = np.zeros(basin.shape, dtype=np.int32)
        kernels.count_ruled(field.site, field.squared, ruled)
        sharpness = np.empty((len(points), 3))
        apart, around = max(round(_ENDS_APART_M / resolution_m), 1), _END_M / resolution_m
        at = np.ascontiguousarray(widest[:, kernels.ROW :])  # of one row or many the same kind to the compiler
        least, most, beside = (length / resolution_m for length in (*_LEAF_M, _LEAF_FREE_M))
        layers = (field.site, field.squared)
        lines = kernels.door_lines(*layers, at, first, apart, 0.8 * least, most)
        kernels.jambs(*layers, ruled, at, first, apart, around, less, lines, least, most, beside, sharpness)
        for (a, b, squared, _, _), length, (blunt, sharp, tips) in zip(points.tolist(), lengths, sharpness.tolist()):
            cut = _Cut(math.sqrt(squared) - less, float(length), blunt, sharp, tips > 0.5)
            self.cuts[a][b] = cut
            self.cuts[b][a] = cut

    def piece_of(self, k: int) -> int:
        """The piece that took k in."""
        while self.into[k] != k:
            k = self.into[k]
        return k

    def remember(self, basin: I32, before: I32) -> None:
        """Note how many cells of each piece were in which room before; none of a cell where that is 0."""
        known = (basin >= 0) & (before > 0)
        codes, cells = np.unique(basin[known].astype(np.int64) << 32 | before[known], return_counts=True)
        for code, n in zip(codes.tolist(), cells.tolist()):
            self.before[code >> 32][code & 0xFFFFFFFF] = float(n)

    def _room_before(self, k: int) -> int:
        """The room that most of a piece was in; 0 if none."""
        room, cells = max(self.before[k].items(), key=lambda item: (item[1], -item[0]), default=(0, 0.0))
        return room if cells > 0.5 * self.area[k] else 0

    def join_small(self, cells: float) -> None:
        """Give each piece with fewer cells to the neighbour it is most open to, the smallest first."""
        waiting = [(self.area[k], k) for k in range(len(self.into)) if self.area[k] < cells]
        heapq.heapify(waiting)
        while waiting:
            area, k = heapq.heappop(waiting)
            if self.into[k] != k or area != self.area[k] or not self.cuts[k]:
                continue
            widest = max(self.cuts[k].items(), key=lambda item: (item[1].clearance, item[1].length, -item[0]))[0]
            kept = self._join(k, widest)
            if self.area[kept] < cells:
                heapq.heappush(waiting, (self.area[kept], kept))

    def measure_stubs(self, basin: I32, most_m: float) -> None:
        """Of all cuts there are now; basin as it was given."""
        owner = np.array([self.piece_of(k) for k in range(len(self.into))], dtype=np.int32)
        sides = np.sort(owner[self._contacts[:, : kernels.UPPER + 1]], axis=1)
        apart = sides[:, 0] != sides[:, 1]
        sides, cells = sides[apart], self._contacts[apart][:, [kernels.ROW, kernels.COL, kernels.SQUARED]]
        order = np.lexsort((-cells[:, 2], sides[:, 1], sides[:, 0]))  # stable: reading order within
        pairs, first = np.unique(sides[order], axis=0, return_index=True)
        beside = np.arange(_BESIDE_M[0], _BESIDE_M[1] + 0.05, 0.1) / self._cell_m
        length = np.empty(len(pairs))
        most, bend = most_m / self._cell_m, _BEND_M / self._cell_m
        kernels.stubs(basin, owner, cells[order], np.append(first, len(order)), beside, _STUB_TURNS, most, bend, length)
        for (a, b), cells_long in zip(pairs.tolist(), length.tolist()):
            self.cuts[a][b].stub_m = 0.0 if self.cuts[a][b].at_leaf else cells_long * self._cell_m

    def join_unconvincing(self, rules: RoomRules) -> None:
        """Join pieces while the least convincing cut is no door."""
        version = [0] * len(self.into)
        waiting: list[tuple[float, int, int, int, int]] = []

        def consider(k: int, only_after: bool) -> None:
            for other in self.cuts[k]:
                if other > k or only_after:
                    a, b = min(k, other), max(k, other)
                    doubt = self._doubt(a, b, rules)
                    if doubt > rules.join:
                        heapq.heappush(waiting, (-doubt, a, b, version[a], version[b]))

        for k in range(len(self.into)):
            if self.into[k] == k:
                consider(k, only_after=False)
        while waiting:
            _, a, b, version_a, version_b = heapq.heappop(waiting)
            if self.into[a] != a or self.into[b] != b or version[a] != version_a or version[b] != version_b:
                continue
            kept = self._join(a, b)
            version[kept] += 1
            consider(kept, only_after=True)

    def _doubt(self, a: int, b: int, rules: RoomRules) -> float:
        """How little a cut looks like a door."""
        cut = self.cuts[a][b]
        means = self.clearance[a] / self.area[a], self.clearance[b] / self.area[b]
        smaller = a if self.area[a] < self.area[b] else b
        rooms = self._room_before(a), self._room_before(b)
        stay = 0.0 if 0 in rooms else rules.stay if rooms[0] == rooms[1] else -rules.stay
        return stay + float(
            rules.narrow_weight * min(cut.clearance / min(means), 2.0)
            + rules.wide_weight * min(cut.clearance / max(means), 2.0)
            + rules.open_weight * cut.length / self.outline[smaller]
            - rules.large_weight * cut.clearance * self._cell_m
            - rules.jamb_weight * min(cut.blunt, rules.blunt_most)
            - rules.edge_weight * min(cut.sharp, rules.sharp_most)
            - rules.stub_weight * max(min(cut.stub_m, rules.stub_most_m) - rules.stub_m, 0.0)
        )

    def _join(self, a: int, b: int) -> int:
        """Make two pieces one; the larger keeps its number, which is returned."""
        if (self.area[a], -a) < (self.area[b], -b):
            a, b = b, a
        self.into[b] = a
        self.area[a] += self.area[b]
        self.clearance[a] += self.clearance[b]
        self.outline[a] += self.outline[b] - 2.0 * self.cuts[a].pop(b).length
        for room, cells in self.before[b].items():
            self.before[a][room] = self.before[a].get(room, 0.0) + cells
        for other, cut in self.cuts[b].items():
            if other == a:
                continue
            del self.cuts[other][b]
            if other in self.cuts[a]:
                self.cuts[a][other].join(cut)
            else:
                self.cuts[a][other] = cut
                self.cuts[other][a] = cut
        self.cuts[b] = {}
        return a


def _contacts(basin: I32, squared: I32) -> I32:
    """(N, 5) pairs of cells side by side in different basins."""
    found = np.empty((4096, 5), dtype=np.int32)
    while (n := int(kernels.contacts(basin, squared, found))) > len(found):
        found = np.empty((n, 5), dtype=np.int32)
    return found[:n]


def _widest_contacts(found: I32, count: int) -> tuple[I32, NDArray[np.int64], I32, NDArray[np.int64]]:
    """Of each pair of basins (M, 5) the contact of greatest clearance, first in reading order; (M,) how many it has;
    and all contacts of that clearance (K, 5), those of pair i from first[i] to first[i + 1]."""
    pair = found[:, kernels.LOWER].astype(np.int64) * count + found[:, kernels.UPPER]
    order = np.lexsort((-found[:, kernels.SQUARED], pair))  # stable: reading order within
    _, begins, which, lengths = np.unique(pair[order], return_index=True, return_inverse=True, return_counts=True)
    sorted_, most = found[order], found[order[begins], kernels.SQUARED]
    equal = sorted_[:, kernels.SQUARED] == most[which]
    first = np.searchsorted(which[equal], np.arange(len(begins) + 1))
    return sorted_[begins], lengths, sorted_[equal], first


def _number_rooms(basin: I32, pieces: _Pieces, room_min_cells: float) -> I32:
    """Labels from basins, in place: rooms from 1 by their first cell in reading order, 0 elsewhere."""
    name = np.zeros(len(pieces.into) + 1, dtype=np.int32)
    owners = [pieces.piece_of(k) for k in range(len(pieces.into))]
    numbers: dict[int, int] = {}
    values, first = np.unique(basin, return_index=True)
    for k in values[np.argsort(first)].tolist():
        if k >= 0 and pieces.area[owners[k]] >= room_min_cells:
            name[k] = numbers.setdefault(owners[k], len(numbers) + 1)
    kernels.rename(basin, name)
    return basin


def _take_in(labels: I32, more: Bools) -> None:
    """Give what hangs together of more to the room it touches most, in place; what touches none, to none. Nothing of it
    is at the border."""
    cells = np.argwhere(more)
    if not len(cells):
        return
    part = np.empty(labels.shape, dtype=np.int32)
    kernels.connected(more, False, part)
    own = part[cells[:, 0], cells[:, 1]]
    touched = np.zeros((own.max() + 1, int(labels.max()) + 1), dtype=np.int64)
    for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        np.add.at(touched, (own, labels[cells[:, 0] + down, cells[:, 1] + right]), 1)
    touched[:, 0] = 0
    labels[cells[:, 0], cells[:, 1]] = touched.argmax(axis=1)[own]


def _describe(labels: I32, squared: I32, order: I32, d: float) -> tuple[Room, ...]:
    """Rooms of padded labels; cells are of the grid without padding."""
    area = np.bincount(labels.ravel())
    by_width = labels.ravel()[order]
    _, first = np.unique(by_width, return_index=True)
    widest = {int(by_width[i]): int(order[i]) for i in first}
    rooms = []
    for number in range(1, len(area)):
        row, col = divmod(widest[number], labels.shape[1])
        clearance_m = math.sqrt(squared[row, col]) * d
        rooms.append(Room(number, (row - 1, col - 1), clearance_m, float(area[number]) * d * d))
    return tuple(rooms)


def find_doors(labels: I32, field: DistanceField, resolution_m: float) -> tuple[Door, ...]:
    """Where rooms meet: one door for each run of cells side by side. labels: padded by a cell of 0 on each side."""
    found = _contacts(np.where(labels > 0, labels, -1).astype(np.int32), field.squared)
    if not len(found):
        return ()
    mask = np.zeros(labels.shape, dtype=np.bool_)
    mask[found[:, kernels.ROW], found[:, kernels.COL]] = True
    run = np.empty(labels.shape, dtype=np.int32)
    kernels.connected(mask, True, run)
    at = run[found[:, kernels.ROW], found[:, kernels.COL]]
    order = np.lexsort((-found[:, kernels.SQUARED], at, found[:, kernels.UPPER], found[:, kernels.LOWER]))
    keys = np.stack((found[:, kernels.LOWER], found[:, kernels.UPPER], at), axis=-1)[order]
    first = np.flatnonzero(np.append(True, (np.diff(keys, axis=0) != 0).any(axis=1)))
    doors, apart = [], max(round(_ENDS_APART_M / resolution_m), 1)
    for a, b, _, row, col in found[order[first]].tolist():
        r0, c0, r1, c1 = (int(v) - 1 for v in kernels.critical_line(field.site, field.squared, row, col, apart))
        width_m = math.hypot(r1 - r0, c1 - c0) * resolution_m
        doors.append(Door(a, b, (row - 1, col - 1), ((r0, c0), (r1, c1)), width_m))
    return tuple(doors)
