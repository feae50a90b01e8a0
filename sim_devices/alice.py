"""ALICE: a round robot that feels its way with 24 whiskers and sees 24 lights; synchro drive; on one serial line.

Source: the robot of [ZvP94] as its book tells it: 30 cm across, 24 photo sensors with a beam of 15 degrees, 24 touch
wires with switches, synchro drive with light barriers at the chain and an encoder at the wheels. Its bytes are not
told; this protocol is ours (docs/devices/alice.md), 57600 8N1, whole numbers little-endian, unasked:

    A5 4C | 40 | sequence u8 | time u32, ms | way ahead i32, way left i32, 0.1 mm, summed up, in the body's frame
          | 24 x light u8, 255 = full | touch, 24 bits, bit k = sensor k | CRC-16 of all before it, u16

40 is the count of bytes from the sequence on to the end of the touches. CRC-16/CCITT-FALSE (0x1021, from 0xFFFF).
What the robot does by itself: it drives ahead until a whisker bends, then chooses another direction away from there.

Quirks: the body is dragged along by the wheels, `drift_rad_per_m` for each metre; wheels slip; a look may be garbled by
lamps switched and wires stuck, with the chance `false_looks`, its checksum right: only the map can notice.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.checksums import crc16_ccitt
from sim_devices.wire import SECOND_NS, PacedWire

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

BAUD = 57600
RING = 24
RADIUS_M = 0.15
WHISKER_M = 0.12
BEAM_RAD = math.radians(15.0)
SYNC = b"\xa5\x4c"
STEP_S = 0.05


@dataclass(frozen=True, slots=True)
class Lamp:
    """A light of the room. power: what a sensor close by gains, of full scale; half of it 2 m away."""

    x_m: float
    y_m: float
    power: float


@dataclass(frozen=True, slots=True)
class Daylight:
    """Light from far away through a glazed side, the same in the whole room. power: at its brightest direction."""

    bearing_rad: float
    power: float
    spread_rad: float


@dataclass(frozen=True, slots=True)
class LampRoom:
    """Walls (N, 4) x0 y0 x1 y1 in metres, lamps, light from far away, and light from everywhere."""

    walls: F64
    lamps: tuple[Lamp, ...]
    daylight: tuple[Daylight, ...] = ()
    ambient: float = 0.05

    def lights(self, x_m: float, y_m: float, bearing_rad: F64) -> F64:
        """(N,) what photo sensors looking to bearings (N,) get; a lamp behind a wall gives nothing."""
        total = np.full(bearing_rad.shape, self.ambient)
        for light in self.daylight:
            off = (bearing_rad - light.bearing_rad + math.pi) % (2.0 * math.pi) - math.pi
            total += light.power * np.exp(-((off / light.spread_rad) ** 2))
        for lamp in self.lamps:
            dx, dy = lamp.x_m - x_m, lamp.y_m - y_m
            if not self._sees(x_m, y_m, lamp):
                continue
            off = (bearing_rad - math.atan2(dy, dx) + math.pi) % (2.0 * math.pi) - math.pi
            total += lamp.power / (1.0 + 0.25 * (dx * dx + dy * dy)) * np.exp(-((off / BEAM_RAD) ** 2))
        return np.asarray(np.minimum(total, 1.0))

    def reaches(self, x_m: float, y_m: float, bearing_rad: F64, length_m: float) -> Bools:
        """(N,) whether something stands within the length along bearings (N,)."""
        tip = np.stack((length_m * np.cos(bearing_rad), length_m * np.sin(bearing_rad)), axis=-1)
        return np.asarray(self._crossed(np.array([x_m, y_m]), tip).any(axis=1))

    def _sees(self, x_m: float, y_m: float, lamp: Lamp) -> bool:
        way = np.array([[lamp.x_m - x_m, lamp.y_m - y_m]]) * 0.999
        return not self._crossed(np.array([x_m, y_m]), way).any()

    def _crossed(self, origin: F64, way: F64) -> Bools:
        """(N, walls) which of the straight ways (N, 2) from the origin cross which wall."""
        a, e = self.walls[:, :2] - origin, self.walls[:, 2:] - self.walls[:, :2]
        cross = way[:, :1] * e[:, 1] - way[:, 1:] * e[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
            share = (a[:, 0] * way[:, 1:] - a[:, 1] * way[:, :1]) / cross
        return np.asarray((along >= 0.0) & (along <= 1.0) & (share >= 0.0) & (share <= 1.0))


def lamp_room() -> LampRoom:
    """A room of 6 x 4.5 m with a partition, a box, five lamps and daylight; the robot starts at (1, 1)."""

    def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
        return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]

    walls = [*box(0.0, 0.0, 6.0, 4.5), *box(2.7, 2.2, 3.3, 2.8), (4.2, 0.0, 4.2, 1.3)]
    lamps = (
        Lamp(0.1, 3.0, 0.4), Lamp(2.0, 4.4, 0.3), Lamp(5.9, 3.4, 0.4), Lamp(5.0, 0.1, 0.4), Lamp(1.7, 0.1, 0.3),
    )  # fmt: skip
    sky = (
        Daylight(math.radians(70.0), 0.8, math.radians(30.0)),
        Daylight(math.radians(-140.0), 0.5, math.radians(20.0)),
    )
    return LampRoom(np.array(walls), lamps, sky)


class Alice:
    """The robot on its serial line. The first step is power-on.

    looks_hz: how often it tells what it feels.  seed: of noise, slip and its choices.
    """

    fault_family = "encoder"

    def __init__(
        self,
        room: LampRoom | None = None,
        *,
        start: tuple[float, float] = (1.0, 1.0),
        looks_hz: float = 4.0,
        speed_m_s: float = 0.2,
        drift_rad_per_m: float = 0.02,
        slip: float = 0.01,
        light_noise: float = 0.01,
        false_looks: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.room = room or lamp_room()
        self.x_m, self.y_m = start
        self.yaw_rad = 0.0  # of the body
        self.false_sequences: set[int] = set()  # looks, counted from 0, that were garbled
        self.looks = 0
        self._period_ns = round(SECOND_NS / looks_hz)
        self._speed = speed_m_s
        self._drift = drift_rad_per_m
        self._slip = slip
        self._noise = light_noise
        self._false = false_looks
        self._random = np.random.default_rng(seed)
        self._heading = 0.0  # of the wheels, in the body's frame
        self._way = [0.0, 0.0]  # what the encoders summed up
        self._wire = PacedWire(BAUD)
        self._begin_ns: int | None = None
        self._driven_ns = 0

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; it hears nothing."""
        if self._begin_ns is None:
            self._begin_ns = self._driven_ns = now_ns
            self._wire.clear(now_ns)
        while (due_ns := self._begin_ns + (self.looks + 1) * self._period_ns) <= now_ns:
            self._drive_until(due_ns)
            self._wire.send(self._frame(due_ns), due_ns)
            self.looks += 1
        sent = self._wire.leave_by(now_ns)
        return bytes(byte ^ 0x5A | 0x80 for byte in sent) if baud is not None and baud != BAUD else sent

    @property
    def next_ns(self) -> int | None:
        """When it wants to be served next."""
        if self._begin_ns is None:
            return None
        due_ns = self._begin_ns + (self.looks + 1) * self._period_ns
        return due_ns if self._wire.next_ns is None else min(due_ns, self._wire.next_ns)

    def _bearings(self) -> F64:
        return np.asarray(self.yaw_rad + np.arange(RING) * (2.0 * math.pi / RING))

    def _drive_until(self, until_ns: int) -> None:
        while self._driven_ns < until_ns:
            step_ns = min(round(STEP_S * SECOND_NS), until_ns - self._driven_ns)
            self._driven_ns += step_ns
            self._drive(self._speed * step_ns / SECOND_NS)

    def _drive(self, way_m: float) -> None:
        course = self.yaw_rad + self._heading
        ahead = course + np.radians([-50.0, -25.0, 0.0, 25.0, 50.0])
        if self.room.reaches(self.x_m, self.y_m, ahead, RADIUS_M + 0.5 * WHISKER_M).any():
            self._turn_away()
            return
        self._heading += float(self._random.normal(0.0, 0.15)) * math.sqrt(way_m)
        self.x_m += way_m * math.cos(course)
        self.y_m += way_m * math.sin(course)
        self.yaw_rad += self._drift * way_m
        counted = way_m * (1.0 + self._slip * float(self._random.standard_normal()))
        self._way[0] += counted * math.cos(self._heading)
        self._way[1] += counted * math.sin(self._heading)

    def _turn_away(self) -> None:
        """Steer where no whisker is bent; steering does not move the body."""
        free = ~self._whiskers()
        free &= np.roll(free, 1) & np.roll(free, -1) & np.roll(free, 2) & np.roll(free, -2)
        choice = np.flatnonzero(free)
        k = int(self._random.choice(choice)) if len(choice) else int(self._random.integers(RING))
        self._heading = k * 2.0 * math.pi / RING

    def _whiskers(self) -> Bools:
        return self.room.reaches(self.x_m, self.y_m, self._bearings(), RADIUS_M + WHISKER_M)

    def _frame(self, now_ns: int) -> bytes:
        light = self.room.lights(self.x_m, self.y_m, self._bearings())
        light = np.clip(light + self._random.normal(0.0, self._noise, RING), 0.0, 1.0)
        touch = self._whiskers()
        if self._random.random() < self._false:
            light, touch = self._random.random(RING), self._random.random(RING) < 0.5
            self.false_sequences.add(self.looks)
        assert self._begin_ns is not None
        head = struct.pack(
            "<2sBBIii", SYNC, 40, self.looks & 0xFF, ((now_ns - self._begin_ns) // 1_000_000) & 0xFFFFFFFF,
            _wrapped(self._way[0]), _wrapped(self._way[1]),
        )  # fmt: skip
        body = head + bytes(round(255.0 * float(value)) for value in light) + _bits(touch).to_bytes(3, "little")
        return body + struct.pack("<H", crc16_ccitt(body, 0xFFFF))


def _wrapped(way_m: float) -> int:
    """Tenths of a millimetre in 32 bits; the sum runs over after 200 km."""
    return (round(way_m * 1e4) + (1 << 31)) % (1 << 32) - (1 << 31)


def _bits(touch: Sequence[bool] | Bools) -> int:
    return sum(1 << k for k, bent in enumerate(touch) if bent)
