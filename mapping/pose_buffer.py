"""Stamped poses, asked for at times between them: known, not yet, or gone. Nothing is extrapolated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2
from mapping.kernels import motion as kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class NotYetError(LookupError):
    """A time beyond the newest pose."""


class GoneError(LookupError):
    """A time before the oldest pose kept, or across a break in the track."""


@dataclass(frozen=True, slots=True)
class _Known:
    """Poses that were asked for last: found (N, 3) at asked (N,), while the buffer began at its row `begin`."""

    begin: int
    asked: I64
    found: F64


class PoseBuffer:
    """The last `capacity` poses of one frame in another, stamps rising.

    A break (motion unknown, e.g. encoders reset) ends a stretch: no pose is interpolated across it.
    """

    def __init__(self, *, capacity: int = 4096) -> None:
        if capacity < 2:
            raise ValueError("a pose buffer keeps at least two poses")
        self._capacity = capacity
        self._stamp_ns: I64 = np.zeros(2 * capacity, dtype=np.int64)
        self._pose: F64 = np.zeros((2 * capacity, 3))
        self._stretch: I64 = np.zeros(2 * capacity, dtype=np.int64)
        self._begin = 0
        self._end = 0
        self._known: _Known | None = None
        self._stretch_since_ns = 0  # stamp of the first pose of the present stretch

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest pose of the present stretch; None when empty."""
        if not len(self):
            return None
        return max(self._stretch_since_ns, int(self._stamp_ns[self._begin]))

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose; None when empty."""
        return int(self._stamp_ns[self._end - 1]) if len(self) else None

    def add(self, stamp_ns: int, pose: Pose2, *, after_break: bool = False) -> None:
        """Append a pose. ValueError if the stamp does not rise: the caller counts and drops it."""
        newest = self.newest_ns
        if newest is not None and stamp_ns <= newest:
            raise ValueError(f"stamps must rise: {stamp_ns} after {newest}")
        if self._end == len(self._stamp_ns):
            self._move_to_front()
        stretch = int(self._stretch[self._end - 1]) + after_break if len(self) else 0
        if after_break or not len(self):
            self._stretch_since_ns = stamp_ns
        self._stamp_ns[self._end] = stamp_ns
        self._pose[self._end] = (pose.x_m, pose.y_m, pose.yaw_rad)
        self._stretch[self._end] = stretch
        self._end += 1
        self._begin = max(self._begin, self._end - self._capacity)

    def _move_to_front(self) -> None:
        kept = slice(self._begin, self._end)
        count = len(self)
        for array in (self._stamp_ns, self._pose, self._stretch):
            array[:count] = array[kept].copy()
        self._begin, self._end = 0, count
        self._known = None

    def at(self, stamp_ns: int) -> Pose2:
        """The pose at one time; NotYetError beyond the newest, GoneError before the oldest or across a break."""
        x, y, yaw = self.at_many(np.array([stamp_ns], dtype=np.int64))[0]
        return Pose2(float(x), float(y), float(yaw))

    def at_many(self, stamp_ns: ArrayLike) -> F64:
        """Poses (N, 3) x, y, yaw at (N,) times, along arcs of constant twist between the two poses around each.

        NotYetError if any lies beyond the newest pose, GoneError if any before the oldest or across a break.
        """
        asked = np.ascontiguousarray(stamp_ns, dtype=np.int64)
        count = self._end - self._begin
        if count < 2:
            return self._at_only_pose(asked)
        known = self._known
        if known is not None and self._begin == known.begin and np.array_equal(asked, known.asked):
            return known.found.copy()  # a sweep is asked for again and again, and poses once known never change
        kept = slice(self._begin, self._end)
        found = np.empty((len(asked), 3))
        outcome = kernels.poses_at(asked, self._stamp_ns[kept], self._pose[kept], self._stretch[kept], found)
        if outcome == kernels.NOT_YET:
            raise NotYetError("no pose that new is known yet")
        if outcome == kernels.GONE:
            raise GoneError("no pose that old is kept, or the track is broken at that time")
        if len(asked) > 1:
            self._known = _Known(self._begin, asked.copy(), found.copy())
        return found

    def _at_only_pose(self, asked: I64) -> F64:
        if not len(self) or np.any(asked > self._stamp_ns[self._begin]):
            raise NotYetError("no pose that new is known yet")
        if np.any(asked < self._stamp_ns[self._begin]):
            raise GoneError("no pose that old is kept")
        return np.repeat(self._pose[self._begin : self._end], len(asked), axis=0)
