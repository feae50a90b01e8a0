"""Walls that are no more: a door that was opened, furniture that was moved (S10, forgetting).

A line is looked at every 10 cm. Where a beam goes straight through and ends behind it, that is noted; where one ends at
it, the note is torn up. Straight, because glass answers only a beam that meets it head on, and lets the others through:
a place is given up after four looks through it, none farther than 15 degrees from the perpendicular and one of them
within 3, with no echo from it in between. Beams that come back from nowhere say nothing: a black wall does that too.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels import line_gone as kernels
from mapping.lines.line_map import LineMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STATION_M: Final = 0.1
REACH_M: Final = 8.0  # farther away a pose's error in heading shifts a wall by more than the margin
MARGIN_M: Final = 0.2
LOOKS: Final = 4
STRAIGHT_RAD: Final = math.radians(15.0)
HEAD_ON_RAD: Final = math.radians(3.0)
STEEPEST_HIT_RAD: Final = math.radians(75.0)
LEAST_GAP_M: Final = 0.3  # three stations in a row; less is a pose that was off, or a crack
LEAST_PIECE_M: Final = 0.2
_ACROSS_M: Final = 0.3
_NOTES_MAX: Final = 50_000
_PLACES_MAX: Final = 8192  # of one look


class Doubts:
    """Notes about the lines of one map."""

    def __init__(self) -> None:
        self._notes: dict[int, tuple[int, bool]] = {}  # by place: looks through it, and whether one was head on
        self._hit, self._through, self._line = (np.empty(_PLACES_MAX, dtype=np.int64) for _ in range(3))
        self._tilt: F64 = np.empty(_PLACES_MAX)

    def __len__(self) -> int:
        return len(self._notes)

    def look(self, line_map: LineMap, bearing_rad: F64, range_m: F64, map_from_sensor: Pose2) -> int:
        """Compare one sweep with the map's lines and cut out what is gone; returns how many lines that changed.

        bearing_rad, range_m: (N,) as seen from one pose, in any order; +inf, -inf and NaN say nothing.
        """
        numbers = line_map.around(map_from_sensor.x_m, map_from_sensor.y_m, REACH_M)
        if len(bearing_rad) < 3 or not len(numbers):
            return 0
        if np.any(np.diff(bearing_rad) <= 0.0):
            order = np.argsort(bearing_rad, kind="stable")
            bearing_rad, range_m = bearing_rad[order], range_m[order]
        readings = np.where(np.isfinite(range_m), range_m, np.nan)
        widest = 2.5 * float(np.median(np.diff(bearing_rad)))
        hits, passed = kernels.look(
            line_map.ends(numbers), bearing_rad, readings,
            map_from_sensor.x_m, map_from_sensor.y_m, map_from_sensor.yaw_rad,
            STATION_M, _ACROSS_M, REACH_M, MARGIN_M, STRAIGHT_RAD, STEEPEST_HIT_RAD, widest,
            self._hit, self._through, self._line, self._tilt,
        )  # fmt: skip
        if self._notes:
            for key in self._hit[:hits].tolist():
                self._notes.pop(key, None)
        due = self._note(passed)
        while len(self._notes) > _NOTES_MAX:
            del self._notes[next(iter(self._notes))]
        return sum(self._cut(line_map, int(numbers[k])) for k in due)

    def _note(self, passed: int) -> list[int]:
        """Write down what beams went through; which lines have places that may be gone."""
        due: dict[int, None] = {}
        for key, line, tilt in zip(
            self._through[:passed].tolist(), self._line[:passed].tolist(), self._tilt[:passed].tolist()
        ):
            looks, head_on = self._notes.get(key, (0, False))
            self._notes[key] = note = (looks + 1, head_on or tilt < HEAD_ON_RAD)
            if _is_gone(note):
                due[line] = None
        return list(due)

    def _cut(self, line_map: LineMap, number: int) -> bool:
        x0, y0, x1, y1 = line_map.ends(np.array([number]))[0].tolist()
        length = math.hypot(x1 - x0, y1 - y0)
        room = int(length / STATION_M) + 2
        key, share = np.empty(room, dtype=np.int64), np.empty(room)
        count = kernels.places_of(x0, y0, x1, y1, STATION_M, _ACROSS_M, key, share)
        keys, along = key[:count].tolist(), share[:count] * length
        gone = np.array([_is_gone(self._notes.get(each)) for each in keys], dtype=np.int8)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], gone, [0])))).reshape(-1, 2).tolist()
        gaps = [
            (along[first] - 0.5 * STATION_M, along[last - 1] + 0.5 * STATION_M)
            for first, last in edges
            if (last - first) * STATION_M > LEAST_GAP_M - 0.5 * STATION_M or last - first == count
        ]
        if not gaps:
            return False
        bounds = [0.0, *(float(v) for gap in gaps for v in gap), length]
        line_map.keep_pieces(number, [(a, b) for a, b in zip(bounds[::2], bounds[1::2]) if b - a >= LEAST_PIECE_M])
        for each, is_gone in zip(keys, gone.tolist()):
            if is_gone:
                self._notes.pop(each, None)
        return True


def _is_gone(note: tuple[int, bool] | None) -> bool:
    return note is not None and note[0] >= LOOKS and note[1]
