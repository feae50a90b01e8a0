"""Requests, answers and streams of Slamtec RPLIDAR scanners. Pure.

    request     A5 command                      without data
                A5 command n data[n] x          with data (bit 7 of the command set); x: xor of all before
    answer      A5 5A size type                 size: bits 0-29 length of one body, bit 30: bodies without end
                body

    node        5 bytes     bit 0 first of a turn, bit 1 not so, bits 2-7 quality; bit 8 always 1,
                            bits 9-23 angle in 1/64 degree; u16 distance in 1/4 mm, 0 for none
    capsule     84 bytes    A0 | x & F, 50 | x >> 4 (x: xor of all behind these two), u16 start angle in 1/64 degree
                            (bit 15: first of the stream), 16 cabins of two samples: u16 a, u16 b, u8 o

All low byte first, angles clockwise. A capsule's samples lie between its start angle and the next one's, so it is
decoded when that one is there; and only if it follows at once, which finds lost and surplus bytes that an 8-bit sum
does not. A node has two check bits only: it must also follow the one before in angle and be followed by another; after
a disturbance several must follow each other.
Source: Slamtec RPLIDAR interface protocol, rplidar_cmd.h and rplidar_protocol.h.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from functools import reduce
from operator import xor

import numpy as np
from numpy.typing import NDArray

from drivers.errors import FrameError
from drivers.readings import F64, SourceCounters

STOP, RESET, SCAN = b"\xa5\x25", b"\xa5\x40", b"\xa5\x20"
GET_INFO, GET_HEALTH, GET_RATES = b"\xa5\x50", b"\xa5\x52", b"\xa5\x59"

# Answers and streams by their type.
INFO, HEALTH, RATES, CONFIG, BOARD, NODES, CAPSULES, ULTRA, DENSE = (
    0x04, 0x06, 0x15, 0x20, 0xFF, 0x81, 0x82, 0x84, 0x85,
)  # fmt: skip
_SIZES = {INFO: 20, HEALTH: 3, RATES: 4, BOARD: 4, NODES: 5, CAPSULES: 84, ULTRA: 132, DENSE: 84}
_CONFIG_SIZES = range(4, 260)
_ENDLESS = 0x40000000
DESCRIPTOR = b"\xa5\x5a"

MODE_COUNT, US_PER_SAMPLE, MAX_DISTANCE, ANSWER_TYPE, TYPICAL_MODE, MODE_NAME = 0x70, 0x71, 0x74, 0x75, 0x7C, 0x7F

SAMPLES = 32  # of a capsule
_TURN = 2.0 * math.pi
_NODE = np.dtype([("flags", "u1"), ("angle", "<u2"), ("distance", "<u2")])
_CABIN = np.dtype([("distance", "<u2", (2,)), ("offsets", "u1")])
_CAPSULE_HEADER = re.compile(rb"[\xa0-\xaf][\x50-\x5f]")
_INDEX: F64 = np.arange(SAMPLES, dtype=np.float64)


def encode_request(command: int, data: bytes) -> bytes:
    """A request with data."""
    frame = bytes([0xA5, command, len(data)]) + data
    return frame + bytes([reduce(xor, frame)])


def express_scan(mode: int) -> bytes:
    """Start of an express scan in a mode of the device's list; 0 is the legacy one."""
    return encode_request(0x82, struct.pack("<BHH", mode, 0, 0))


def motor_pwm(duty: int) -> bytes:
    """Motor speed 0..1023; 0 stops it. Known to A2 and later."""
    return encode_request(0xF0, struct.pack("<H", duty))


def get_config(key: int, mode: int | None = None) -> bytes:
    """Ask for a value, of a scan mode where the key is one of these."""
    return encode_request(0x84, struct.pack("<I", key) + (b"" if mode is None else struct.pack("<H", mode)))


GET_BOARD = encode_request(0xFF, bytes(4))


@dataclass(frozen=True, slots=True)
class Answer:
    """A body, or (streams) the descriptor that announces many; body is then empty."""

    kind: int
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class Block:
    """Samples in the order they were measured, none lost between them. Arrays (N,).

    angle_rad: clockwise, 0..2 pi.  distance_m: 0 for none.  starts: first of a turn, None if the stream does not mark
    it.  arrived_ns: chunk with the last sample's last byte.  bytes_after: that had arrived behind each sample's record.
    after_gap: samples were lost before these.
    """

    angle_rad: F64
    distance_m: F64
    quality: F64
    starts: NDArray[np.bool_] | None
    arrived_ns: int
    bytes_after: F64
    after_gap: bool


