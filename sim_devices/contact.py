"""Bumpers and cliff switches: a contact that closes when something is touched, or when there is no floor below.

What a contact does electrically is its line: to ground under a pull-up (pressed reads low) or the other way, made to
open or to close. Real contacts bounce: for some milliseconds after an edge they say one thing and then the other.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from sim_devices.device import Mount, Scene
from sim_devices.wheel import Undo
from sim_devices.wire import SECOND_NS

BEAMS = 31
CHATTER_NS = 1_000_000  # a bouncing contact keeps a state for so long at least
SET_BACK_M = 0.1  # from which a bumper looks for what it touches: nothing is inside the robot

Touch = Callable[[int], bool]  # told the time: whether the thing is pressed, truly


@runtime_checkable
class GroundScene(Protocol):
    """A scene that knows how high the floor is."""

    def floor_m(self, mount: Mount, now_ns: int) -> float:
        """Height of the floor below this place, metres; 0 is the level that the robot drives on."""


def floor_under(scene: Scene, mount: Mount, now_ns: int) -> float:
    """Height of the floor there; 0 where the scene does not know floors."""
    return scene.floor_m(mount, now_ns) if isinstance(scene, GroundScene) else 0.0


@dataclass(frozen=True, slots=True)
class Bumper:
    """A straight bumper: pressed as soon as something is within `travel_m` ahead of it, anywhere along its width.

    mount: its middle, looking outwards.
    """

    scene: Scene
    mount: Mount
    width_m: float = 0.4
    travel_m: float = 0.01

    def __call__(self, now_ns: int) -> bool:
        back = self.mount
        c, s = np.cos(back.yaw_rad), np.sin(back.yaw_rad)
        behind = Mount(back.x_m - SET_BACK_M * float(c), back.y_m - SET_BACK_M * float(s), back.z_m, back.yaw_rad)
        across = np.linspace(-self.width_m / 2.0, self.width_m / 2.0, BEAMS)
        bearing = np.arctan2(across, SET_BACK_M)
        reach = (SET_BACK_M + self.travel_m) / np.cos(bearing)
        ranges = self.scene.beam_ranges(behind, bearing, np.full(BEAMS, float(now_ns)), float(reach.max()))
        return bool(np.any(ranges <= reach))


@dataclass(frozen=True, slots=True)
class Cliff:
    """A switch that closes where the floor below it is deeper than `drop_m`."""

    scene: Scene
    mount: Mount
    drop_m: float = 0.03

    def __call__(self, now_ns: int) -> bool:
        return floor_under(self.scene, self.mount, now_ns) < -self.drop_m


class Contact:
    """A switch that is closed while it is touched, bounces, and may be stuck.

    bounce_s: for how long it chatters after an edge.  normally_closed: opens when touched, as safe wiring does.
    """

    fault_family = "switch"

    def __init__(self, touch: Touch, *, bounce_s: float = 0.004, normally_closed: bool = False, seed: int = 0) -> None:
        self.bounce_s = bounce_s
        self.stuck: bool | None = None
        self._touch = touch
        self._normally_closed = normally_closed
        self._seed = seed
        self._was_touched: bool | None = None
        self._edge_ns = -(1 << 62)

    def is_closed(self, now_ns: int) -> bool:
        """Whether it says that it is touched, now."""
        if self.stuck is not None:
            return self.stuck
        touched = self._touch(now_ns)
        if touched != self._was_touched:
            if self._was_touched is not None:
                self._edge_ns = now_ns
            self._was_touched = touched
        if now_ns - self._edge_ns < self.bounce_s * SECOND_NS:
            slot = (now_ns - self._edge_ns) // CHATTER_NS
            return bool(zlib.crc32(f"{self._seed} {self._edge_ns} {slot}".encode()) & 1)
        return touched

    def level(self, now_ns: int) -> bool:
        """The line, pulled up: low while the contact conducts."""
        conducts = self.is_closed(now_ns) != self._normally_closed
        return not conducts

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float], now_ns: int) -> Undo | None:
        """See wheel.Faulty."""
        if kind == "bounce":
            before, self.bounce_s = self.bounce_s, value
            return lambda _: setattr(self, "bounce_s", before)
        if kind in ("stuck_on", "stuck_off"):
            self.stuck = kind == "stuck_on"
            return lambda _: setattr(self, "stuck", None)
        return None
