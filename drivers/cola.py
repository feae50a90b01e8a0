"""CoLa binary telegrams of SICK scanners (TiM, LMS1xx and relatives): framing and the scan's layout. Pure.

    02 02 02 02, u32 length of the payload, payload, one byte: xor of the payload

    payload     s?? name, a space, values     big-endian
                sRN read, sWN write, sMN call, sEN subscribe; answers sRA, sWA, sAN, sEA; sSN event; sFA error

    LMDscandata
        u16 version, u16 device, u32 serial number, u16 status
        u16 count of telegrams, u16 count of scans, u32 time of the scan us, u32 time of sending us (since power-on)
        u16 inputs, u16 outputs, u16 layer, u32 scan frequency 1/100 Hz, u32 measuring frequency 100 Hz
        u16 encoders, for each: u32 position, u16 speed
        u16 channels of 16 bits, for each: 5 letters, f32 scale, f32 offset, i32 first angle and u16 step in 1/10000
            degree, u16 values, the values
        u16 channels of 8 bits, alike
        u16 position (1: six f32 and a byte), u16 name and u16 comment (1: u8 length and text), u16 time (1: u16 year,
            month, day, hour, minute, second as u8, u32 us), u16 event

Source: SICK Telegram Listing Ranging Sensors (8014631), LMS4000 operating instructions (8023198) p. 53-56; the layout
was checked on a recorded TiM.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass

import numpy as np

from drivers.errors import FrameError
from drivers.readings import F64, SourceCounters

STX = b"\x02\x02\x02\x02"
MAX_PAYLOAD = 60_000
_KIND = re.compile(rb"s[A-Z][A-Z]")
_NAMED = re.compile(rb"s[A-Z][A-Z]( [A-Za-z][A-Za-z0-9]*( |$)|$)|sFA")
_FIXED = struct.Struct(">HHIHHHIIHHHIIH")
_CHANNEL = struct.Struct(">5sffiHH")
SCAN_HEADS = (b"sSN LMDscandata ", b"sRA LMDscandata ")


def encode_telegram(payload: bytes) -> bytes:
    """A telegram around a payload such as `sRN DeviceIdent`."""
    return STX + struct.pack(">I", len(payload)) + payload + bytes([_sum(payload)])


@dataclass(frozen=True, slots=True)
class Telegram:
    """A payload and the stamp of the chunk with its last byte. scan: what it holds, if it is LMDscandata."""

    payload: bytes
    arrived_ns: int
    scan: ScanData | None = None


class TelegramReader:
    """Whole telegrams from chunks. What does not fit is looked at again from its second byte.

    A telegram that has begun does not hold up a whole one behind its begin: then it was none, or was cut. A scan whose
    layout is odd although its sum is right does not swallow what lies in it: the sum has 8 bits only.
    """

    def __init__(self, counters: SourceCounters | None = None) -> None:
        self._counters = counters or SourceCounters()
        self._buffer = bytearray()

    def clear(self) -> None:
        """Forget a telegram that has only begun."""
        self._buffer.clear()

    def feed(self, chunk: bytes, stamp_ns: int) -> list[Telegram]:
        """Telegrams that this chunk completes."""
        self._buffer += chunk
        data = bytes(self._buffer)
        found: list[Telegram] = []
        at = 0
        while True:
            begin = _find_start(data, at)
            self._count_noise(begin - at)
            at = begin
            size = _size_at(data, at)
            if size is None or at + size > len(data):
                whole = _whole_behind(data, at)
                if whole is None:
                    break
                self._count_noise(whole - at)
                at = whole
                continue
            payload = data[at + 8 : at + size - 1]
            if size == 0 or _sum(payload) != data[at + size - 1]:
                self._counters.drop("bad_sum" if size else "noise_bytes")
                at += 1
                continue
            try:
                if _NAMED.match(payload) is None:
                    raise FrameError("bad_layout")
                scan = decode_scan(payload) if payload.startswith(SCAN_HEADS) else None
            except FrameError as error:
                self._counters.drop(error.reason)
                at += 1
                continue
            found.append(Telegram(payload, stamp_ns, scan))
            at += 1 if scan is not None and scan.tail_is_odd else size
        del self._buffer[:at]
        return found

    def _count_noise(self, size: int) -> None:
        if size > 0:
            self._counters.drop("noise_bytes", size)


def _find_start(data: bytes, at: int) -> int:
    begin = data.find(STX, at)
    if begin >= 0:
        return begin
    kept = len(data) - len(data.rstrip(STX[:1]))
    return max(at, len(data) - min(kept, len(STX) - 1))


def _size_at(data: bytes, at: int) -> int | None:
    """Size of the telegram that begins here, 0 if none can, None if more bytes must tell."""
    if len(data) - at < 11:
        return None
    length = int.from_bytes(data[at + 4 : at + 8], "big")
    if not 4 <= length <= MAX_PAYLOAD or _KIND.match(data, at + 8) is None:
        return 0
    return length + 9


def _whole_behind(data: bytes, at: int) -> int | None:
    """Where a whole telegram begins behind this place, if there is one."""
    while (at := data.find(STX, at + 1)) >= 0:
        size = _size_at(data, at)
        if size and at + size <= len(data) and _sum(data[at + 8 : at + size - 1]) == data[at + size - 1]:
            return at
    return None


def _sum(payload: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(payload, np.uint8))) if payload else 0


# --- the scan ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of values. name: DIST1, RSSI1, ...  first_deg, step_deg: as sent.  scaled: (N,) raw * scale + offset."""

    name: str
    raw: F64
    scaled: F64
    first_deg: float
    step_deg: float