class AnswerReader:
    """Answers and samples from chunks. What does not fit is looked at again from its second byte."""

    def __init__(self, counters: SourceCounters | None = None) -> None:
        self._counters = counters or SourceCounters()
        self._buffer = bytearray()
        self.clear()

    def clear(self) -> None:
        """Forget everything: the next thing is an answer."""
        self._buffer.clear()
        self._pending: tuple[int, int] | None = None  # type and size of a body that is awaited
        self._nodes: _NodeStream | None = None
        self._capsules: _CapsuleStream | None = None

    def feed(self, chunk: bytes, stamp_ns: int) -> list[Answer | Block]:
        """What this chunk completes."""
        self._buffer += chunk
        found: list[Answer | Block] = []
        while True:
            if self._nodes is not None:
                found += self._nodes.feed(self._buffer, stamp_ns)
                return found
            if self._capsules is not None:
                found += self._capsules.feed(self._buffer, stamp_ns)
                return found
            answer = self._next_answer()
            if answer is None:
                return found
            found.append(answer)

    def _next_answer(self) -> Answer | None:
        if self._pending is None and not self._find_descriptor():
            return None
        assert self._pending is not None
        kind, size = self._pending
        if size & _ENDLESS:
            self._pending = None
            if kind == NODES:
                self._nodes = _NodeStream(self._counters)
            elif kind == CAPSULES:
                self._capsules = _CapsuleStream(self._counters)
            return Answer(kind)
        if len(self._buffer) < size:
            return None
        body = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._pending = None
        return Answer(kind, body)

    def _find_descriptor(self) -> bool:
        buffer = self._buffer
        while True:
            begin = buffer.find(DESCRIPTOR)
            noise = begin if begin >= 0 else len(buffer) - buffer.endswith(DESCRIPTOR[:1])
            if noise:
                self._counters.drop("noise_bytes", noise)
                del buffer[:noise]
            if len(buffer) < 7:
                return False
            size, kind = struct.unpack_from("<IB", buffer, 2)
            if _is_known(kind, size):
                self._pending = (kind, size)
                del buffer[:7]
                return True
            self._counters.drop("bad_descriptor")
            del buffer[0]


def _is_known(kind: int, size: int) -> bool:
    if kind == CONFIG:
        return size in _CONFIG_SIZES
    endless = _ENDLESS if kind in (NODES, CAPSULES, ULTRA, DENSE) else 0
    return kind in _SIZES and size == _SIZES[kind] | endless


# --- streams ----------------------------------------------------------------------------------------------------------


