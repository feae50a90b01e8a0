"""The motor of a laser scanner that turns all the way round."""

from __future__ import annotations

import math

import numpy as np

from sim_devices.device import F64
from sim_devices.wire import SECOND_NS

STEADY_SHARE = 0.9
WOBBLE_PERIOD_S = 7.3


class Spinner:
    """Where a turning head looks at any time: speed ramps to its target, and wobbles a little around it.

    turns_per_s, spin_up_s: it takes this long from standing to that speed.  wobble: share by which it swings.
    It stands until it is told to turn.
    """

    def __init__(self, turns_per_s: float, spin_up_s: float, wobble: float) -> None:
        self._ramp = turns_per_s / spin_up_s if spin_up_s > 0.0 else math.inf  # turns per s, a second
        self._wobble = wobble
        self._from_ns = 0
        self._turns = 0.0
        self._speed = self.target = 0.0

    def turn_at(self, turns_per_s: float, now_ns: int, *, at_once: bool = False) -> None:
        """Go for another speed from now on; at_once: have it at once, as after a time without supply."""
        here = np.array([float(now_ns)])
        self._turns = float(self.turns(here)[0])
        self._speed = turns_per_s if at_once else self.speed(now_ns)
        self._from_ns, self.target = now_ns, turns_per_s

    def turns(self, stamp_ns: F64) -> F64:
        """Turns made at times (N,) since ever, clockwise."""
        t = (stamp_ns - self._from_ns) * 1e-9
        ramp_s = abs(self.target - self._speed) / self._ramp
        ramping = np.minimum(t, ramp_s)
        slope = math.copysign(self._ramp, self.target - self._speed) if ramp_s > 0.0 else 0.0
        steady = self._speed * ramping + 0.5 * slope * ramping**2 + self.target * np.maximum(0.0, t - ramp_s)
        omega = 2.0 * math.pi / WOBBLE_PERIOD_S
        turns: F64 = self._turns + steady + self._wobble * self.target / omega * (1.0 - np.cos(omega * t))
        return turns

    def speed(self, now_ns: int) -> float:
        """Turns per second, without the wobble."""
        t = (now_ns - self._from_ns) * 1e-9
        change = self.target - self._speed
        return self._speed + math.copysign(min(abs(change), self._ramp * t if t > 0.0 else 0.0), change)

    def steady_ns(self) -> int:
        """When the speed is near enough to its target."""
        missing = max(0.0, abs(self.target - self._speed) - (1.0 - STEADY_SHARE) * self.target)
        return self._from_ns + round(missing / self._ramp * SECOND_NS)
