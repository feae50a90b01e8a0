"""The pace of a serial line: bytes leave at the line's rate, in order, ten bits each."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

SECOND_NS = 1_000_000_000
BITS_PER_BYTE = 10
BURST_NS = 1_000_000  # how often a message under way wants to be served


@dataclass(slots=True)
class _Message:
    ready_ns: int
    data: bytes
    rate_after_bps: int | None
    whole: bool
    sent: int = 0


class PacedWire:
    """A device's sending side. rate_bps may be changed at any time; what has left, has left."""

    def __init__(self, rate_bps: int, now_ns: int = 0) -> None:
        self.rate_bps = rate_bps
        self.clear(now_ns)

    def clear(self, now_ns: int) -> None:
        """Forget what has not left."""
        self._waiting: deque[_Message] = deque()
        self._free_ns = now_ns
        self._promised_ns = now_ns

    def send(self, data: bytes, now_ns: int, rate_after_bps: int | None = None, *, whole: bool = False) -> None:
        """Queue a message that is ready at now_ns.

        rate_after_bps: the line's rate once it has left.  whole: it takes its time on the line, but a USB chip behind
        it hands it on in one packet.
        """
        self._waiting.append(_Message(now_ns, data, rate_after_bps, whole))
        self._promised_ns = max(self._promised_ns, now_ns) + self._duration_ns(len(data))

    def leave_by(self, now_ns: int) -> bytes:
        """The bytes that have left since the last call."""
        out = bytearray()
        while self._waiting:
            first = self._waiting[0]
            start_ns = max(first.ready_ns, self._free_ns)
            room = max(0, now_ns - start_ns) * self.rate_bps // (BITS_PER_BYTE * SECOND_NS)
            left = len(first.data) - first.sent
            count = 0 if first.whole and room < left else min(left, room)
            out += first.data[first.sent : first.sent + count]
            first.sent += count
            if count:
                self._free_ns = start_ns + self._duration_ns(count)
            if first.sent < len(first.data):
                break
            self._waiting.popleft()
            if first.rate_after_bps is not None:
                self.rate_bps = first.rate_after_bps
        return bytes(out)

    def busy_at(self, now_ns: int) -> bool:
        """Whether what is queued is still leaving at now_ns."""
        return self._promised_ns > now_ns

    @property
    def free_ns(self) -> int:
        """When all that is queued will have left; in the past if the wire is idle."""
        return self._promised_ns

    @property
    def is_empty(self) -> bool:
        """Whether all has left."""
        return not self._waiting

    @property
    def next_ns(self) -> int | None:
        """When some or all of the first message will have left; None if none waits."""
        if not self._waiting:
            return None
        first = self._waiting[0]
        start_ns = max(first.ready_ns, self._free_ns)
        duration_ns = self._duration_ns(len(first.data) - first.sent)
        return start_ns + (duration_ns if first.whole else min(duration_ns, BURST_NS))

    def _duration_ns(self, count: int) -> int:
        """Time that so many bytes take, rounded up, so that `leave_by` at that instant has them all."""
        return -(-count * BITS_PER_BYTE * SECOND_NS // self.rate_bps)
