"""Telegrams of SICK LMS2xx scanners (LMS200/211/220/221/291): framing, codes, layout. Pure.

    offset  bytes
    0       1      02
    1       1      address; from the scanner 80h + its own
    2       2      length of the payload, low byte first
    4       n      payload: command, data, and from the scanner a status byte last
    4 + n   2      CRC over all before it, low byte first

Single bytes outside of telegrams: 06 accepted, 15 refused (bad CRC, gap between bytes). Numbers are little-endian.
Source: SICK telegram listing LMS2xx (8007954).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from drivers.checksums import crc16_sick
from drivers.errors import FrameError
from drivers.readings import F64, SourceCounters

STX, ACK, NAK = 0x02, 0x06, 0x15
MAX_PAYLOAD = 808

# Replies by their first byte.
POWER_ON, RESET, REFUSED, MODE, VALUES, STATUS, TYPE, VARIANT, CONFIGURATION, CONFIGURED = (
    0x90, 0x91, 0x92, 0xA0, 0xB0, 0xB1, 0xBA, 0xBB, 0xF4, 0xF7,
)  # fmt: skip
_PAYLOAD_SIZES = {
    POWER_ON: range(2, 67),
    RESET: range(2, 3),
    REFUSED: range(2, 3),
    MODE: range(3, 4),
    VALUES: range(4, MAX_PAYLOAD + 1),
    STATUS: range(124, 201),
    TYPE: range(2, 67),
    VARIANT: range(7, 8),
    CONFIGURATION: range(34, 38),
    CONFIGURED: range(35, 39),
}
_COUNT_BITS = 0x3FF


def encode_telegram(payload: bytes, address: int = 0) -> bytes:
    """A telegram as the host sends it; address 0 is everyone."""
    frame = struct.pack("<BBH", STX, address, len(payload)) + payload
    return frame + struct.pack("<H", crc16_sick(frame))


@dataclass(frozen=True, slots=True)
class Telegram:
    """What the scanner sent. payload: of a telegram, or one byte: ACK or NAK.

    size: bytes on the wire.  bytes_after: how many had arrived behind it.  began_ns, arrived_ns: stamps of the chunks
    with its first and its last byte.
    """

    payload: bytes
    size: int
    bytes_after: int
    began_ns: int
    arrived_ns: int

    @property
    def command(self) -> int:
        """Which reply it is; ACK or NAK for these."""
        return self.payload[0]

    @property
    def status(self) -> int:
        """The status byte that ends a telegram's payload."""
        return self.payload[-1]


class TelegramReader:
    """Whole telegrams from chunks. What does not fit is looked at again from its second byte.

    A telegram that has begun does not hold up a whole one behind its begin: then it was none, or was cut.
    """

    def __init__(self, counters: SourceCounters | None = None) -> None:
        self._counters = counters or SourceCounters()
        self._buffer = bytearray()
        self._began_ns = 0  # of the buffer's first byte
        self._origin: int | None = None  # of the scans: severity and source, which the status byte tells
        self._odd_origin: int | None = None
        _crc_shares()  # made once, not when the first telegram comes

    def clear(self) -> None:
        """Forget a telegram that has only begun."""
        self._buffer.clear()
        self._origin = self._odd_origin = None

    def feed(self, chunk: bytes, stamp_ns: int) -> list[Telegram]:
        """Telegrams that this chunk completes, ACKs and NAKs, in order."""
        old = len(self._buffer)
        self._buffer += chunk
        data = bytes(self._buffer)
        found: list[Telegram] = []
        at = noise = 0
        while at < len(data):
            size = _size_at(data, at)
            if size is None or at + size > len(data):
                whole = _whole_behind(data, at)
                if whole is None:
                    break
                noise += whole - at
                at = whole
                continue
            began_ns = self._began_ns if at < old else stamp_ns
            after = len(data) - at - size
            if size == 1 and data[at] in (ACK, NAK):
                found.append(Telegram(data[at : at + 1], 1, after, began_ns, stamp_ns))
                at += 1
            elif size > 1 and crc16_fast(data[at : at + size]) == 0 and self._believes(data[at + 4 : at + size - 2]):
                found.append(Telegram(data[at + 4 : at + size - 2], size, after, began_ns, stamp_ns))
                at += size
            else:
                if size > 1:
                    self._counters.drop("bad_crc")  # or, 1 in 65536, a right one at a wrong place
                else:
                    noise += 1
                at += 1
        if noise:
            self._counters.drop("noise_bytes", noise)
        del self._buffer[:at]
        if at >= old:
            self._began_ns = stamp_ns
        return found

    def _believes(self, payload: bytes) -> bool:
        """A scan whose status has another source or severity than the scans before needs a second one that says so.

        In a telegram that lost or won a byte another byte stands there: this finds what the CRC by chance does not.
        """
        if payload[0] != VALUES:
            return True
        origin = payload[-1] & 0x1F
        if origin not in (self._origin, self._odd_origin) and self._origin is not None:
            self._odd_origin = origin
            return False
        self._origin, self._odd_origin = origin, None
        return True


