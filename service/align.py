"""A value waits until the poses around it are known: covered, not yet, or gone.

Nothing is extrapolated. A sweep is put into a grid when odometry reaches from its first to its last beam; until then
it waits here, in order of stamps, for a bounded time and in bounded number. What everything waits for is named.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")


class Cover(Enum):
    """How known poses lie to a span of time."""

    COVERED = "covered"
    NOT_YET = "not yet"
    GONE = "gone"


def cover(first_ns: int, last_ns: int, *, oldest_ns: int | None, newest_ns: int | None) -> Cover:
    """Whether poses from oldest_ns to newest_ns (None: there are none) reach over the span, ends included."""
    if newest_ns is None or oldest_ns is None or last_ns > newest_ns:
        return Cover.NOT_YET
    return Cover.GONE if first_ns < oldest_ns else Cover.COVERED


@dataclass(frozen=True, slots=True, order=True)
class _Ticket:
    first_ns: int
    source: str
    number: int  # of arrival; keeps equal stamps in order
    last_ns: int = field(compare=False)
    since_ns: int = field(compare=False)


@dataclass(frozen=True, slots=True)
class Released(Generic[T]):
    """What may go on, in order of stamps, and what will never be covered."""

    ready: list[tuple[str, T]]
    dropped: list[tuple[str, str]]  # (source, reason)


class WaitingRoom(Generic[T]):
    """Values with a span of time, waiting for poses.

    limit_ns: longest wait.  capacity: most values at once; the oldest leave first when it is full.
    Drop reasons: `odometry_late` waited too long, `odometry_gone` poses that old are no longer known,
    `before_odometry` measured before there was any pose, `waiting_full` too many wait.
    """

    def __init__(self, *, limit_ns: int, capacity: int = 256) -> None:
        self._limit_ns = limit_ns
        self._capacity = capacity
        self._tickets: list[_Ticket] = []
        self._values: dict[int, T] = {}
        self._count = 0

    def __len__(self) -> int:
        return len(self._tickets)

    def longest_wait_ns(self, now_ns: int) -> int:
        """How long the value waits that waits longest; 0 if none does."""
        return max((now_ns - ticket.since_ns for ticket in self._tickets), default=0)

    def put(self, source: str, value: T, first_ns: int, last_ns: int, now_ns: int) -> list[tuple[str, str]]:
        """Let a value wait for poses from first_ns to last_ns; returns what had to leave for it."""
        self._count += 1
        bisect.insort(self._tickets, _Ticket(first_ns, source, self._count, last_ns, now_ns))
        self._values[self._count] = value
        dropped = []
        while len(self._tickets) > self._capacity:
            ticket = self._tickets.pop(0)
            del self._values[ticket.number]
            dropped.append((ticket.source, "waiting_full"))
        return dropped

    def release(
        self, *, oldest_ns: int | None, newest_ns: int | None, now_ns: int, begun_ns: int | None = None
    ) -> Released[T]:
        """Let go what poses cover by now, and what waited too long. begun_ns: the very first pose, if there was one."""
        ready: list[tuple[str, T]] = []
        dropped: list[tuple[str, str]] = []
        staying: list[_Ticket] = []
        for ticket in self._tickets:
            covered = cover(ticket.first_ns, ticket.last_ns, oldest_ns=oldest_ns, newest_ns=newest_ns)
            if covered is Cover.NOT_YET and now_ns - ticket.since_ns <= self._limit_ns:
                staying.append(ticket)
                continue
            value = self._values.pop(ticket.number)
            if covered is Cover.COVERED:
                ready.append((ticket.source, value))
            elif covered is Cover.NOT_YET:
                dropped.append((ticket.source, "odometry_late"))
            else:
                is_early = begun_ns is not None and ticket.first_ns < begun_ns
                dropped.append((ticket.source, "before_odometry" if is_early else "odometry_gone"))
        self._tickets = staying
        return Released(ready, dropped)
