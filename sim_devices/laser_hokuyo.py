"""Hokuyo SCIP 2.x laser rangefinders: the device's side of the line.

Source: Hokuyo "Communication Protocol Specification for SCIP2.0 Standard" (C-42-03320B); figures of the models from
their own VV, PP and II replies.

    host    CC[parameters][;free string] LF            CR and CR LF end a command as well
    device  echo LF  status(2) sum LF  [lines, each with its sum]  LF

What this emulator does that a naive one would not:
- The head turns from power-on; sweeps begin at fixed instants, whether anyone asks or not. A scan leaves the device
  when its sweep is complete, and every beam measures the scene at its own instant, so a moving robot skews the scan.
- Bytes leave at the line's rate. On RS-232 a scan that is ready while the one before still leaves is skipped, as a
  19200 baud URG does; skipped scans do not count as reported ones.
- The clock is 24-bit milliseconds since power-on or RS, with drift; it wraps after 4.66 hours. The stamp of a scan is
  taken when the head passes step 0.
- QT lets a report that is already leaving finish, then answers. MD switches the laser on, and off after a counted run.
- In time mode everything but TM, QT and RS is refused with 0E. QT does not leave time mode; RS and TM2 do.
- SS answers at the old rate and changes after the reply has left. At a wrong rate the host reads noise; what it sends
  is lost to framing errors.
- Before the motor is up to speed streams are accepted and wait; GD is held back until a first scan exists.
- RB twice: the answers still leave, then the device is deaf for half a second and starts from scratch.
- One that starts in SCIP 1.1 answers V, G, L and S of that version until it is sent SCIP2.0.
- Commands that come together are answered a millisecond apart (TM at once), so that a host reads one reply at a time.
- An empty line is not answered. A second measuring command replaces the stream that runs.
- Assumed, the papers being silent: distances past 4095 mm are clipped in MS and GS; a start before AMIN is allowed and
  gives "not measurable"; HD, HE, ND and NE are unknown commands on these models (0E).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.checksums import scip_sum, scip_sums
from sim_devices.device import F64, Mount, Scene
from sim_devices.wire import SECOND_NS, PacedWire

I64 = NDArray[np.int64]

CLOCK_MASK = 0xFFFFFF
MAX_FREE_STRING = 16
MAX_COMMAND = 256
FREE_STRING = frozenset(b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 ._+-@")
LINE_RATES = (19200, 38400, 57600, 115200, 250000, 500000, 750000)
USB_RATE_BPS = 8_000_000  # full-speed CDC moves about 0.8 MB/s
TCP_RATE_BPS = 100_000_000
BLOCK = 64
WAKING = frozenset((b"BM", b"MD", b"MS", b"ME", b"GD", b"GS", b"GE"))
ALWAYS_OBEYED = frozenset((b"TM", b"QT", b"RS", b"RT", b"%ST"))  # in time mode, too
REBOOT_S = 0.5
REBOOT_WINDOW_NS = SECOND_NS
COMMAND_NS = 1_000_000
BACKLOG_NS = 50_000_000
MAX_RANGE_2_CHARS = 4095


@dataclass(frozen=True, slots=True)
class LaserProfile:
    """What one model is and says of itself. Distances in millimetres, as its PP reply has them."""

    model: str
    vendor: str
    product: str
    firmware: str
    protocol: str
    serial: str
    dmin_mm: int
    dmax_mm: int
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    last_accepted_step: int
    rpm: int
    link: str  # "rs232", "usb" or "tcp"
    wire_rate_bps: int  # on RS-232: the rate after power-on
    status_ok: str
    noise_floor_m: float
    noise_per_range: float
    nothing_code: int
    too_close_code: int
    unknown_code: int
    weak_code: int
    has_intensity: bool = False
    has_motor_speed: bool = False
    tm1_always: bool = False
    speaks_scip1: bool = False

    @property
    def period_ns(self) -> int:
        """One turn of the head at standard speed."""
        return round(60 * SECOND_NS / self.rpm)


URG_04LX = LaserProfile(
    model="URG-04LX(Hokuyo Automatic Co.,Ltd.)",
    vendor="Hokuyo Automatic Co.,Ltd.",
    product="SOKUIKI Sensor URG-04LX",
    firmware="3.1.00(18/Jan./2007)",
    protocol="SCIP 2.0",
    serial="H0614967",
    dmin_mm=20,
    dmax_mm=5600,
    steps_per_turn=1024,
    first_step=44,
    last_step=725,
    front_step=384,
    last_accepted_step=768,
    rpm=600,
    link="rs232",
    wire_rate_bps=19200,
    status_ok="Sensor works well.",
    noise_floor_m=0.003,
    noise_per_range=0.004,
    nothing_code=0,
    too_close_code=18,
    unknown_code=19,
    weak_code=1,
    has_motor_speed=True,
    speaks_scip1=True,
)
UHG_08LX = LaserProfile(
    model="UHG-08LX(Hokuyo Automatic Co.,Ltd.)",
    vendor="Hokuyo Automatic Co.,Ltd.",
    product="SOKUIKI Sensor UHG-08LX",
    firmware="1.1.0(26/Sep./2008)",
    protocol="SCIP 2.0",
    serial="H0805042",
    dmin_mm=30,
    dmax_mm=11000,
    steps_per_turn=1024,
    first_step=0,
    last_step=768,
    front_step=384,
    last_accepted_step=768,
    rpm=900,
    link="usb",
    wire_rate_bps=USB_RATE_BPS,
    status_ok="Sensor works well.",
    noise_floor_m=0.004,
    noise_per_range=0.004,
    nothing_code=0,
    too_close_code=18,
    unknown_code=19,
    weak_code=1,
    has_motor_speed=True,
)
UTM_30LX = LaserProfile(
    model="UTM-30LX[Hokuyo Automatic Co., Ltd.]",
    vendor="Hokuyo Automatic Co., Ltd.",
    product="SOKUIKI Sensor TOP-URG UTM-30LX",
    firmware="1.20.02(15/Mar./2010)",
    protocol="SCIP 2.0",
    serial="H1004321",
    dmin_mm=23,
    dmax_mm=60000,
    steps_per_turn=1440,
    first_step=0,
    last_step=1080,
    front_step=540,
    last_accepted_step=1080,
    rpm=2400,
    link="usb",
    wire_rate_bps=USB_RATE_BPS,
    status_ok="Stable 000 no error.",
    noise_floor_m=0.008,
    noise_per_range=0.0006,
    nothing_code=1,
    too_close_code=2,
    unknown_code=3,
    weak_code=2,
    has_intensity=True,
    tm1_always=True,
)
UST_10LX = LaserProfile(
    model="UST-10LX",
    vendor="Hokuyo Automatic Co., Ltd.",
    product="UST-10LX",
    firmware="3.00.00(08/Jun./2016)",
    protocol="SCIP 2.2",
    serial="H1512345",
    dmin_mm=20,
    dmax_mm=30000,
    steps_per_turn=1440,
    first_step=0,
    last_step=1080,
    front_step=540,
    last_accepted_step=1080,
    rpm=2400,
    link="tcp",
    wire_rate_bps=TCP_RATE_BPS,
    status_ok="sensor is working normally",
    noise_floor_m=0.008,
    noise_per_range=0.0006,
    nothing_code=1,
    too_close_code=2,
    unknown_code=3,
    weak_code=2,
    has_intensity=True,
    tm1_always=True,
)
PROFILES = {"urg-04lx": URG_04LX, "uhg-08lx": UHG_08LX, "utm-30lx": UTM_30LX, "ust-10lx": UST_10LX}


def encode_numbers(values: I64, characters: int) -> NDArray[np.uint8]:
    """Numbers as SCIP characters: six bits each, most significant first, plus 30h. values: (N,); returns (N * c,)."""
    shifts = np.arange(6 * (characters - 1), -1, -6, dtype=np.int64)
    return (((values[:, None] >> shifts) & 0x3F) + 0x30).astype(np.uint8).ravel()


def encode_number(value: int, characters: int) -> bytes:
    """One number as SCIP characters."""
    return bytes((value >> 6 * i & 0x3F) + 0x30 for i in reversed(range(characters)))


def data_lines(characters: NDArray[np.uint8]) -> bytes:
    """Data cut into blocks of 64, each with its sum and a line feed; the last block is shorter."""
    whole = len(characters) // BLOCK * BLOCK
    blocks = characters[:whole].reshape(-1, BLOCK)
    lines = np.empty((len(blocks), BLOCK + 2), np.uint8)
    lines[:, :BLOCK] = blocks
    lines[:, BLOCK] = scip_sums(blocks)
    lines[:, BLOCK + 1] = 0x0A
    rest = characters[whole:].tobytes()
    tail = rest + bytes((scip_sum(rest), 0x0A)) if rest else b""
    return lines.tobytes() + tail


def sealed(line: bytes) -> bytes:
    """A status or stamp line with its sum and line feed."""
    return line + bytes((scip_sum(line), 0x0A))


def field(key: str, value: str) -> bytes:
    """One line of VV, PP or II: the sum covers key and value, not the semicolon before it."""
    line = f"{key}:{value}".encode("ascii")
    return line + b";" + bytes((scip_sum(line), 0x0A))


@dataclass(frozen=True, slots=True)
class _Wanted:
    """What a measuring command asks for."""

    echo: bytes  # without the count of a stream
    free: bytes  # with its semicolon
    kind: str  # "D" 3 characters, "S" 2 characters, "E" 3 + 3 with intensity
    start: int
    end: int
    cluster: int


@dataclass(slots=True)
class _Stream:
    wanted: _Wanted
    interval: int
    remaining: int | None  # None: until QT
    next_turn: int


class HokuyoLaser:
    """One laser rangefinder on its line. See the module's text for its habits.

    profile: a model of PROFILES.  mount: its pose on the robot.  seed: of noise and dropouts.
    start_in_scip1: power up in SCIP 1.1, as an old URG-04LX does.  spin_up_s: from power-on to the first sweep.
    clock_drift_ppm: how much too fast its clock runs.  clock_start_ms: its clock at power-on (to test the wrap).
    noise_scale: 0 for exact ranges.  dropout: share of beams that give the "weak" code.  refuse_hasty: answer 0B to a
    command that comes again before the reply to the same command has left.  link: "rs232", "usb" or "tcp" where the
    unit is attached otherwise than its profile says (a URG-04LX has both RS-232 and USB).
    The first step is power-on.
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount | None = None,
        *,
        profile: LaserProfile = URG_04LX,
        serial: str | None = None,
        seed: int = 0,
        start_in_scip1: bool = False,
        spin_up_s: float = 1.0,
        clock_drift_ppm: float = 0.0,
        clock_start_ms: int = 0,
        noise_scale: float = 1.0,
        dropout: float = 0.0,
        refuse_hasty: bool = False,
        link: str | None = None,
    ) -> None:
        self.profile = profile
        self.scene = scene
        self.mount = mount if mount is not None else Mount()
        self.link = link if link is not None else profile.link
        self._base_rate_bps = {"usb": USB_RATE_BPS, "tcp": TCP_RATE_BPS}.get(self.link, 19200)
        if self.link == profile.link:
            self._base_rate_bps = profile.wire_rate_bps
        self.clock_drift_ppm = clock_drift_ppm
        self.noise_scale = noise_scale
        self.dropout = dropout
        self.refuse_hasty = refuse_hasty
        self.skipped_scans = 0
        self._serial = serial if serial is not None else profile.serial
        self._random = np.random.default_rng(seed)
        self._start_in_scip1 = start_in_scip1 and profile.speaks_scip1
        self._clock_start_ms = clock_start_ms
        self._spin_up_ns = round(spin_up_s * SECOND_NS)
        self._trouble: str | None = None
        self._speed_share = 1.0
        self._handlers: dict[bytes, Callable[[bytes, bytes, int], None]] = {
            b"VV": self._version,
            b"PP": self._parameters,
            b"II": self._state,
            b"BM": self._laser_on,
            b"QT": self._quit,
            b"RS": self._reset,
            b"TM": self._time,
            b"SS": self._bit_rate,
            b"CR": self._motor_speed,
            b"HS": self._sensitivity,
            b"RB": self._reboot,
            b"DB": self._simulate_fault,
            b"MD": self._stream_scans,
            b"MS": self._stream_scans,
            b"GD": self._latest_scan,
            b"GS": self._latest_scan,
        }
        if profile.link != "rs232":
            self._handlers[b"RT"] = self._partial_reset
        if profile.has_intensity:
            self._handlers[b"ME"] = self._stream_scans
            self._handlers[b"GE"] = self._latest_scan
        self.power_on(0)
        self._powered = False  # until the first step tells the time

    # -- what the wire and the tests see ------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then. baud: the host's line speed, if known."""
        if not self._powered:
            self.power_on(now_ns)
        if now_ns < self._boot_done_ns:
            return b""
        fits = self.link != "rs232" or baud is None or baud == self._wire.rate_bps
        self._finish_sweeps(now_ns)
        if fits and received and not self._rebooting:
            self._take(received, now_ns)
            self._finish_sweeps(now_ns)
        out = self._wire.leave_by(now_ns)
        if self._rebooting and self._wire.is_empty:
            self.power_on(now_ns, boot_s=REBOOT_S)
        return out if fits else self._garbled(out)

    @property
    def next_ns(self) -> int | None:
        """When something is due to leave next; None while it only waits for its host."""
        if not self._powered:
            return None
        due = [] if self._stream is None else [self._turn_done_ns(self._stream.next_turn)]
        if self._held is not None:
            due.append(self._turn_done_ns(self._first_turn))
        if (leaving_ns := self._wire.next_ns) is not None:
            due.append(leaving_ns)
        return min(due, default=None)

    @property
    def laser_is_on(self) -> bool:
        """Whether the beam is on."""
        return self._laser_on_ns is not None

    @property
    def line_rate_bps(self) -> int:
        """The rate the line runs at now; on USB and TCP only a pace."""
        return self._wire.rate_bps

    def clock_ms(self, now_ns: int) -> int:
        """The device's own clock, 24 bits."""
        return (self._clock_ns(now_ns) // 1_000_000 + self._clock_offset_ms) & CLOCK_MASK

    def _clock_ns(self, now_ns: int) -> int:
        """What the clock has counted since it was set."""
        elapsed_ns = now_ns - self._clock_zero_ns
        return elapsed_ns + round(elapsed_ns * self.clock_drift_ppm * 1e-6)

    def power_on(self, now_ns: int, boot_s: float = 0.0) -> None:
        """Start from scratch, as after the supply came back; deaf and mute for boot_s."""
        self._powered = True
        self._boot_done_ns = now_ns + round(boot_s * SECOND_NS)
        self._clock_zero_ns = now_ns
        self._clock_offset_ms = self._clock_start_ms
        self._scip1 = self._start_in_scip1
        self._slower_percent = 0
        self._period_ns = round(self.profile.period_ns / self._speed_share)
        self._asleep = False
        self._turn_zero_ns = self._boot_done_ns + self._spin_up_ns
        self._wire = PacedWire(self._base_rate_bps, now_ns)
        self._buffer = bytearray()
        self._stream: _Stream | None = None
        self._held: tuple[_Wanted, bytes] | None = None
        self._laser_on_ns: int | None = None
        self._first_turn = 0
        self._time_mode = False
        self._sensitive = False
        self._dark = False  # in SCIP 1
        self._reboot_asked_ns: int | None = None
        self._rebooting = False
        self._last_command = b""
        self._busy_ns = now_ns  # with commands

    def set_clock_drift(self, ppm: float, now_ns: int) -> None:
        """Let the clock run so much too fast from now on; it does not jump."""
        shown_ns = self._clock_ns(now_ns)
        self.clock_drift_ppm = ppm
        self._clock_zero_ns = now_ns - round(shown_ns / (1.0 + ppm * 1e-6))

    def set_speed_share(self, share: float, now_ns: int) -> None:
        """Let the head turn at this share of the speed it should have."""
        self._speed_share = share
        self._turn_at(self._slower_percent, now_ns)

    def link_lost(self, now_ns: int) -> None:
        """The host's TCP connection ended: stop measuring and forget what was to be sent."""
        if self.link == "tcp":
            self._stop()
            self._wire.clear(now_ns)
            self._buffer.clear()

    def trouble(self, status: str | None, now_ns: int) -> None:
        """Hardware trouble: a running stream ends with this status (50..97), BM answers 01. None: well again."""
        self._trouble = status
        if status is not None and self._stream is not None:
            wanted = self._stream.wanted
            self._wire.send(wanted.echo + b"00" + wanted.free + b"\n" + sealed(status.encode("ascii")) + b"\n", now_ns)
            self._stop()

    # -- the line -----------------------------------------------------------------------------------------------------

    def _garbled(self, sent: bytes) -> bytes:
        """What a host at another rate makes of these bytes."""
        return self._random.integers(0, 256, len(sent), dtype=np.uint8).tobytes()

    def _take(self, received: bytes, now_ns: int) -> None:
        self._buffer += received.replace(b"\r", b"\n")
        while (end := self._buffer.find(b"\n")) >= 0:
            line = bytes(self._buffer[:end])
            del self._buffer[: end + 1]
            if line and not self._rebooting:
                self._obey(line, now_ns)
        if len(self._buffer) > MAX_COMMAND:
            self._buffer.clear()

    # -- commands -----------------------------------------------------------------------------------------------------

    def _ready(self, now_ns: int) -> int:
        """When a reply begins to leave."""
        return max(now_ns, self._busy_ns - COMMAND_NS)

    def _obey(self, line: bytes, now_ns: int) -> None:
        if line[:2] != b"TM":
            self._busy_ns = min(max(now_ns, self._busy_ns), now_ns + BACKLOG_NS) + COMMAND_NS
        if self._scip1:
            self._obey_scip1(line, now_ns)
            return
        hasty = self.refuse_hasty and line == self._last_command and not self._wire.is_empty
        self._last_command = line
        command, semicolon, free = line.partition(b";")
        symbol = line[:3] if line[:3] in (b"%ST", b"%SL") else command[:2]
        handler = self._handlers.get(symbol)
        if self.link == "tcp" and symbol in (b"%ST", b"%SL"):
            handler = self._short_state if symbol == b"%ST" else self._sleep
        if len(free) > MAX_FREE_STRING:
            self._answer(line, "0G", now_ns)
        elif not FREE_STRING.issuperset(free):
            self._answer(line, "0H", now_ns)
        elif handler is None or (self._time_mode and symbol not in ALWAYS_OBEYED):
            self._answer(line, "0E", now_ns)
        elif hasty:
            self._answer(line, "0B", now_ns)
        else:
            if self._asleep and symbol in WAKING:
                self._asleep = False
                self._turn_zero_ns = now_ns + self._spin_up_ns
            handler(command, semicolon + free, now_ns)

    def _obey_scip1(self, line: bytes, now_ns: int) -> None:
        """V, G, L and S of SCIP 1.1, without sums: echo, one character of status, lines, an empty line."""
        match line[:1], len(line):
            case b"V", 1:
                told = (("VEND", self.profile.vendor), ("PROD", self.profile.product), ("FIRM", self.profile.firmware),
                        ("PROT", "00003,(SCIP 1.0)"), ("SERI", self._serial))  # fmt: skip
                self._answer_scip1(line, "".join(f"{key}:{value}\n" for key, value in told).encode("ascii"), now_ns)
            case b"G", 9:
                self._scan_scip1(line, now_ns)
            case b"L", 2 if line[1:] in (b"0", b"1"):
                self._dark = line == b"L0"
                self._answer_scip1(line, b"", now_ns)
            case b"S", 14 if (rate_bps := _digits(line[1:7])) in LINE_RATES:
                self._answer_scip1(line, b"", now_ns, rate_bps if self.link == "rs232" else None)
            case _ if line == b"SCIP2.0":
                self._scip1 = False
                self._answer_scip1(line, b"", now_ns)
            case _:
                self._wire.send(line + b"\nE\n\n", self._ready(now_ns))

    def _answer_scip1(self, echo: bytes, lines: bytes, now_ns: int, rate_after_bps: int | None = None) -> None:
        self._wire.send(echo + b"\n0\n" + lines + b"\n", self._ready(now_ns), rate_after_bps)

    def _scan_scip1(self, line: bytes, now_ns: int) -> None:
        """`G` start end cluster: two characters a value, 64 to a line. The beam is on from power-on."""
        start, end, cluster = _digits(line[1:4]), _digits(line[4:7]), _digits(line[7:9])
        newest = (now_ns - self._turn_zero_ns) // self._period_ns
        while self._turn_done_ns(newest) > now_ns:
            newest -= 1
        fits = start is not None and end is not None and start <= end <= self.profile.last_accepted_step
        if start is None or end is None or cluster is None or not fits or self._dark or newest < 0:
            self._wire.send(line + b"\nE\n\n", self._ready(now_ns))
            return
        ranges_mm, intensity = self._measure(start, end, self._turn_start_ns(newest))
        ranges_mm, _ = self._clustered(ranges_mm, intensity, max(1, cluster))
        characters = encode_numbers(np.minimum(ranges_mm, MAX_RANGE_2_CHARS), 2).tobytes()
        blocks = (characters[at : at + BLOCK] + b"\n" for at in range(0, len(characters), BLOCK))
        self._answer_scip1(line, b"".join(blocks), now_ns)

    def _answer(self, echo: bytes, status: str, now_ns: int, lines: bytes = b"") -> None:
        reply = echo + b"\n" + sealed(status.encode("ascii")) + lines + b"\n"
        self._wire.send(reply, self._ready(now_ns), whole=self.link == "tcp")  # TCP is given whole replies

    def _sized(self, command: bytes, free: bytes, length: int, now_ns: int) -> bool:
        """Whether a command is as long as it must be; refuses it otherwise."""
        if len(command) == length:
            return True
        self._answer(command + free, "0C" if len(command) < length else "0D", now_ns)
        return False

    def _version(self, command: bytes, free: bytes, now_ns: int) -> None:
        if self._sized(command, free, 2, now_ns):
            told = self.profile
            lines = field("VEND", told.vendor) + field("PROD", told.product) + field("FIRM", told.firmware)
            lines += field("PROT", told.protocol) + field("SERI", self._serial)
            self._answer(command + free, "00", now_ns, lines)

    def _parameters(self, command: bytes, free: bytes, now_ns: int) -> None:
        if self._sized(command, free, 2, now_ns):
            told = self.profile
            numbers = (("DMIN", told.dmin_mm), ("DMAX", told.dmax_mm), ("ARES", told.steps_per_turn),
                       ("AMIN", told.first_step), ("AMAX", told.last_step), ("AFRT", told.front_step),
                       ("SCAN", told.rpm))  # fmt: skip
            lines = field("MODL", told.model) + b"".join(field(key, str(value)) for key, value in numbers)
            self._answer(command + free, "00", now_ns, lines)

    def _state(self, command: bytes, free: bytes, now_ns: int) -> None:
        if not self._sized(command, free, 2, now_ns):
            return
        rpm = round(60 * SECOND_NS / self._period_ns)
        speed = f"Initial({rpm}[rpm])<-Default setting by user"
        if self._slower_percent:
            speed = f"{self._slower_percent}%Down({rpm}[rpm])"
        rate = {"usb": "USB only", "tcp": "Ethernet 100 [Mbps]"}.get(
            self.link, f"{self._wire.rate_bps}[bps]<-Default setting by user"
        )
        measuring = (
            "IDLE" if self._stream is None else "Measuring by Sensitive Mode" if self._sensitive else "Measuring"
        )
        lines = field("MODL", self.profile.model) + field("LASR", "ON" if self.laser_is_on else "OFF")
        lines += field("SCSP", speed) + field("MESM", measuring) + field("SBPS", rate)
        lines += field("TIME", f"{self.clock_ms(now_ns):06X}") + field("STAT", self._health(now_ns))
        self._answer(command + free, "00", now_ns, lines)

    def _short_state(self, command: bytes, free: bytes, now_ns: int) -> None:
        if self._sized(command, free, 3, now_ns):
            self._answer(command + free, "00", now_ns, sealed(self._state_code(now_ns)))

    def _sleep(self, command: bytes, free: bytes, now_ns: int) -> None:
        """Laser and motor off until it is asked to measure."""
        if self._sized(command, free, 3, now_ns):
            self._stop()
            self._asleep = True
            self._answer(command + free, "00", now_ns)

    def _state_code(self, now_ns: int) -> bytes:
        """Three digits: 000 standby, 001 booting, 002 time mode, 003 laser on, 004 streaming, 005 asleep, 900 error."""
        if self._trouble is not None:
            return b"900"
        if self._asleep:
            return b"005"
        if self._time_mode:
            return b"002"
        if self._stream is not None:
            return b"004"
        if self.laser_is_on:
            return b"003"
        return b"001" if now_ns < self._turn_zero_ns else b"000"

    def _health(self, now_ns: int) -> str:
        if self._trouble is not None:
            return f"Error {self._trouble} hardware trouble."
        return "Motor is starting up." if now_ns < self._turn_zero_ns else self.profile.status_ok

    def _laser_on(self, command: bytes, free: bytes, now_ns: int) -> None:
        if not self._sized(command, free, 2, now_ns):
            return
        if self._trouble is not None:
            self._answer(command + free, "01", now_ns)
        elif self.laser_is_on:
            self._answer(command + free, "02", now_ns)
        else:
            self._switch_on(now_ns)
            self._answer(command + free, "00", now_ns)

    def _quit(self, command: bytes, free: bytes, now_ns: int) -> None:
        if self._sized(command, free, 2, now_ns):
            self._stop()
            self._answer(command + free, "00", now_ns)

    def _reset(self, command: bytes, free: bytes, now_ns: int) -> None:
        if self._sized(command, free, 2, now_ns):
            self._forget(now_ns)
            self._set_speed(0, now_ns)
            back_bps = self._base_rate_bps if self.link == "rs232" else None
            self._wire.send(command + free + b"\n" + sealed(b"00") + b"\n", self._ready(now_ns), back_bps)

    def _partial_reset(self, command: bytes, free: bytes, now_ns: int) -> None:
        """RT of the younger models: like RS, but motor speed and bit rate stay."""
        if self._sized(command, free, 2, now_ns):
            self._forget(now_ns)
            self._answer(command + free, "00", now_ns)

    def _forget(self, now_ns: int) -> None:
        self._stop()
        self._time_mode = False
        self._sensitive = False
        self._clock_zero_ns = now_ns
        self._clock_offset_ms = 0

    def _time(self, command: bytes, free: bytes, now_ns: int) -> None:
        echo = command + free
        if not self._sized(command, free, 3, now_ns):
            return
        match command[2:]:
            case b"0" if self._time_mode:
                self._answer(echo, "02", now_ns)
            case b"0":
                self._stop()
                self._time_mode = True
                self._answer(echo, "00", now_ns)
            case b"1" if self._time_mode or self.profile.tm1_always:
                self._answer(echo, "00", now_ns, sealed(encode_number(self.clock_ms(now_ns), 4)))
            case b"1":
                self._answer(echo, "04", now_ns)
            case b"2" if self._time_mode:
                self._time_mode = False
                self._answer(echo, "00", now_ns)
            case b"2":
                self._answer(echo, "03", now_ns)
            case _:
                self._answer(echo, "01", now_ns)

    def _bit_rate(self, command: bytes, free: bytes, now_ns: int) -> None:
        echo = command + free
        if self.link == "tcp":
            self._answer(echo, "0F", now_ns)
            return
        if not self._sized(command, free, 8, now_ns):
            return
        rate_bps = _digits(command[2:])
        if rate_bps is None:
            self._answer(echo, "01", now_ns)
        elif rate_bps not in LINE_RATES:
            self._answer(echo, "02", now_ns)
        elif self.link == "usb":
            self._answer(echo, "00", now_ns)
        elif rate_bps == self._wire.rate_bps:
            self._answer(echo, "03", now_ns)
        else:
            self._wire.send(echo + b"\n" + sealed(b"00") + b"\n", self._ready(now_ns), rate_bps)

    def _motor_speed(self, command: bytes, free: bytes, now_ns: int) -> None:
        echo = command + free
        if not self._sized(command, free, 4, now_ns):
            return
        asked = _digits(command[2:])
        if asked is None:
            self._answer(echo, "01", now_ns)
        elif asked > 10 and asked != 99:
            self._answer(echo, "02", now_ns)
        elif not self.profile.has_motor_speed:
            self._answer(echo, "04", now_ns)
        elif asked % 99 == self._slower_percent:
            self._answer(echo, "03", now_ns)
        else:
            self._set_speed(asked % 99, now_ns)
            self._answer(echo, "00", now_ns)

    def _sensitivity(self, command: bytes, free: bytes, now_ns: int) -> None:
        echo = command + free
        if not self._sized(command, free, 3, now_ns):
            return
        if command[2:] not in (b"0", b"1"):
            self._answer(echo, "01", now_ns)
        elif (command[2:] == b"1") == self._sensitive:
            self._answer(echo, "02", now_ns)
        else:
            self._sensitive = not self._sensitive
            self._answer(echo, "00", now_ns)

    def _reboot(self, command: bytes, free: bytes, now_ns: int) -> None:
        if not self._sized(command, free, 2, now_ns):
            return
        asked_ns = self._reboot_asked_ns
        if asked_ns is None or now_ns - asked_ns > REBOOT_WINDOW_NS:
            self._reboot_asked_ns = now_ns
            self._answer(command + free, "01", now_ns)
            return
        self._stop()
        self._answer(command + free, "00", now_ns)
        self._rebooting = True

    def _simulate_fault(self, command: bytes, free: bytes, now_ns: int) -> None:
        if not self._sized(command, free, 4, now_ns):
            return
        code = _digits(command[2:])
        if code is None:
            self._answer(command + free, "01", now_ns)
        elif not 1 <= code <= 10:
            self._answer(command + free, "02", now_ns)
        else:
            self._answer(command + free, "00", now_ns)
            self.trouble(None if code == 10 else str(49 + code), now_ns)

    def _stream_scans(self, command: bytes, free: bytes, now_ns: int) -> None:
        if not self._sized(command, free, 15, now_ns):
            return
        wanted = self._area(command, free, now_ns, command[:13])
        if wanted is None:
            return
        interval, count = _digits(command[12:13]), _digits(command[13:15])
        if interval is None or count is None:
            self._answer(command + free, "06" if interval is None else "07", now_ns)
        elif self._trouble is not None:
            self._answer(command + free, self._trouble, now_ns)
        else:
            self._switch_on(now_ns)
            self._stream = _Stream(wanted, interval, count or None, self._first_turn_from(now_ns))
            self._answer(command + free, "00", now_ns)

    def _latest_scan(self, command: bytes, free: bytes, now_ns: int) -> None:
        if not self._sized(command, free, 12, now_ns):
            return
        wanted = self._area(command, free, now_ns, command)
        if wanted is None:
            return
        if not self.laser_is_on:
            self._answer(command + free, "10", now_ns)
        elif self._turn_done_ns(self._first_turn) > now_ns:
            self._held = (wanted, command + free)
        else:
            self._report_latest(wanted, command + free, now_ns)

    def _area(self, command: bytes, free: bytes, now_ns: int, echo: bytes) -> _Wanted | None:
        """The parameters that all measuring commands share; answers the error and gives None if one is wrong."""
        start, end, cluster = _digits(command[2:6]), _digits(command[6:10]), _digits(command[10:12])
        if start is None:
            fault = "01"
        elif end is None:
            fault = "02"
        elif cluster is None:
            fault = "03"
        elif end > self.profile.last_accepted_step:
            fault = "04"
        elif end < start:
            fault = "05"
        else:
            return _Wanted(echo, free, chr(command[1]), start, end, max(1, cluster))
        self._answer(command + free, fault, now_ns)
        return None

    # -- measuring ----------------------------------------------------------------------------------------------------

    def _switch_on(self, now_ns: int) -> None:
        if self._laser_on_ns is None:
            self._laser_on_ns = now_ns
            self._first_turn = self._first_turn_from(now_ns)

    def _stop(self) -> None:
        self._stream = None
        self._held = None
        self._laser_on_ns = None

    def _set_speed(self, slower_percent: int, now_ns: int) -> None:
        """Turn the head slower by so many percent; the turn under way begins anew."""
        if slower_percent != self._slower_percent:
            self._turn_at(slower_percent, now_ns)

    def _turn_at(self, slower_percent: int, now_ns: int) -> None:
        self._slower_percent = slower_percent
        self._period_ns = round(self.profile.period_ns * 100 / (100 - slower_percent) / self._speed_share)
        self._turn_zero_ns = max(self._turn_zero_ns, now_ns)
        self._first_turn = 0
        if self._stream is not None:
            self._stream.next_turn = 0

    def _turn_start_ns(self, turn: int) -> int:
        return self._turn_zero_ns + turn * self._period_ns

    def _turn_done_ns(self, turn: int) -> int:
        """When the head has passed the last step of the field."""
        swept = self.profile.last_accepted_step + 1
        return self._turn_start_ns(turn) + self._period_ns * swept // self.profile.steps_per_turn

    def _first_turn_from(self, now_ns: int) -> int:
        """The first turn that begins at or after now."""
        return max(0, -((self._turn_zero_ns - now_ns) // self._period_ns))

    def _finish_sweeps(self, now_ns: int) -> None:
        if self._held is not None and self._turn_done_ns(self._first_turn) <= now_ns:
            (wanted, echo), self._held = self._held, None
            self._report_latest(wanted, echo, self._turn_done_ns(self._first_turn))
        while self._stream is not None and self._turn_done_ns(self._stream.next_turn) <= now_ns:
            stream, done_ns = self._stream, self._turn_done_ns(self._stream.next_turn)
            if self._wire.busy_at(done_ns):
                self.skipped_scans += 1
                stream.next_turn += 1
                continue
            if stream.remaining is not None:
                stream.remaining -= 1
            echo = stream.wanted.echo + b"%02d" % (stream.remaining or 0) + stream.wanted.free
            self._answer(echo, "99", done_ns, self._measured(stream.wanted, stream.next_turn))
            stream.next_turn += 1 + stream.interval
            if stream.remaining == 0:
                self._stop()

    def _report_latest(self, wanted: _Wanted, echo: bytes, now_ns: int) -> None:
        turn = (now_ns - self._turn_zero_ns) // self._period_ns
        while self._turn_done_ns(turn) > now_ns:
            turn -= 1
        self._answer(echo, "00", now_ns, self._measured(wanted, turn))

    def _measured(self, wanted: _Wanted, turn: int) -> bytes:
        """Stamp line and data lines of one turn's scan."""
        start_ns = self._turn_start_ns(turn)
        ranges_mm, intensity = self._measure(wanted.start, wanted.end, start_ns)
        ranges_mm, intensity = self._clustered(ranges_mm, intensity, wanted.cluster)
        if wanted.kind == "S":
            characters = encode_numbers(np.minimum(ranges_mm, MAX_RANGE_2_CHARS), 2)
        elif wanted.kind == "E":
            characters = encode_numbers(np.column_stack((ranges_mm, intensity)).ravel(), 3)
        else:
            characters = encode_numbers(ranges_mm, 3)
        return sealed(encode_number(self.clock_ms(start_ns), 4)) + data_lines(characters)

    def _measure(self, start: int, end: int, turn_start_ns: int) -> tuple[I64, I64]:
        """Distances in millimetres (or codes) and intensities of the steps start..end of one turn."""
        told = self.profile
        step = np.arange(start, end + 1, dtype=np.float64)
        bearing_rad: F64 = (step - told.front_step) * (2.0 * np.pi / told.steps_per_turn)
        stamp_ns: F64 = turn_start_ns + step * (self._period_ns / told.steps_per_turn)
        true_m = self.scene.beam_ranges(self.mount, bearing_rad, stamp_ns, told.dmax_mm * 1e-3)
        seen_m = self._noisy(true_m)
        finite = np.isfinite(seen_m)
        ranges_mm = np.rint(np.where(finite, seen_m, 0.0) * 1e3).astype(np.int64)
        intensity = self._intensity(np.where(finite, seen_m, np.inf))
        ranges_mm[finite & (ranges_mm < told.dmin_mm)] = told.too_close_code
        nothing = (seen_m == np.inf) | (finite & (ranges_mm > told.dmax_mm))
        ranges_mm[nothing] = told.nothing_code
        ranges_mm[seen_m == -np.inf] = told.too_close_code
        ranges_mm[np.isnan(seen_m) | (step < told.first_step) | (step > told.last_step)] = told.unknown_code
        if self.dropout:
            ranges_mm[(self._random.random(len(step)) < self.dropout) & (ranges_mm >= told.dmin_mm)] = told.weak_code
        intensity[ranges_mm < told.dmin_mm] = 0
        return ranges_mm, intensity

    def _noisy(self, true_m: F64) -> F64:
        if not self.noise_scale:
            return true_m
        sigma_m = self.profile.noise_floor_m + self.profile.noise_per_range * np.where(np.isfinite(true_m), true_m, 0.0)
        noisy: F64 = true_m + self.noise_scale * sigma_m * self._random.standard_normal(len(true_m))
        return noisy

    def _intensity(self, range_m: F64) -> I64:
        """Echo strength in the device's units: about 3500 near, falling with the square of the range."""
        level = 3500.0 / (1.0 + (range_m / 8.0) ** 2)
        return np.maximum(0, np.rint(level)).astype(np.int64)

    def _clustered(self, ranges_mm: I64, intensity: I64, cluster: int) -> tuple[I64, I64]:
        """One value for each `cluster` steps: the smallest that is a distance, else the group's first code."""
        if cluster == 1:
            return ranges_mm, intensity
        groups = -(-len(ranges_mm) // cluster)
        padded = np.full(groups * cluster, np.iinfo(np.int64).max)
        padded[: len(ranges_mm)] = np.where(ranges_mm >= self.profile.dmin_mm, ranges_mm, np.iinfo(np.int64).max - 1)
        # All codes: every entry ties at max - 1, and argmin takes the first of the group.
        chosen = padded.reshape(groups, cluster).argmin(axis=1) + np.arange(groups) * cluster
        return ranges_mm[chosen], intensity[chosen]


def _digits(text: bytes) -> int | None:
    """A decimal parameter, or None if any character is not a digit."""
    return int(text) if text.isdigit() else None
