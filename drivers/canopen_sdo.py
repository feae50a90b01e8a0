"""The client side of CANopen SDO (CiA 301) as a pure state machine: one question at a time to one node.

    upload    40 iL iH s 0 0 0 0      -> 4F 1 byte, 4B 2, 47 3, 43 4 bytes in d0..d3 (expedited; 42: length not told)
                                      -> 41 + u32 length (40: not told), then segments:
              60 | toggle             -> toggle | (7 - n) << 1 | last, with n bytes; toggle 00, 10, 00 …
    download  2F|2B|27|23 iL iH s d.. -> 60 iL iH s 0 0 0 0            (expedited, up to 4 bytes)
    abort     80 iL iH s code         either way, ends the transfer

Source: CiA 301, section SDO protocols.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.conversation import CanFrame
from drivers.errors import DeviceRefused

REQUEST_ID = 0x600
ANSWER_ID = 0x580
_LONGEST_UPLOAD = 4096  # names and identities are short; a node that goes on for ever is not listened to

ABORT_TEXTS = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "no answer in time",
    0x05040001: "command not known",
    0x06010000: "access not supported",
    0x06010001: "write only",
    0x06010002: "read only",
    0x06020000: "no such object",
    0x06040041: "object cannot be mapped",
    0x06070010: "wrong length",
    0x06070012: "too long",
    0x06070013: "too short",
    0x06090011: "no such sub-index",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x08000000: "general error",
    0x08000020: "cannot be stored",
    0x08000022: "not in this state of the device",
}
TOGGLE_ERROR = 0x05030000
TIMED_OUT = 0x05040000
BAD_COMMAND = 0x05040001
TOO_LONG = 0x06070012


@dataclass(frozen=True, slots=True)
class Upload:
    """Read an object of the node."""

    index: int
    sub: int = 0


@dataclass(frozen=True, slots=True)
class Download:
    """Write an object of the node: up to 4 bytes."""

    index: int
    sub: int
    data: bytes


@dataclass(frozen=True, slots=True)
class SdoDone:
    """What came of a question: the data read (empty for a write), or the abort code."""

    data: bytes = b""
    abort_code: int | None = None

    @property
    def ok(self) -> bool:
        return self.abort_code is None

    @property
    def number(self) -> int:
        """The data as an unsigned little-endian number."""
        return int.from_bytes(self.data, "little")


class SdoAborted(DeviceRefused):
    """A transfer was aborted; the text says by which code and what it means."""

    def __init__(self, question: Upload | Download, code: int) -> None:
        text = ABORT_TEXTS.get(code, "unknown reason")
        super().__init__(f"object {question.index:04X}h:{question.sub:02X}: {text} (abort {code:08X}h)")
        self.code = code


class SdoClient:
    """Puts one question at a time to a node. Frames to send are fetched by `requests`.

    timeout_ns: for each answer; the question is repeated `repeats` times, then it ends with TIMED_OUT.
    """

    def __init__(self, node: int, *, timeout_ns: int = 150_000_000, repeats: int = 2) -> None:
        if not 1 <= node <= 127:
            raise ValueError(f"node {node}: CANopen nodes are 1 to 127")
        self._request_id = REQUEST_ID + node
        self._timeout_ns = timeout_ns
        self._repeats = repeats
        self._question: Upload | Download | None = None
        self._to_send: list[bytes] = []
        self._deadline_ns = 0
        self._tries_left = 0
        self._segments: bytearray | None = None  # not None: an upload in segments is under way
        self._length: int | None = None
        self._toggle = 0

    @property
    def busy(self) -> bool:
        return self._question is not None

    def ask(self, question: Upload | Download, now_ns: int) -> None:
        """Begin a transfer; whatever was under way is forgotten."""
        self._question = question
        self._tries_left = self._repeats
        self._begin(now_ns)

    def cancel(self) -> None:
        """Forget what is under way."""
        self._question = None
        self._segments = None
        self._to_send.clear()

    def requests(self, now_ns: int) -> tuple[Sequence[CanFrame], SdoDone | None]:
        """Frames to send now, and the outcome if the last try has just timed out."""
        done = None
        if self._question is not None and not self._to_send and now_ns >= self._deadline_ns:
            if self._tries_left > 0:
                self._tries_left -= 1
                self._begin(now_ns)
            else:
                done = self._abort(TIMED_OUT)
        frames = [CanFrame(self._request_id, data) for data in self._to_send]
        self._to_send.clear()
        return frames, done

    def receive(self, data: bytes, now_ns: int) -> SdoDone | None:
        """A frame from the node's answer id. Returns the outcome if it ends the transfer; foreign ones are ignored.

        After a segment the next question waits in `requests`.
        """
        question = self._question
        if question is None or len(data) != 8:
            return None
        if self._segments is not None and data[0] >> 5 == 0:
            return self._take_segment(data, now_ns)
        if data[1:4] != _multiplexer(question):
            return None  # an answer to somebody else's question, or to one that we gave up
        if data[0] == 0x80:
            code = int.from_bytes(data[4:], "little")
            self.cancel()
            return SdoDone(abort_code=code)
        if self._segments is not None:
            return None  # a repeated answer to the beginning
        if isinstance(question, Download):
            return self._end(b"") if data[0] == 0x60 else self._abort(BAD_COMMAND)
        return self._take_upload(data, now_ns)

    def _begin(self, now_ns: int) -> None:
        question = self._question
        assert question is not None
        self._segments = None
        self._deadline_ns = now_ns + self._timeout_ns
        if isinstance(question, Upload):
            self._to_send = [b"\x40" + _multiplexer(question) + bytes(4)]
        else:
            command = 0x23 | (4 - len(question.data)) << 2
            self._to_send = [bytes((command,)) + _multiplexer(question) + question.data.ljust(4, b"\0")]

    def _take_upload(self, data: bytes, now_ns: int) -> SdoDone | None:
        command = data[0]
        if command >> 5 != 2:
            return self._abort(BAD_COMMAND)
        expedited, told = command & 2, command & 1
        if expedited:
            size = 4 - (command >> 2 & 3) if told else 4
            return self._end(data[4 : 4 + size])
        self._segments = bytearray()
        self._length = int.from_bytes(data[4:], "little") if told else None
        if self._length is not None and self._length > _LONGEST_UPLOAD:
            return self._abort(TOO_LONG)
        self._toggle = 0
        self._ask_segment(now_ns)
        return None

    def _take_segment(self, data: bytes, now_ns: int) -> SdoDone | None:
        assert self._segments is not None
        command = data[0]
        if command & 0x10 != self._toggle:
            return self._abort(TOGGLE_ERROR)
        size = 7 - (command >> 1 & 7)
        self._segments += data[1 : 1 + size]
        if len(self._segments) > _LONGEST_UPLOAD:
            return self._abort(TOO_LONG)
        if not command & 1:
            self._toggle ^= 0x10
            self._ask_segment(now_ns)
            return None
        if self._length is not None and len(self._segments) != self._length:
            return self._abort(0x06070010)
        return self._end(bytes(self._segments))

    def _ask_segment(self, now_ns: int) -> None:
        self._to_send = [bytes((0x60 | self._toggle,)).ljust(8, b"\0")]
        self._deadline_ns = now_ns + self._timeout_ns

    def _end(self, data: bytes) -> SdoDone:
        self.cancel()
        return SdoDone(data)

    def _abort(self, code: int) -> SdoDone:
        """End the transfer from our side, and tell the node."""
        assert self._question is not None
        message = b"\x80" + _multiplexer(self._question) + code.to_bytes(4, "little")
        self.cancel()
        self._to_send = [message]
        return SdoDone(abort_code=code)


def _multiplexer(question: Upload | Download) -> bytes:
    return question.index.to_bytes(2, "little") + bytes((question.sub,))
