"""SICK TiM5xx and LMS1xx on TCP, speaking CoLa: the device's side.

Sources: SICK "Telegram Listing Ranging sensors LMS1xx, LMS5xx, TiM2xx, TiM5xx, TiM7xx, ..." (8014631); the layout of
scans agrees with recorded ones of a TiM.

    CoLa B   02 02 02 02  length (4, big-endian)  payload  xor of the payload
    CoLa A   02  payload as text  03

A payload is a command of three letters, a name and parameters: sRN/sRA read, sWN/sWA write, sMN/sAN call, sEN/sEA ask
for events, sSN event, sFA failure. Parameters are big-endian numbers in B, hexadecimal words (or decimal ones with a
sign) in A; texts carry their length.

What this emulator does that a naive one would not:
- Both dialects are understood at any time; each request is answered in its own, scans come in that of their request.
- Writing, starting and stopping need the password of a user level; Run takes the level back.
- Scans are measured beam by beam as the mirror turns, at fixed instants, and come when the last beam is measured; a
  scan that is complete while the line is still busy is skipped. Counters count all scans, sent or not.
- Scans have the channels, the range of angles and the rate that were configured; a device in trouble says so in the
  status words of every scan, and has no distances.
- Its 48 monitoring fields are empty and its digital lines rest, so their events never come.
- A telegram is handed to TCP in one piece, as scanners do: hosts that read once for each question rely on that.
- Not yet up to speed: device state busy, no scans. A host that goes away ends its events and its user level.
- Assumed: the time since start-up in a scan is that of its first beam; distances of 0 mean no echo, 1 blinded, 2 too
  close; real units take only the dialect they are set to.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.device import F64, Mount, Scene
from sim_devices.ranging import Ranger
from sim_devices.wire import SECOND_NS, PacedWire

I64 = NDArray[np.int64]

COLA_TCP_PORTS = (2111, 2112)
TCP_RATE_BPS = 100_000_000
REPLY_NS = 2_000_000
MAX_TELEGRAM = 65536
PASSWORDS = {2: 0xB21ACE26, 3: 0xF4724744, 4: 0x81BE23AA}  # maintenance, authorised client, service
MAY_WRITE = 2
TEN_THOUSANDTHS = 10_000  # angles are in 1/10000 degree
ACCESS_DENIED, UNKNOWN_METHOD, UNKNOWN_VARIABLE, INVALID_DATA = 1, 2, 3, 5
WRITE_DENIED, UNKNOWN_COMMAND, UNKNOWN_EVENT = 0x0A, 0x0C, 0x0F
NO_ECHO, BLINDED, TOO_CLOSE = 0, 1, 2
BUSY, READY, FAULTY = 0, 1, 2
SCAN_CONFIG = "B" * 11 + "H"
INPUTS, OUTPUTS = 4, 3  # digital lines
FIELDS = 48
_FIELD = re.compile(r"field(\d{3})")
QUIET_EVENTS = frozenset(("LFErec", "LIDinputstate", "LIDoutputstate"))  # told when something changes: never here
SIMPLE_VARIABLES = frozenset(
    (
        "ActiveFieldSet", "EIHstCola", "EIIpAddr", "FieldSetSelectionMethod", "GlareDetectionSens",
        "FREchoFilter", "LFPmeanfilter", "LFPmedianfilter", "LFPparticle", "LICencres",
        "LICencset", "LICsrc", "LocationName", "SetActiveApplications",
        "TSCRole", "TSCTCInterface", "TSCTCSrvAddr", "TSCTCupdatetime",
    )
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ColaProfile:
    """What one model is and says of itself. Angles in degrees of the device, where 90 looks ahead.

    steps: resolution in 1/10000 degree for each scan rate in 1/100 Hz that it can have; the first is its default.
    scan_config: what scans contain as delivered, the 12 numbers of LMDscandatacfg: channels (2), strength, in 16 bits,
    its unit, encoders (2), position, name, comment, time, every n-th.
    """

    name: str
    firmware: str
    order_number: str
    serial: int
    start_deg: float
    stop_deg: float
    steps: tuple[tuple[int, int], ...]
    range_min_m: float
    range_max_m: float
    scan_config: tuple[int, ...]


TIM571 = ColaProfile(
    "TiM571", "V1.13-22.03.19", "1079742", 18480390, -45.0, 225.0, ((1500, 3333),), 0.05, 25.0,
    (1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 1),
)  # fmt: skip
LMS111 = ColaProfile(
    "LMS111", "V1.36-21.10.2010", "1041114", 10440118, -45.0, 225.0, ((5000, 5000), (2500, 2500)), 0.05, 20.0,
    (1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1),
)  # fmt: skip
COLA_PROFILES = {"tim571": TIM571, "lms111": LMS111}


# -- fields ------------------------------------------------------------------------------------------------------------

Field = tuple[str, int | float | str] | tuple[str, I64]  # its kind and value


def encode_fields(fields: Sequence[Field], *, binary: bool) -> bytes:
    """Parameters in one of the two dialects.

    Kinds: B H I i numbers as in `struct`; f float; s a text with its length; c a text without; b array of bytes,
    h array of 16-bit numbers.
    """
    parts = [_binary(kind, value) if binary else _text(kind, value) for kind, value in fields]
    return (b"" if binary else b" ").join(parts)


def _binary(kind: str, value: int | float | str | I64) -> bytes:
    if isinstance(value, str):
        text = value.encode("ascii")
        return struct.pack(">H", len(text)) + text if kind == "s" else text
    if isinstance(value, np.ndarray):
        return value.astype(">u2" if kind == "h" else np.uint8).tobytes()
    return struct.pack(">" + kind, value)


def _text(kind: str, value: int | float | str | I64) -> bytes:
    if isinstance(value, str):
        return f"{len(value):X} {value}".encode("ascii") if kind == "s" else value.encode("ascii")
    if isinstance(value, np.ndarray):
        return " ".join(f"{int(v):X}" for v in value).encode("ascii")
    if isinstance(value, float):
        return struct.pack(">f", value).hex().upper().encode("ascii")
    return f"{value & 0xFFFFFFFF if value < 0 else value:X}".encode("ascii")


def decode_numbers(kinds: str, parameters: bytes, *, binary: bool) -> tuple[int, ...] | None:
    """Numbers that a host sent, of the kinds B H I i; None if they are not what was expected."""
    if binary:
        try:
            return struct.unpack(">" + kinds, parameters)
        except struct.error:
            return None
    words = parameters.split()
    if len(words) != len(kinds):
        return None
    numbers = [_number(word, kind) for word, kind in zip(words, kinds)]
    return None if None in numbers else tuple(n for n in numbers if n is not None)


def _number(word: bytes, kind: str) -> int | None:
    try:
        value = int(word) if word[:1] in (b"+", b"-") else int(word, 16)
    except ValueError:
        return None
    size = struct.calcsize(">" + kind) * 8
    if kind == "i" and value >= 1 << size - 1:
        value -= 1 << size
    low, high = (-(1 << size - 1), 1 << size - 1) if kind == "i" else (0, 1 << size)
    return value if low <= value < high else None


def frame(payload: bytes, *, binary: bool) -> bytes:
    """A payload as it goes over the line."""
    if not binary:
        return b"\x02" + payload + b"\x03"
    sum_ = 0
    for byte in payload:
        sum_ ^= byte
    return b"\x02\x02\x02\x02" + struct.pack(">I", len(payload)) + payload + bytes((sum_,))


@dataclass(frozen=True, slots=True)
class _Request:
    command: str
    name: str
    parameters: bytes
    binary: bool

    def numbers(self, kinds: str) -> tuple[int, ...] | None:
        return decode_numbers(kinds, self.parameters, binary=self.binary)


class SickColaLaser:
    """One scanner on its TCP line. See the module's text for its habits.

    profile: a model of COLA_PROFILES.  spin_up_s: from power-on to the first scan.  needs_login: False lets anyone
    write.  noise_scale: 0 for exact ranges.  dropout: share of beams without an echo.  clock_drift_ppm: how much too
    fast its clock runs.  The first step is power-on.
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount | None = None,
        *,
        profile: ColaProfile = TIM571,
        serial: int | None = None,
        seed: int = 0,
        spin_up_s: float = 1.0,
        needs_login: bool = True,
        noise_scale: float = 1.0,
        dropout: float = 0.0,
        clock_drift_ppm: float = 0.0,
    ) -> None:
        self.profile = profile
        self.clock_drift_ppm = clock_drift_ppm
        self.skipped_scans = 0
        self._serial = serial if serial is not None else profile.serial
        self._random = np.random.default_rng(seed)
        self._ranger = Ranger(
            scene, mount or Mount(), self._random, profile.range_max_m, 0.01, noise_scale=noise_scale, dropout=dropout
        )
        self._spin_up_ns = round(spin_up_s * SECOND_NS)
        self._needs_login = needs_login
        self._trouble: str | None = None
        self._speed_share = 1.0
        self._starts = 0
        self._variables: dict[tuple[str, bool], bytes] = {}  # by name and dialect
        self._rate, self._step = profile.steps[0]
        self._range = self._whole_range
        self._config = list(profile.scan_config)
        self._methods: dict[str, Callable[[_Request, int], None]] = {
            "SetAccessMode": self._log_in,
            "Run": self._run,
            "LMCstartmeas": self._start_measuring,
            "LMCstopmeas": self._stop_measuring,
            "LMCstandby": self._stop_measuring,
            "mLMPsetscancfg": self._set_scan_config,
            "mEEwriteall": self._write_all,
            "mSCreboot": self._reboot,
        }
        self._power_on(0)
        self._powered = False  # until the first step tells the time

    # -- what the wire and the tests see ------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns what it sends by then."""
        if not self._powered:
            self.power_on(now_ns)
        self._finish_scans(now_ns)
        if received:
            self._take(received, now_ns)
        return self._wire.leave_by(now_ns)

    @property
    def next_ns(self) -> int | None:
        """When something is due next; None while it only waits for its host."""
        due = [self._done_ns(self._next_scan)] if self._powered and self._events is not None else []
        if (leaving_ns := self._wire.next_ns) is not None:
            due.append(leaving_ns)
        return min(due, default=None)

    def power_on(self, now_ns: int) -> None:
        """Start from scratch, as after the supply came back; what was configured is kept."""
        self._starts += 1
        self._power_on(now_ns)

    def _power_on(self, now_ns: int) -> None:
        self._powered = True
        self._wire = PacedWire(TCP_RATE_BPS, now_ns)
        self._buffer = bytearray()
        self._level = 0
        self._measuring = True
        self._events: bool | None = None  # the dialect of a host that wants scans: True for binary
        self._boot_ns = self._clock_zero_ns = now_ns
        self._clock_offset_us = 0
        self._turn_zero_ns = now_ns + self._spin_up_ns
        self._first_number = 0
        self._next_scan = 0
        self._sent = 0

    def link_lost(self, now_ns: int) -> None:
        """The host's connection ended."""
        self._wire.clear(now_ns)
        self._buffer.clear()
        self._events = None
        self._level = 0

    def set_speed_share(self, share: float, now_ns: int) -> None:
        """Let the mirror turn at this share of the speed it should have."""
        self._turn_anew(now_ns)
        self._speed_share = share

    def set_clock_drift(self, ppm: float, now_ns: int) -> None:
        """Let the clock run so much too fast from now on; it does not jump."""
        self._clock_offset_us = self.clock_us(now_ns)
        self._clock_zero_ns = now_ns
        self.clock_drift_ppm = ppm

    def trouble(self, status: str | None, now_ns: int) -> None:
        """Hardware trouble: state and status words say so, and no beam has an echo. None: well again."""
        self._trouble = status

    def clock_us(self, now_ns: int) -> int:
        """The device's own clock: microseconds since it started."""
        elapsed_ns = now_ns - self._clock_zero_ns
        return self._clock_offset_us + round(elapsed_ns * (1.0 + self.clock_drift_ppm * 1e-6)) // 1000

    # -- the line -----------------------------------------------------------------------------------------------------

    def _take(self, received: bytes, now_ns: int) -> None:
        self._buffer += received
        while (request := self._next_request()) is not None:
            self._obey(request, now_ns)

    def _next_request(self) -> _Request | None:
        """The next request in either dialect; what is none is dropped."""
        while (start := self._buffer.find(0x02)) >= 0:
            del self._buffer[:start]
            if self._buffer[:4] == b"\x02\x02\x02\x02"[: len(self._buffer)] and len(self._buffer) != 1:
                if len(self._buffer) < 8:
                    return None
                length = int.from_bytes(self._buffer[4:8], "big")
                if length > MAX_TELEGRAM:
                    del self._buffer[0]
                    continue
                if len(self._buffer) < length + 9:
                    return None
                telegram = bytes(self._buffer[: length + 9])
                if frame(telegram[8:-1], binary=True) == telegram:
                    del self._buffer[: length + 9]
                    return _parsed(telegram[8:-1], binary=True)
                del self._buffer[0]
                continue
            end = next((k for k, byte in enumerate(self._buffer[1:], 1) if not 0x20 <= byte < 0x7F), None)
            if end is None and len(self._buffer) <= MAX_TELEGRAM:
                return None
            if end is not None and self._buffer[end] == 0x03:
                payload = bytes(self._buffer[1:end])
                del self._buffer[: end + 1]
                return _parsed(payload, binary=False)
            del self._buffer[0]  # text is all that may stand there
        self._buffer.clear()
        return None

    def _answer(self, request: _Request, command: str, fields: Sequence[Field], now_ns: int) -> None:
        head = f"{command} {request.name}".encode("ascii")
        body = encode_fields(fields, binary=request.binary)
        gap = b" " if body or request.binary else b""
        self._wire.send(frame(head + gap + body, binary=request.binary), now_ns + REPLY_NS, whole=True)

    def _refuse(self, request: _Request, code: int, now_ns: int) -> None:
        body = b"sFA " + encode_fields([("B", code)], binary=request.binary)
        self._wire.send(frame(body, binary=request.binary), now_ns + REPLY_NS, whole=True)

    def _obey(self, request: _Request, now_ns: int) -> None:
        match request.command:
            case "sRN" | "sRI":
                self._read(request, now_ns)
            case "sWN":
                self._write(request, now_ns)
            case "sMN":
                method = self._methods.get(request.name)
                if method is None:
                    self._refuse(request, UNKNOWN_METHOD, now_ns)
                else:
                    method(request, now_ns)
            case "sEN":
                self._subscribe(request, now_ns)
            case _:
                self._refuse(request, UNKNOWN_COMMAND, now_ns)

    # -- variables ----------------------------------------------------------------------------------------------------

    def _read(self, request: _Request, now_ns: int) -> None:
        if request.name == "LMDscandata":
            self._one_scan(request, now_ns)
            return
        written = self._variables.get((request.name, request.binary))
        if written is not None:
            body = f"sRA {request.name} ".encode("ascii") + written
            self._wire.send(frame(body, binary=request.binary), now_ns + REPLY_NS, whole=True)
            return
        fields = self._variable(request.name, now_ns)
        if fields is None:
            self._refuse(request, UNKNOWN_VARIABLE, now_ns)
        else:
            self._answer(request, "sRA", fields, now_ns)

    def _variable(self, name: str, now_ns: int) -> list[Field] | None:
        told = self.profile
        if (field := _FIELD.fullmatch(name)) is not None and int(field[1]) < FIELDS:
            return _empty_field(int(field[1]))
        hours = (now_ns - self._boot_ns) // (SECOND_NS * 360)  # tenths of an hour
        start, stop = self._range
        known: dict[str, list[Field]] = {
            "0": [("s", told.name), ("s", told.firmware)],
            "DeviceIdent": [("s", told.name), ("s", told.firmware)],
            "DItype": [("s", told.name)],
            "DIornr": [("s", told.order_number)],
            "OrdNum": [("s", told.order_number)],
            "SerialNumber": [("s", f"{self._serial:08d}")],
            "FirmwareVersion": [("s", told.firmware)],
            "LocationName": [("s", "not defined")],
            "SCdevicestate": [("B", self._state(now_ns))],
            "STlms": self._lms_state(now_ns),
            "LCMstate": [("B", 0)],  # the window is clean
            "LSPdatetime": list(zip("HBBBBBI", self._wall_time(now_ns))),
            "ODoprh": [("I", 1234 + hours)],
            "ODpwrc": [("I", self._starts)],
            "LMPscancfg": self._scan_config(),
            "LIDinputstate": [("H", 0), ("I", 0), *[("B", 0)] * INPUTS, ("H", 0)],
            "LIDoutputstate": [("H", 0), ("I", 0), *[("B", 0), ("I", 0)] * OUTPUTS, ("H", 0)],
            "LFErec": [("H", 0)],
            "FieldSetSelectionMethod": [("B", 0)],
            "ActiveFieldSet": [("H", 1)],
            "LMPoutputRange": [("H", 1), ("I", self._step), ("i", start), ("i", stop)],
            "LMDscandatacfg": [(kind, int(value)) for kind, value in zip(SCAN_CONFIG, self._config)],
        }
        return known.get(name)

    def _state(self, now_ns: int) -> int:
        if self._trouble is not None:
            return FAULTY
        return READY if now_ns >= self._turn_zero_ns else BUSY

    def _lms_state(self, now_ns: int) -> list[Field]:
        state = 7 if self._state(now_ns) == READY and self._measuring else 6 if self._state(now_ns) == READY else 1
        text = self._wall_time(now_ns)
        clock = f"{text[3]:02d}:{text[4]:02d}:{text[5]:02d}"
        return [("H", state), ("B", 0), ("s", clock), ("s", "01.01.1970"), ("B", 0), ("B", 0), ("B", 0)]

    def _scan_config(self) -> list[Field]:
        start, stop = self._whole_range
        return [("I", self._rate), ("H", 1), ("I", self._step), ("i", start), ("i", stop)]

    def _write(self, request: _Request, now_ns: int) -> None:
        if not self._may_write:
            self._refuse(request, WRITE_DENIED, now_ns)
        elif request.name == "LMDscandatacfg":
            self._accept(request, self._configure(request.numbers(SCAN_CONFIG)), now_ns)
        elif request.name == "LMPoutputRange":
            self._accept(request, self._limit(request.numbers("HIii")), now_ns)
        elif request.name in SIMPLE_VARIABLES:
            self._variables[request.name, request.binary] = request.parameters
            self._accept(request, True, now_ns)
        else:
            self._refuse(request, UNKNOWN_VARIABLE, now_ns)

    def _accept(self, request: _Request, fits: bool, now_ns: int) -> None:
        if fits:
            self._answer(request, "sWA", [], now_ns)
        else:
            self._refuse(request, INVALID_DATA, now_ns)

    def _configure(self, numbers: tuple[int, ...] | None) -> bool:
        """Contents of scans: channels, remission, its resolution, ..., time, every n-th scan."""
        if numbers is None or numbers[11] < 1 or numbers[2] > 1 or numbers[3] > 1:
            return False
        self._config = list(numbers)
        return True

    def _limit(self, numbers: tuple[int, ...] | None) -> bool:
        """Range of angles of scans."""
        low, high = self._whole_range
        if numbers is None or not low <= numbers[2] < numbers[3] <= high:
            return False
        self._range = (numbers[2], numbers[3])
        return True

    # -- methods ------------------------------------------------------------------------------------------------------

    @property
    def _may_write(self) -> bool:
        return self._level >= MAY_WRITE or not self._needs_login

    def _log_in(self, request: _Request, now_ns: int) -> None:
        numbers = request.numbers("BI")
        fits = numbers is not None and PASSWORDS.get(numbers[0]) == numbers[1]
        if numbers is not None and fits:
            self._level = numbers[0]
        self._answer(request, "sAN", [("B", int(fits))], now_ns)

    def _run(self, request: _Request, now_ns: int) -> None:
        self._level = 0
        self._answer(request, "sAN", [("B", 1)], now_ns)

    def _permitted(self, request: _Request, now_ns: int) -> bool:
        if not self._may_write:
            self._refuse(request, ACCESS_DENIED, now_ns)
        return self._may_write

    def _start_measuring(self, request: _Request, now_ns: int) -> None:
        if self._permitted(request, now_ns):
            self._measuring = True
            self._answer(request, "sAN", [("B", 0)], now_ns)

    def _stop_measuring(self, request: _Request, now_ns: int) -> None:
        if self._permitted(request, now_ns):
            self._measuring = False
            self._answer(request, "sAN", [("B", 0)], now_ns)

    def _set_scan_config(self, request: _Request, now_ns: int) -> None:
        """Rate and resolution; the field of the head is fixed, whatever angles are asked for."""
        if not self._permitted(request, now_ns):
            return
        numbers = request.numbers("IHIii")
        rates = {rate for rate, _ in self.profile.steps}
        if numbers is None or numbers[1] != 1:
            code = 5
        elif numbers[0] not in rates:
            code = 1
        elif (numbers[0], numbers[2]) not in self.profile.steps:
            code = 2
        else:
            code = 0
            self._turn_anew(now_ns)
            self._rate, self._step = numbers[0], numbers[2]
        self._answer(request, "sAN", [("B", code), *self._scan_config()], now_ns)

    def _write_all(self, request: _Request, now_ns: int) -> None:
        if self._permitted(request, now_ns):
            self._answer(request, "sAN", [("B", 1)], now_ns)

    def _reboot(self, request: _Request, now_ns: int) -> None:
        """The answer still leaves; then all is as after power-on, but the connection."""
        if self._permitted(request, now_ns):
            self.power_on(now_ns)
            self._answer(request, "sAN", [], now_ns)

    def _subscribe(self, request: _Request, now_ns: int) -> None:
        numbers = request.numbers("B")
        if request.name in QUIET_EVENTS and numbers is not None and numbers[0] <= 1:
            self._answer(request, "sEA", [("B", numbers[0])], now_ns)
        elif request.name != "LMDscandata":
            self._refuse(request, UNKNOWN_EVENT, now_ns)
        elif numbers is None or numbers[0] > 1:
            self._refuse(request, INVALID_DATA, now_ns)
        else:
            self._answer(request, "sEA", [("B", numbers[0])], now_ns)
            self._events = request.binary if numbers[0] else None
            self._next_scan = self._first_scan_from(now_ns)

    # -- measuring ----------------------------------------------------------------------------------------------------

    @property
    def _whole_range(self) -> tuple[int, int]:
        told = self.profile
        return round(told.start_deg * TEN_THOUSANDTHS), round(told.stop_deg * TEN_THOUSANDTHS)

    @property
    def _turn_ns(self) -> int:
        return round(100 * SECOND_NS / (self._rate * self._speed_share))

    def _turn_anew(self, now_ns: int) -> None:
        """The turn under way begins again; call before the speed changes."""
        self._first_number += self._first_scan_from(now_ns)
        self._turn_zero_ns = max(self._turn_zero_ns, now_ns)
        self._next_scan = 0

    def _first_scan_from(self, now_ns: int) -> int:
        return max(0, -((self._turn_zero_ns - now_ns) // self._turn_ns))

    def _begin_ns(self, scan: int) -> int:
        return self._turn_zero_ns + scan * self._turn_ns

    def _done_ns(self, scan: int) -> int:
        low, high = self._whole_range
        return self._begin_ns(scan) + self._turn_ns * (high - low) // (360 * TEN_THOUSANDTHS)

    def _finish_scans(self, now_ns: int) -> None:
        while self._events is not None and (done_ns := self._done_ns(self._next_scan)) <= now_ns:
            scan, self._next_scan = self._next_scan, self._next_scan + 1
            if not self._measuring or (self._first_number + scan) % self._config[11]:
                continue
            if self._wire.busy_at(done_ns):
                self.skipped_scans += 1
                continue
            body = encode_fields(self._scan(scan, done_ns), binary=self._events)
            self._wire.send(frame(b"sSN LMDscandata " + body, binary=self._events), done_ns, whole=True)

    def _one_scan(self, request: _Request, now_ns: int) -> None:
        """The newest complete scan."""
        newest = (now_ns - self._turn_zero_ns) // self._turn_ns
        while self._done_ns(newest) > now_ns:
            newest -= 1
        if newest < 0 or not self._measuring:
            self._refuse(request, INVALID_DATA, now_ns)
        else:
            self._answer(request, "sRA", self._scan(newest, now_ns), now_ns)

    def _scan(self, scan: int, sent_ns: int) -> list[Field]:
        """All fields of one scan telegram."""
        begin_ns = self._begin_ns(scan)
        low, _ = self._whole_range
        start, stop = self._range
        first = math.ceil((start - low) / self._exact_step - 0.05)  # 0.05: limits are told in whole 1/10000 degrees
        count = math.floor((stop - low) / self._exact_step + 0.05) - first + 1
        angle = low + np.arange(first, first + count).astype(np.float64) * self._exact_step
        stamp_ns: F64 = begin_ns + (angle - low) / (360.0 * TEN_THOUSANDTHS) * self._turn_ns
        distances, rssi = self._measure(np.radians(angle / TEN_THOUSANDTHS - 90.0), stamp_ns)
        status = 0 if self._trouble is None else 1
        self._sent += 1
        shots = round(self._rate * 360 * TEN_THOUSANDTHS / self._exact_step / 10_000)
        head: list[Field] = [
            ("H", 1), ("H", 1), ("I", self._serial), ("B", 0), ("B", status),
            ("H", self._sent & 0xFFFF), ("H", (self._first_number + scan) & 0xFFFF),
            ("I", self.clock_us(begin_ns) & 0xFFFFFFFF), ("I", self.clock_us(sent_ns) & 0xFFFFFFFF),
            ("B", 0), ("B", 0), ("B", 8), ("B", 0), ("H", 0), ("I", self._rate), ("I", shots), ("H", 0),
        ]  # fmt: skip
        place: list[Field] = [("f", 1.0), ("f", 0.0), ("i", round(angle[0])), ("H", self._step), ("H", count)]
        wide: list[Field] = [("c", "DIST1"), *place, ("h", distances)]
        narrow: list[Field] = []
        if self._config[2]:
            target, kind, scale = (wide, "h", 1) if self._config[3] else (narrow, "b", 64)
            target += [("c", "RSSI1"), *place, (kind, rssi // scale)]
        wide_channels = 2 if self._config[2] and self._config[3] else 1
        return [*head, ("H", wide_channels), *wide, ("H", int(bool(narrow))), *narrow, *self._tail(begin_ns)]

    @property
    def _exact_step(self) -> float:
        """The true resolution: 3333 stands for a third of a degree."""
        return 10_000 / 3.0 if self._step == 3333 else float(self._step)

    def _tail(self, begin_ns: int) -> list[Field]:
        """Position, name, comment, time, event: each with a flag whether it follows."""
        name: list[Field] = [("H", 0)]
        if self._config[8]:
            name = [("H", 1), ("s", "not defined")]
        time: list[Field] = [("H", 0)]
        if self._config[10]:
            kinds = "HBBBBBI"
            time = [("H", 1), *((kind, value) for kind, value in zip(kinds, self._wall_time(begin_ns)))]
        return [("H", 0), *name, ("H", 0), *time, ("H", 0)]

    def _wall_time(self, now_ns: int) -> tuple[int, int, int, int, int, int, int]:
        """Year, month, day, hour, minute, second, microsecond of a clock that nobody set: it starts with 1970."""
        us = self.clock_us(now_ns)
        minutes, seconds = divmod(us // 1_000_000, 60)
        hours, minutes = divmod(minutes, 60)
        return 1970, 1, 1 + hours // 24 % 28, hours % 24, minutes, seconds, us % 1_000_000

    def _measure(self, bearing_rad: F64, stamp_ns: F64) -> tuple[I64, I64]:
        """Distances in mm (or codes) and echo strengths of 16 bits."""
        range_m = self._ranger.measure(bearing_rad, stamp_ns)
        finite = np.isfinite(range_m)
        metres = np.where(finite, range_m, 0.0)
        distances = np.rint(metres * 1000.0).astype(np.int64)
        distances[(finite & (metres < self.profile.range_min_m)) | (range_m == -np.inf)] = TOO_CLOSE
        distances[(range_m == np.inf) | (metres > self.profile.range_max_m)] = NO_ECHO
        distances[np.isnan(range_m)] = BLINDED
        if self._trouble is not None:
            distances[:] = NO_ECHO
        strength = np.rint(16_000.0 / (1.0 + (metres / 6.0) ** 2)).astype(np.int64)
        return distances, np.where(distances > TOO_CLOSE, strength, 0)


def _empty_field(number: int) -> list[Field]:
    """A monitoring field that nobody drew: scales of distances and angles, type, number, no shape of either kind."""
    shapes: list[Field] = [("H", 0)] * 4  # segmented, rectangular, radial, dynamic
    return [("f", 1.0), ("f", 0.0), ("I", 1), ("i", 0), ("B", 0), ("B", number), *shapes]


def _parsed(payload: bytes, *, binary: bool) -> _Request:
    """Command, name and parameters of a payload; `sRI0` has no space before its name."""
    command, rest = payload[:3].decode("latin-1"), payload[3:]
    rest = rest.removeprefix(b" ")
    name, _, parameters = rest.partition(b" ")
    return _Request(command, name.decode("latin-1"), parameters, binary)
