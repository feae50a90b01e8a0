"""What can be wrong with a set of sonars, whatever board they hang on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite

import numpy as np

from sim_devices.wheel import Undo

SOUND_AT_20_C = 331.3 + 0.606 * 20.0  # what boards reckon with, m/s
FOREIGN_SHARE = 0.3  # of readings that hear somebody else's pulse first
SONAR_KINDS = ("stuck", "chain_break", "order_swap", "temperature", "cross_talk")


@dataclass(slots=True)
class SonarTroubles:
    """State of all such faults on one board; without any, `told_m` changes nothing.

    stuck_m: channels that always say the same (0: all).  cut_from: channels from this one on are cut off.
    crossed: whose place a channel measures from.  air_temp_c: true; boards reckon with 20.  foreign: share of readings
    that hear another's pulse.
    """

    stuck_m: dict[int, float] = field(default_factory=dict)
    cut_from: float = inf
    crossed: dict[int, int] = field(default_factory=dict)
    air_temp_c: float = 20.0
    foreign: float = 0.0

    def inflict(self, kind: str, value: float, arguments: Mapping[str, float]) -> Undo | None:
        """See wheel.Faulty."""
        channel = round(arguments.get("channel", 0))
        if kind == "stuck":
            return self._set("stuck_m", self.stuck_m | {channel: value})
        if kind == "chain_break":
            return self._set("cut_from", value)
        if kind == "order_swap":
            first, second = channel or 1, round(arguments.get("with", 2))
            return self._set("crossed", {first: second, second: first})
        if kind == "temperature":
            return self._set("air_temp_c", value)
        return self._set("foreign", FOREIGN_SHARE) if kind == "cross_talk" else None

    def told_m(
        self, channel: int, measure: Callable[[int], float], random: np.random.Generator, range_max_m: float
    ) -> float | None:
        """The distance that a channel tells; None if nothing is connected there. measure: the truth at a channel."""
        if channel >= self.cut_from:
            return None
        stuck_m = self.stuck_m.get(channel, self.stuck_m.get(0))
        if stuck_m is not None:
            return stuck_m
        range_m = measure(self.crossed.get(channel, channel))
        if isfinite(range_m):
            range_m *= SOUND_AT_20_C / (331.3 + 0.606 * self.air_temp_c)
        if self.foreign and random.random() < self.foreign:
            range_m = min(range_m, range_max_m * float(random.random()))
        return range_m

    def _set(self, name: str, value: object) -> Undo:
        before = getattr(self, name)
        setattr(self, name, value)
        return lambda _: setattr(self, name, before)
