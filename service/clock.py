"""The two clocks, handed out so that nobody else has to ask: monotonic for logic, wall time for labels."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Who is asked for the time, at the edges only."""

    def now_ns(self) -> int:
        """Monotonic nanoseconds: never steps, means nothing outside this machine's uptime."""

    def wall_from_monotonic_ns(self, stamp_ns: int) -> int:
        """The wall time (nanoseconds since 1970, UTC) of a monotonic stamp, by the wall clock as it stands now."""


class SystemClock:
    """The machine's clocks."""

    def __init__(self) -> None:
        self._offset_ns = wall_offset_ns()

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wall_from_monotonic_ns(self, stamp_ns: int) -> int:
        """Follows steps of the wall clock at once: a label tells when something was by today's reckoning.

        Two readings of the clocks differ by some hundred nanoseconds. One moment has one label all the same, on every
        key: else what happened at once seems to run backwards, and ROS 2's transforms end just before their scan.
        """
        offset_ns = wall_offset_ns()
        if abs(offset_ns - self._offset_ns) > _STEADY_NS:
            self._offset_ns = offset_ns
        return stamp_ns + self._offset_ns


_AT_ONCE_NS = 50_000
_STEADY_NS = 100_000
_TRIES = 5


def wall_offset_ns() -> int:
    """Wall clock less monotonic clock; the wall clock is read between two readings of the other one.

    Who is held up between them reads again, or the label would be wrong by half of that.
    """
    spans: list[tuple[int, int]] = []
    while not spans or (spans[-1][0] > _AT_ONCE_NS and len(spans) < _TRIES):
        before = time.monotonic_ns()
        wall = time.time_ns()
        after = time.monotonic_ns()
        spans.append((after - before, wall - (before + after) // 2))
    return min(spans)[1]


@dataclass(slots=True)
class CrankedClock:
    """A clock that moves when it is turned; for tests and for replay."""

    monotonic_ns: int = 0
    wall_offset_ns: int = 0

    def now_ns(self) -> int:
        return self.monotonic_ns

    def wall_from_monotonic_ns(self, stamp_ns: int) -> int:
        return stamp_ns + self.wall_offset_ns

    def turn(self, nanoseconds: int) -> int:
        """Let time pass; returns the new time. ValueError if it would run backwards."""
        if nanoseconds < 0:
            raise ValueError("monotonic time does not run backwards")
        self.monotonic_ns += nanoseconds
        return self.monotonic_ns