class _NodeStream:
    """5-byte nodes. In step, each must follow the one before; out of step, a run of them must."""

    RUN = 5
    BACK_RAD, AHEAD_RAD = math.radians(-10.0), math.radians(45.0)

    def __init__(self, counters: SourceCounters) -> None:
        self._counters = counters
        self._in_step = False
        self._gap = False
        self._last_rad = 0.0

    def feed(self, buffer: bytearray, stamp_ns: int) -> list[Block]:
        """Blocks in the buffer; takes from it what is done with."""
        data = bytes(buffer)
        at = 0
        found: list[Block] = []
        while True:
            if not self._in_step:
                step = self._find_step(data, at)
                if step > at:
                    self._counters.drop("noise_bytes", step - at)
                    self._gap = True
                at = step
                if not self._in_step:
                    break
            count = (len(data) - at) // 5
            good = self._follow_on(data, at, count)
            if good > 1:
                self._tell(data, at, good - 1, stamp_ns, found)
                at += 5 * (good - 1)
            if good == count:
                break
            self._in_step = False
            self._gap = True
        del buffer[:at]
        return found

    def _follow_on(self, data: bytes, at: int, count: int) -> int:
        """How many nodes from here follow each other. The last of them is not told: a byte of it may be missing."""
        nodes = np.frombuffer(data, _NODE, count, at)
        angle = np.concatenate(([self._last_rad], _node_angles(nodes)))
        follows = _node_checks(nodes) & self._follow(angle)
        return count if follows.all() else int(np.argmin(follows))

    def _tell(self, data: bytes, at: int, count: int, stamp_ns: int, found: list[Block]) -> None:
        nodes = np.frombuffer(data, _NODE, count, at)
        angle, flags = _node_angles(nodes), nodes["flags"]
        self._last_rad = float(angle[-1])
        found.append(
            Block(
                angle,
                nodes["distance"] / 4000.0,
                (flags >> 2).astype(np.float64),
                (flags & 1).astype(bool),
                stamp_ns,
                np.asarray((len(data) - at) - 5.0 * np.arange(1, count + 1), dtype=np.float64),
                self._gap,
            )
        )
        self._gap = False

    def _find_step(self, data: bytes, at: int) -> int:
        """Where a run of nodes begins that follow each other; in step if there is one, else where one still may."""
        last = len(data) - 5 * self.RUN  # the last place where a whole run can begin
        if last < at:
            return at
        here = np.frombuffer(data, np.uint8, len(data) - at, at)
        angle = np.asarray(here[1:-1] | here[2:].astype(np.uint16) << 8, dtype=np.uint16)
        size = last - at + 1
        step = (_radians(angle[5:]) - _radians(angle[:-5]) + math.pi) % _TURN - math.pi
        follows = (step >= self.BACK_RAD) & (step <= self.AHEAD_RAD)
        checks = _checks(here[:-2], angle)
        runs = checks[:size].copy()
        for node in range(1, self.RUN):
            runs &= checks[5 * node : 5 * node + size] & follows[5 * (node - 1) : 5 * (node - 1) + size]
        if runs.any():
            begin = int(np.argmax(runs))
            self._in_step = True
            self._last_rad = float(_radians(angle[begin : begin + 1])[0])
            return at + begin
        return last + 1

    def _follow(self, angle_rad: F64) -> NDArray[np.bool_]:
        step = (np.diff(angle_rad) + math.pi) % _TURN - math.pi
        return np.asarray((step >= self.BACK_RAD) & (step <= self.AHEAD_RAD))


def _node_angles(nodes: NDArray[np.void]) -> F64:
    return _radians(nodes["angle"])


def _radians(angle: NDArray[np.uint16]) -> F64:
    return np.asarray((angle >> 1) * (math.pi / 180.0 / 64.0), dtype=np.float64)


def _node_checks(nodes: NDArray[np.void]) -> NDArray[np.bool_]:
    return _checks(nodes["flags"], nodes["angle"])


