"""When a device sampled what it was asked for, from when it was asked and when its answer was read. Pure."""

from __future__ import annotations

from collections import deque

_KEPT = 15


class Trips:
    """How long the answers of one device take.

    An answer that came much later than most lay waiting: in a USB chip, or for this program, which was held up. The
    device answered as soon as usual all the same, so the time beyond the median of the last 15 is not believed.
    """

    def __init__(self) -> None:
        self._trips_ns: deque[int] = deque(maxlen=_KEPT)

    def sampled_ns(self, asked_ns: int, answered_ns: int) -> int:
        """answered_ns: when the answer was read, less its time on the wire. Returns a time from asked_ns on."""
        trip_ns = max(answered_ns - asked_ns, 0)
        self._trips_ns.append(trip_ns)
        usual_ns = sorted(self._trips_ns)[len(self._trips_ns) // 2]
        return asked_ns + min(trip_ns, usual_ns)
