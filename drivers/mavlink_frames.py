"""MAVLink frames, versions 1 and 2, and the few messages that a mapping service reads and sends. Pure.

    v2   FD len incompat compat seq system component id0 id1 id2  payload  crc low, high  [13 bytes signature]
    v1   FE len seq system component id                           payload  crc low, high

CRC-16/MCRF4XX (initial FFFF, reflected 1021h) over everything behind the first byte, then over the message's own
CRC_EXTRA byte, which ties it to the layout below. In v2 trailing zeros of the payload are cut; the reader puts them
back. A message whose CRC_EXTRA is not known here cannot be checked and is passed over byte by byte, though not counted
as noise where it has a header: autopilots send dozens of kinds.

Why not pymavlink here: its parser gives up a whole frame's length at a wrong CRC, true frames within included, takes
its version from an environment variable, and its tables cost 30 MB. It judges this file in the tests instead.

Source: MAVLink guide, "Packet serialization"; common.xml.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.readings import SourceCounters

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER, _V2_HEADER = 6, 10
_CRC_SIZE, _SIGNATURE_SIZE = 2, 13
_SIGNED = 0x01


@dataclass(frozen=True, slots=True)
class Layout:
    """A message: fields in the order of the wire, its CRC_EXTRA, and its length without extension fields (v1)."""

    fields: struct.Struct
    crc_extra: int
    base_size: int


HEARTBEAT, ATTITUDE, COMMAND_LONG, DISTANCE_SENSOR, OBSTACLE_DISTANCE = 0, 30, 76, 132, 330
ODOMETRY, WHEEL_DISTANCE = 331, 9000
LAYOUTS: dict[int, Layout] = {
    # custom_mode, type, autopilot, base_mode, system_status, version
    HEARTBEAT: Layout(struct.Struct("<IBBBBB"), 50, 9),
    # time_boot_ms, roll, pitch, yaw, their rates
    ATTITUDE: Layout(struct.Struct("<Iffffff"), 39, 28),
    # seven parameters, command, target system, target component, confirmation
    COMMAND_LONG: Layout(struct.Struct("<fffffffHBBB"), 152, 33),
    # time_boot_ms, min, max, current (cm), type, id, orientation, covariance | fields of view, quaternion, quality
    DISTANCE_SENSOR: Layout(struct.Struct("<IHHHBBBBffffffB"), 85, 14),
    # time_usec, 72 distances, min, max (cm), type, increment (deg) | increment (deg), angle of the first, frame
    OBSTACLE_DISTANCE: Layout(struct.Struct("<Q72HHHBBffB"), 23, 158),
    # time_usec, x y z, q, v, rates, covariances of pose and speed, frame, child frame | resets, estimator, quality
    ODOMETRY: Layout(struct.Struct("<Q13f42fBBBBb"), 91, 230),
    # time_usec, 16 distances (m), count
    WHEEL_DISTANCE: Layout(struct.Struct("<Q16dB"), 113, 137),
}


_MARK = re.compile(rb"[\xFD\xFE]")
_HEADER = re.compile(  # of a message that is known here: noise is passed over at the speed of this search
    b"\xfd[\x01-\xff][\x00\x01]....(?:"
    + b"|".join(re.escape(message_id.to_bytes(3, "little")) for message_id in LAYOUTS)
    + b")|\xfe....(?:"
    + b"|".join(re.escape(bytes((message_id,))) for message_id in LAYOUTS if message_id < 256)
    + b")",
    re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Message:
    """A whole message with a right CRC. values: as in LAYOUTS.  size: bytes on the wire."""

    system: int
    component: int
    message_id: int
    values: tuple[float, ...]
    size: int


def crc16_mcrf4xx(data: bytes, start: int = 0xFFFF) -> int:
    """CRC-16/MCRF4XX. Check value of `123456789`: 6F91h."""
    crc = start
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def _table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ 0x8408 if value & 1 else value >> 1
        table.append(value)
    return tuple(table)


_TABLE = _table()


def encode_v2(message_id: int, values: tuple[float, ...], *, sequence: int, system: int, component: int) -> bytes:
    """A version 2 frame, unsigned, trailing zeros cut."""
    layout = LAYOUTS[message_id]
    payload = layout.fields.pack(*values)
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    head = bytes((len(payload), 0, 0, sequence & 0xFF, system, component)) + message_id.to_bytes(3, "little")
    crc = crc16_mcrf4xx(bytes((layout.crc_extra,)), crc16_mcrf4xx(head + payload))
    return bytes((_V2,)) + head + payload + crc.to_bytes(2, "little")


class Frames:
    """Bytes in any pieces -> messages. Drops are counted: `noise_bytes`, `bad_crc`."""

    def __init__(self, counters: SourceCounters) -> None:
        self._counters = counters
        self._buffer = bytearray()
        self._foreign = 0  # bytes still to come of a message that is not known here

    def clear(self) -> None:
        """Forget half a frame."""
        self._buffer.clear()
        self._foreign = 0

    def feed(self, chunk: bytes) -> Iterator[tuple[Message, int]]:
        """The messages that a chunk completes, each with how many bytes of the chunk came after it."""
        self._buffer += chunk
        at = 0
        while at < len(self._buffer):
            size = self._size_at(at)
            if size is None:
                break
            message = self._message_at(at, size) if size else None
            if message is None:
                at = self._next_start(at + 1)
                continue
            self._foreign = 0
            at += size
            yield message, len(self._buffer) - at
        del self._buffer[:at]

    def _next_start(self, at: int) -> int:
        """Where the next frame could begin; what lies before is noise (or a frame that we do not know)."""
        header = _HEADER.search(self._buffer, at)
        if header is not None:
            start = header.start()
        else:  # perhaps the beginning of one, at the end
            tail = max(at, len(self._buffer) - _V2_HEADER + 1)
            mark = _MARK.search(self._buffer, tail)
            start = len(self._buffer) if mark is None else mark.start()
        self._pass_over(at - 1, start)
        return start

    def _pass_over(self, at: int, end: int) -> None:
        """Count what is no known message: noise, or a frame of another kind (its header tells how long it is)."""
        noise = 0
        while at < end:
            self._foreign = self._foreign or self._foreign_size(at)
            known = min(self._foreign, end - at)
            self._foreign -= known
            noise += not known
            at += known or 1
        if noise:
            self._counters.drop("noise_bytes", noise)

    def _foreign_size(self, at: int) -> int:
        """Size of the frame of a kind not known here that begins at this byte, 0 if none does."""
        head = self._buffer[at : at + _V2_HEADER]
        if head[0] == _V2 and len(head) == _V2_HEADER and not head[2] & ~_SIGNED and not head[9]:
            known = int.from_bytes(head[7:10], "little") in LAYOUTS
            return 0 if known else _V2_HEADER + head[1] + _CRC_SIZE + (_SIGNATURE_SIZE if head[2] & _SIGNED else 0)
        if head[0] == _V1 and len(head) >= _V1_HEADER and head[5] not in LAYOUTS:
            return _V1_HEADER + head[1] + _CRC_SIZE
        return 0

    def _size_at(self, at: int) -> int | None:
        """Size of the frame that begins here: 0 if none can, None if more bytes are needed to tell or to have it."""
        buffer = self._buffer
        mark, left = buffer[at], len(buffer) - at
        if mark not in (_V1, _V2):
            return 0
        header = _V1_HEADER if mark == _V1 else _V2_HEADER
        if left < header:
            return None
        length = buffer[at + 1]
        if mark == _V1:
            layout = LAYOUTS.get(buffer[at + 5])
            if layout is None or length != layout.base_size:
                return 0
            size = _V1_HEADER + length + _CRC_SIZE
        else:
            layout = LAYOUTS.get(int.from_bytes(buffer[at + 7 : at + 10], "little"))
            flags = buffer[at + 2]
            if layout is None or not 1 <= length <= layout.fields.size or flags & ~_SIGNED:
                return 0
            size = _V2_HEADER + length + _CRC_SIZE + (_SIGNATURE_SIZE if flags & _SIGNED else 0)
        return size if left >= size else None

    def _message_at(self, at: int, size: int) -> Message | None:
        frame = bytes(self._buffer[at : at + size])
        header = _V1_HEADER if frame[0] == _V1 else _V2_HEADER
        end = header + frame[1]
        message_id = frame[5] if frame[0] == _V1 else int.from_bytes(frame[7:10], "little")
        layout = LAYOUTS[message_id]
        crc = crc16_mcrf4xx(bytes((layout.crc_extra,)), crc16_mcrf4xx(frame[1:end]))
        if crc != int.from_bytes(frame[end : end + _CRC_SIZE], "little"):
            self._counters.drop("bad_crc")
            return None
        system, component = (frame[3], frame[4]) if frame[0] == _V1 else (frame[5], frame[6])
        values = layout.fields.unpack(frame[header:end].ljust(layout.fields.size, b"\0"))
        return Message(system, component, message_id, values, size)
