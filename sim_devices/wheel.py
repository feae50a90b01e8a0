"""One wheel as the boards see it that count it and drive it: travel of the scene -> counts; commands -> the scene.

Most scenes move as they are told by a route or a log and leave commands alone. A scene with `drive_wheel` obeys: the
robot then drives where the host's motor commands send it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import floor, pi
from typing import Literal, Protocol, runtime_checkable

from sim_devices.device import Scene
from sim_devices.wire import SECOND_NS

Side = Literal["left", "right"]
Undo = Callable[[int], object]  # told the time
SPEED_WINDOW_NS = 10_000_000


@runtime_checkable
class DrivenScene(Protocol):
    """A scene whose wheels turn as motors tell them."""

    def drive_wheel(self, now_ns: int, side: Side, speed_m_s: float) -> None:
        """From now on this wheel rolls so fast, until told otherwise."""


@runtime_checkable
class Faulty(Protocol):
    """A device that carries out faults inside itself."""

    fault_family: str

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """Begin a fault; returns what ends it, None if nothing is to be undone. Kinds it does not know: None."""


@dataclass(slots=True)
class Wheel:
    """A wheel with an incremental encoder.

    ticks_per_turn: counts for each turn of the wheel, gear included; negative where the count falls rolling forward.
    offset: what is added to the count since the world's start; `zero` and `set_count` change it.
    """

    scene: Scene
    side: Side
    radius_m: float = 0.10
    ticks_per_turn: float = 4096.0
    offset: int = 0
    _speed_m_s: float = 0.0

    def turns(self, now_ns: int) -> float:
        """Turns since the world's start, forward positive."""
        left_m, right_m = self.scene.wheel_travel_m(now_ns)
        return (left_m if self.side == "left" else right_m) / (2.0 * pi * self.radius_m)

    def count(self, now_ns: int) -> int:
        """The count, without any limit."""
        return floor(self.turns(now_ns) * self.ticks_per_turn) + self.offset

    def set_count(self, count: int, now_ns: int) -> None:
        """Make the present count this value."""
        self.offset += count - self.count(now_ns)

    def ticks_per_s(self, now_ns: int, window_ns: int = SPEED_WINDOW_NS) -> float:
        """Speed of the count over the last window, not rounded to whole ticks."""
        turned = self.turns(now_ns) - self.turns(now_ns - window_ns)
        return turned * self.ticks_per_turn * SECOND_NS / window_ns

    def drive(self, now_ns: int, ticks_per_s: float) -> None:
        """The motor is told to turn so fast; only changes reach the scene."""
        speed_m_s = ticks_per_s / self.ticks_per_turn * 2.0 * pi * self.radius_m
        if speed_m_s != self._speed_m_s and isinstance(self.scene, DrivenScene):
            self.scene.drive_wheel(now_ns, self.side, speed_m_s)
        self._speed_m_s = speed_m_s

    @property
    def commanded_m_s(self) -> float:
        """What the motor was told last."""
        return self._speed_m_s


def signed(value: int, bits: int) -> int:
    """A number as a register of so many bits holds it, two's complement."""
    half = 1 << (bits - 1)
    return (value + half) % (1 << bits) - half


def inflict_on_counts(
    wheels: tuple[Wheel, ...],
    kind: str,
    value: float,
    arguments: Mapping[str, float],
    now_ns: int,
    *,
    lowest: int = -(1 << 31),
    highest: int = (1 << 31) - 1,
) -> None:
    """Faults of counters: `wrap` sets them this many steps before they turn over (negative: after).

    side=1 hits the left wheel only, side=2 the right one; down=1 puts them before the lowest value, not the highest.
    """
    side = {1: "left", 2: "right"}.get(round(arguments.get("side", 0)))
    steps = round(value)
    for wheel in wheels:
        if kind == "wrap" and side in (None, wheel.side):
            count = lowest + steps if arguments.get("down") else highest + 1 - steps
            wheel.set_count(count, now_ns)
