"""Rooms as they were told last, so that what stands about for a while parts none and a door half seen joins none (S44).

Cuts between rooms that were told in some turns are believed more, those within one less: see RoomRules.stay. And a
person who walks through a room is drawn as a wall where he went; between him and a cupboard the room is cut, until the
robot looks there again. So a room that was about as large for some turns is told as two only when it was found in two
in some turns while the robot was in it and could see; until then its parts are one room. A room that is only being
discovered is what is found of it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapping.hybrid.rooms import RoomMap, join_rooms

I32 = NDArray[np.int32]

_MOSTLY = 0.5  # of a region's cells: more of them in one room, and it is of that room
_SAME = 0.85  # of the cells that a room has or had: as many in common, and it is about as large


class RoomsBefore:
    """Which room each cell of the map was in. The same calls in the same order say the same."""

    def __init__(self, *, settle: int = 1) -> None:
        """settle: in how many turns a room must have been told to count; in how many running it must have been about
        the same lest it is told in parts at once; and in how many, apart from those in which the robot was elsewhere,
        it must then be found in parts before it is told so.
        """
        self._settle = settle
        self._row0 = self._col0 = 0
        self._ids: I32 = np.zeros((0, 0), dtype=np.int32)
        self._told: dict[int, int] = {}
        """By id: turns in which it was told."""
        self._same: dict[int, int] = {}
        """By id: turns running in which it was told about the same."""
        self._found_parted: dict[int, int] = {}

    def begin_with(self, ids: I32, row0: int, col0: int) -> None:
        """Take it that these rooms were told often enough. ids: (R, C) as `window` gives them."""
        self._ids, self._row0, self._col0 = ids, row0, col0
        self._told = dict.fromkeys(np.unique(ids[ids > 0]).tolist(), self._settle)
        self._same = dict(self._told)
        self._found_parted = {}

    def window(self, shape: tuple[int, int], row0: int, col0: int) -> I32:
        """(R, C) ids of rooms in a window of the map, 0 for none, and for those that were not told often enough."""
        ids = self._window(shape, row0, col0)
        counts = np.zeros(max(self._told, default=0) + 1, dtype=np.bool_)
        counts[[room_id for room_id, turns in self._told.items() if turns >= self._settle]] = True
        return np.where(counts[ids], ids, 0)

    def _window(self, shape: tuple[int, int], row0: int, col0: int) -> I32:
        out = np.zeros(shape, dtype=np.int32)
        top, left = self._row0 - row0, self._col0 - col0
        rows = slice(max(top, 0), max(min(top + self._ids.shape[0], shape[0]), 0))
        cols = slice(max(left, 0), max(min(left + self._ids.shape[1], shape[1]), 0))
        if rows.start < rows.stop and cols.start < cols.stop:
            out[rows, cols] = self._ids[rows.start - top : rows.stop - top, cols.start - left : cols.stop - left]
        return out

    def as_told(self, found: RoomMap, before: I32, here: tuple[int, int] | None) -> tuple[RoomMap, list[int]]:
        """The rooms to tell, and the numbers of those among them that are parts of a room and settled as such.

        before: what `window` gave for the same cells.  here: the cell [row, col] where the robot is, None if unknown.
        """
        entered = 0 if here is None else int(found.labels[here])
        parts: dict[int, list[int]] = {}
        for number, room_id in _rooms_of(found, before).items():
            parts.setdefault(room_id, []).append(number)
        joined: list[tuple[int, int]] = []
        settled: list[int] = []
        seen: dict[int, int] = {}
        for room_id, numbers in parts.items():
            within = [(door.a, door.b) for door in found.doors if door.a in numbers and door.b in numbers]
            if not within or self._same[room_id] < self._settle:
                continue
            seen[room_id] = self._found_parted.get(room_id, 0) + (entered in numbers)
            if seen[room_id] < self._settle:
                joined += within
            else:
                settled += numbers
        self._found_parted = seen
        if not joined:
            return found, settled
        told, number_of = join_rooms(found, joined)
        return told, [number_of[number] for number in settled]

    def keep(self, found: RoomMap, ids: Mapping[int, int], row0: int, col0: int) -> None:
        """What is told now; where nothing is, what was told last stands. ids: by number, of all that have one."""
        name = np.zeros(len(found.rooms) + 1, dtype=np.int32)
        for number, room_id in ids.items():
            name[number] = room_id
        told, last = name[found.labels], self._window(found.labels.shape, row0, col0)
        most = max(int(told.max()), int(last.max())) + 1
        now, was = (np.bincount(each.ravel(), minlength=most) for each in (told, last))
        both = np.bincount(told[told == last], minlength=most)
        for room_id in ids.values():
            is_same = both[room_id] >= _SAME * (now[room_id] + was[room_id] - both[room_id])
            self._told[room_id] = self._told.get(room_id, 0) + 1
            self._same[room_id] = self._same.get(room_id, 0) + 1 if is_same else 1
        self._ids, self._row0, self._col0 = np.where(told > 0, told, last), row0, col0


def _rooms_of(found: RoomMap, before: I32) -> dict[int, int]:
    """The room in which most cells of each region were, of those for which there is one."""
    count = len(found.rooms) + 1
    ids = np.unique(before[before > 0])
    if not len(ids):
        return {}
    of_id = np.zeros(int(ids[-1]) + 1, dtype=np.int64)
    of_id[ids] = np.arange(1, len(ids) + 1)
    codes = found.labels.astype(np.int64) * (len(ids) + 1) + of_id[before]
    shared = np.bincount(codes.ravel(), minlength=count * (len(ids) + 1)).reshape(count, -1)
    most = shared[:, 1:].argmax(axis=1)
    mostly = shared[np.arange(count), most + 1] > _MOSTLY * shared.sum(axis=1)
    return {number: int(ids[most[number]]) for number in range(1, count) if mostly[number]}
