"""What is kept to draw the map again, sorted by where it was seen from: of a place seen often, the oldest may go.

A place is a square of PLACE_M, looked at within one of SECTORS headings. So much is kept there as two passes leave
behind; then what is oldest goes, the newest never, and what sees farther than all others (a door stood open once)
stays before others. So what is kept is bounded by the ground that was driven, not by the way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

PLACE_M = 0.5
SECTORS = 8
MOST = 12  # two passes: a sweep every 0.1 m, and some for turns
NEWEST = 5  # of a place are not given up
BEARINGS = 72
FARTHER_M = 1.0  # than any other from the same place, which is 0.7 m wide
ALONE = 2  # bearings in which a sweep sees so much farther: that is no speckle

Cell = tuple[str, int, int, int]


@dataclass(frozen=True, slots=True)
class _Entry:
    """serial: its name.  profile: (BEARINGS,), see `profile_of`; None of what has none."""

    serial: int
    profile: F32 | None


@dataclass(frozen=True, slots=True)
class _Place:
    """What is kept of one cell, the oldest first."""

    cell: Cell
    entries: list[_Entry]


class KeptPlaces:
    """What is kept, by place: at most so much of each. Serials rise with time."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._places: dict[Cell, _Place] = {}
        self._place_of: dict[int, _Place] = {}

    def __len__(self) -> int:
        return len(self._place_of)

    def add(self, serial: int, name: str, pose: F64, profile: F32 | None) -> list[int]:
        """Something of that name (a sensor's) was kept, seen from pose (3,). Returns the serials that may be given up
        for it, which are forgotten here."""
        place = self._at(_cell(name, pose))
        entries = place.entries
        entries.append(_Entry(serial, profile))
        self._place_of[serial] = place
        gone = []
        while len(entries) > self._most:
            entry = entries.pop(_least_needed(entries))
            del self._place_of[entry.serial]
            gone.append(entry.serial)
        return gone

    def move(self, serials: Iterable[int], poses: F64) -> None:
        """What is kept is seen from elsewhere now: poses (K, 3) of serials (K)."""
        for serial, pose in zip(serials, poses):
            before = self._place_of.get(serial)
            if before is None:
                continue
            cell = _cell(before.cell[0], pose)
            if cell != before.cell:
                index = next(k for k, entry in enumerate(before.entries) if entry.serial == serial)
                after = self._place_of[serial] = self._at(cell)
                after.entries.append(before.entries.pop(index))
                after.entries.sort(key=lambda entry: entry.serial)
                if not before.entries:
                    del self._places[before.cell]

    def _at(self, cell: Cell) -> _Place:
        place = self._places.get(cell)
        if place is None:
            place = self._places[cell] = _Place(cell, [])
        return place


def profile_of(bearing_rad: F64, range_m: F64, yaw_rad: float) -> F32:
    """How far a sweep sees in each of BEARINGS directions of the map; 0 where it says nothing.

    bearing_rad, range_m: (N,) of the sensor; +inf is nothing seen, told as the farthest number there is.  yaw_rad: of
    the sensor in the map.
    """
    says = ~np.isnan(range_m) & (range_m > 0.0)
    turn = np.mod((bearing_rad[says] + yaw_rad) / (2.0 * math.pi), 1.0)
    out = np.zeros(BEARINGS, dtype=np.float32)
    far = np.minimum(range_m[says], float(np.finfo(np.float32).max)).astype(np.float32)
    np.maximum.at(out, np.minimum((turn * BEARINGS).astype(np.int64), BEARINGS - 1), far)
    return out


def _least_needed(entries: list[_Entry]) -> int:
    """Which of a place is given up: the oldest that sees nothing alone; if all do, the one that sees least alone."""
    old = range(len(entries) - NEWEST)
    if any(entry.profile is None for entry in entries):
        return 0
    profiles = np.stack([entry.profile for entry in entries if entry.profile is not None])
    order = np.sort(profiles, axis=0)
    farthest, next_to_it = order[-1], order[-2]
    alone = [int(np.sum((profiles[k] == farthest) & (farthest > next_to_it + FARTHER_M))) for k in old]
    return next((k for k in old if alone[k] < ALONE), int(np.argmin(alone)))


def _cell(name: str, pose: F64) -> Cell:
    heading = math.floor(float(pose[2]) / (2.0 * math.pi) * SECTORS + 0.5) % SECTORS
    return name, math.floor(float(pose[0]) / PLACE_M), math.floor(float(pose[1]) / PLACE_M), heading
