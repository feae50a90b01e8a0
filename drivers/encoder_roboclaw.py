"""RoboClaw motor controllers in packet serial mode: the counts of both motors' encoders.

    question        answer                                        meaning
    address 78      left i32, right i32, CRC                      both counts, sampled together
    address 16, 17  count u32, status u8, CRC                     count M1, M2 (older firmware without 78)
    address 21      text LF NUL, CRC                              version
    address 24      u16 in 0.1 V, CRC                             main battery

Big-endian. CRC-16 (1021h, initial 0) over address, command and data, high byte first; questions for values carry none.
An answer does not say what it answers, but its CRC covers the question: what was late or meant for another question
does not pass. An unknown command is met with silence; a pause of 10 ms makes the controller forget half a packet.

This driver only asks. It moves no motor and resets no count.

Source: Basicmicro "RoboClaw User Manual", packet serial commands 16, 17, 21, 24, 78.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from drivers.checksums import crc16_ccitt
from drivers.conversation import SetBaudRate, silence_limit
from drivers.errors import FrameError
from drivers.readings import ClockFit, Identity, LinkState, Reading, SourceCounters, WheelReading
from drivers.trips import Trips
from drivers.wheel_counts import Meeting, WheelCounts

_LONGEST_VERSION = 48
_CRC_SIZE = 2
_MS = 1_000_000
_PATIENCE_NS = 60 * _MS  # for an answer; the controller answers within 1 ms, a busy host later
_QUIET_NS = 12 * _MS  # after a missing answer: the controller then forgets what it has of a packet
_SEARCH_PERIOD_NS = 250 * _MS
_OVERDUE_NS = 500 * _MS
_LOST_AFTER = 8  # unanswered questions in a row
_BOTH_TRIES = 3  # so often 78 unanswered by a controller that tells its version: an older one
_VERSION_TRIES = 2
_BATTERY_PERIOD_NS = 5_000 * _MS


class Command(IntEnum):
    """What we ask."""

    COUNT_M1 = 16
    COUNT_M2 = 17
    VERSION = 21
    MAIN_BATTERY = 24
    BOTH_COUNTS = 78


_DATA_SIZE = {Command.COUNT_M1: 5, Command.COUNT_M2: 5, Command.MAIN_BATTERY: 2, Command.BOTH_COUNTS: 8}


# ---- messages


def encode_question(address: int, command: Command) -> bytes:
    """A question for a value: two bytes, without a CRC."""
    return bytes((address, command))


def decode_answer(address: int, command: Command, answer: bytes) -> bytes:
    """The data of an answer to a question. FrameError `bad_crc` or `wrong_length`."""
    size = _DATA_SIZE.get(command)
    if len(answer) < _CRC_SIZE or (size is not None and len(answer) != size + _CRC_SIZE):
        raise FrameError("wrong_length", answer.hex())
    data, code = answer[:-_CRC_SIZE], int.from_bytes(answer[-_CRC_SIZE:], "big")
    if crc16_ccitt(encode_question(address, command) + data) != code:
        raise FrameError("bad_crc", answer.hex())
    return data


def decode_both_counts(data: bytes) -> tuple[int, int]:
    """Counts of M1 and M2, signed."""
    left, right = struct.unpack(">ii", data)
    return left, right


def decode_count(data: bytes) -> int:
    """The count of one motor, signed. Its status byte tells wraps since the last question: differences tell it too."""
    (count,) = struct.unpack(">ix", data)
    return int(count)


def decode_version(data: bytes) -> str:
    """The text of the version answer. FrameError `bad_version` if it is none."""
    if not data.endswith(b"\n\0") or not all(0x20 <= byte < 0x7F for byte in data[:-2]):
        raise FrameError("bad_version", data.hex())
    return data[:-2].decode("ascii")


# ---- conversation


@dataclass(slots=True)
class _Question:
    command: Command
    asked_ns: int


class RoboClawConversation:
    """A RoboClaw with an encoder at each motor.

    address: 80h to 87h.  left_motor: the motor at the left wheel, 1 or 2.  rate_hz: of the readings.
    max_ticks_per_s: no wheel counts faster; tells damage and resets from motion.  baud_bps: for the time on the wire.
    """

    def __init__(
        self,
        address: int = 0x80,
        *,
        left_motor: Literal[1, 2] = 1,
        rate_hz: float = 50.0,
        max_ticks_per_s: float = 200_000.0,
        baud_bps: int = 38400,
    ) -> None:
        if not 0x80 <= address <= 0x87:
            raise ValueError(f"address {address:02X}h: RoboClaw addresses are 80h to 87h")
        if not 0.0 < rate_hz <= 200.0:
            raise ValueError(f"rate_hz {rate_hz}: above 0, up to 200")
        self._address = address
        self._left_motor = left_motor
        self._period_ns = round(1e9 / rate_hz)
        self._byte_ns = 10 * 1_000_000_000 // baud_bps
        self._counters = SourceCounters()
        self._counts = WheelCounts(self._counters, max_ticks_per_s=max_ticks_per_s)
        self._identity: Identity | None = None
        self.battery_v: float | None = None
        self._restart(0)

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if self._running:
            return LinkState.RUNNING
        return LinkState.STARTING if self._answered else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        if not self._answered and self._overdue:
            return (
                f"no answer from a RoboClaw at address {self._address:02X}h: check its power, the wires, that it is in "
                "packet serial mode, its address and its line speed"
            )
        if self._answered and not self._running and self._misses >= _BOTH_TRIES:
            return "the RoboClaw answers but tells no counts: set up its encoders with the maker's tool"
        return None

    @property
    def identity(self) -> Identity | None:
        return self._identity

    @property
    def clock_fit(self) -> ClockFit | None:
        """The controller tells no time."""
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
        self._buffer = bytearray()
        self._question: _Question | None = None
        self._answered = self._running = self._overdue = False
        self._misses = 0
        self._version_tries = 0
        self._version_told = False
        self._one_by_one = False
        self._next_motor = Command.COUNT_M1
        self._connected_ns = now_ns
        self._quiet_until_ns = now_ns + _QUIET_NS  # it may have half a packet of somebody before us
        self._counts_due_ns = now_ns
        self._battery_due_ns = now_ns + _BATTERY_PERIOD_NS // 2
        self._trips = Trips()
        self._meeting = Meeting(longest_gap_ns=max(150 * _MS, 3 * self._period_ns))
        self._counts.restart()

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        self._overdue = now_ns - self._connected_ns > _OVERDUE_NS
        self._notice_missing_answer(now_ns)
        if self._question is not None or now_ns < self._quiet_until_ns:
            return ()
        command = self._next_question(now_ns)
        if command is None:
            return ()
        self._buffer.clear()  # whatever came unasked is no answer to this
        self._question = _Question(command, now_ns)
        return (encode_question(self._address, command),)

    def next_request_ns(self) -> int:
        """When requests() has something to say next, if nothing arrives before."""
        if self._question is not None:
            return self._question.asked_ns + _PATIENCE_NS
        return max(self._quiet_until_ns, min(self._counts_due_ns, self._battery_due_ns))

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        self._counters.chunks += 1
        self._counters.bytes += len(chunk)
        self._buffer += chunk
        question = self._question
        if question is None:
            self._counters.drop("unasked_bytes", len(self._buffer))
            self._buffer.clear()
            self._quiet_until_ns = max(self._quiet_until_ns, stamp_ns + _QUIET_NS)
            return
        data = self._find_answer(question.command)
        if data is None:
            return
        self._question = None
        self._answered = True
        self._misses = 0
        reading = self._understand(question, data, stamp_ns)
        if reading is not None:
            self._running = True
            self._counters.readings += 1
            yield reading

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """We moved nothing."""
        return ()

    # ---- out

    def _next_question(self, now_ns: int) -> Command | None:
        if not self._version_told and (not self._answered or self._version_tries < _VERSION_TRIES):
            self._version_tries += 1
            # A controller that keeps its version to itself may still tell its counts.
            return Command.VERSION if self._version_tries % 2 else Command.BOTH_COUNTS
        if now_ns >= self._counts_due_ns:
            return self._ask_counts(now_ns)
        if now_ns >= self._battery_due_ns:
            self._battery_due_ns = now_ns + _BATTERY_PERIOD_NS
            return Command.MAIN_BATTERY
        return None

    def _ask_counts(self, now_ns: int) -> Command:
        period_ns = self._period_ns // 2 if self._one_by_one else self._period_ns
        late = now_ns - self._counts_due_ns > period_ns
        self._counts_due_ns = (now_ns if late else self._counts_due_ns) + period_ns  # the beat is kept, no backlog
        if not self._one_by_one:
            return Command.BOTH_COUNTS
        command = self._next_motor
        self._next_motor = Command.COUNT_M2 if command is Command.COUNT_M1 else Command.COUNT_M1
        return command

    def _notice_missing_answer(self, now_ns: int) -> None:
        question = self._question
        if question is None or now_ns - question.asked_ns < _PATIENCE_NS:
            return
        self._question = None
        self._counters.drop("bad_answer" if self._buffer else "unanswered")
        self._buffer.clear()
        self._quiet_until_ns = now_ns + _QUIET_NS
        self._misses += 1
        if question.command is Command.BOTH_COUNTS and self._answered and not self._running:
            self._one_by_one = self._misses % (2 * _BOTH_TRIES) >= _BOTH_TRIES
        if not self._answered:
            self._quiet_until_ns = max(self._quiet_until_ns, question.asked_ns + _SEARCH_PERIOD_NS // 2)
        if self._misses >= _LOST_AFTER and not self._running:
            self._answered = False
            self._misses = 0

    # ---- in

    def _find_answer(self, command: Command) -> bytes | None:
        """The data of the answer, wherever in what came since the question it begins; None if it is not whole yet."""
        if (surplus := len(self._buffer) - 4 * _LONGEST_VERSION) > 0:
            self._counters.drop("noise_bytes", surplus)
            del self._buffer[:surplus]
        for start in range(len(self._buffer)):
            for answer in self._candidates(command, start):
                try:
                    data = decode_answer(self._address, command, answer)
                except FrameError:
                    continue
                if start:
                    self._counters.drop("noise_bytes", start)
                self._buffer.clear()
                return data
        return None

    def _candidates(self, command: Command, start: int) -> list[bytes]:
        """What could be the answer if it begins here."""
        rest = self._buffer[start:]
        if command is not Command.VERSION:
            size = _DATA_SIZE[command] + _CRC_SIZE
            return [bytes(rest[:size])] if len(rest) >= size else []
        end = rest.find(b"\n\0", 1, _LONGEST_VERSION)
        size = end + 2 + _CRC_SIZE
        return [bytes(rest[:size])] if end > 0 and len(rest) >= size else []

    def _understand(self, question: _Question, data: bytes, stamp_ns: int) -> WheelReading | None:
        # Sampled when the controller answered: its answer's time on the wire is taken off.
        sampled_ns = self._trips.sampled_ns(question.asked_ns, stamp_ns - (len(data) + _CRC_SIZE) * self._byte_ns)
        match question.command:
            case Command.VERSION:
                self._take_version(data)
            case Command.MAIN_BATTERY:
                self.battery_v = int.from_bytes(data, "big") / 10.0
            case Command.BOTH_COUNTS:
                first, second = decode_both_counts(data)
                return self._reading(first, second, sampled_ns)
            case Command.COUNT_M1 | Command.COUNT_M2:
                side = 0 if question.command is Command.COUNT_M1 else 1
                met = self._meeting.add(side, decode_count(data), sampled_ns)
                return None if met is None else self._reading(*met)
        return None

    def _take_version(self, data: bytes) -> None:
        try:
            text = decode_version(data)
        except FrameError as error:
            self._counters.drop(error.reason)
            return
        self._version_told = True
        words = text.split()
        firmware = next((word for word in words if word[:1] == "v" and word[1:2].isdigit()), "")
        model = " ".join(word for word in words if word != firmware)
        self._identity = Identity(vendor="Basicmicro", model=model, firmware=firmware)

    def _reading(self, first: int, second: int, stamp_ns: int) -> WheelReading | None:
        left, right = (first, second) if self._left_motor == 1 else (second, first)
        return self._counts.advance(left, right, stamp_ns)
