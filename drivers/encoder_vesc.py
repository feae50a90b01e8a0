"""Two VESC motor controllers on CAN, one at each wheel: their status frames, which they send by themselves.

    29-bit id = packet << 8 | controller, big-endian

    packet 9     ERPM i32, current i16 in 0.1 A, duty i16 in 0.001
    packet 27    tachometer i32, input voltage i16 in 0.1 V, reserved i16

The tachometer counts 6 for each electrical turn: ticks_per_turn of a wheel = 6 * pole pairs * gear. It starts at 0 when
the controller is switched on. The two controllers send when they like: their counts are brought to common times.

Nothing is sent. Source: vedderb/bldc, CAN status messages (comm_can.c).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from drivers.conversation import CanFrame, SetBaudRate, silence_limit
from drivers.readings import ClockFit, Identity, LinkState, Reading, SourceCounters
from drivers.wheel_counts import Meeting, WheelCounts

STATUS_1, STATUS_5 = 9, 27
TICKS_PER_ELECTRICAL_TURN = 6
_MS = 1_000_000
_OVERDUE_NS = 1_000 * _MS
_NEVER_HEARD = -(1 << 62)
_SIDES = ("left", "right")


def can_id_of(packet: int, controller: int) -> int:
    """The 29-bit id under which a controller sends a packet."""
    return packet << 8 | controller


def decode_tachometer(data: bytes) -> tuple[int, float]:
    """Count and input voltage of packet 27 (older firmware leaves out the reserved two bytes). ValueError if short."""
    if len(data) not in (6, 8):
        raise ValueError(f"{len(data)} bytes")
    count, decivolts = struct.unpack_from(">ih", data)
    return count, decivolts / 10.0


def decode_speed(data: bytes) -> tuple[int, float, float]:
    """ERPM, current (A) and duty cycle of packet 9. ValueError if it is not 8 bytes long."""
    if len(data) != 8:
        raise ValueError(f"{len(data)} bytes")
    erpm, current, duty = struct.unpack(">ihh", data)
    return erpm, current / 10.0, duty / 1000.0


@dataclass(slots=True)
class _Controller:
    heard_ns: int = _NEVER_HEARD  # any status
    counted_ns: int = _NEVER_HEARD  # its tachometer


class VescPairConversation:
    """The two controllers of a differential drive. Counts are in their own directions: signs are configuration.

    id_left, id_right: controller ids, 0 to 254.  rate_hz: at which they are set to send status 5.
    max_ticks_per_s: no tachometer counts faster.
    """

    def __init__(
        self, id_left: int, id_right: int, *, rate_hz: float = 50.0, max_ticks_per_s: float = 30_000.0
    ) -> None:
        if id_left == id_right or not all(0 <= each <= 254 for each in (id_left, id_right)):
            raise ValueError(f"controller ids {id_left}, {id_right}: two different ones, 0 to 254")
        if not 0.0 < rate_hz <= 1000.0:
            raise ValueError(f"rate_hz {rate_hz}: above 0, up to 1000")
        self._ids = (id_left, id_right)
        self._period_ns = round(1e9 / rate_hz)
        self._sides = {
            can_id_of(packet, controller): (side, packet)
            for side, controller in enumerate(self._ids)
            for packet in (STATUS_1, STATUS_5)
        }
        self._counters = SourceCounters()
        self._counts = WheelCounts(self._counters, max_ticks_per_s=max_ticks_per_s)
        self._meeting = Meeting(longest_gap_ns=max(3 * self._period_ns, 150 * _MS))
        self.supply_v: float | None = None
        self._restart(0)

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if self._running:
            return LinkState.RUNNING
        heard = all(each.heard_ns != _NEVER_HEARD for each in self._controllers)
        return LinkState.STARTING if heard else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        return "; ".join(self._troubles()) or None

    def _troubles(self) -> Iterator[str]:
        for side, controller, number in zip(_SIDES, self._controllers, self._ids):
            who = f"controller {number} ({side} wheel)"
            if self._now_ns - max(controller.heard_ns, self._connected_ns) > _OVERDUE_NS:
                yield f"{who} is not heard: check its power, the bus, its id, and that CAN status messages are on"
            elif self._now_ns - max(controller.counted_ns, self._connected_ns) > _OVERDUE_NS:
                yield f"{who} does not send its tachometer: switch on CAN status message 5 in VESC Tool"

    @property
    def identity(self) -> Identity | None:
        """Status frames tell no name; both are VESCs if both are heard."""
        return Identity(vendor="Vedder", model="VESC") if self.state is not LinkState.SILENT else None

    @property
    def clock_fit(self) -> ClockFit | None:
        """Status frames carry no time."""
        return None

    @property
    def counters(self) -> SourceCounters:
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        return silence_limit(self._period_ns)

    # ---- how it is driven

    def connected(self, now_ns: int) -> None:
        self._restart(now_ns)

    def _restart(self, now_ns: int) -> None:
        self._connected_ns = self._now_ns = now_ns
        self._controllers = (_Controller(), _Controller())
        self._running = False
        self._counts.restart()
        self._meeting.restart()

    def requests(self, now_ns: int) -> Sequence[CanFrame | SetBaudRate]:
        """Nothing is ever sent; only time is noted."""
        self._now_ns = now_ns
        return ()

    def receive(self, chunk: CanFrame, stamp_ns: int) -> Iterator[Reading]:
        known = self._sides.get(chunk.can_id)
        if known is None or not chunk.extended or chunk.remote:
            return
        self._counters.chunks += 1
        self._counters.bytes += len(chunk.data)
        side, packet = known
        controller = self._controllers[side]
        try:
            if packet == STATUS_1:
                decode_speed(chunk.data)  # a sign of life; the tachometer tells the way
                controller.heard_ns = stamp_ns
                return
            count, self.supply_v = decode_tachometer(chunk.data)
        except ValueError:
            self._counters.drop("wrong_length")
            return
        controller.heard_ns = controller.counted_ns = stamp_ns
        met = self._meeting.add(side, count, stamp_ns)
        reading = None if met is None else self._counts.advance(*met)
        if reading is not None:
            self._running = True
            self._counters.readings += 1
            yield reading

    def farewell(self) -> Sequence[CanFrame | SetBaudRate]:
        """We moved nothing."""
        return ()
