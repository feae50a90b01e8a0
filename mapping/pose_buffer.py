"""Stamped poses, asked for at times between them: known, not yet, or gone. Nothing is extrapolated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, wrap_angles

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class NotYetError(LookupError):
    """A time beyond the newest pose."""


class GoneError(LookupError):
    """A time before the oldest pose kept, or across a break in the track."""


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

    def at(self, stamp_ns: int) -> Pose2:
        """The pose at one time; NotYetError beyond the newest, GoneError before the oldest or across a break."""
        x, y, yaw = self.at_many(np.array([stamp_ns], dtype=np.int64))[0]
        return Pose2(float(x), float(y), float(yaw))

    def at_many(self, stamp_ns: ArrayLike) -> F64:
        """Poses (N, 3) x, y, yaw at (N,) times, along arcs of constant twist between the two poses around each.

        NotYetError if any lies beyond the newest pose, GoneError if any before the oldest or across a break.
        """
        asked = np.asarray(stamp_ns, dtype=np.int64)
        stamps = self._stamp_ns[self._begin : self._end]
        if not len(stamps) or (len(asked) and asked.max() > stamps[-1]):
            raise NotYetError("no pose that new is known yet")
        if len(asked) and asked.min() < stamps[0]:
            raise GoneError("no pose that old is kept")
        after = np.clip(np.searchsorted(stamps, asked, side="left"), 1, max(len(stamps) - 1, 1))
        if len(stamps) == 1:
            return np.repeat(self._pose[self._begin : self._end], len(asked), axis=0)
        exact = stamps[after - 1] == asked
        stretch = self._stretch[self._begin : self._end]
        if np.any((stretch[after] != stretch[after - 1]) & ~exact & (stamps[after] != asked)):
            raise GoneError("the track is broken at that time")
        pose = self._pose[self._begin : self._end]
        span = (stamps[after] - stamps[after - 1]).astype(np.float64)
        share = (asked - stamps[after - 1]) / span
        first, last = (int(after.min()), int(after.max())) if len(after) else (1, 1)
        if last - first >= len(asked):
            return interpolate_many(pose[after - 1], pose[after], share)
        # A sweep crosses few arcs: what belongs to an arc is worked out once, not for every beam on it.
        arcs = _Arcs.between(pose[first - 1 : last], pose[first : last + 1])
        return arcs.of(after - first).at(share)


def interpolate_many(start: F64, end: F64, share: F64) -> F64:
    """Poses (N, 3) at shares (N,) of the way along arcs from start (N, 3) to end (N, 3); as frames.interpolate."""
    return _Arcs.between(start, end).at(share)


@dataclass(frozen=True, slots=True)
class _Arcs:
    """Motions of constant twist: start (N, 3), cosine and sine of its yaw, velocity in its frame, turn; (N,) each."""

    start: F64
    cos: F64
    sin: F64
    vx: F64
    vy: F64
    turn: F64

    @staticmethod
    def between(start: F64, end: F64) -> _Arcs:
        turn = wrap_angles(end[:, 2] - start[:, 2])
        a, b = _arc_coefficients(turn)
        cos, sin = np.cos(start[:, 2]), np.sin(start[:, 2])
        dx, dy = end[:, 0] - start[:, 0], end[:, 1] - start[:, 1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx  # the motion in the start's frame
        norm = a * a + b * b
        return _Arcs(start, cos, sin, (a * x + b * y) / norm, (a * y - b * x) / norm, turn)

    def of(self, which: NDArray[np.int64]) -> _Arcs:
        """Those arcs, in that order."""
        return _Arcs(
            self.start[which], self.cos[which], self.sin[which], self.vx[which], self.vy[which], self.turn[which]
        )

    def at(self, share: F64) -> F64:
        """Poses (N, 3) at shares of the way."""
        a, b = _arc_coefficients(share * self.turn)
        x, y = share * (a * self.vx - b * self.vy), share * (b * self.vx + a * self.vy)
        poses = np.empty((len(share), 3))
        poses[:, 0] = self.start[:, 0] + self.cos * x - self.sin * y
        poses[:, 1] = self.start[:, 1] + self.sin * x + self.cos * y
        poses[:, 2] = wrap_angles(self.start[:, 2] + share * self.turn)
        return poses


def _arc_coefficients(w: F64) -> tuple[F64, F64]:
    small = np.abs(w) < 1e-6
    safe = np.where(small, 1.0, w)
    return np.where(small, 1.0 - w * w / 6.0, np.sin(safe) / safe), np.where(
        small, w / 2.0, (1.0 - np.cos(safe)) / safe
    )
