"""MaxBotix ultrasonic rangers by their serial text, one sensor on a line; and several behind a text multiplexer.

Source: data sheets of the LV-EZ, XL, HR and HRXL families. 9600 8N1 (USB types 57600), no address, no check sum, no
questions.

    LV-EZ   R123 CR     inches   006..254, 255 nothing seen     every 49 ms, the text in the last 5
    XL      R123 CR     cm       020..765, 765 nothing seen     every 99 ms
    HRXL    R1234 CR    mm       0300..5000, 5000 nothing seen  every 133 ms; types to 10 m: 0500..9999, 9999 nothing
    HRUSB   R1234 blank CR, mm, as HRXL

Habits kept: from power-on a quarter of a second of silence, then a few lines of banner, then readings for ever; what is
nearer than the least distance reads as the least distance; the host's bytes are not heard (a line's RX pin starts and
stops ranging, which no serial port does). The sensor measures at the begin of its cycle and tells at the end.

The multiplexer is a micro-controller that fires its sensors in turn, so that they do not hear each other, and prints
lines that end with CR LF: one for each reading with the channel before it ("3:R1234"), or one for each round with all
readings in order of their channels ("R0480 R1234"). Sensors on it that are not connected are left out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, radians

import numpy as np

from sim_devices.device import Mount, Scene
from sim_devices.sonar_faults import FOREIGN_SHARE
from sim_devices.wheel import Undo
from sim_devices.wire import SECOND_NS, PacedWire

BAUD = 9600
SILENT_NS = SECOND_NS // 4
BANNER_LINE_NS = 50_000_000
SOUND_AT_20_C = 343.4


@dataclass(frozen=True, slots=True)
class Family:
    """What one family of sensors prints.

    unit_m: of one step of its numbers.  least, most: ends of its numbers.  nothing: the number where nothing is seen.
    """

    unit_m: float
    digits: int
    least: int
    most: int
    nothing: int
    period_ns: int
    banner: tuple[str, ...]
    tail: str = ""
    baud_bps: int = BAUD

    def text(self, range_m: float) -> bytes:
        """A reading, without its CR."""
        steps = self.nothing
        if isfinite(range_m) and range_m <= self.most * self.unit_m:
            steps = max(self.least, round(range_m / self.unit_m))
        return f"R{steps:0{self.digits}d}{self.tail}".encode("ascii")


_HRXL_BANNER = ("HRXL-MaxSonar", "PN:MB7360", "MaxBotix Inc.", "RoHS 1.8b090  0713", "TempI")
FAMILIES: dict[str, Family] = {
    "lv": Family(0.0254, 3, 6, 254, 255, 49_000_000, ("LV-MaxSonar-EZ", "RoHS")),
    "xl": Family(0.01, 3, 20, 765, 765, 99_000_000, ("XL-MaxSonar-EZ", "RoHS")),
    "hr": Family(0.001, 4, 300, 4999, 5000, 133_000_000, _HRXL_BANNER),
    "hr-5m": Family(0.001, 4, 300, 4999, 5000, 133_000_000, _HRXL_BANNER),
    "hr-10m": Family(0.001, 4, 500, 9998, 9999, 166_000_000, _HRXL_BANNER),
    "hrusb": Family(0.001, 4, 300, 4999, 5000, 133_000_000, ("HRUSB-MaxSonar", "RoHS"), " ", 57600),
}


class _Ear:
    """One sensor's measuring: the scene through its cone, with noise; and what its faults make of it."""

    def __init__(
        self, scene: Scene, mount: Mount, half_angle_rad: float, family: Family, noise_m: float, seed: int
    ) -> None:
        self.scene = scene
        self.mount = mount
        self.half_angle_rad = half_angle_rad
        self.family = family
        self.noise_m = noise_m
        self.air_temp_c = 20.0
        self.stuck_m: float | None = None
        self.is_connected = True
        self.foreign = 0.0  # share of readings that hear another's pulse
        self._random = np.random.default_rng(seed)

    def text(self, now_ns: int) -> bytes:
        """A reading as text."""
        if self.stuck_m is not None:
            return self.family.text(self.stuck_m)
        reach_m = self.family.most * self.family.unit_m
        range_m = self.scene.cone_range(self.mount, self.half_angle_rad, now_ns, reach_m)
        if isfinite(range_m):
            range_m *= SOUND_AT_20_C / (331.3 + 0.606 * self.air_temp_c)
            range_m = max(0.0, range_m + self.noise_m * float(self._random.standard_normal()))
        if self.foreign and self._random.random() < self.foreign:
            range_m = min(range_m, reach_m * float(self._random.random()))
        return self.family.text(range_m if isfinite(range_m) else inf)


def _inflict(ears: Mapping[int, _Ear], kind: str, value: float, arguments: Mapping[str, float]) -> Undo | None:
    """Faults of sonars, on the channel that is named or on all."""
    channel = round(arguments.get("channel", 0))
    hit = [ear for number, ear in ears.items() if channel in (0, number)]
    if kind == "chain_break":
        hit = [ear for number, ear in ears.items() if number >= value]
        return _set_all(hit, "is_connected", False)
    if kind == "order_swap":
        pair = [ears[n] for n in (channel or 1, round(arguments.get("with", 2))) if n in ears]
        return _swap(pair[0], pair[1]) if len(pair) == 2 else None
    if kind == "cross_talk":
        return _set_all(hit, "foreign", FOREIGN_SHARE)
    if kind in ("stuck", "temperature"):
        return _set_all(hit, {"stuck": "stuck_m", "temperature": "air_temp_c"}[kind], value)
    return None


