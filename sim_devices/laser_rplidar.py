"""Slamtec RPLIDAR A1 and A2 on their serial line: the device's side.

Source: Slamtec "RPLIDAR interface protocol and application notes" as the public headers of rplidar_sdk have it
(rplidar_cmd.h, rplidar_protocol.h).

    host    A5 command                                  or A5 command+80h n data... xor
    device  A5 5A length and kind of answer, type       once an answer; then the answer, or many until told to stop

What this emulator does that a naive one would not:
- Samples are taken by the clock, 2000 or 4000 a second, wherever the head looks then; it turns clockwise, seldom at
  exactly the same speed. So the number of samples of a turn varies, and a new turn begins with the first sample past 0.
- Express samples come as capsules of 32, the angle of each a straight line between the starts of two capsules minus
  a small offset, larger for near things, as the lever between emitter and receiver makes it.
- A scan begins when the motor is up to speed; a forced scan at once. A1 motors hang on DTR, which a pty does not have:
  they turn, unless told otherwise from outside. A2 motors obey the PWM command; 0 stops them, and the samples with
  them.
- Health 2 (protection stop): scans are not answered until a reset, which heals what is not really broken. A reset is
  followed by silence, then by a few lines of text, in which a reader may look for frames.
- Firmware before 1.24 knows neither configuration (84h) nor modes: 84h is not answered at all.
- Stop is not answered, and what has been handed to the line still comes. A new request ends a scan, PWM does not.
- At another line rate the host reads noise and is not heard.
- Assumed: samples without an echo have distance 0 and quality 0; quality falls with range. Ultra and dense capsules
  (modes faster than 115200 baud carries in this form) are not there and not offered.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.device import F64, Mount, Scene
from sim_devices.ranging import MOST_FORESEEN, Ranger, garbled
from sim_devices.spinner import Spinner
from sim_devices.wire import SECOND_NS, PacedWire

I64 = NDArray[np.int64]

START = 0xA5
REPLY_NS = 2_000_000
MAX_DATA = 255
HEALTH_GOOD, HEALTH_WARNING, HEALTH_ERROR = 0, 1, 2
ANSWER_INFO, ANSWER_HEALTH, ANSWER_RATES, ANSWER_CONFIG, ANSWER_BOARD = 0x04, 0x06, 0x15, 0x20, 0xFF
ANSWER_NODES, ANSWER_CAPSULES = 0x81, 0x82
REPEATED = 0x40000000
NODES_A_BATCH = 8
SAMPLES_A_CAPSULE = 32
ANGLE_UNITS = 360 * 64
MAX_OFFSET = 31  # eighths of a degree; above it readers disagree about the sign
MAX_PWM = 1023
DEFAULT_PWM = 660
SLOWEST_SHARE = 0.2  # of the rated speed: below, the laser is off


@dataclass(frozen=True, slots=True)
class ScanMode:
    """One entry of the list of scan modes."""

    name: str
    sample_ns: int
    answer: int
    range_max_m: float


@dataclass(frozen=True, slots=True)
class RpLidarProfile:
    """What one model is and says of itself."""

    model: int
    hardware: int
    firmware: tuple[int, int]
    line_rate_bps: int
    turns_per_s: float
    has_pwm: bool
    range_min_m: float
    modes: tuple[ScanMode, ...]


STANDARD = ScanMode("Standard", 500_000, ANSWER_NODES, 12.0)
A1M8 = RpLidarProfile(
    0x18, 5, (1, 29), 115200, 7.0, False, 0.15, (STANDARD, ScanMode("Express", 250_000, ANSWER_CAPSULES, 12.0))
)
A2M8 = RpLidarProfile(
    0x28,
    5,
    (1, 29),
    115200,
    10.0,
    True,
    0.15,
    (ScanMode("Standard", 500_000, ANSWER_NODES, 16.0), ScanMode("Express", 250_000, ANSWER_CAPSULES, 16.0)),
)
A2M7 = RpLidarProfile(
    0x27,
    6,
    (1, 29),
    256000,
    10.0,
    True,
    0.15,
    (ScanMode("Standard", 250_000, ANSWER_NODES, 16.0), ScanMode("Express", 125_000, ANSWER_CAPSULES, 16.0)),
)
RPLIDAR_PROFILES = {"a1": A1M8, "a2": A2M8, "a2m7": A2M7}
CONFIG_SINCE = (1, 24)


def encode_node(angle: int, distance: int, quality: int, *, begins: bool) -> bytes:
    """A standard sample: angle in 64ths of a degree, distance in quarter millimetres, 6 bits of quality."""
    return struct.pack("<BHH", quality << 2 | (1 if begins else 2), angle << 1 | 1, distance)


def encode_capsule(start: int, distances: I64, offsets: I64, *, first: bool) -> bytes:
    """32 samples: start in 64ths of a degree, distances (32,) in quarter millimetres, offsets (32,) in eighths."""
    body = bytearray(struct.pack("<H", start | (0x8000 if first else 0)))
    whole = distances & 0xFFFC
    for a, b, low, high in zip(whole[0::2], whole[1::2], offsets[0::2], offsets[1::2]):
        body += struct.pack("<HHB", a | low >> 4, b | high >> 4, (low & 15) | (high & 15) << 4)
    sum_ = _xor(bytes(body))
    return bytes((0xA0 | sum_ & 0x0F, 0x50 | sum_ >> 4)) + bytes(body)


@dataclass(slots=True)
class _Scan:
    """A scan that runs. zero_ns: its first sample; None while the motor is not ready."""

    mode: ScanMode
    forced: bool
    zero_ns: int | None = None
    next_batch: int = 0
    foreseen: int = 0  # up to this batch the scene has been asked
    offsets: I64 | None = None  # of those batches
    is_first: bool = True
    last_turn: int | None = None

    @property
    def batch(self) -> int:
        """Samples that leave together."""
        return SAMPLES_A_CAPSULE if self.mode.answer == ANSWER_CAPSULES else NODES_A_BATCH

    def stamps_ns(self, first_ns: int, count: int = 1) -> F64:
        """(batch count,) when the samples of so many batches are taken."""
        return first_ns + np.arange(count * self.batch, dtype=np.float64) * self.mode.sample_ns

    def next_offsets(self) -> I64 | None:
        """(batch,) of the next batch, if they have been worked out; `next_batch` is one more already."""
        if self.offsets is None or self.next_batch > self.foreseen:
            return None
        begin = len(self.offsets) - (self.foreseen - self.next_batch + 1) * self.batch
        return self.offsets[begin : begin + self.batch]


def _bearing_rad(turns: F64) -> F64:
    """Counter-clockwise; the head turns clockwise."""
    return -2.0 * np.pi * turns


def _turned_back(turns: F64, offset: I64) -> F64:
    """Turns less offsets in eighths of a degree."""
    back: F64 = turns - offset / (8.0 * 360.0)
    return back


class RpLidar:
    """One scanner on its line. See the module's text for its habits.

    profile: a model of RPLIDAR_PROFILES.  firmware: another than the profile's, e.g. (1, 20).  serial: 16 bytes.
    boot_s: from power-on or reset to the boot text.  spin_up_s: of the motor.  wobble: share by which its speed swings.
    health, error: as told; health 2 refuses scans.  noise_scale: 0 for exact ranges.  dropout: share of samples without
    an echo.  lever_m: between emitter and receiver; makes the offsets of express samples.
    The first step is power-on.
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount | None = None,
        *,
        profile: RpLidarProfile = A1M8,
        firmware: tuple[int, int] | None = None,
        serial: bytes | None = None,
        seed: int = 0,
        boot_s: float = 0.5,
        spin_up_s: float = 1.0,
        wobble: float = 0.01,
        health: int = HEALTH_GOOD,
        error: int = 0,
        noise_scale: float = 1.0,
        dropout: float = 0.0,
        lever_m: float = 0.01,
    ) -> None:
        self.profile = profile
        self.firmware = firmware if firmware is not None else profile.firmware
        self.health = health
        self.error = error
        self.lever_m = lever_m
        self.points_left_out = 0.0  # share of the samples not sent (in capsules: without an echo)
        self._broken = False
        self._serial = serial if serial is not None else bytes((0xAA, 0x55, profile.model)) + bytes(range(1, 14))
        if len(self._serial) != 16:
            raise ValueError("the serial number has 16 bytes")
        self._random = np.random.default_rng(seed)
        range_max_m = max(mode.range_max_m for mode in profile.modes)
        self._ranger = Ranger(
            scene, mount or Mount(), self._random, range_max_m, 0.001, 0.005, noise_scale=noise_scale, dropout=dropout
        )
        self._boot_ns = round(boot_s * SECOND_NS)
        self._motor = Spinner(profile.turns_per_s, spin_up_s, wobble)
        self._speed_share = 1.0
        self._pwm = DEFAULT_PWM
        self._turns_on = True
        self._handlers: dict[int, Callable[[bytes, int], None]] = {
            0x20: lambda data, now_ns: self._begin_scan(self._standard, now_ns, forced=False),
            0x21: lambda data, now_ns: self._begin_scan(self._standard, now_ns, forced=True),
            0x25: lambda data, now_ns: self._end_scan(),
            0x40: self._reset,
            0x50: self._info,
            0x52: self._tell_health,
            0x59: self._rates,
            0x82: self._express,
            0xF0: self._set_pwm,
            0xFF: self._board,
        }
        if self.firmware >= CONFIG_SINCE:
            self._handlers[0x84] = self._config
        self.power_on(0)
        self._powered = False  # until the first step tells the time

    # -- what the wire and the tests see ------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then. baud: the host's line speed, if known."""
        if not self._powered:
            self.power_on(now_ns)
        if now_ns < self._boot_done_ns:
            return b""
        if not self._booted:
            self._tell_boot()
        fits = baud is None or baud == self.profile.line_rate_bps
        self._sample(now_ns)
        if fits and received:
            self._take(received, now_ns)
        out = self._wire.leave_by(now_ns)
        return out if fits else garbled(out, self._random)

    @property
    def next_ns(self) -> int | None:
        """When something is due next; None while it only waits for its host."""
        if not self._powered:
            return None
        if not self._booted:
            return self._boot_done_ns
        due = []
        if self._scan is not None and self._scan.zero_ns is not None:
            due.append(self._batch_done_ns(self._scan, self._scan.zero_ns))
        if (leaving_ns := self._wire.next_ns) is not None:
            due.append(leaving_ns)
        return min(due, default=None)

    @property
    def is_scanning(self) -> bool:
        """Whether a scan was begun and not stopped."""
        return self._scan is not None

    @property
    def turns_per_s(self) -> float:
        """The speed the motor is told to have; 0 when it stands."""
        return self._motor.target

    def power_on(self, now_ns: int) -> None:
        """Start as after the supply came back: silent for boot_s, the motor spins up to its default speed."""
        self._powered = True
        self._motor.turn_at(0.0, now_ns, at_once=True)
        self._boot(now_ns)

    def _boot(self, now_ns: int) -> None:
        self._boot_done_ns = now_ns + self._boot_ns
        self._booted: bool = False
        self._wire: PacedWire = PacedWire(self.profile.line_rate_bps, now_ns)
        self._buffer = bytearray()
        self._scan: _Scan | None = None
        self._pwm = DEFAULT_PWM
        self._drive(now_ns)

    def switch_motor(self, on: bool, now_ns: int) -> None:
        """What DTR does to an A1 on a real USB bridge."""
        self._turns_on = on
        self._drive(now_ns)

    def set_speed_share(self, share: float, now_ns: int) -> None:
        """Let the head turn at this share of the speed it should have."""
        self._speed_share = share
        self._drive(now_ns)

    def trouble(self, status: str | None, now_ns: int) -> None:
        """Hardware trouble under this number: a scan ends, health is 2. None: well again."""
        self.health = HEALTH_GOOD if status is None else HEALTH_ERROR
        self.error = 0 if status is None else int(status)
        self._broken = status is not None
        if status is not None:
            self._end_scan()

    # -- the line -----------------------------------------------------------------------------------------------------

    def _take(self, received: bytes, now_ns: int) -> None:
        self._buffer += received
        while (request := self._next_request()) is not None:
            command, data = request
            handler = self._handlers.get(command)
            if handler is not None:
                if command != 0xF0:
                    self._end_scan()
                handler(data, now_ns)
            if not self._booted:
                self._buffer.clear()

    def _next_request(self) -> tuple[int, bytes] | None:
        """The next whole request: command and data. What is none is dropped byte by byte."""
        while (start := self._buffer.find(START)) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 2:
                return None
            command = self._buffer[1]
            if not command & 0x80:
                del self._buffer[:2]
                return command, b""
            if command == START:  # A5 A5: the first one was noise
                del self._buffer[0]
                continue
            if len(self._buffer) < 3 or len(self._buffer) < self._buffer[2] + 4:
                return None
            end = self._buffer[2] + 4
            frame = bytes(self._buffer[:end])
            if _xor(frame) == 0:
                del self._buffer[:end]
                return command, frame[3:-1]
            del self._buffer[0]
        self._buffer.clear()
        return None

    def _answer(self, kind: int, body: bytes, now_ns: int) -> None:
        head = struct.pack("<BBIB", START, 0x5A, len(body), kind)
        self._wire.send(head + body, now_ns + REPLY_NS, whole=True)

    def _tell_boot(self) -> None:
        self._booted = True
        major, minor = self.firmware
        text = f"RP LIDAR System.\r\nFirmware Ver {major}.{minor} - rtm, HW Ver {self.profile.hardware}\r\n"
        self._wire.send(f"{text}Model: {self.profile.model:02x}\r\n".encode("ascii"), self._boot_done_ns)

    # -- requests -----------------------------------------------------------------------------------------------------

    def _reset(self, data: bytes, now_ns: int) -> None:
        """Back to the start; only what is broken stays so. The motor of an A2 goes to its default."""
        if not self._broken:
            self.health, self.error = HEALTH_GOOD, 0
        self._boot(now_ns)

    def _info(self, data: bytes, now_ns: int) -> None:
        major, minor = self.firmware
        told = bytes((self.profile.model, minor, major, self.profile.hardware)) + self._serial
        self._answer(ANSWER_INFO, told, now_ns)

    def _tell_health(self, data: bytes, now_ns: int) -> None:
        self._answer(ANSWER_HEALTH, struct.pack("<BH", self.health, self.error), now_ns)

    def _rates(self, data: bytes, now_ns: int) -> None:
        us = [mode.sample_ns // 1000 for mode in (self._standard, self._fastest)]
        self._answer(ANSWER_RATES, struct.pack("<HH", *us), now_ns)

    def _config(self, data: bytes, now_ns: int) -> None:
        """84h: the key comes back, with its value if there is one."""
        if len(data) < 4:
            return
        key = int.from_bytes(data[:4], "little")
        number = int.from_bytes(data[4:6], "little")
        mode = self.profile.modes[number] if number < len(self.profile.modes) else None
        value = b""
        if key == 0x70:
            value = struct.pack("<H", len(self.profile.modes))
        elif key == 0x7C:
            value = struct.pack("<H", self.profile.modes.index(self._fastest))
        elif key == 0x01:
            value = struct.pack("<HH", round(self.profile.turns_per_s * 60), DEFAULT_PWM)
        elif mode is not None and len(data) >= 6:
            value = _told_of_mode(key, mode)
        self._answer(ANSWER_CONFIG, data[:4] + value, now_ns)

    def _set_pwm(self, data: bytes, now_ns: int) -> None:
        if self.profile.has_pwm and len(data) == 2:
            self._pwm = min(MAX_PWM, int.from_bytes(data, "little"))
            self._drive(now_ns)

    def _board(self, data: bytes, now_ns: int) -> None:
        self._answer(ANSWER_BOARD, struct.pack("<I", self.profile.has_pwm), now_ns)

    def _express(self, data: bytes, now_ns: int) -> None:
        """Mode 0 means the express scan of old; a mode that is not there is not answered."""
        if len(data) != 5:
            return
        number = data[0]
        if number == 0 or (number == 1 and self.firmware < CONFIG_SINCE):
            self._begin_scan(self._fastest, now_ns, forced=False)
        elif number < len(self.profile.modes) and self.firmware >= CONFIG_SINCE:
            self._begin_scan(self.profile.modes[number], now_ns, forced=False)

    @property
    def _standard(self) -> ScanMode:
        return self.profile.modes[0]

    @property
    def _fastest(self) -> ScanMode:
        return self.profile.modes[-1]

    # -- measuring ----------------------------------------------------------------------------------------------------

    def _drive(self, now_ns: int) -> None:
        """Turn as switch, PWM and faults want it. A scan that waits for the motor begins when it is steady."""
        share = self._pwm / DEFAULT_PWM if self.profile.has_pwm else 1.0
        self._motor.turn_at(self.profile.turns_per_s * share * self._speed_share * self._turns_on, now_ns)
        if self._scan is not None and self._scan.zero_ns is None:
            self._await_motor(self._scan, now_ns)

    def _begin_scan(self, mode: ScanMode, now_ns: int, *, forced: bool) -> None:
        if self.health == HEALTH_ERROR:
            return
        size = 84 if mode.answer == ANSWER_CAPSULES else 5
        self._wire.send(struct.pack("<BBIB", START, 0x5A, size | REPEATED, mode.answer), now_ns + REPLY_NS, whole=True)
        self._scan = _Scan(mode, forced)
        self._await_motor(self._scan, now_ns + REPLY_NS)

    def _await_motor(self, scan: _Scan, now_ns: int) -> None:
        if scan.forced:
            scan.zero_ns = now_ns
        elif self._motor.target > 0.0:
            scan.zero_ns = max(now_ns, self._motor.steady_ns())

    def _end_scan(self) -> None:
        self._scan = None

    def _batch_done_ns(self, scan: _Scan, zero_ns: int) -> int:
        return zero_ns + ((scan.next_batch + 1) * scan.batch - 1) * scan.mode.sample_ns

    def _sample(self, now_ns: int) -> None:
        """Take all samples that are due, and hand whole batches to the line."""
        scan = self._scan
        while scan is not None and scan.zero_ns is not None:
            done_ns = self._batch_done_ns(scan, scan.zero_ns)
            if done_ns > now_ns:
                return
            if scan.next_batch >= scan.foreseen:
                self._foresee(scan, done_ns, now_ns)
            first_ns = done_ns - (scan.batch - 1) * scan.mode.sample_ns
            scan.next_batch += 1
            slow = self._motor.speed(first_ns) < SLOWEST_SHARE * self.profile.turns_per_s
            if slow and not scan.forced:
                continue
            stamp_ns = scan.stamps_ns(first_ns)
            turns = self._motor.turns(stamp_ns)
            if scan.mode.answer == ANSWER_CAPSULES:
                self._wire.send(self._capsule(scan, turns, stamp_ns), done_ns, whole=True)
            else:
                self._wire.send(self._nodes(scan, turns, stamp_ns), done_ns, whole=True)

    def _foresee(self, scan: _Scan, done_ns: int, now_ns: int) -> None:
        """Several batches are due: see `Ranger.foresee`."""
        count = min((now_ns - done_ns) // (scan.batch * scan.mode.sample_ns) + 1, MOST_FORESEEN // scan.batch)
        stamp_ns = scan.stamps_ns(done_ns - (scan.batch - 1) * scan.mode.sample_ns, count)
        scan.offsets = None
        if count < 2 or not self._ranger.may_foresee(stamp_ns):
            return
        scan.foreseen = scan.next_batch + count
        turns = self._motor.turns(stamp_ns)
        if scan.mode.answer == ANSWER_CAPSULES:
            scan.offsets = self._offsets(turns, stamp_ns)
            turns = _turned_back(turns, scan.offsets)
        self._ranger.foresee(_bearing_rad(turns), stamp_ns)

    def _nodes(self, scan: _Scan, turns: F64, stamp_ns: F64) -> bytes:
        """Samples as 5-byte nodes."""
        angle = np.rint(turns % 1.0 * ANGLE_UNITS).astype(np.int64) % ANGLE_UNITS
        turn = np.floor(turns + 0.5 / ANGLE_UNITS).astype(np.int64)  # an angle that rounds up to 360 begins a turn
        distance, quality = self._distances(turns, stamp_ns)
        out = bytearray()
        kept: Sequence[int] = range(scan.batch)
        if self.points_left_out:
            kept = [k for k in kept if self._random.random() >= self.points_left_out]
        for k in kept:
            begins = scan.last_turn is not None and int(turn[k]) != scan.last_turn
            scan.last_turn = int(turn[k])
            out += encode_node(int(angle[k]), int(distance[k]), int(quality[k]), begins=begins)
        return bytes(out)

    def _capsule(self, scan: _Scan, turns: F64, stamp_ns: F64) -> bytes:
        """32 samples as one express capsule."""
        offset = scan.next_offsets()
        if offset is None:
            offset = self._offsets(turns, stamp_ns)
        distance, _ = self._distances(_turned_back(turns, offset), stamp_ns)
        if self.points_left_out:
            distance[self._random.random(scan.batch) < self.points_left_out] = 0
        start = round(float(turns[0] % 1.0) * ANGLE_UNITS) % ANGLE_UNITS
        capsule = encode_capsule(start, distance, offset, first=scan.is_first)
        scan.is_first = False
        return capsule

    def _offsets(self, turns: F64, stamp_ns: F64) -> I64:
        """How far the lever turns each sample back, in eighths of a degree."""
        if not self.lever_m:
            return np.zeros(len(turns), np.int64)
        ranger = self._ranger
        true_m = ranger.scene.beam_ranges(ranger.mount, _bearing_rad(turns), stamp_ns, ranger.range_max_m)
        seen_m = np.where(np.isfinite(true_m), np.maximum(true_m, self.profile.range_min_m), ranger.range_max_m)
        eighths = np.degrees(np.arctan(self.lever_m / seen_m)) * 8.0
        offsets: I64 = np.clip(np.rint(eighths), 0, MAX_OFFSET).astype(np.int64)
        return offsets

    def _distances(self, turns: F64, stamp_ns: F64) -> tuple[I64, I64]:
        """Distances in quarter millimetres, 0 where there is none, and qualities of samples."""
        range_m = self._ranger.measure(_bearing_rad(turns), stamp_ns)
        good = np.isfinite(range_m)
        range_m = np.where(good, range_m, 0.0)
        good &= (range_m >= self.profile.range_min_m) & (range_m <= self._ranger.range_max_m)
        quarters = np.where(good, np.rint(range_m * 4000.0), 0.0).astype(np.int64)
        quality = np.where(good, np.clip(47.0 - 2.0 * range_m, 10.0, 47.0), 0.0).astype(np.int64)
        return np.minimum(quarters, 0xFFFF), quality


def _told_of_mode(key: int, mode: ScanMode) -> bytes:
    """The value of a configuration key that takes a mode's number."""
    if key == 0x71:
        return struct.pack("<I", round(mode.sample_ns / 1000 * 256))
    if key == 0x74:
        return struct.pack("<I", round(mode.range_max_m * 256))
    if key == 0x75:
        return bytes((mode.answer,))
    return mode.name.encode("ascii") + b"\0" if key == 0x7F else b""


def _xor(data: bytes) -> int:
    sum_ = 0
    for byte in data:
        sum_ ^= byte
    return sum_