@dataclass(frozen=True, slots=True)
class ScanData:
    """A decoded LMDscandata. Times: us since power-on, 32 bits.  tail_is_odd: what follows the channels is unusual."""

    serial: int
    status: int
    telegram_count: int
    scan_count: int
    scan_us: int
    sent_us: int
    scans_per_s: float
    beams_per_s: float
    channels: dict[str, Channel]
    tail_is_odd: bool


def decode_scan(payload: bytes) -> ScanData:
    """The values of `sSN LMDscandata`. Raises FrameError where they do not fit themselves."""
    data = payload[len(SCAN_HEADS[0]) :]
    try:
        fixed = _FIXED.unpack_from(data)
        _, _, serial, status, telegrams, scans, scan_us, sent_us, _, _, _, frequency, beams, encoders = fixed
        at = _FIXED.size
        if encoders > 3 or frequency == 0:
            raise FrameError("bad_layout", f"{encoders} encoders, {frequency / 100} Hz")
        at += 6 * encoders
        channels, at = _channels(data, at, 2)
        bytes_channels, at = _channels(data, at, 1)
    except struct.error as error:
        raise FrameError("bad_layout", str(error)) from error
    return ScanData(
        serial,
        status,
        telegrams,
        scans,
        scan_us,
        sent_us,
        frequency / 100.0,
        beams * 100.0,
        bytes_channels | channels,
        not _tail_fits(data, at),
    )


def _channels(data: bytes, at: int, width: int) -> tuple[dict[str, Channel], int]:
    (count,) = struct.unpack_from(">H", data, at)
    at += 2
    if count > 10:
        raise FrameError("bad_layout", f"{count} channels")
    found: dict[str, Channel] = {}
    for _ in range(count):
        name, scale, offset, first, step, values = _CHANNEL.unpack_from(data, at)
        at += _CHANNEL.size
        if not (name.isalnum() and math.isfinite(scale) and math.isfinite(offset)) or scale <= 0.0 or step == 0:
            raise FrameError("bad_layout", repr(name))
        if at + width * values > len(data):
            raise FrameError("bad_layout", f"{values} values")
        raw = np.frombuffer(data, ">u2" if width == 2 else "u1", values, at).astype(np.float64)
        at += width * values
        found[name.decode()] = Channel(name.decode(), raw, raw * scale + offset, first / 1e4, step / 1e4)
    return found, at


def _tail_fits(data: bytes, at: int) -> bool:
    """Whether position, name, comment, time and event are as described, up to the last byte."""
    try:
        for takes in (_position_size, _text_size, _text_size, _time_size):
            (given,) = struct.unpack_from(">H", data, at)
            at += 2
            if given > 1:
                return False
            at += takes(data, at) if given else 0
        (event,) = struct.unpack_from(">H", data, at)
    except (struct.error, IndexError, FrameError):
        return False
    return event <= 1 and (event == 1 or at + 2 == len(data))


def _position_size(_data: bytes, _at: int) -> int:
    return 25


def _text_size(data: bytes, at: int) -> int:
    return 1 + data[at]


def _time_size(data: bytes, at: int) -> int:
    _, month, day, hour, minute, second, us = struct.unpack_from(">HBBBBBI", data, at)
    if not (month <= 12 and day <= 31 and hour < 24 and minute < 60 and second <= 60 and us < 1_000_000):
        raise FrameError("bad_time")
    return 11


def exact_step_deg(step_deg: float) -> float:
    """A step as the scanner makes it: thirds and sixths of a degree are sent rounded or cut to four places."""
    twelfths = round(step_deg * 12.0)
    return twelfths / 12.0 if twelfths and abs(step_deg - twelfths / 12.0) < 1.01e-4 else step_deg


def decode_identity(payload: bytes) -> tuple[str, str]:
    """Name and version from `sRA DeviceIdent`: two texts, each with its length before it."""
    data = payload.partition(b"DeviceIdent ")[2]
    texts: list[str] = []
    for _ in range(2):
        if len(data) < 2:
            break
        length = int.from_bytes(data[:2], "big")
        texts.append(data[2 : 2 + length].decode("ascii", "replace").strip(" \0"))
        data = data[2 + length :]
    return (texts + ["", ""])[0], (texts + ["", ""])[1]


def trouble_of_status(status: int) -> str | None:
    """What the status word asks for, or None: 1 error, 2 and 4 pollution (warning, error)."""
    if status & 0x01:
        return f"reports an error (status {status:04X}h): power it off and on; if it stays, it needs service"
    if status & 0x06:
        return f"its front window is dirty (status {status:04X}h): clean it, or it will go blind"
    return None