def _set_all(ears: Sequence[_Ear], name: str, value: object) -> Undo:
    before = [getattr(ear, name) for ear in ears]
    for ear in ears:
        setattr(ear, name, value)

    def undo(_: int) -> None:
        for ear, was in zip(ears, before):
            setattr(ear, name, was)

    return undo


def _swap(first: _Ear, second: _Ear) -> Undo:
    first.mount, second.mount = second.mount, first.mount

    def undo(_: int) -> None:
        first.mount, second.mount = second.mount, first.mount

    return undo


class _Talker(ABC):
    """What both devices share: a quarter of a second of silence, a banner, then lines for ever."""

    fault_family = "sonar"

    def __init__(self, banner: tuple[str, ...], baud_bps: int) -> None:
        self._banner = banner
        self._baud = baud_bps
        self._wire = PacedWire(baud_bps)
        self._powered = False
        self._line_ns: int = 0  # when the next line is ready
        self._ears: dict[int, _Ear] = {}

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns the bytes that have left by then. What it receives is not heard."""
        if not self._powered:
            self.power_on(now_ns)
        if now_ns - self._line_ns > 2 * SECOND_NS:  # nobody stepped it for a while: nothing is made up for that
            self._wire.clear(now_ns)
            self._line_ns = now_ns
        while self._line_ns <= now_ns:
            self._say_next(self._line_ns)
        out = self._wire.leave_by(now_ns)
        fits = baud is None or baud == self._baud
        return out if fits else bytes(byte ^ 0x5A | 0x80 for byte in out)

    @property
    def next_ns(self) -> int | None:
        """When its next line is ready or bytes are due to leave."""
        return min(at_ns for at_ns in (self._wire.next_ns, self._line_ns) if at_ns is not None)

    def power_on(self, now_ns: int) -> None:
        """The supply comes: silence, banner, readings."""
        self._powered = True
        self._wire.clear(now_ns)
        for number, line in enumerate(self._banner):
            self._wire.send(line.encode("ascii") + b"\r", now_ns + SILENT_NS + number * BANNER_LINE_NS)
        self._line_ns = now_ns + SILENT_NS + len(self._banner) * BANNER_LINE_NS + self._first_ns()

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty."""
        return _inflict(self._ears, kind, value, arguments)

    @abstractmethod
    def _first_ns(self) -> int:
        """From the greeting's end to the first line."""

    @abstractmethod
    def _say_next(self, now_ns: int) -> None:
        """Send the next line."""


class MaxBotix(_Talker):
    """One sensor on its own line. The first step is power-on.

    family: "lv", "xl", "hr", "hr-10m" or "hrusb".  half_angle_rad: half its opening angle.  Faults call it channel 1.
    baud_bps: another than the family's.
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount,
        *,
        family: str = "hr",
        half_angle_rad: float = radians(15.0),
        noise_m: float = 0.002,
        baud_bps: int | None = None,
        seed: int = 0,
    ) -> None:
        self.family = FAMILIES[family]
        super().__init__(self.family.banner, self.family.baud_bps if baud_bps is None else baud_bps)
        self._ear = _Ear(scene, mount, half_angle_rad, self.family, noise_m, seed)
        self._ears = {1: self._ear}

    def _first_ns(self) -> int:
        return self.family.period_ns

    def _say_next(self, now_ns: int) -> None:
        if self._ear.is_connected:
            self._wire.send(self._ear.text(now_ns - self.family.period_ns) + b"\r", now_ns, whole=True)
        self._line_ns += self.family.period_ns


class TextMultiplexer(_Talker):
    """Sensors fired in turn by a micro-controller that prints a line for each.

    mounts: channel -> where that sensor sits.  lines: "labelled" or "list".  baud_bps: of its own line.
    """

    def __init__(
        self,
        scene: Scene,
        mounts: Mapping[int, Mount],
        *,
        family: str = "hr",
        half_angle_rad: float = radians(15.0),
        noise_m: float = 0.002,
        baud_bps: int = BAUD,
        lines: str = "labelled",
        seed: int = 0,
    ) -> None:
        if not mounts:
            raise ValueError("a multiplexer needs at least one sensor")
        super().__init__((), baud_bps)
        self._cycle_ns = FAMILIES[family].period_ns
        if lines not in ("labelled", "list"):
            raise ValueError("a multiplexer prints labelled lines or lists")
        self._is_list = lines == "list"
        self._round: list[bytes] = []
        self._ears = {
            channel: _Ear(scene, mount, half_angle_rad, FAMILIES[family], noise_m, seed + channel)
            for channel, mount in sorted(mounts.items())
        }
        self._turn = 0

    def power_on(self, now_ns: int) -> None:
        """The supply comes: the first sensor is first."""
        self._turn = 0
        self._round = []
        super().power_on(now_ns)

    def _first_ns(self) -> int:
        return self._cycle_ns

    def _say_next(self, now_ns: int) -> None:
        channel = list(self._ears)[self._turn % len(self._ears)]
        if self._ears[channel].is_connected:
            text = self._ears[channel].text(now_ns - self._cycle_ns)
            self._round.append(text if self._is_list else b"%d:%s" % (channel, text))
        self._turn += 1
        self._line_ns += self._cycle_ns
        if self._round and (not self._is_list or self._turn % len(self._ears) == 0):
            self._wire.send(b" ".join(self._round) + b"\r\n", now_ns, whole=True)
            self._round = []

    @property
    def rate_hz(self) -> float:
        """How often each channel comes."""
        return SECOND_NS / (self._cycle_ns * len(self._ears))
