"""A micro-controller board with the ros_arduino_bridge sketch: wheel counts, motors, pings, pins, servos; as text.

Source: the sketch and its Python driver (hbrobotics/ros_arduino_bridge), exchanges with the sketch built for a PC.

    57600 8N1. A letter, arguments separated by one blank, CR. The reply ends with CR LF. Nothing is echoed.
    b  baud            e  counts "left right"     r  counts to 0            m l r  ticks per 1/30 s, for 2 s
    u  Kp:Kd:Ki:Ko     p pin  ping, cm            a, d pin  analog, digital read
    w, x pin v  write  c pin mode                 s i deg, t i  servo       all else  "Invalid Command"

Habits kept: characters before the first blank overwrite the letter, so line feeds before it do no harm; LF ends
nothing; the counts are signed 32 bits; the wheels stop by themselves 2 s after the last `m`. A ping blocks the board as
long as its echo is under way, and for a second if nothing is connected to the pin. The board is deaf while it starts;
characters that come then are lost. Arguments read as C's atoi reads them. The board's USB chip hands on a reply in one
packet: drivers that stop reading at CR and empty the port before they ask again rely on its LF being there by then.

Assumed: a ping without echo answers 0 after 38 ms; a pin nobody connected reads 1 where the sketch pulled it up
(`c pin 2`, or 1 written to an input) and 0 else; an unconnected analog input reads 0. Opening the port resets a real
board; a pty cannot see that, so `reset` is a fault here, and a power cycle does the same.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite, radians

import numpy as np

from sim_devices.device import Mount, Scene
from sim_devices.sonar_faults import SONAR_KINDS, SonarTroubles
from sim_devices.wheel import Undo, Wheel, inflict_on_counts, signed
from sim_devices.wire import SECOND_NS, PacedWire

BAUD = 57600
PID_HZ = 30
AUTO_STOP_NS = 2 * SECOND_NS
ARGUMENT_LENGTH = 31
TOP_TURNS_PER_S = 3.0  # of a wheel at full PWM
RECEIVE_BUFFER = 64  # what a busy board can hold; the rest is lost
TURN_AROUND_NS = 200_000  # from a CR to the first character of its reply
NO_ECHO_NS = 38_000_000
NOTHING_CONNECTED_NS = SECOND_NS  # for which pulseIn waits
SOUND_US_PER_CM = 29  # what the sketch reckons with, there and back separately
SOUND_M_S = 343.4
SERVO_DEG_PER_S = 300.0
_NUMBER = re.compile(rb"[ \t\n\v\f\r]*([+-]?[0-9]+)")

Pin = Callable[[int], bool]  # told the time: whether the line is high


@dataclass(frozen=True, slots=True)
class Sonar:
    """A ping sensor on a pin: its pose on the robot, half its opening angle, how far it hears."""

    mount: Mount
    half_angle_rad: float = radians(15.0)
    range_min_m: float = 0.02
    range_max_m: float = 4.0


class ArduinoBridge:
    """The board on its serial line. The first step is power-on.

    left, right: its wheels; None builds the sketch without a base: `e`, `m`, `r`, `u` are invalid commands then.
    sonars, pins, analog: what is connected to which pin; a pin's function tells whether the line is high.
    boot_s: from power-on or reset to the first command.  Forks of the sketch: leading_blank prints a blank before the
    baud, raw_pwm knows `o l r`, PWM of the motors (-255..255), baud_bps is another line rate.
    """

    fault_family = "encoder"

    def __init__(
        self,
        left: Wheel | None,
        right: Wheel | None,
        *,
        sonars: Mapping[int, Sonar] | None = None,
        pins: Mapping[int, Pin] | None = None,
        analog: Mapping[int, int] | None = None,
        boot_s: float = 1.0,
        noise_m: float = 0.003,
        leading_blank: bool = False,
        baud_bps: int = BAUD,
        raw_pwm: bool = False,
        seed: int = 0,
    ) -> None:
        self.wheels: tuple[Wheel, ...] = () if left is None or right is None else (left, right)
        self.sonars = dict(sonars or {})
        self.pins = dict(pins or {})
        self.analog = dict(analog or {})
        self.pid = (20, 12, 0, 50)
        self.sonar_troubles = SonarTroubles()
        self.fault_families = (*(("encoder",) if self.wheels else ()), *(("sonar",) if self.sonars else ()))
        self._scene: Scene | None = self.wheels[0].scene if self.wheels else None
        self._boot_ns = round(boot_s * SECOND_NS)
        self._noise_m = noise_m
        self._baud = baud_bps
        self._baud_text = (b" %d" if leading_blank else b"%d") % baud_bps
        self._raw_pwm = raw_pwm
        self._random = np.random.default_rng(seed)
        self._wire = PacedWire(baud_bps)
        self._powered = False
        self._begin(0)

    def see(self, scene: Scene) -> None:
        """Measure pings in this scene; needed where there are no wheels, or sonars see other faults than they do."""
        self._scene = scene

    # -- what the wire and the tests see ------------------------------------------------------------------------------

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then."""
        if not self._powered:
            self.power_on(now_ns)
        self._stop_when_forgotten(now_ns)
        if baud is not None and baud != self._baud:
            return bytes(byte ^ 0x5A | 0x80 for byte in self._wire.leave_by(now_ns))
        if now_ns >= self._awake_ns:
            self._inbox += received
        self._work(now_ns)
        del self._inbox[RECEIVE_BUFFER:]
        return self._wire.leave_by(now_ns)

    @property
    def next_ns(self) -> int | None:
        """When it wants to be served next; None while it only waits for commands."""
        due = [self._wire.next_ns, self._stop_ns]
        if self._inbox:
            due.append(self._free_ns)
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def power_on(self, now_ns: int) -> None:
        """Power comes, or the reset button was pressed: counts start at 0, motors stand."""
        self._powered = True
        self._begin(now_ns)
        self._awake_ns = self._free_ns = now_ns + self._boot_ns
        for wheel in self.wheels:
            wheel.set_count(0, now_ns)
            wheel.drive(now_ns, 0.0)

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty."""
        if kind in SONAR_KINDS:
            return self.sonar_troubles.inflict(kind, value, arguments)
        if kind == "reset":
            self.power_on(now_ns)
        else:
            inflict_on_counts(self.wheels, kind, value, arguments, now_ns)
        return None

    @property
    def moving(self) -> bool:
        """Whether its motors are told to turn."""
        return self._stop_ns is not None

    # -- the sketch ---------------------------------------------------------------------------------------------------

    def _begin(self, now_ns: int) -> None:
        self._inbox = bytearray()
        self._letter = 0
        self._arguments = [bytearray(), bytearray()]
        self._filling = 0  # 0: the letter, 1 and 2: an argument
        self._awake_ns = self._free_ns = now_ns
        self._stop_ns: int | None = None
        self._modes: dict[int, int] = {}
        self._levels: dict[int, int] = {}
        self._servos: dict[int, tuple[int, float, int]] = {}  # since when, from where, to where
        self._wire.clear(now_ns)

    def _work(self, now_ns: int) -> None:
        """Take characters until a command keeps the board busy."""
        while self._inbox and self._free_ns <= now_ns:
            character = self._inbox.pop(0)
            if character == 0x0D:
                reply, busy_ns = self._run(now_ns)
                self._free_ns = now_ns + busy_ns
                self._wire.send(reply + b"\r\n", self._free_ns + TURN_AROUND_NS, whole=True)
                self._letter, self._arguments, self._filling = 0, [bytearray(), bytearray()], 0
            elif character == 0x20:
                self._filling = min(2, self._filling + 1)
            elif self._filling == 0:
                self._letter = character
            elif len(argument := self._arguments[self._filling - 1]) < ARGUMENT_LENGTH:
                argument.append(character)

    def _run(self, now_ns: int) -> tuple[bytes, int]:
        """Reply to a command, and how long it blocks the board."""
        first, second = (_atoi(argument) for argument in self._arguments)
        match chr(self._letter):
            case "b":
                return self._baud_text, 0
            case "a":
                return b"%d" % max(0, min(1023, self.analog.get(first, 0))), 100_000
            case "d":
                return b"%d" % self._level(first, now_ns), 0
            case "w" | "x":
                self._levels[first] = second
            case "c":
                self._modes[first] = second
            case "p":
                return self._ping(first, now_ns)
            case "s":
                self._servos[first] = (now_ns, self._servo(first, now_ns), max(0, min(180, second)))
            case "t":
                return b"%d" % round(self._servo(first, now_ns)), 0
            case "e" | "r" | "m" | "u" if self.wheels:
                return self._run_base(chr(self._letter), first, second, now_ns), 0
            case "o" if self.wheels and self._raw_pwm:
                self._drive(first / 255.0 * TOP_TURNS_PER_S, second / 255.0 * TOP_TURNS_PER_S, now_ns)
            case _:
                return b"Invalid Command", 0
        return b"OK", 0

    def _run_base(self, letter: str, first: int, second: int, now_ns: int) -> bytes:
        left, right = self.wheels
        if letter == "e":
            return b"%d %d" % (signed(left.count(now_ns), 32), signed(right.count(now_ns), 32))
        if letter == "r":
            for wheel in self.wheels:
                wheel.set_count(0, now_ns)
        elif letter == "m":
            per_s = PID_HZ / abs(left.ticks_per_turn), PID_HZ / abs(right.ticks_per_turn)
            self._drive(first * per_s[0], second * per_s[1], now_ns)
        else:
            gains = [_atoi(part) for part in bytes(self._arguments[0]).split(b":") if part][:4]
            self.pid = (*gains, *self.pid[len(gains) :])  # type: ignore[assignment]
        return b"OK"

    def _drive(self, left_turns_per_s: float, right_turns_per_s: float, now_ns: int) -> None:
        for wheel, turns_per_s in zip(self.wheels, (left_turns_per_s, right_turns_per_s)):
            wheel.drive(now_ns, turns_per_s * abs(wheel.ticks_per_turn))
        self._stop_ns = now_ns + AUTO_STOP_NS if left_turns_per_s or right_turns_per_s else None

    def _stop_when_forgotten(self, now_ns: int) -> None:
        if self._stop_ns is not None and now_ns > self._stop_ns:
            for wheel in self.wheels:
                wheel.drive(self._stop_ns, 0.0)
            self._stop_ns = None

    # -- pins ---------------------------------------------------------------------------------------------------------

    def _level(self, pin: int, now_ns: int) -> int:
        mode = self._modes.get(pin, 0)
        if mode == 1:
            return int(bool(self._levels.get(pin, 0)))
        if pin in self.pins:
            return int(self.pins[pin](now_ns))
        return int(mode == 2 or bool(self._levels.get(pin, 0)))

    def _ping(self, pin: int, now_ns: int) -> tuple[bytes, int]:
        sonar = self.sonars.get(pin)
        if sonar is None or self._scene is None:
            return b"0", NOTHING_CONNECTED_NS
        scene = self._scene

        def measure(at_pin: int) -> float:
            there = self.sonars.get(at_pin, sonar)
            return scene.cone_range(there.mount, there.half_angle_rad, now_ns, sonar.range_max_m)

        told_m = self.sonar_troubles.told_m(pin, measure, self._random, sonar.range_max_m)
        if told_m is None:
            return b"0", NOTHING_CONNECTED_NS
        range_m = told_m
        if not (isfinite(range_m) and range_m <= sonar.range_max_m):
            return b"0", NO_ECHO_NS
        range_m = max(sonar.range_min_m, range_m + self._noise_m * float(self._random.standard_normal()))
        echo_us = 2.0e6 * range_m / SOUND_M_S
        return b"%d" % int(echo_us / SOUND_US_PER_CM / 2.0), round(1000 * echo_us)

    def _servo(self, number: int, now_ns: int) -> float:
        """Where a servo stands on its way: it turns at its own pace."""
        if number not in self._servos:
            return 90.0
        since_ns, begin, target = self._servos[number]
        turned = SERVO_DEG_PER_S * (now_ns - since_ns) / SECOND_NS
        return min(float(target), begin + turned) if target >= begin else max(float(target), begin - turned)


def _atoi(text: bytes | bytearray) -> int:
    """What C's atoi makes of it, in the board's 16 bits."""
    match = _NUMBER.match(bytes(text))
    return signed(int(match[1]), 16) if match else 0
