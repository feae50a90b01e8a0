"""What the reader remembers of its sources: rates, usual periods, hold-ups, when to try again, what was said lately."""

from __future__ import annotations

import logging
from collections import deque

log = logging.getLogger("drivers.reader")

_FIRST_BACKOFF_NS = 100_000_000
LONGEST_BACKOFF_NS = 1_000_000_000
_INTERVALS_KEPT = 9  # three quarters of so many are no longer than a source's usual period
_HOLD_UPS_NS = 60_000_000  # longer than hubs, adapters and schedulers hold readings back: surely silence
_HOLD_UP_MARGIN = 1.5
_HOLD_UPS_KEPT_NS = 10_000_000_000  # and for as long again
_READINGS_TO_KNOW = 50
_LOG_PERIOD_NS = 60_000_000_000


class Backoff:
    """When to try next: at once, then after 0.1 s, doubling to 1 s, for ever."""

    def __init__(self) -> None:
        self.due_ns = 0
        self._wait_ns = _FIRST_BACKOFF_NS

    def next(self, now_ns: int) -> None:
        """An attempt was made (or the wire lost) now."""
        self.due_ns = now_ns + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, LONGEST_BACKOFF_NS)

    def reset(self) -> None:
        """It worked: the next loss is a new one."""
        self._wait_ns = _FIRST_BACKOFF_NS

    def note_life(self, now_ns: int) -> None:
        """Like reset, but only after it has worked for longer than the longest wait."""
        if now_ns > self.due_ns + LONGEST_BACKOFF_NS:
            self.reset()


class Rate:
    """Readings a second, over windows of about one second."""

    def __init__(self) -> None:
        self._window_ns: int | None = None
        self._count = 0
        self._hz = 0.0
        self._last_ns = 0

    def count(self, stamp_ns: int) -> None:
        self._last_ns = stamp_ns
        if self._window_ns is None:
            self._window_ns, self._count = stamp_ns, 0
            return
        self._count += 1
        elapsed_ns = stamp_ns - self._window_ns
        if elapsed_ns >= 1_000_000_000:
            self._hz = self._count * 1e9 / elapsed_ns
            self._window_ns, self._count = stamp_ns, 0

    def hz(self, now_ns: int) -> float:
        if self._window_ns is None or now_ns - self._last_ns > 2_000_000_000:
            return 0.0
        if self._hz == 0.0 and self._last_ns > self._window_ns:  # within the first second
            return self._count * 1e9 / (self._last_ns - self._window_ns)
        return self._hz


class UsualPeriod:
    """The third quartile of the newest intervals between readings; 0 until there are enough.

    One pause does not move it, and of readings that come in pairs it is the wait for the next pair.
    """

    def __init__(self) -> None:
        self.period_ns = 0
        self._last_ns: int | None = None
        self._intervals: deque[int] = deque(maxlen=_INTERVALS_KEPT)

    def count(self, stamp_ns: int) -> None:
        if self._last_ns is not None:
            self._intervals.append(stamp_ns - self._last_ns)
            if len(self._intervals) == _INTERVALS_KEPT:
                self.period_ns = sorted(self._intervals)[_INTERVALS_KEPT * 3 // 4]
        self._last_ns = stamp_ns


class HoldUps:
    """How long readings were lately held back on their way: by a hub, an adapter, a scheduler that had other work.

    limit_ns: below it a wait is nothing new; 60 ms until enough readings came. Longer waits were silence and teach
    nothing. Only sources with periods below 20 ms have limits so short. It is the largest wait of the last 10 to 20 s.
    """

    def __init__(self) -> None:
        self.limit_ns = _HOLD_UPS_NS
        self._began_ns = 0
        self._count = 0
        self._past_ns = 0
        self._most_ns = 0

    def count(self, stamp_ns: int, wait_ns: int) -> None:
        if wait_ns > _HOLD_UPS_NS:
            return
        self._count += 1
        self._most_ns = max(self._most_ns, wait_ns)
        if self._count < _READINGS_TO_KNOW:
            return
        if stamp_ns - self._began_ns > _HOLD_UPS_KEPT_NS:
            self._began_ns, self._past_ns, self._most_ns = stamp_ns, self._most_ns, wait_ns
        self.limit_ns = min(round(_HOLD_UP_MARGIN * max(self._past_ns, self._most_ns)), _HOLD_UPS_NS)


class RateLimitedLog:
    """One line per cause per minute; the next line of that cause tells how many were kept back."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, int]] = {}  # cause -> (when told, kept back since)

    def say(self, now_ns: int, cause: str, level: int, text: str) -> bool:
        kept_back = self._due(now_ns, cause)
        if kept_back is not None:
            log.log(level, "%s%s", text, f" (and {kept_back} times more since last told)" if kept_back else "")
        return kept_back is not None

    def forget(self, cause: str) -> None:
        """The next line of this cause is told at once."""
        self._last.pop(cause, None)

    def exception(self, now_ns: int, cause: str, text: str, *args: object) -> None:
        if self._due(now_ns, cause) is not None:
            log.exception(text, *args)

    def _due(self, now_ns: int, cause: str) -> int | None:
        told_ns, kept_back = self._last.get(cause, (None, 0))
        if told_ns is not None and now_ns - told_ns < _LOG_PERIOD_NS:
            self._last[cause] = (told_ns, kept_back + 1)
            return None
        self._last[cause] = (now_ns, 0)
        return kept_back