def _checks(flags: NDArray[np.uint8], angle: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Check bits right and angle within a turn."""
    return np.asarray((((flags ^ flags >> 1) & 1) == 1) & ((angle & 1) == 1) & (angle >> 1 <= 360 * 64))


@dataclass(frozen=True, slots=True)
class Capsule:
    """A legacy capsule. offset_rad: what each sample lies before its even place."""

    start_rad: float
    is_first: bool
    distance_m: F64
    offset_rad: F64


def decode_capsule(data: bytes) -> Capsule:
    """84 bytes. Raises FrameError if the marks or the sum are wrong."""
    if len(data) != 84 or data[0] & 0xF0 != 0xA0 or data[1] & 0xF0 != 0x50:
        raise FrameError("bad_header")
    if int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8, 82, 2))) != (data[0] & 0x0F | (data[1] & 0x0F) << 4):
        raise FrameError("bad_sum")
    start = data[2] | data[3] << 8
    if start & 0x7FFF > 360 * 64:
        raise FrameError("bad_angle", str(start))
    cabins = np.frombuffer(data, _CABIN, 16, 4)
    distance = cabins["distance"]
    low = np.stack((cabins["offsets"] & 0x0F, cabins["offsets"] >> 4), axis=1).astype(np.int64)
    offset = (distance & 3).astype(np.int64) << 4 | low
    offset = np.where(offset >= 32, offset - 64, offset)  # six bits with sign
    return Capsule(
        math.radians((start & 0x7FFF) / 64.0),
        bool(start & 0x8000),
        (distance & 0xFFFC).ravel() / 4000.0,
        np.asarray(offset.ravel() * (math.pi / 180.0 / 8.0), dtype=np.float64),
    )


class _CapsuleStream:
    """Legacy capsules: each is told when the next one follows it at once."""

    def __init__(self, counters: SourceCounters) -> None:
        self._counters = counters
        self._before: tuple[Capsule, int, int] | None = None  # with its stamp and what had arrived behind it
        self._span_rad: float | None = None
        self._stray_rad: float | None = None  # an odd one, in case the next is odd in the same way
        self._gap = False

    def feed(self, buffer: bytearray, stamp_ns: int) -> list[Block]:
        """Blocks in the buffer; takes from it what is done with."""
        data = bytes(buffer)
        at = 0
        found: list[Block] = []
        while True:
            begin = _find_header(data, at)
            if begin > at:
                self._counters.drop("noise_bytes", begin - at)
                self._lose()
                at = begin
            if len(data) - at < 84:
                break
            try:
                capsule = decode_capsule(data[at : at + 84])
            except FrameError as error:
                self._counters.drop(error.reason)
                self._lose()
                at += 1
                continue
            if capsule.is_first and self._span_rad is not None:
                self._counters.drop("bad_first")  # no scan begins in the middle of one
                self._lose()
                at += 1
                continue
            at += 84
            if capsule.is_first:
                self._gap = self._gap or self._before is not None
            elif self._before is not None:
                self._tell(*self._before, capsule.start_rad, found)
            self._before = (capsule, stamp_ns, len(data) - at)
        del buffer[:at]
        return found

    def _lose(self) -> None:
        if self._before is not None:
            self._counters.drop("unpaired_capsule")
            self._before = None
        self._gap = True

    def _tell(self, capsule: Capsule, stamp_ns: int, bytes_after: int, next_rad: float, found: list[Block]) -> None:
        span_rad = (next_rad - capsule.start_rad) % _TURN
        stray_rad, self._stray_rad = self._stray_rad, None
        trusted = capsule.is_first if self._span_rad is None else _like(span_rad, self._span_rad)
        if not (trusted or (stray_rad is not None and _like(span_rad, stray_rad))):
            self._counters.drop("stray_angle")
            self._stray_rad = span_rad
            self._gap = True
            return
        self._span_rad = span_rad
        angle = (capsule.start_rad + _INDEX * (span_rad / SAMPLES) - capsule.offset_rad) % _TURN
        quality = np.where(capsule.distance_m > 0.0, 47.0, 0.0)  # capsules have none; as the maker's library fills it
        found.append(
            Block(angle, capsule.distance_m, quality, None, stamp_ns, np.full(SAMPLES, float(bytes_after)), self._gap)
        )
        self._gap = False


def _like(span_rad: float, usual_rad: float) -> bool:
    """The head's speed changes by less than this from one capsule to the next; a lost capsule doubles the span."""
    return usual_rad / 1.6 <= span_rad <= usual_rad * 1.6


def _find_header(data: bytes, at: int) -> int:
    """Where the next capsule may begin."""
    match = _CAPSULE_HEADER.search(data, at)
    if match is not None:
        return match.start()
    return max(at, len(data) - bool(data and data[-1] & 0xF0 == 0xA0))


# --- contents ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Who it is. firmware: major and minor."""

    model: int
    firmware: tuple[int, int]
    hardware: int
    serial: str

    @property
    def name(self) -> str:
        """18h is A1M8, 28h A2M8; later families have letters of their own."""
        major, sub = self.model >> 4, self.model & 0x0F
        return f"RPLIDAR A{major}M{sub}" if major <= 3 else f"RPLIDAR {self.model:02X}h"


def decode_info(body: bytes) -> DeviceInfo:
    """Body of INFO."""
    model, minor, major, hardware = body[:4]
    return DeviceInfo(model, (major, minor), hardware, body[4:20].hex().upper())


def config_value(body: bytes, key: int) -> int | None:
    """A number from a CONFIG body of this key, None if it is another key's or holds none."""
    if len(body) < 5 or struct.unpack_from("<I", body)[0] != key:
        return None
    return int.from_bytes(body[4:8], "little")


def config_text(body: bytes, key: int) -> str:
    """Text from a CONFIG body."""
    if len(body) < 4 or struct.unpack_from("<I", body)[0] != key:
        return ""
    return body[4:].split(b"\0")[0].decode("ascii", "replace")
