"""Which sensor is meant: the one whose readings change when a person covers it, or turns it, with a hand.

Pure: readings and time go in. For two seconds it learns how things are; then a laser or transducer counts as covered
when much more of what it sees is very near than before, wheels as meant when they turn. What moves around the robot
anyway (people, its own arm) raises the bar of the sensor that sees it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from drivers.readings import ChainReading, RangeStatus, Reading, ScanReading, WheelReading

LEARN_NS = 2_000_000_000
_HELD_NS = 300_000_000  # covered for so long, it is meant
_NEAR_M = 0.3
_RISE = 0.35  # of its beams or rounds, above the most seen while learning
_LEAST_TICKS = 20


@dataclass(frozen=True, slots=True)
class Meant:
    """What was covered or turned. part: the channel of a chain, `left` or `right` of wheels, None for a laser."""

    source: str
    part: str | None = None

    def text(self) -> str:
        """For people."""
        return self.source if self.part is None else f"{self.source}, {self.part}"


@dataclass(slots=True)
class _Part:
    """One laser, transducer or wheel. highest: of the share that is near, while learning."""

    highest: float = 0.0
    since_ns: int | None = None
    ticks: int | None = None


@dataclass(slots=True)
class Watch:
    """Feed it readings; it says which sensor was meant, once it is sure."""

    began_ns: int
    _parts: dict[Meant, _Part] = field(default_factory=dict)

    def learns(self, now_ns: int) -> bool:
        """Whether it is still finding out how things are: nobody should cover anything yet."""
        return now_ns - self.began_ns < LEARN_NS

    def heard(self) -> list[str]:
        """Names of the sources that have said something."""
        return sorted({meant.source for meant in self._parts})

    def take(self, source: str, reading: Reading, now_ns: int) -> Meant | None:
        """Take one reading; what was meant, or None."""
        match reading:
            case ScanReading():
                return self._near(Meant(source), _share_near(reading), now_ns)
            case ChainReading():
                meant = (
                    self._near(Meant(source, f"channel {each.channel}"), _is_near(each.status, each.range_m), now_ns)
                    for each in reading.ranges
                    if each.status is not RangeStatus.NOT_LOOKED and each.heard_from is None
                )
                return next((each for each in [*meant] if each is not None), None)
            case WheelReading():
                return self._wheels(source, reading, now_ns)
            case _:
                return None

    def _near(self, who: Meant, share: float, now_ns: int) -> Meant | None:
        part = self._parts.setdefault(who, _Part())
        if self.learns(now_ns):
            part.highest = max(part.highest, share)
            return None
        if share < min(part.highest + _RISE, 0.95):
            part.since_ns = None
            return None
        if part.highest >= 0.95:  # it saw nothing else before: nothing can be told
            return None
        part.since_ns = now_ns if part.since_ns is None else part.since_ns
        return who if now_ns - part.since_ns >= _HELD_NS else None

    def _wheels(self, source: str, reading: WheelReading, now_ns: int) -> Meant | None:
        moved: Mapping[str, int] = {"left wheel": reading.left_ticks, "right wheel": reading.right_ticks}
        for side, ticks in moved.items():
            part = self._parts.setdefault(Meant(source, side), _Part())
            if part.ticks is None or self.learns(now_ns) or not reading.continuous:
                part.ticks = ticks
            elif abs(ticks - part.ticks) >= _LEAST_TICKS:
                return Meant(source, side)
        return None


def _share_near(scan: ScanReading) -> float:
    """How much of a scan is nearer than a hand held before it, or cannot be measured."""
    ranges = np.asarray(scan.range_m, dtype=np.float64)
    if ranges.size == 0:
        return 0.0
    return float(np.mean(np.isneginf(ranges) | np.isnan(ranges) | (ranges < max(_NEAR_M, 1.5 * scan.range_min_m))))


def _is_near(status: RangeStatus, range_m: float) -> float:
    near = status is RangeStatus.TOO_CLOSE or (status is RangeStatus.ECHO and range_m < _NEAR_M)
    return 1.0 if near else 0.0
