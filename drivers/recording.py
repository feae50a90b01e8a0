"""What goes over a wire, as records that are kept, and the same records through the same conversations again.

A record is one item of a tap (ports.Direction) with the times at which requests() was called since the wire's record
before it: with them a conversation can be brought, call by call, to exactly the state it had. On disk a record is a
CDR message of the type in WIRE_TYPE, one channel a wire, so that any reader of ROS 2 bags can look at it:

    offset  type      field
    0       int64     stamp_ns      host monotonic: arrival of what came in, the requests() call behind what went out
    8       uint32    number        CAN id, or bits a second
    12      int64[]   asked_ns      requests() was called then, in this order, before this item
    ..      uint8     direction     0 in, 1 out, 2 conversation begun, 3 wire lost, 4 nothing but asked_ns; with words:
                                    at stamp_ns only the sources named there, one a line, were asked
    ..      uint8     form          0 bytes, 1 CAN frame, 2 line speed, 3 words
    ..      uint8     flags         of a CAN frame: 1 extended, 2 remote
    ..      uint8     dlc           length that a remote frame asks for, 255 if not said
    ..      uint8[]   data          bytes of the item; words in UTF-8
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.conversation import CanFrame, Conversation, SetBaudRate
from drivers.errors import FrameError
from drivers.ports import Direction
from drivers.readings import Reading

log = logging.getLogger(__name__)

WIRE_TYPE = "umfeld_msgs/msg/WireItem"
WIRE_DEFINITION = """int64 stamp_ns
uint32 number
int64[] asked_ns
uint8 direction
uint8 form
uint8 flags
uint8 dlc
uint8[] data
"""

Item = bytes | CanFrame | SetBaudRate | str

_HEADER = b"\x00\x01\x00\x00"  # CDR, little endian
_HEAD = struct.Struct("<qII")
_TAIL = struct.Struct("<4BI")
_DIRECTIONS = (Direction.IN, Direction.OUT, Direction.CONNECTED, Direction.LOST, Direction.TURN)
_BYTES, _CAN, _SPEED, _WORDS = range(4)
_EXTENDED, _REMOTE = 1, 2
_NO_DLC = 255


@dataclass(frozen=True, slots=True)
class WireRecord:
    """One item on a wire. asked_ns: when requests() was called since the record before, oldest first."""

    stamp_ns: int
    direction: Direction
    item: Item
    asked_ns: tuple[int, ...] = ()


def encode_record(record: WireRecord) -> bytes:
    """The CDR message of a record."""
    form, number, flags, dlc, data = _taken_apart(record.item)
    count = len(record.asked_ns)
    return b"".join(
        (
            _HEADER,
            _HEAD.pack(record.stamp_ns, number, count),
            struct.pack(f"<{count}q", *record.asked_ns),
            _TAIL.pack(_DIRECTIONS.index(record.direction), form, flags, dlc, len(data)),
            data,
        )
    )


def decode_record(message: bytes) -> WireRecord:
    """The record in a CDR message. Raises FrameError if it is none."""
    if message[:4] != _HEADER:
        raise FrameError("bad_header", "a record begins with 00 01 00 00")
    try:
        stamp_ns, number, count = _HEAD.unpack_from(message, 4)
        asked_ns = struct.unpack_from(f"<{count}q", message, 4 + _HEAD.size)
        place = 4 + _HEAD.size + 8 * count
        direction, form, flags, dlc, length = _TAIL.unpack_from(message, place)
    except struct.error as error:
        raise FrameError("torn", str(error)) from error
    data = message[place + _TAIL.size :]
    if len(data) != length or direction >= len(_DIRECTIONS):
        raise FrameError("torn", f"{len(data)} bytes where {length} belong")
    return WireRecord(stamp_ns, _DIRECTIONS[direction], _put_together(form, number, flags, dlc, data), asked_ns)


def _taken_apart(item: Item) -> tuple[int, int, int, int, bytes]:
    """form, number, flags, dlc, data."""
    match item:
        case CanFrame():
            flags = _EXTENDED * item.extended + _REMOTE * item.remote
            return _CAN, item.can_id, flags, _NO_DLC if item.dlc is None else item.dlc, item.data
        case SetBaudRate():
            return _SPEED, item.bits_per_s, 0, 0, b""
        case str():
            return _WORDS, 0, 0, 0, item.encode()
        case _:
            return _BYTES, 0, 0, 0, bytes(item)


def _put_together(form: int, number: int, flags: int, dlc: int, data: bytes) -> Item:
    match form:
        case 0:
            return data
        case 1:
            remote = bool(flags & _REMOTE)
            return CanFrame(number, data, bool(flags & _EXTENDED), remote, None if dlc == _NO_DLC else dlc)
        case 2:
            return SetBaudRate(number)
        case 3:
            return data.decode(errors="replace")
        case _:
            raise FrameError("unknown_form", f"form {form}")


@dataclass(slots=True)
class WireWriter:
    """Gathers the turns of one wire until there is an item to write them with."""

    longest_wait: int = 50
    _asked_ns: list[int] = field(default_factory=list)

    def take(self, direction: Direction, stamp_ns: int, item: Item) -> WireRecord | None:
        """What a tap heard; returns what is to be kept now, in this order, None if that can wait."""
        if direction is Direction.TURN and not item:
            self._asked_ns.append(stamp_ns)
            return self.rest() if len(self._asked_ns) >= self.longest_wait else None
        return WireRecord(stamp_ns, direction, item, self._taken())

    def rest(self) -> WireRecord | None:
        """The turns that no item came after."""
        asked_ns = self._taken()
        return WireRecord(asked_ns[-1], Direction.TURN, "", asked_ns) if asked_ns else None

    def _taken(self) -> tuple[int, ...]:
        asked_ns = tuple(self._asked_ns)
        self._asked_ns.clear()
        return asked_ns


class WirePlayer:
    """The conversations of one wire, driven by records instead of a port.

    sent, sent_otherwise: requests that came out as recorded, and differently: then these are other drivers or other
    settings than recorded, or records are missing.
    """

    def __init__(self, conversations: Mapping[str, Conversation[Any]]) -> None:
        self._conversations = dict(conversations)
        self._silent = set(conversations)  # not begun in this recording yet: it began while they were running
        self._broken: set[str] = set(conversations)  # left alone until begun anew, as the reader does after a bug
        self._expected: list[Item] = []
        self._surplus = 0
        self.sent = 0
        self.sent_otherwise = 0
        self.bugs = 0

    def play(self, record: WireRecord) -> Iterator[tuple[str, Reading]]:
        """Repeat what happened; yields (source, reading). To be exhausted."""
        for asked_ns in record.asked_ns:
            self._ask(asked_ns)
        match record.direction:
            case Direction.IN:
                assert isinstance(record.item, bytes | CanFrame)
                for source in self._conversations:
                    yield from self._receive(source, record.item, record.stamp_ns)
            case Direction.OUT:
                self._compare(record.item)
            case Direction.CONNECTED:
                self._begin(str(record.item), record.stamp_ns)
            case Direction.TURN if record.item:
                self._ask(record.stamp_ns, only=frozenset(str(record.item).split("\n")))
            case _:
                pass

    def _ask(self, now_ns: int, *, only: frozenset[str] | None = None) -> None:
        self.sent_otherwise += len(self._expected) + self._surplus
        self._expected.clear()
        self._surplus = 0
        for source, conversation in self._conversations.items():
            if source not in self._broken and (only is None or source in only):
                try:
                    self._expected.extend(conversation.requests(now_ns))
                except Exception as error:
                    self._note_bug(source, error)

    def _compare(self, item: Item) -> None:
        if self._expected and self._expected[0] == item:
            self._expected.pop(0)
            self.sent += 1
        elif not self._silent:  # what is sent after the last turn of all is the farewell
            self._surplus += 1

    def _receive(self, source: str, item: bytes | CanFrame, stamp_ns: int) -> Iterator[tuple[str, Reading]]:
        if source in self._broken:
            return
        try:
            for reading in self._conversations[source].receive(item, stamp_ns):
                yield source, reading
        except Exception as error:
            self._note_bug(source, error)

    def _begin(self, source: str, now_ns: int) -> None:
        self._expected.clear()
        conversation = self._conversations.get(source)
        if conversation is None:
            return
        self._broken.discard(source)
        self._silent.discard(source)
        try:
            conversation.connected(now_ns)
        except Exception as error:
            self._note_bug(source, error)

    def _note_bug(self, source: str, error: Exception) -> None:
        self.bugs += 1
        self._broken.add(source)
        log.warning("%s: %s in a replay: %s", source, type(error).__name__, error)
