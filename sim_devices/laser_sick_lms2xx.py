"""SICK LMS200, 211, 221 and 291 scanners on their serial line: the device's side.

Source: SICK "Telegram Listing LMS2xx" (8007954); offsets of the status telegram as sicktoolbox reads them.

    host    02 addr  len len  command data...          crc crc     numbers little-endian; addr 00 or the device's own
    device  06 (accepted) or 15 (not), then
            02 80+addr  len len  command+80h data...  status  crc crc

What this emulator does that a naive one would not:
- It powers up at 9600 baud and tells so by an unsolicited 90h. What a host sends at another rate is lost; what the
  device sends then reaches the host as noise. A change of rate is confirmed at the old one.
- A host that pauses for more than 6 ms within a telegram has sent nothing; a wrong check code is answered by NAK, and
  what follows within 30 ms of it is lost.
- The mirror turns 75 times a second whether anyone asks or not. A turn gives one beam a degree; finer fields are woven
  from 2 or 4 turns, each beam measured at its own instant. Whenever the line is free the newest complete scan leaves;
  on a slow line most scans are skipped.
- Mode 2Ah sends every turn by itself, with its number in quarter degrees.
- Configuration is written in installation mode only, and slowly. Modes, field, resolution and unit change what follows.
- 13, 14 or 15 bits of distance, by the measuring mode; the top codes are no distances.
- Assumed, the listing being silent here: 14 and 15 bit modes have their codes at the top of their range, and streaming
  goes on with a new field after 3Bh. Not there: reflectivity (measuring mode 3Fh, mode 50h), field evaluation.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.checksums import sick_crc
from sim_devices.device import F64, Mount, Scene
from sim_devices.ranging import Ranger, garbled
from sim_devices.wire import SECOND_NS, PacedWire

I64 = NDArray[np.int64]

STX = 0x02
ACK, NAK = b"\x06", b"\x15"
PASSWORD = b"SICK_LMS"
MAX_PAYLOAD = 812
GAP_NS = 6_000_000
NAK_DEAF_NS = 30_000_000
ACK_NS = 1_000_000
REPLY_NS = 5_000_000
MODE_NS = 40_000_000
POWER_ON_BAUD = 9600
MIRROR_HZ = 75.0

INSTALLATION, STREAM, MONITOR = 0x00, 0x24, 0x25
STREAM_MEAN, STREAM_SUBRANGE, STREAM_PARTIAL = 0x26, 0x27, 0x2A
STREAMS = frozenset((STREAM, STREAM_MEAN, STREAM_SUBRANGE, STREAM_PARTIAL))
RATES = {0x42: 9600, 0x41: 19200, 0x40: 38400, 0x48: 500000}
BAUD_WORDS = {9600: 0x8067, 19200: 0x8033, 38400: 0x8019, 500000: 0x8001}
VARIANTS = frozenset(((100, 100), (100, 50), (100, 25), (180, 100), (180, 50)))  # degrees, hundredths of a degree
DISTANCE_BITS = {0x00: 13, 0x01: 13, 0x02: 13, 0x03: 14, 0x04: 14, 0x05: 15, 0x06: 15, 0x0F: 15}
CONFIG_SIZE = 34
AVAILABILITY, MEASURING_MODE, UNIT = 4, 5, 6  # places in the configuration
REAL_TIME_INDICES = 0x02
DONE, WRONG_PASSWORD, NOT_POSSIBLE = 0, 1, 2

# below the top of the distance bits
INVALID, DAZZLED, CHANNEL_FAULT, BEYOND = 0, 1, 5, 8
DAZZLE_FLAG = 0x8000  # in 13-bit words: field A, field B, dazzle

HEALTHY = 0x10
WARNING, ERROR = 2, 3
POLLUTED = 0x80


@dataclass(frozen=True, slots=True)
class Lms2xxProfile:
    """What one model says of itself and how far it sees."""

    type_text: str
    software: str  # 7 characters
    boot_software: str
    field_deg: int
    resolution: int  # hundredths of a degree
    unit_mm: bool
    range_max_m: float = 80.0


LMS200 = Lms2xxProfile("LMS200;301063;V02.10 ", "V02.10 ", "V01.50 ", 180, 50, unit_mm=True)
LMS211 = Lms2xxProfile("LMS211;30206 ;V02.00 ", "V02.00 ", "V01.30 ", 100, 50, unit_mm=False)
LMS221 = Lms2xxProfile("LMS221;30206 ;V02.00 ", "V02.00 ", "V01.30 ", 180, 50, unit_mm=False)
LMS291 = Lms2xxProfile("LMS291;S05   ;V03.04 ", "V03.04 ", "V01.60 ", 180, 50, unit_mm=False)
LMS2XX_PROFILES = {"lms200": LMS200, "lms211": LMS211, "lms221": LMS221, "lms291": LMS291}


@dataclass(frozen=True, slots=True)
class _Sweep:
    """One scan or one turn of it: when it begins, and its beams.

    turns: which mirror turn of the sweep each beam belongs to.
    """

    begin_ns: int
    angle_deg: F64
    turns: I64
    partial: int | None = None  # quarter degrees, of a single turn


class SickLms2xxLaser:
    """One scanner on its line. See the module's text for its habits.

    profile: a model of LMS2XX_PROFILES.  boot_s: from power-on, or a reset, to the telegram that tells so.
    config_write_s: how long a configuration takes to be stored (up to 7 s on real ones).  address: 0 to 127.
    noise_scale: 0 for exact ranges.  dazzle: share of beams that give the dazzled code.  pollution: of the front
    window; from 0.5 on warned of, from 1.0 on an error.  The first step is power-on.
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount | None = None,
        *,
        profile: Lms2xxProfile = LMS200,
        address: int = 0,
        seed: int = 0,
        boot_s: float = 1.0,
        config_write_s: float = 0.15,
        noise_scale: float = 1.0,
        dazzle: float = 0.0,
        pollution: float = 0.0,
    ) -> None:
        self.profile = profile
        self.dazzle = dazzle
        self.pollution = pollution
        self.skipped_scans = 0
        self._random = np.random.default_rng(seed)
        self._ranger = Ranger(
            scene, mount or Mount(), self._random, profile.range_max_m, 0.005, noise_scale=noise_scale
        )
        self._address = address
        self._boot_ns = round(boot_s * SECOND_NS)
        self._write_ns = round(config_write_s * SECOND_NS)
        self._config = bytearray(CONFIG_SIZE)
        self._config[2:4] = bytes((0x46, 0x00)) if profile.type_text.startswith("LMS200") else bytes(2)
        self._config[UNIT] = profile.unit_mm
        self._field_deg, self._resolution = profile.field_deg, profile.resolution
        self._trouble = False
        self._speed_share = 1.0
        self._handlers: dict[int, Callable[[bytes, int], None]] = {
            0x10: self._reset,
            0x20: self._change_mode,
            0x30: self._one_scan,
            0x31: self._status,
            0x32: self._errors,
            0x3A: self._type,
            0x3B: self._variant,
            0x74: self._read_config,
            0x77: self._write_config,
        }
        self.power_on(0)
        self._powered = False  # until the first step tells the time

    # -- what the wire and the tests see ------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then. baud: the host's line speed, if known."""
        if not self._powered:
            self.power_on(now_ns)
        if now_ns < self._boot_done_ns:
            return b""
        if not self._announced:
            self._announce()
        fits = baud is None or baud == self._wire.rate_bps
        self._finish_scans(now_ns)
        if fits and received and not self._rebooting and now_ns >= self._deaf_until_ns:
            self._take(received, now_ns)
        out = self._wire.leave_by(now_ns)
        if self._rebooting and self._wire.is_empty:
            self.power_on(now_ns)
        return out if fits else garbled(out, self._random)

    @property
    def next_ns(self) -> int | None:
        """When something is due next; None while it only waits for its host."""
        if not self._powered:
            return None
        if not self._announced:
            return self._boot_done_ns
        due = [self._next_send_ns] if self._wants_scans else []
        if (leaving_ns := self._wire.next_ns) is not None:
            due.append(leaving_ns)
        return min(due, default=None)

    @property
    def line_rate_bps(self) -> int:
        """The rate the line runs at now."""
        return self._wire.rate_bps

    @property
    def is_streaming(self) -> bool:
        """Whether scans leave unasked."""
        return self._mode in STREAMS

    def power_on(self, now_ns: int) -> None:
        """Start as after the supply came back: deaf for boot_s, at 9600 baud; the configuration was kept."""
        self._powered = True
        self._boot_done_ns = now_ns + self._boot_ns
        self._announced: bool = False
        self._rebooting: bool = False
        self._wire: PacedWire = PacedWire(POWER_ON_BAUD, now_ns)
        self._buffer = bytearray()
        self._heard_ns = now_ns
        self._deaf_until_ns: int = now_ns
        self._mode = MONITOR
        self._mode_bytes = b""
        self._asked: bytes | None = None  # of a single scan
        self._mean: list[I64] = []
        self._turn_zero_ns = self._boot_done_ns
        self._turn_ns = round(SECOND_NS / (MIRROR_HZ * self._speed_share))
        self._next_turn = 0
        self._sent_scans = 0

    def set_speed_share(self, share: float, now_ns: int) -> None:
        """Let the mirror turn at this share of its speed; the turn under way begins anew."""
        self._speed_share = share
        self._turn_zero_ns = max(self._turn_zero_ns, now_ns)
        self._turn_ns = round(SECOND_NS / (MIRROR_HZ * share))
        self._next_turn = 0

    def trouble(self, status: str | None, now_ns: int) -> None:
        """A fault of the receiver: all beams give the channel fault code, the status byte an error. None: well."""
        self._trouble = status is not None

    # -- the line -----------------------------------------------------------------------------------------------------

    def _take(self, received: bytes, now_ns: int) -> None:
        if self._buffer and now_ns - self._heard_ns > GAP_NS:
            self._buffer.clear()
        self._heard_ns = now_ns
        self._buffer += received
        while (payload := self._next_telegram(now_ns)) is not None:
            if payload and not self._rebooting:
                self._obey(payload, now_ns)

    def _next_telegram(self, now_ns: int) -> bytes | None:
        """The next whole telegram's payload, empty if it was for another; None if there is none yet."""
        while (start := self._buffer.find(STX)) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 4:
                return None
            address, length = self._buffer[1], int.from_bytes(self._buffer[2:4], "little")
            mine = address in (0, self._address)
            if 1 <= length <= MAX_PAYLOAD and address < 0x80:
                if len(self._buffer) < length + 6:
                    return None
                frame = bytes(self._buffer[: length + 6])
                if sick_crc(frame[:-2]) == int.from_bytes(frame[-2:], "little"):
                    del self._buffer[: length + 6]
                    return frame[4:-2] if mine else b""
            if mine:
                self._refuse(now_ns)
                return None
            del self._buffer[0]
        self._buffer.clear()
        return None

    def _refuse(self, now_ns: int) -> None:
        """NAK, and nothing is heard for a while."""
        self._buffer.clear()
        self._deaf_until_ns = now_ns + NAK_DEAF_NS
        self._wire.send(NAK, now_ns + ACK_NS)

    def _obey(self, payload: bytes, now_ns: int) -> None:
        self._wire.send(ACK, now_ns + ACK_NS)
        handler = self._handlers.get(payload[0])
        if handler is None:
            self._tell(0x92, b"", now_ns + REPLY_NS)
        else:
            handler(payload[1:], now_ns)

    def _announce(self) -> None:
        self._announced = True
        self._tell(0x90, self.profile.type_text.encode("ascii"), self._boot_done_ns)

    def _tell(self, command: int, data: bytes, ready_ns: int, rate_after_bps: int | None = None) -> None:
        payload = bytes((command,)) + data + bytes((self._status_byte,))
        head = bytes((STX, 0x80 | self._address)) + len(payload).to_bytes(2, "little")
        self._wire.send(
            head + payload + sick_crc(head + payload).to_bytes(2, "little"), ready_ns, rate_after_bps=rate_after_bps
        )

    @property
    def _status_byte(self) -> int:
        if self._trouble or self.pollution >= 1.0:
            return HEALTHY | ERROR | (POLLUTED if self.pollution >= 1.0 else 0)
        return HEALTHY | WARNING | POLLUTED if self.pollution >= 0.5 else HEALTHY

    # -- commands -----------------------------------------------------------------------------------------------------

    def _reset(self, data: bytes, now_ns: int) -> None:
        self._mode, self._asked = MONITOR, None
        self._tell(0x91, b"", now_ns + REPLY_NS)
        self._rebooting = True

    def _type(self, data: bytes, now_ns: int) -> None:
        self._tell(0xBA, self.profile.type_text.encode("ascii"), now_ns + REPLY_NS)

    def _errors(self, data: bytes, now_ns: int) -> None:
        """Pairs of kind and number of what is wrong."""
        found = bytes((ERROR, 1)) if self._trouble else b""
        if self.pollution >= 0.5:
            found += bytes((ERROR if self.pollution >= 1.0 else WARNING, 2))
        self._tell(0xB2, found, now_ns + REPLY_NS)

    def _status(self, data: bytes, now_ns: int) -> None:
        told = bytearray(152)
        told[0:7] = self.profile.software.encode("ascii")
        told[7] = self._mode
        told[8] = self._trouble or self.pollution >= 1.0
        told[17] = 1 if self._field_deg == 100 else 0
        clean = 200
        struct.pack_into("<8H4H", told, 18, *[round(clean * max(0.0, 1.0 - 0.5 * self.pollution))] * 8, *[clean] * 4)
        struct.pack_into("<8H4H", told, 42, *[clean] * 12)
        struct.pack_into("<H", told, 66, round(SECOND_NS / self._turn_ns * 60))
        told[101] = self._config[MEASURING_MODE]
        struct.pack_into("<HH", told, 106, self._field_deg, self._resolution)
        struct.pack_into("<H", told, 115, BAUD_WORDS[self._wire.rate_bps])
        told[119] = self._address
        told[121] = self._config[UNIT]
        told[123:130] = self.profile.boot_software.encode("ascii")
        self._tell(0xB1, bytes(told), now_ns + REPLY_NS)

    def _read_config(self, data: bytes, now_ns: int) -> None:
        self._tell(0xF4, bytes(self._config), now_ns + REPLY_NS)

    def _write_config(self, data: bytes, now_ns: int) -> None:
        """Older hosts write 32 bytes, or 7, up to the unit (Player's sicklms200); what they leave out stays."""
        possible = self._mode == INSTALLATION and UNIT < len(data) <= CONFIG_SIZE + 1
        possible = possible and data[MEASURING_MODE] in DISTANCE_BITS and data[UNIT] in (0, 1)
        if possible:
            self._config[: len(data)] = data[:CONFIG_SIZE]
        self._tell(0xF7, bytes((possible,)) + bytes(self._config), now_ns + (self._write_ns if possible else REPLY_NS))

    def _variant(self, data: bytes, now_ns: int) -> None:
        wanted = struct.unpack("<HH", data) if len(data) == 4 else (0, 0)
        possible = wanted in VARIANTS
        if possible:
            self._field_deg, self._resolution = wanted
            self._begin_scans(now_ns)
        told = struct.pack("<BHH", possible, self._field_deg, self._resolution)
        self._tell(0xBB, told, now_ns + MODE_NS)

    def _change_mode(self, data: bytes, now_ns: int) -> None:
        mode, more = (data[0], data[1:]) if data else (None, b"")
        if mode in RATES:
            self._tell(0xA0, bytes((DONE,)), now_ns + MODE_NS, RATES[mode])
            return
        result = self._possible(mode, more)
        if mode is not None and result == DONE:
            self._mode, self._mode_bytes, self._asked = mode, more, None
            self._begin_scans(now_ns + MODE_NS)
        self._tell(0xA0, bytes((result,)), now_ns + MODE_NS)

    def _possible(self, mode: int | None, more: bytes) -> int:
        """Result code of a change to a mode."""
        if mode == INSTALLATION:
            return DONE if more == PASSWORD else WRONG_PASSWORD
        if mode in (MONITOR, STREAM, STREAM_PARTIAL):
            return DONE
        if mode == STREAM_MEAN and len(more) == 1 and more[0] >= 2:
            return DONE
        return DONE if mode == STREAM_SUBRANGE and self._subrange(more) is not None else NOT_POSSIBLE

    def _one_scan(self, data: bytes, now_ns: int) -> None:
        """30h: what a stream would send, once."""
        kind, more = data[:1], data[1:]
        fits = kind == b"\1" or (kind == b"\2" and len(more) == 1 and more[0] >= 2)
        fits = fits or (kind == b"\3" and self._subrange(more) is not None)
        if not fits or self.is_streaming:
            self._tell(0x92, b"", now_ns + REPLY_NS)
            return
        self._asked = data
        self._begin_scans(now_ns)

    def _subrange(self, more: bytes) -> tuple[int, int] | None:
        """First and last value that a host wants, counted from 1."""
        if len(more) != 4:
            return None
        first, last = struct.unpack("<HH", more)
        return (first, last) if 1 <= first <= last <= self._count else None

    # -- measuring ----------------------------------------------------------------------------------------------------

    @property
    def _count(self) -> int:
        return self._field_deg * 100 // self._resolution + 1

    @property
    def _turns_a_scan(self) -> int:
        return 1 if self._mode == STREAM_PARTIAL else 100 // self._resolution

    @property
    def _wants_scans(self) -> bool:
        return self.is_streaming or self._asked is not None

    def _begin_scans(self, now_ns: int) -> None:
        """The next scan begins with the first turn from now on."""
        self._mean = []
        self._next_turn = max(0, -((self._turn_zero_ns - now_ns) // self._turn_ns))

    def _sweep(self, turn: int) -> _Sweep:
        """The scan that begins with a turn; in mode 2Ah that turn alone."""
        index: I64 = np.arange(self._count, dtype=np.int64)
        weave = 100 // self._resolution
        partial = None
        if self._mode == STREAM_PARTIAL:
            index = index[turn % weave :: weave]
            partial = turn % weave * self._resolution // 25
        angle_deg = (180 - self._field_deg) / 2.0 + index.astype(np.float64) * (self._resolution * 0.01)
        turns = index % weave if partial is None else np.zeros_like(index)
        return _Sweep(self._turn_zero_ns + turn * self._turn_ns, angle_deg, turns, partial)

    def _done_ns(self, turn: int) -> int:
        """When the scan that begins with a turn has measured its last beam."""
        return self._turn_zero_ns + (turn + self._turns_a_scan - 1) * self._turn_ns + self._turn_ns // 2

    def _finish_scans(self, now_ns: int) -> None:
        """Send the newest complete scan whenever the line is free; older ones are skipped."""
        while self._wants_scans and (begin_ns := self._next_send_ns) <= now_ns:
            scan_ns = self._turns_a_scan * self._turn_ns
            skipped = (begin_ns - self._done_ns(self._next_turn)) // scan_ns
            self.skipped_scans += skipped
            self._next_turn += skipped * self._turns_a_scan
            self._send_scan(self._sweep(self._next_turn), begin_ns)
            self._next_turn += self._turns_a_scan

    @property
    def _next_send_ns(self) -> int:
        return max(self._done_ns(self._next_turn), self._wire.free_ns)

    def _send_scan(self, sweep: _Sweep, ready_ns: int) -> None:
        words = self._measure(sweep)
        kind, more = self._wanted()
        info = (self._config[UNIT] << 14) | (0 if sweep.partial is None else 0x2000 | sweep.partial << 11)
        match kind:
            case 2:
                self._mean.append(words)
                if len(self._mean) < more[0]:
                    return
                words, self._mean = self._averaged(self._mean), []
                command, head = 0xB6, more[:1]
            case 3:
                first, last = struct.unpack("<HH", more)
                words = words[first - 1 : last]
                command, head = 0xB7, more
            case _:
                command, head = 0xB0, b""
        data = head + struct.pack("<H", info | len(words)) + words.astype("<u2").tobytes()
        self._asked = None
        self._tell(command, data + self._indices(), ready_ns)
        self._sent_scans += 1

    def _wanted(self) -> tuple[int, bytes]:
        """What is to be sent of a scan, in the numbers of command 30h, and its parameters."""
        if self._asked is not None:
            return self._asked[0], self._asked[1:]
        return {STREAM_MEAN: 2, STREAM_SUBRANGE: 3}.get(self._mode, 1), self._mode_bytes

    def _indices(self) -> bytes:
        if not self._config[AVAILABILITY] & REAL_TIME_INDICES:
            return b""
        return bytes((self._next_turn & 0xFF, self._sent_scans & 0xFF))

    def _averaged(self, scans: list[I64]) -> I64:
        """Mean of scans; a beam that is no distance in one of them keeps its newest code."""
        stack = np.array(scans)
        distances = (stack < self._top - BEYOND).all(axis=0)
        mean: I64 = np.where(distances, np.rint(stack.mean(axis=0)).astype(np.int64), stack[-1])
        return mean

    @property
    def _top(self) -> int:
        """The highest word without flags: all distance bits set."""
        return (1 << DISTANCE_BITS[self._config[MEASURING_MODE]]) - 1

    def _measure(self, sweep: _Sweep) -> I64:
        """Words (N,) of one sweep."""
        stamp_ns: F64 = sweep.begin_ns + (sweep.turns + sweep.angle_deg / 360.0) * self._turn_ns
        range_m = self._ranger.measure(np.radians(sweep.angle_deg - 90.0), stamp_ns)
        a_metre = 1000.0 if self._config[UNIT] else 100.0
        with np.errstate(invalid="ignore"):
            count: F64 = np.rint(np.clip(np.nan_to_num(range_m, posinf=1e6, neginf=0.0), 0.0, 1e6) * a_metre)
        words: I64 = np.minimum(count.astype(np.int64), self._top - BEYOND)
        words[np.isnan(range_m) | (range_m < 0.0)] = self._top - INVALID
        if self.dazzle:
            flag = DAZZLE_FLAG if self._top == 0x1FFF else 0
            words[self._random.random(len(words)) < self.dazzle] = (self._top - DAZZLED) | flag
        if self._trouble:
            words[:] = self._top - CHANNEL_FAULT
        return words
