"""LDROBOT LD06, LD19 and their family: scanners that talk without being asked.

Source: LDROBOT "LD06 / LD19 development manual", packet table and example; sizes and checks of ldlidar_stl_sdk.

    54 2C  speed  start  12 x (distance, intensity)  end  time  crc        47 bytes, numbers little-endian

speed in degrees a second, start and end in 1/100 degree, distance in mm (0: none), time in ms (0..29999).

What this emulator does that a naive one would not:
- Samples are taken by the clock; the head turns clockwise, at a speed that swings a little. Speed, angles and time of a
  packet are those of its own samples, so readers that compare them find them to agree, also while the motor spins up.
- Angles are counted through 360 and wrap within a packet wherever that happens.
- The clock counts from power-on, may drift, and wraps at 30 s.
- A sample without an echo keeps an intensity: only the distance tells.
- What a host sends is not heard, but for the LD14P: 54 A0 start, A1 stop, A2 speed, 04, 4 bytes, crc.
- Assumed: the time is that of the last sample; a motor in trouble stands, and all its distances are 0.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.checksums import ldrobot_crc
from sim_devices.device import F64, Mount, Scene
from sim_devices.ranging import MOST_FORESEEN, Ranger, garbled
from sim_devices.spinner import Spinner
from sim_devices.wire import SECOND_NS, PacedWire

I64 = NDArray[np.int64]

HEADER, VERSION = 0x54, 0x2C
SAMPLES = 12
CLOCK_WRAP_MS = 30_000
COMMAND_SIZE = 8
START_MOTOR, STOP_MOTOR, SET_SPEED = 0xA0, 0xA1, 0xA2
NO_ECHO_INTENSITY = 212


@dataclass(frozen=True, slots=True)
class LdProfile:
    """What one model does."""

    line_rate_bps: int
    samples_per_s: int
    turns_per_s: float
    range_min_m: float
    range_max_m: float
    obeys: bool = False


LD06 = LdProfile(230400, 4500, 10.0, 0.02, 12.0)
LD19 = LdProfile(230400, 4500, 10.0, 0.02, 12.0)
STL27L = LdProfile(921600, 21600, 10.0, 0.03, 25.0)
LD14P = LdProfile(230400, 4000, 6.0, 0.10, 8.0, obeys=True)
LDROBOT_PROFILES = {"ld06": LD06, "ld19": LD19, "stl27l": STL27L, "ld14p": LD14P}


def encode_packet(speed_dps: int, start: int, end: int, distances_mm: I64, intensities: I64, time_ms: int) -> bytes:
    """One packet; start and end in 1/100 degree, distances and intensities (12,)."""
    body = bytearray(struct.pack("<BBHH", HEADER, VERSION, speed_dps, start))
    for distance, intensity in zip(distances_mm, intensities):
        body += struct.pack("<HB", distance, intensity)
    body += struct.pack("<HH", end, time_ms)
    return bytes(body) + bytes((ldrobot_crc(bytes(body)),))


def _bearing_rad(turns: F64) -> F64:
    """Counter-clockwise; the head turns clockwise."""
    return -2.0 * np.pi * turns


class LdLidar:
    """One scanner on its line. See the module's text for its habits.

    profile: a model of LDROBOT_PROFILES.  boot_s: from power-on to the first packet.  spin_up_s: of the motor.
    wobble: share by which its speed swings.  clock_drift_ppm: how much too fast its clock runs.  clock_start_ms: its
    clock at power-on (to test the wrap).  noise_scale: 0 for exact ranges.  dropout: share of samples without an echo.
    The first step is power-on.
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount | None = None,
        *,
        profile: LdProfile = LD06,
        seed: int = 0,
        boot_s: float = 0.2,
        spin_up_s: float = 0.8,
        wobble: float = 0.01,
        clock_drift_ppm: float = 0.0,
        clock_start_ms: int = 0,
        noise_scale: float = 1.0,
        dropout: float = 0.0,
    ) -> None:
        self.profile = profile
        self.clock_drift_ppm = clock_drift_ppm
        self._random = np.random.default_rng(seed)
        self._ranger = Ranger(
            scene,
            mount or Mount(),
            self._random,
            profile.range_max_m,
            0.003,
            0.002,
            noise_scale=noise_scale,
            dropout=dropout,
        )
        self._boot_ns = round(boot_s * SECOND_NS)
        self._motor = Spinner(profile.turns_per_s, spin_up_s, wobble)
        self._clock_start_ms = clock_start_ms
        self._told_share = self._speed_share = 1.0
        self._trouble = False
        self.power_on(0)
        self._powered = False  # until the first step tells the time

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then. baud: the host's line speed, if known."""
        if not self._powered:
            self.power_on(now_ns)
        fits = baud is None or baud == self.profile.line_rate_bps
        if received and fits and self.profile.obeys and now_ns >= self._zero_ns:
            self._take(received, now_ns)
        while self._done_ns(self._next_packet) <= now_ns:
            if self._next_packet >= self._foreseen and self._done_ns(self._next_packet + 1) <= now_ns:
                self._foresee(now_ns)
            if self._told_share:
                self._wire.send(self._packet(self._next_packet), self._done_ns(self._next_packet), whole=True)
            self._next_packet += 1
        out = self._wire.leave_by(now_ns)
        return out if fits else garbled(out, self._random)

    @property
    def next_ns(self) -> int | None:
        """When something is due next."""
        if not self._powered:
            return None
        leaving_ns = self._wire.next_ns
        done_ns = self._done_ns(self._next_packet)
        return done_ns if leaving_ns is None else min(done_ns, leaving_ns)

    def power_on(self, now_ns: int) -> None:
        """Start as after the supply came back: the motor spins up, then packets come without end."""
        self._powered = True
        self._zero_ns = now_ns + self._boot_ns
        self._next_packet = self._foreseen = 0  # up to that one the scene has been asked
        self._wire = PacedWire(self.profile.line_rate_bps, now_ns)
        self._buffer = bytearray()
        self._clock_zero_ns = now_ns
        self._clock_offset_ns = self._clock_start_ms * 1_000_000
        self._told_share = 1.0
        self._motor.turn_at(0.0, now_ns, at_once=True)
        self._drive(now_ns)

    def set_speed_share(self, share: float, now_ns: int) -> None:
        """Let the head turn at this share of the speed it should have."""
        self._speed_share = share
        self._drive(now_ns)

    def set_clock_drift(self, ppm: float, now_ns: int) -> None:
        """Let the clock run so much too fast from now on; it does not jump."""
        self._clock_offset_ns = self._clock_ns(now_ns)
        self._clock_zero_ns = now_ns
        self.clock_drift_ppm = ppm

    def trouble(self, status: str | None, now_ns: int) -> None:
        """The motor stands and nothing is measured. None: well again."""
        self._trouble = status is not None
        self._drive(now_ns)

    def clock_ms(self, now_ns: int) -> int:
        """The device's own clock."""
        return self._clock_ns(now_ns) // 1_000_000 % CLOCK_WRAP_MS

    def _clock_ns(self, now_ns: int) -> int:
        elapsed_ns = now_ns - self._clock_zero_ns
        return self._clock_offset_ns + elapsed_ns + round(elapsed_ns * self.clock_drift_ppm * 1e-6)

    def _drive(self, now_ns: int) -> None:
        share = 0.0 if self._trouble else self._speed_share * self._told_share
        self._motor.turn_at(self.profile.turns_per_s * share, now_ns)

    # -- measuring ----------------------------------------------------------------------------------------------------

    def _sample_ns(self, sample: int) -> int:
        return self._zero_ns + sample * SECOND_NS // self.profile.samples_per_s

    def _done_ns(self, packet: int) -> int:
        return self._sample_ns(packet * SAMPLES + SAMPLES - 1)

    def _stamps_ns(self, packet: int, count: int = 1) -> F64:
        """(12 count,) when the samples of these packets are taken."""
        samples = range(packet * SAMPLES, (packet + count) * SAMPLES)
        return np.array([self._sample_ns(sample) for sample in samples], dtype=np.float64)

    def _foresee(self, now_ns: int) -> None:
        """Several packets are due: see `Ranger.foresee`."""
        late_s = (now_ns - self._done_ns(self._next_packet)) / SECOND_NS
        count = min(1 + int(late_s * self.profile.samples_per_s / SAMPLES), MOST_FORESEEN // SAMPLES)
        self._foreseen = self._next_packet + count
        stamp_ns = self._stamps_ns(self._next_packet, count)
        self._ranger.foresee(_bearing_rad(self._motor.turns(stamp_ns)), stamp_ns)

    def _packet(self, packet: int) -> bytes:
        stamp_ns = self._stamps_ns(packet)
        turns = self._motor.turns(stamp_ns)
        angle = np.rint(turns % 1.0 * 36000.0).astype(np.int64) % 36000
        speed_dps = (turns[-1] - turns[0]) * 360.0 / ((stamp_ns[-1] - stamp_ns[0]) * 1e-9)
        range_m = self._ranger.measure(_bearing_rad(turns), stamp_ns)
        good = np.isfinite(range_m)
        range_m = np.where(good, range_m, 0.0)
        good &= (range_m >= self.profile.range_min_m) & (range_m <= self.profile.range_max_m) & (not self._trouble)
        distances_mm = np.where(good, np.rint(range_m * 1000.0), 0.0).astype(np.int64)
        echo = np.clip(235.0 - 8.0 * range_m, 1.0, 255.0)
        intensities = np.where(good, echo, NO_ECHO_INTENSITY).astype(np.int64)
        time_ms = self.clock_ms(self._done_ns(packet))
        return encode_packet(round(speed_dps), int(angle[0]), int(angle[-1]), distances_mm, intensities, time_ms)

    # -- commands of the LD14P ----------------------------------------------------------------------------------------

    def _take(self, received: bytes, now_ns: int) -> None:
        self._buffer += received
        while (start := self._buffer.find(HEADER)) >= 0:
            del self._buffer[:start]
            frame = bytes(self._buffer[:COMMAND_SIZE])
            if len(frame) < COMMAND_SIZE:
                return
            if frame[2] == 4 and ldrobot_crc(frame[:-1]) == frame[-1]:
                del self._buffer[:COMMAND_SIZE]
                self._obey(frame[1], int.from_bytes(frame[3:7], "little", signed=True), now_ns)
            else:
                del self._buffer[0]
        self._buffer.clear()

    def _obey(self, command: int, value: int, now_ns: int) -> None:
        if command == STOP_MOTOR:
            self._told_share = 0.0
        elif command == START_MOTOR:
            self._told_share = self._told_share or 1.0
        elif command == SET_SPEED and 2 * 360 <= value <= 8 * 360:
            self._told_share = value / 360.0 / self.profile.turns_per_s
        self._drive(now_ns)
