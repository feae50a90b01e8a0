"""What every emulator is: `step(now_ns, received) -> sent`, without thread, sleep or clock; and what it measures.

An emulator is told the time in nanoseconds of simulated time and what its host sent since the last step, and
returns what it puts on the wire by now. Tests step it faster than real time; attach.py steps it on a pty.
It asks a `Scene` for the truth: the simulated world (world.py) or a recorded log (log_scene.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Frame:
    """A classic CAN frame as the emulators write it."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    dlc: int | None = None


@dataclass(frozen=True, slots=True)
class Mount:
    """Where a sensor sits on the robot: metres and radians in the robot's base frame (x forward, y left).

    upside_down: head down; what is to its own left is to the robot's right.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_rad: float = 0.0
    upside_down: bool = False

    def turned(self, bearing_rad: F64) -> F64:
        """Bearings of its own, counter-clockwise for whoever stands as it does, as headings in the base frame."""
        return self.yaw_rad + (-bearing_rad if self.upside_down else bearing_rad)


class ByteDevice(Protocol):
    """A device on a serial or TCP line."""

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Advance to now_ns; returns what it sends. baud: the host's line speed, None if not known (any fits)."""


class CanDevice(Protocol):
    """A device on a CAN bus."""

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """Advance to now_ns; returns the frames it sends, in order."""


class Scene(Protocol):
    """The truth that emulators measure."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """True distances along beams: (N,) metres; +inf beyond range_max_m, NaN where nothing can be known.

        bearing_rad: (N,) in the sensor frame, counter-clockwise.  stamp_ns: (N,) when each beam is fired.
        """

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        """Distance to the nearest surface that a sonar hears within its cone; +inf if none up to range_max_m."""

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """Distances rolled by the left and the right wheel since the start, forward positive, slip included."""