def _size_at(data: bytes, at: int) -> int | None:
    """Size of the telegram that begins here, 1 if none can, None if more bytes must tell.

    Only lengths that belong to the reply are believed, so that noise with an STX in it does not hold up the telegrams
    behind it.
    """
    if data[at] != STX:
        return 1
    head = data[at : at + 7]
    if len(head) > 1 and not head[1] & 0x80:
        return 1
    if len(head) < 5:
        return None
    length = head[2] | head[3] << 8
    if length not in _PAYLOAD_SIZES.get(head[4], ()):
        return 1
    if head[4] == VALUES:
        if len(head) < 7:
            return None
        values = (head[5] | head[6] << 8) & _COUNT_BITS
        if length - 2 * values not in (4, 6):  # 6: with real-time indices
            return 1
    return length + 6


def _whole_behind(data: bytes, at: int) -> int | None:
    """Where a whole telegram begins behind this place, if there is one."""
    while (at := data.find(STX, at + 1)) >= 0:
        size = _size_at(data, at)
        if size is not None and 1 < size <= len(data) - at and crc16_fast(data[at : at + size]) == 0:
            return at
    return None


@cache
def _crc_shares() -> NDArray[np.uint16]:
    """(MAX + 6, 256): what a byte adds to the CRC, by its distance from the end."""
    byte: NDArray[np.uint32] = np.arange(256, dtype=np.uint32)
    share, shares = byte, []
    for place in range(MAX_PAYLOAD + 6):
        shares.append(share)
        share = np.asarray(share << 1 ^ np.where(share & 0x8000, 0x18005, 0), dtype=np.uint32)
        if place == 0:
            share = np.asarray(share ^ byte << 8, dtype=np.uint32)  # a byte enters a second time with the next one
    return np.array(shares, dtype=np.uint16)


def crc16_fast(frame: bytes) -> int:
    """0 for a telegram whose CRC is right. The scheme is linear, so the shares of all bytes are just combined."""
    values = np.frombuffer(frame, np.uint8)[-3::-1]
    crc = np.bitwise_xor.reduce(_crc_shares()[np.arange(values.size), values])
    return int(crc) ^ (frame[-2] | frame[-1] << 8)


# --- contents ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MeasuringMode:
    """How a word of a scan divides into distance and flags. bits: of the distance.  dazzle_flag: mask, 0 if none."""

    bits: int
    dazzle_flag: int = 0


_FIELDS_MODE = MeasuringMode(13, 0x8000)
MEASURING_MODES = {
    0x00: _FIELDS_MODE,  # 8 m or 80 m; field A, field B, dazzle
    0x01: MeasuringMode(13),  # reflector bits
    0x02: MeasuringMode(13),  # fields A, B, C
    0x03: MeasuringMode(14),  # 16 m, reflector
    0x04: MeasuringMode(14),  # 16 m, fields A, B
    0x05: MeasuringMode(15),  # 32 m, reflector
    0x06: MeasuringMode(15),  # 32 m, field A
    0x0F: MeasuringMode(15),  # 32 m
}


