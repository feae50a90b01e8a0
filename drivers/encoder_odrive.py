"""Two ODrive axes on CAN (CANSimple), one at each wheel, of firmware 0.5.x or 0.6.x.

    11-bit id = node << 5 | command, little-endian; a value is asked for by a remote frame of its id

    01   heartbeat, each 100 ms    axis error u32, state u8; 0.5.x: bit 0 of bytes 5, 6, 7 motor, encoder, controller
                                   error; 0.6.x: byte 5 result of the last procedure, byte 6 bit 0 trajectory done
    09   encoder estimates         position f32 in turns, speed f32 in turns/s; sent each 10 ms, or when asked
    0A   encoder count (0.5.x)     running count i32, count within one turn i32; when asked

The running count is exact and wraps; it is asked for first. Firmware 0.6.x does not know it: then the position is read,
a 32-bit float in which between 8192 and 16384 turns a step is 1/1024 turn. Both come out in encoder counts.

This driver only asks: it sets no state and no speed. Source: odriverobotics/ODrive, CAN protocol (0.5.6, 0.6.10).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from drivers.conversation import CanFrame, SetBaudRate, silence_limit
from drivers.errors import FrameError
from drivers.readings import ClockFit, Identity, LinkState, Reading, SourceCounters, WheelReading
from drivers.trips import Trips
from drivers.wheel_counts import Meeting, WheelCounts

_MS = 1_000_000
_SEARCH_PERIOD_NS = 100 * _MS
_OVERDUE_NS = 1_000 * _MS
_LOST_NS = 500 * _MS  # five heartbeats
_COUNT_PATIENCE_NS = 300 * _MS  # both live, but one does not answer 0Ah for so long: it does not know it
_SENT_BY_ITSELF_NS = 250 * _MS  # a position that comes unasked within this is not asked for
_COARSE_TURNS = 8192.0
_MOST_TURNS = float(1 << 23)  # beyond, a float has no fraction of a turn left
_NEVER_HEARD = -(1 << 62)
_SIDES = ("left", "right")

Firmware = Literal["auto", "0.5", "0.6"]


class Command(IntEnum):
    """The commands used here."""

    HEARTBEAT = 0x01
    ESTIMATES = 0x09
    COUNT = 0x0A


# ---- messages


def can_id_of(node: int, command: Command) -> int:
    """The 11-bit id of a command to or from a node."""
    return node << 5 | command


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """axis_error: bits, 0 is well.  state: 1 idle, 8 closed loop.  flags: bytes 5 to 7, by firmware."""

    axis_error: int
    state: int
    flags: bytes

    def parts_in_error(self) -> list[str]:
        """Firmware 0.5.x only: which parts of the axis report errors."""
        return [name for name, byte in zip(("motor", "encoder", "controller"), self.flags) if byte & 1]


def decode_heartbeat(data: bytes) -> Heartbeat:
    """FrameError `wrong_length`."""
    if len(data) != 8:
        raise FrameError("wrong_length", data.hex())
    error, state = struct.unpack_from("<IB", data)
    return Heartbeat(error, state, data[5:])


def decode_estimates(data: bytes) -> tuple[float, float]:
    """Position in turns and speed in turns/s. FrameError `wrong_length`, or `not_a_position` if it cannot be one."""
    if len(data) != 8:
        raise FrameError("wrong_length", data.hex())
    turns, turns_per_s = struct.unpack("<ff", data)
    if not math.isfinite(turns) or abs(turns) > _MOST_TURNS:
        raise FrameError("not_a_position", data.hex())
    return turns, turns_per_s


def decode_count(data: bytes) -> tuple[int, int]:
    """Running count and count within one turn. FrameError `wrong_length`."""
    if len(data) != 8:
        raise FrameError("wrong_length", data.hex())
    running, within = struct.unpack("<ii", data)
    return running, within


# ---- conversation


@dataclass(slots=True)
class _Axis:
    """One node, as heard."""

    node: int
    heard_ns: int = _NEVER_HEARD
    asked: bool = False  # for its position, and not answered yet
    asked_ns: int | None = None  # for its position or count; None if there was an answer since
    unasked_ns: int = _NEVER_HEARD  # when a position came by itself
    heartbeat: Heartbeat | None = None
    turns: float = 0.0


class ODrivePairConversation:
    """The two axes of a differential drive. Counts are in the axes' own directions: signs are configuration.

    node_left, node_right: 0 to 63.  rate_hz: of our questions.  counts_per_turn: of the encoders (their cpr setting);
    positions are told in these counts too.  firmware: auto asks for counts and takes positions if they are not known.
    """

    def __init__(
        self,
        node_left: int,
        node_right: int,
        *,
        rate_hz: float = 100.0,
        counts_per_turn: int = 8192,
        max_turns_per_s: float = 100.0,
        firmware: Firmware = "auto",
    ) -> None:
        if node_left == node_right or not all(0 <= node <= 63 for node in (node_left, node_right)):
            raise ValueError(f"nodes {node_left}, {node_right}: two different ones, 0 to 63")
        if not 0.0 < rate_hz <= 500.0:
            raise ValueError(f"rate_hz {rate_hz}: above 0, up to 500")
        if counts_per_turn < 1:
            raise ValueError(f"counts_per_turn {counts_per_turn}: at least 1")
        self._nodes = (node_left, node_right)
        self._period_ns = round(1e9 / rate_hz)
        self._counts_per_turn = counts_per_turn
        self._firmware: Firmware = firmware
        self._known = {
            can_id_of(node, command): (side, command) for side, node in enumerate(self._nodes) for command in Command
        }
        self._counters = SourceCounters()
        self._counts = WheelCounts(self._counters, max_ticks_per_s=counts_per_turn * max_turns_per_s)
        self._meeting = Meeting(longest_gap_ns=max(3 * self._period_ns, 150 * _MS))
        self._restart(0)

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if self._running:
            return LinkState.RUNNING
        return LinkState.STARTING if self._both_heard() else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        return "; ".join(text for side, axis in zip(_SIDES, self._axes) for text in self._troubles(side, axis)) or None

    def _troubles(self, side: str, axis: _Axis) -> Iterator[str]:
        who = f"node {axis.node} ({side} wheel)"
        limit_ns = _OVERDUE_NS if axis.heard_ns == _NEVER_HEARD else _LOST_NS
        if self._now_ns - max(axis.heard_ns, self._connected_ns) > limit_ns:
            yield f"{who} is not heard: check its power, the wiring and termination, node id and bit rate"
            return
        heartbeat = axis.heartbeat
        if heartbeat is not None and heartbeat.axis_error:
            yield f"{who} reports axis error {heartbeat.axis_error:08X}h: look it up with odrivetool (dump_errors)"
        if heartbeat is not None and self._by_count and (parts := heartbeat.parts_in_error()):
            yield f"{who} reports an error of its {', '.join(parts)}: look it up with odrivetool (dump_errors)"
        if not self._by_count and abs(axis.turns) >= _COARSE_TURNS:
            step = math.ulp(abs(axis.turns)) * 2.0**29  # of a 32-bit float
            yield (
                f"{who} is {axis.turns:.0f} turns from its zero, where positions have steps of 1/{1 / step:.0f} turn: "
                "set its position to 0 or restart it"
            )

    @property
    def identity(self) -> Identity | None:
        """The generation of the firmware, as its answers show; the frames used here tell no serial number."""
        if not self._running:
            return None
        return Identity(vendor="ODrive", model="CANSimple axes", firmware="0.5.x" if self._by_count else "0.6.x")

    @property
    def clock_fit(self) -> ClockFit | None:
        """Frames carry no time."""
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
        self._axes = tuple(_Axis(node) for node in self._nodes)
        self._running = False
        self._both_since_ns: int | None = None
        self._trips = Trips()
        self._due_ns = now_ns
        self._read(by_count=self._firmware != "0.6")

    def _read(self, *, by_count: bool) -> None:
        self._by_count = by_count
        self._listens_since_ns = self._now_ns
        self._meeting.restart()
        self._counts.restart()

    def requests(self, now_ns: int) -> Sequence[CanFrame | SetBaudRate]:
        self._now_ns = now_ns
        self._notice_ignorance(now_ns)
        if now_ns < self._due_ns:
            return ()
        period_ns = self._period_ns if self._both_heard() else max(self._period_ns, _SEARCH_PERIOD_NS)
        late = now_ns - self._due_ns > period_ns
        self._due_ns = (now_ns if late else self._due_ns) + period_ns
        if self._by_count:
            for axis in self._axes:
                axis.asked_ns = now_ns
            return [_ask(axis.node, Command.COUNT) for axis in self._axes]
        limit_ns = max(_SENT_BY_ITSELF_NS, 2 * self._period_ns)
        mute = [axis for axis in self._axes if now_ns - max(axis.unasked_ns, self._listens_since_ns) > limit_ns]
        for axis in mute:
            axis.asked, axis.asked_ns = True, now_ns
        return [_ask(axis.node, Command.ESTIMATES) for axis in mute]

    def next_request_ns(self) -> int:
        """When requests() has something to say next."""
        return self._due_ns

    def receive(self, chunk: CanFrame, stamp_ns: int) -> Iterator[Reading]:
        known = self._known.get(chunk.can_id)
        if known is None or chunk.extended or chunk.remote:
            return
        self._counters.chunks += 1
        self._counters.bytes += len(chunk.data)
        side, command = known
        try:
            reading = self._take(side, command, chunk.data, stamp_ns)
        except FrameError as error:
            self._counters.drop(error.reason)
            return
        if reading is not None:
            self._running = True
            self._counters.readings += 1
            yield reading

    def farewell(self) -> Sequence[CanFrame | SetBaudRate]:
        """We moved nothing."""
        return ()

    # ---- how it works

    def _both_heard(self) -> bool:
        return all(axis.heard_ns != _NEVER_HEARD for axis in self._axes)

    def _notice_ignorance(self, now_ns: int) -> None:
        """Both axes live, but one of them does not answer questions for its count: it has none."""
        if not self._by_count or self._firmware == "0.5" or self._running or not self._both_heard():
            self._both_since_ns = None
            return
        if self._both_since_ns is None:
            self._both_since_ns = now_ns
        if now_ns - self._both_since_ns > _COUNT_PATIENCE_NS:
            self._read(by_count=False)

    def _take(self, side: int, command: Command, data: bytes, stamp_ns: int) -> WheelReading | None:
        axis = self._axes[side]
        if command is Command.HEARTBEAT:
            axis.heartbeat = decode_heartbeat(data)
            axis.heard_ns = stamp_ns
            return None
        if command is Command.COUNT:
            count, _ = decode_count(data)
            axis.heard_ns = stamp_ns
            return self._meet(side, count, self._sampled_ns(axis, stamp_ns)) if self._by_count else None
        axis.turns, _ = decode_estimates(data)
        axis.heard_ns = stamp_ns
        if not axis.asked:
            axis.unasked_ns = stamp_ns
        axis.asked = False
        if self._by_count:
            return None
        return self._meet(side, round(axis.turns * self._counts_per_turn), self._sampled_ns(axis, stamp_ns))

    def _sampled_ns(self, axis: _Axis, stamp_ns: int) -> int:
        """Of what came at stamp_ns: then, or when answers to our questions usually come."""
        asked_ns, axis.asked_ns = axis.asked_ns, None
        return stamp_ns if asked_ns is None else self._trips.sampled_ns(asked_ns, stamp_ns)

    def _meet(self, side: int, count: int, stamp_ns: int) -> WheelReading | None:
        met = self._meeting.add(side, count, stamp_ns)
        return None if met is None else self._counts.advance(*met)


def _ask(node: int, command: Command) -> CanFrame:
    return CanFrame(can_id_of(node, command), remote=True, dlc=8)
