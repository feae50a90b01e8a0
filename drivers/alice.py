"""ALICE: 24 photo and 24 touch sensors, and the way of a synchro drive, told unasked. Bytes in, looks out. Pure.

    offset  bytes                       45 bytes, low byte first, 57600 bit/s 8N1
    0       2     A5 4C
    2       1     28: 40 bytes follow before the code
    3       1     sequence, one more each look
    4       4     time, ms since power-on
    8       8     way ahead, way to the left, 0.1 mm, signed, summed up in the body's frame; both wrap
    16      24    light, 255 is full scale; sensor k looks 15 k degrees counter-clockwise of the front
    40      3     touch, 24 bits in 3 bytes, bit k is sensor k
    43      2     CRC-16/CCITT-FALSE of all before

Source: docs/devices/alice.md, our own protocol for the robot of [ZvP94].
"""

from __future__ import annotations

import struct
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.checksums import crc16_ccitt
from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.readings import Identity, LinkState, Reading, RingReading
from drivers.scripted import ScriptedConversation, Step

_MS = 1_000_000
BAUD = 57600
RING = 24
HEADER = b"\xa5\x4c"
_HEAD = struct.Struct("<2sBBIii")
_FOLLOWING = _HEAD.size - 3 + RING + RING // 8
FRAME_SIZE = 3 + _FOLLOWING + 2
_WRAP = 1 << 32
LONGEST_STEP_M = 2.0  # between two looks; more is a gap in which anything may have happened


@dataclass(frozen=True, slots=True)
class Look:
    """One frame. time_ms: since power-on.  ahead, left: 0.1 mm, not unwrapped."""

    sequence: int
    time_ms: int
    ahead: int
    left: int
    light: bytes
    touch: int


def decode_frame(frame: bytes) -> Look:
    """A whole frame; FrameError with its reason if it is none."""
    if len(frame) != FRAME_SIZE or not frame.startswith(HEADER):
        raise FrameError("bad_length")
    _, count, sequence, time_ms, ahead, left = _HEAD.unpack_from(frame)
    if count != _FOLLOWING:
        raise FrameError("bad_length", str(count))
    if crc16_ccitt(frame[:-2], 0xFFFF) != int.from_bytes(frame[-2:], "little"):
        raise FrameError("bad_crc")
    touch = int.from_bytes(frame[_HEAD.size + RING : -2], "little")
    return Look(sequence, time_ms, ahead, left, frame[_HEAD.size : _HEAD.size + RING], touch)


class AliceConversation(ScriptedConversation[Look]):
    """A `Conversation[bytes]` with the robot. It only listens: it drives by itself and knows no command."""

    def __init__(self, *, baud: int = BAUD) -> None:
        self._baud = baud
        super().__init__()
        self._buffer = bytearray()
        self._last: Look | None = None
        self._ahead = self._left = 0

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """It understands no command."""
        return ()

    def _forget(self) -> None:
        self._buffer.clear()
        self._last = None

    def _life(self) -> Generator[Step[Look], Look | None, None]:
        yield Step((SetBaudRate(self._baud),))
        while True:
            heard = self._counters.bytes
            look = yield Step((), lambda _: True, 1_000 * _MS)
            if look is None:
                self._state = LinkState.SILENT
                self._trouble = (
                    f"sends bytes that are no looks of an ALICE: another device, or not {self._baud} bit/s"
                    if self._counters.bytes > heard
                    else "sends nothing: is it switched on, is its TX on this port's RX?"
                )
                continue
            if self._state is LinkState.SILENT:
                self._state = LinkState.STARTING
                self._trouble = None
            self._identity = Identity(vendor="umfeld", model="ALICE")
            yield from self._watch()
            self._last = None

    def _messages(self, chunk: bytes, stamp_ns: int) -> Iterable[Look]:
        """Frames with a right code; what is none is looked at again from its second byte."""
        self._buffer += chunk
        while (begin := self._buffer.find(HEADER)) >= 0:
            self._skip(begin)
            if len(self._buffer) < FRAME_SIZE:
                return
            try:
                look = decode_frame(bytes(self._buffer[:FRAME_SIZE]))
            except FrameError as error:
                self._counters.drop(error.reason)
                self._skip(1)
            else:
                del self._buffer[:FRAME_SIZE]
                yield look
        self._skip(len(self._buffer) - self._buffer.endswith(HEADER[:1]))

    def _skip(self, size: int) -> None:
        if size > 0:
            self._counters.drop("noise_bytes", size)
            del self._buffer[:size]

    def _take(self, look: Look, stamp_ns: int) -> Iterator[Reading]:
        before, self._last = self._last, look
        continuous = False
        if before is not None:
            ahead, left = _unwrapped(look.ahead - before.ahead), _unwrapped(look.left - before.left)
            passed_ms = (look.time_ms - before.time_ms) % _WRAP
            continuous = max(abs(ahead), abs(left)) < LONGEST_STEP_M * 1e4 and 0 < passed_ms < _WRAP // 2
            if continuous:
                self._ahead, self._left = self._ahead + ahead, self._left + left
                self._period_ns = passed_ms * _MS
                missing = (look.sequence - before.sequence - 1) % 256
                if missing:
                    self._counters.drop("missing", missing)
            else:
                self._counters.drop("gap")
        light = np.frombuffer(look.light, dtype=np.uint8) / 255.0
        touch = np.array([look.touch >> k & 1 for k in range(RING)], dtype=np.bool_)
        wire_ns = round(FRAME_SIZE * 10e9 / self._baud)
        yield RingReading(stamp_ns - wire_ns, light, touch, self._ahead / 1e4, self._left / 1e4, continuous)


def _unwrapped(difference: int) -> int:
    return (difference + (_WRAP >> 1)) % _WRAP - (_WRAP >> 1)
