"""Names of rooms that stay: which room of a new decomposition is which room of those before (S44).

Each room that was ever found keeps an id and its territory, the cells it was known by. A new region gets the id whose
territory it shares the most with, of several that share about as much the oldest. What a region swallows (a wall was
taken down, or a door is too wide open) sleeps with its territory, and wakes with its old id when it is found again by
itself; an id is never given to another room.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.hybrid.rooms import RoomMap

Bools = NDArray[np.bool_]
I32 = NDArray[np.int32]

_SAME = 0.5  # of the smaller of territory and region: less in common is another room
_SWALLOWED = 0.3  # of another's territory: then what the region covers is not one room's alone
_RIVALS = 0.5  # of the largest share: who has that much may be the room, the oldest is
_HEAD = struct.Struct("<2siiII")
_SIDE_MAX = 1 << 15


@dataclass(slots=True)
class _Known:
    """A room's territory: cells of the map from (row0, col0) on."""

    row0: int
    col0: int
    cells: Bools
    area: int


class RoomBook:
    """Ids from 1 on, and names that people gave them.

    ids of the same updates in the same order are the same.
    """

    def __init__(self, *, settle: int = 1) -> None:
        """settle: in how many updates running a region must be found before it gets an id of its own."""
        self._settle = settle
        self._known: dict[int, _Known] = {}
        self._waiting: list[tuple[_Known, int]] = []
        self._next = 1
        self.names: dict[int, str] = {}
        self.changed: set[int] = set()
        """Ids whose territory changed since somebody emptied this."""

    def update(
        self, found: RoomMap, *, row0: int = 0, col0: int = 0, entered: int | None = None, settled: Container[int] = ()
    ) -> dict[int, int]:
        """Ids of the rooms of a new decomposition, by their number in it; of regions that wait, none.

        row0, col0: place of its first cell on the map.  entered: the room that the robot is in, which need not wait, as
        those that are settled.
        Each region gets one id at most, no id goes to two.
        """
        shared = {room_id: self._shared(known, found, row0, col0) for room_id, known in self._known.items()}
        sizes = np.bincount(found.labels.ravel(), minlength=len(found.rooms) + 1)
        claims: dict[int, dict[int, int]] = {room.number: {} for room in found.rooms}
        for room_id, counts in shared.items():
            for number in np.flatnonzero(counts).tolist():
                if number > 0 and counts[number] >= _SAME * min(self._known[room_id].area, int(sizes[number])):
                    claims[number][room_id] = int(counts[number])
        ids: dict[int, int] = {}
        for number in sorted(claims, key=lambda k: (-max(claims[k].values(), default=0), k)):
            open_claims = {k: count for k, count in claims[number].items() if k not in ids.values()}
            if open_claims:
                enough = _RIVALS * max(open_claims.values())
                ids[number] = min(k for k, count in open_claims.items() if count >= enough)
        waiting: list[tuple[_Known, int]] = []
        for room in found.rooms:
            if room.number in ids:
                room_id = ids[room.number]
                others = (k for k in shared if k != room_id)
                if any(shared[k][room.number] > _SWALLOWED * self._known[k].area for k in others):
                    continue  # more than this room is in it: what was known of it stands
            else:
                seen = 1 + self._waited(found, room.number, int(sizes[room.number]), row0, col0)
                if seen < self._settle and room.number != entered and room.number not in settled:
                    waiting.append((_territory_of(found, room.number, row0, col0), seen))
                    continue
                room_id = ids[room.number] = self._next
                self._next += 1
            self._learn(room_id, found, room.number, row0, col0)
        self._waiting = waiting
        return ids

    def _waited(self, found: RoomMap, number: int, size: int, row0: int, col0: int) -> int:
        """In how many updates before this one running the region was found."""
        shares = ((known, seen, int(self._shared(known, found, row0, col0)[number])) for known, seen in self._waiting)
        return max((seen for known, seen, share in shares if share >= _SAME * min(known.area, size)), default=0)

    def territory_mask(self, shape: tuple[int, int], row0: int, col0: int, *, only: int | None = None) -> Bools:
        """(R, C) cells of a window that belong to a room (default: to any that there ever was)."""
        mask = np.zeros(shape, dtype=np.bool_)
        for known in self._known.values() if only is None else (self._known[only],):
            top, left = known.row0 - row0, known.col0 - col0
            rows = slice(max(top, 0), max(min(top + known.cells.shape[0], shape[0]), 0))
            cols = slice(max(left, 0), max(min(left + known.cells.shape[1], shape[1]), 0))
            if rows.start < rows.stop and cols.start < cols.stop:
                mask[rows, cols] |= known.cells[
                    rows.start - top : rows.stop - top, cols.start - left : cols.stop - left
                ]
        return mask

    def territories_in(self, shape: tuple[int, int], row0: int, col0: int) -> I32:
        """(R, C) ids of a window, 0 for none; of two rooms that share cells the smaller."""
        ids = np.zeros(shape, dtype=np.int32)
        for room_id in sorted(self._known, key=lambda k: (-self._known[k].area, k)):
            ids[self.territory_mask(shape, row0, col0, only=room_id)] = room_id
        return ids

    def forget_all(self) -> None:
        """The map begins anew. Ids go on from where they were, so that none means two rooms."""
        self.changed |= set(self._known)
        self._known.clear()
        self._waiting.clear()
        self.names.clear()

    @property
    def known_ids(self) -> list[int]:
        """Every room there ever was, sleeping ones too."""
        return sorted(self._known)

    @property
    def next_id(self) -> int:
        """The id that the next new room gets."""
        return self._next

    def territory_bytes(self, room_id: int) -> bytes:
        """For the store; KeyError if there is no such room."""
        known = self._known[room_id]
        head = _HEAD.pack(b"R1", known.row0, known.col0, *known.cells.shape)
        return head + zlib.compress(np.packbits(known.cells).tobytes(), 1)

    def restore(self, territories: dict[int, bytes], names: dict[int, str], next_id: int) -> None:
        """Go on with what was stored. ValueError if it is damaged; then the book is as before."""
        known = {room_id: _territory(payload) for room_id, payload in territories.items()}
        if any(room_id < 1 for room_id in known) or next_id < 1 or not set(names) <= set(known):
            raise ValueError("ids of rooms do not fit together")
        self._known, self.names, self._waiting = known, dict(names), []
        self._next = max([next_id, *(room_id + 1 for room_id in known)])
        self.changed = set()

    def _shared(self, known: _Known, found: RoomMap, row0: int, col0: int) -> NDArray[np.int64]:
        """Cells that a territory has in common with each region."""
        top, left = known.row0 - row0, known.col0 - col0
        rows = slice(max(top, 0), max(min(top + known.cells.shape[0], found.labels.shape[0]), 0))
        cols = slice(max(left, 0), max(min(left + known.cells.shape[1], found.labels.shape[1]), 0))
        if rows.start >= rows.stop or cols.start >= cols.stop:
            return np.zeros(len(found.rooms) + 1, dtype=np.int64)
        own = known.cells[rows.start - top : rows.stop - top, cols.start - left : cols.stop - left]
        return np.bincount(found.labels[rows, cols][own], minlength=len(found.rooms) + 1)

    def _learn(self, room_id: int, found: RoomMap, number: int, row0: int, col0: int) -> None:
        new = _territory_of(found, number, row0, col0)
        old = self._known.get(room_id)
        if old is None or (old.row0, old.col0) != (new.row0, new.col0) or not np.array_equal(old.cells, new.cells):
            self._known[room_id] = new
            self.changed.add(room_id)


def _territory_of(found: RoomMap, number: int, row0: int, col0: int) -> _Known:
    mask = found.labels == number
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    cells = mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1].copy()
    return _Known(row0 + int(rows[0]), col0 + int(cols[0]), cells, int(cells.sum()))


def _territory(payload: bytes) -> _Known:
    try:
        magic, row0, col0, rows, cols = _HEAD.unpack_from(payload)
        if magic != b"R1" or not (0 < rows < _SIDE_MAX and 0 < cols < _SIDE_MAX):
            raise ValueError("not a room's territory")
        size = (rows * cols + 7) // 8
        bits = zlib.decompressobj().decompress(payload[_HEAD.size :], size + 1)
        if len(bits) != size:
            raise ValueError("a room's territory is cut short")
    except (struct.error, zlib.error) as error:
        raise ValueError(f"a room's territory is damaged: {error}") from error
    cells = np.unpackbits(np.frombuffer(bits, dtype=np.uint8), count=rows * cols).reshape(rows, cols).astype(np.bool_)
    return _Known(row0, col0, cells, int(cells.sum()))
