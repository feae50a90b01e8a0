"""What every driver is: one device's side of a wire as a pure state machine.

No port, clock, thread, log or sleep: time is handed in. The reader (reader.py) owns the wire and drives it:

    conversation.connected(now)                       the wire was (re)opened: forget everything, start from reset
    for item in conversation.requests(now): send it   at least every 20 ms, and after every receive
    for reading in conversation.receive(chunk, stamp): queue it
    for item in conversation.farewell(): send it      motors and lasers off

Four methods are optional. `next_request_ns()` tells when requests() has something to say next if nothing arrives
before: such a conversation, once it runs, is asked then and after what it received, and not every 20 ms. `is_amid()`
tells that a message has begun whose rest is on its way, and that nothing is to be asked before it is there.
`hears(item)` tells whether receive() would do anything with it. `prepared()` gives what requests() will say at the time
of next_request_ns() if nothing arrives before (None: ask then): it may be sent then, and requests() called soon after,
with that time and before anything that came since is handed on.

`Wire` is `bytes` on serial and TCP lines, `CanFrame` on CAN. Any split of the same bytes gives the same readings.
A conversation never raises on what comes over the wire: it counts the reason in `counters.drops` and goes on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from drivers.readings import ClockFit, Identity, LinkState, Reading, SourceCounters


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A classic CAN frame. can_id: 11 bits, or 29 when extended. A remote frame has no data; dlc then asks a length."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    dlc: int | None = None


@dataclass(frozen=True, slots=True)
class SetBaudRate:
    """Ask the reader to change the serial line's speed, in order with the bytes sent before and after it."""

    bits_per_s: int


WireT = TypeVar("WireT", bytes, CanFrame)

LEAST_SILENCE_NS = 30_000_000
"""Shorter pauses are those of USB chips (16 ms) and schedulers, not of devices."""
MOST_SILENCE_NS = 500_000_000


def silence_limit(period_ns: int) -> int:
    """When a device with this period counts as silent: after three periods, at least 30 ms, at most 500 ms."""
    return min(max(3 * period_ns, LEAST_SILENCE_NS), MOST_SILENCE_NS)


class Conversation(Protocol[WireT]):
    """One device on a wire. See the module's docstring for how it is driven."""

    @property
    def state(self) -> LinkState:
        """SILENT until the device answers, STARTING until readings flow, then RUNNING."""

    @property
    def trouble(self) -> str | None:
        """What is wrong now and how to repair it, in one line, or None."""

    @property
    def identity(self) -> Identity | None:
        """Who the device says it is, once it said so."""

    @property
    def clock_fit(self) -> ClockFit | None:
        """The device clock against the host's, or None for a device without a clock."""

    @property
    def counters(self) -> SourceCounters:
        """What was counted since construction (not reset by connected())."""

    @property
    def silence_limit_ns(self) -> int:
        """No reading for longer than this means that the device is silent: see silence_limit. The reader allows more
        where it measures longer periods, or that readings are held back."""

    def connected(self, now_ns: int) -> None:
        """The wire was opened or reopened: forget partial messages, begin with reset and resynchronisation."""

    def receive(self, chunk: WireT, stamp_ns: int) -> Iterator[Reading]:
        """Take what arrived at stamp_ns; yields finished readings. Must be exhausted by the caller."""

    def requests(self, now_ns: int) -> Sequence[WireT | SetBaudRate]:
        """What is to be sent now; also where time-outs are noticed and questions repeated."""

    def farewell(self) -> Sequence[WireT | SetBaudRate]:
        """What leaves the device safe: laser off, motor off, streaming stopped."""