@dataclass(frozen=True, slots=True)
class Values:
    """A B0 telegram. words: (N,) as sent.  partial: which part of an interlaced scan it is, None if it is whole."""

    words: NDArray[np.uint16]
    unit_mm: int
    partial: int | None
    status: int


def decode_values(payload: bytes) -> Values:
    """The content of B0. Raises FrameError where it does not fit itself."""
    if len(payload) < 4 or payload[0] != VALUES:
        raise FrameError("bad_length")
    (info,) = struct.unpack_from("<H", payload, 1)
    count = info & _COUNT_BITS
    if len(payload) - 2 * count not in (4, 6):
        raise FrameError("bad_length", f"{count} values in {len(payload)} bytes")
    unit = info >> 14
    if unit > 1:
        raise FrameError("bad_unit", str(unit))
    words = np.frombuffer(payload, "<u2", count, 3)
    partial = info >> 11 & 3 if info & 0x2000 else None
    return Values(words, 1 if unit else 10, partial, payload[-1])


def ranges_of(values: Values, mode: MeasuringMode) -> F64:
    """(N,) metres by the rule of drivers.readings.

    The nine highest codes are no distances: beyond maximum is +inf, all others (invalid, dazzled, overflow, too little
    signal, channel fault, and codes without a name) are unknown. Dazzled beams are unknown, whatever they measured.
    """
    distance = values.words & (1 << mode.bits) - 1
    beyond = (1 << mode.bits) - 9  # 1FF7h of 13 bits
    range_m = distance * (values.unit_mm / 1000.0)
    range_m[distance > beyond] = math.nan
    range_m[distance == beyond] = math.inf
    range_m[distance == 0] = -math.inf
    if mode.dazzle_flag:
        range_m[(values.words & mode.dazzle_flag) != 0] = math.nan
    return np.asarray(range_m, dtype=np.float64)


def range_max_m(unit_mm: int, mode: MeasuringMode) -> float:
    """The largest distance that can be told."""
    return ((1 << mode.bits) - 10) * unit_mm / 1000.0


@dataclass(frozen=True, slots=True)
class ScannerStatus:
    """What a B1 telegram says."""

    software: str
    defective: bool
    field_deg: int
    resolution_cdeg: int


def decode_status(payload: bytes) -> ScannerStatus:
    """The content of B1 (offsets from the byte behind B1). Raises FrameError if it is too short."""
    data = payload[1:-1]
    if len(data) < 122:
        raise FrameError("bad_length", f"status of {len(data)} bytes")
    field_deg, resolution = struct.unpack_from("<HH", data, 106)
    return ScannerStatus(_text(data[:7]), data[8] != 0, field_deg, resolution)


def decode_type(payload: bytes) -> tuple[str, str]:
    """Model and firmware from BA or 90: `LMS200;301063;V02.10 `."""
    fields = _text(payload[1:-1]).split(";")
    version = next((each for each in fields[1:] if each[:1] in ("V", "X") or "." in each), "")
    return fields[0].strip(), version.strip()


def trouble_of_status(status: int) -> str | None:
    """What the status byte of a telegram asks for, or None. Bits: 0-2 severity, 6 implausible values, 7 pollution."""
    if status & 0x80:
        return f"its front window is dirty (status {status:02X}h): clean it, or it will go blind"
    if status & 0x07 >= 3:
        grave = "fatal error" if status & 0x07 == 4 else "error"
        return f"reports a {grave} (status {status:02X}h): power it off and on; if it stays, it needs service"
    if status & 0x40:
        return f"says that its values are implausible (status {status:02X}h): is it dazzled, or another laser in sight?"
    return None


def _text(data: bytes) -> str:
    return "".join(chr(each) for each in data if 0x20 <= each < 0x7F).strip()
