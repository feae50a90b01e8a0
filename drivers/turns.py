"""Samples of a turning scanner put together to one reading a turn. Pure.

Scanners whose head just turns send samples one after the other, as many a turn as come out. A reading is a turn: from
the first sample behind 0 degrees (or the one the device marks) to the last one before the next. Where samples were
lost, a reading ends early and another begins: times within a reading are then still even, and nothing true is thrown
away. Angles of these scanners grow clockwise seen from above, so a bearing is minus the angle.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.readings import F64, ScanReading, SourceCounters

NoEcho = Literal["unknown", "clear"]
"""What a distance of 0 means: nothing known, or nothing there up to the range limit.

These scanners send 0 for what is too far, but also for what is too near, too dark or behind glass, and do not tell
which. Only who knows that nothing of that is around may say "clear"."""

MAX_BEAMS = 8192  # of a turn: with more the head stands still
_TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Limits:
    """What a scanner can measure; no_echo: what its distance 0 means."""

    range_min_m: float
    range_max_m: float
    no_echo: NoEcho = "unknown"

    def ranges(self, distance_m: F64) -> F64:
        """(N,) by the rule of drivers.readings: nearer than the least -inf, farther than the most +inf, 0 no echo."""
        range_m = np.where(distance_m > self.range_max_m, math.inf, distance_m)
        range_m = np.where(distance_m < self.range_min_m, -math.inf, range_m)
        return np.where(distance_m == 0.0, math.inf if self.no_echo == "clear" else math.nan, range_m)


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples in the order they were measured, none lost between them. All arrays (N,).

    angle_rad: clockwise from the scanner's zero.  distance_m: 0 for no echo.  intensity: device units.
    arrived_ns: host time, wire time taken off; a sample was not measured later.  clock_ns: host time by the device's
    clock, NaN where unknown; None without a clock.  starts: samples that begin a turn; None: by the angle.
    """

    angle_rad: F64
    distance_m: F64
    intensity: F64
    arrived_ns: F64
    clock_ns: F64 | None = None
    starts: NDArray[np.bool_] | None = None

    def part(self, begin: int, end: int) -> Samples:
        """Samples begin..end - 1, without their marks of a start."""
        span = slice(begin, end)
        clock_ns = None if self.clock_ns is None else self.clock_ns[span]
        return Samples(
            self.angle_rad[span], self.distance_m[span], self.intensity[span], self.arrived_ns[span], clock_ns
        )


class TurnAssembler:
    """Samples in, a reading a turn out. beam_ns: time from one sample to the next, kept up to date by the owner."""

    def __init__(self, limits: Limits, *, beam_ns: float, counters: SourceCounters | None = None) -> None:
        self.limits = limits
        self.beam_ns = beam_ns
        self._counters = counters or SourceCounters()
        self._turns_ns: deque[float] = deque(maxlen=8)
        self.turn_ns: float | None = None  # length of a turn, median of the last ones; None before there was one
        self._newest_ns: int | None = None
        self.restart()

    def restart(self) -> None:
        """The head may have been stopped: what is left of its turn is not told, nor what is seen of the next one."""
        self._blocks: list[Samples] = []
        self._count = 0
        self._in_turn = False  # the turn's first sample was seen
        self._angle: float | None = None  # of the last sample; None: the next one follows no other
        self._progress_rad = 0.0  # of the last sample, within its turn

    def add(self, samples: Samples) -> Iterator[ScanReading]:
        """Take samples that follow those before; yields the turns they complete."""
        if samples.starts is None and self._goes_on(samples.angle_rad):
            self._collect(samples)
            return
        begin = 0
        starts = self._by_angle(samples.angle_rad) if samples.starts is None else samples.starts
        for start in np.flatnonzero(starts):
            self._collect(samples.part(begin, int(start)))
            if self._in_turn:
                self._turns_ns.append(self._count * self.beam_ns)
                self.turn_ns = median(self._turns_ns)
                yield from self._reading()
            self._drop()
            self._in_turn = True
            begin = int(start)
        self._collect(samples.part(begin, len(samples.angle_rad)))

    def cut(self) -> Iterator[ScanReading]:
        """Samples were lost here: what was collected is a reading of its own, and so is the rest of the turn."""
        self._angle = None
        yield from self._reading()
        self._drop()

    def _goes_on(self, angle_rad: F64) -> bool:
        """Whether these angles plainly rise from the last one and do not pass zero: the usual case, told quickly."""
        if self._angle is None or len(angle_rad) == 0:
            return False
        first, last = float(angle_rad[0]), float(angle_rad[-1])
        progress_rad = self._progress_rad + last - self._angle
        if not self._angle <= first <= last < self._angle + math.pi or progress_rad >= _TURN:
            return False
        self._angle, self._progress_rad = last, progress_rad
        return True

    def _by_angle(self, angle_rad: F64) -> NDArray[np.bool_]:
        """Which samples are the first to pass zero; an angle that trembles about zero passes it once."""
        if len(angle_rad) == 0:
            return np.zeros(0, dtype=bool)
        first = angle_rad[0] if self._angle is None else self._angle
        step = np.diff(angle_rad, prepend=first)
        begin = float(first) if self._angle is None else self._progress_rad
        progress = begin + np.cumsum(step - _TURN * np.round(step / _TURN))
        turns = np.floor(np.maximum.accumulate(np.maximum(progress, 0.0)) / _TURN)
        self._angle = float(angle_rad[-1])
        self._progress_rad = float(progress[-1] - _TURN * turns[-1])
        return np.asarray(np.diff(turns, prepend=0.0) > 0)

    def _collect(self, samples: Samples) -> None:
        if not self._in_turn or len(samples.angle_rad) == 0:
            return
        self._blocks.append(samples)
        self._count += len(samples.angle_rad)
        if self._count > MAX_BEAMS:
            self._counters.drop("head_stands")
            self.restart()

    def _drop(self) -> None:
        self._blocks = []
        self._count = 0

    def _reading(self) -> Iterator[ScanReading]:
        if self._count == 0:
            return
        blocks = self._blocks
        late_ns = self.beam_ns * np.arange(self._count)
        # Bytes come late, never early: the sample that came least late tells when all were measured.
        first_ns = float((np.concatenate([block.arrived_ns for block in blocks]) - late_ns).min())
        if blocks[0].clock_ns is not None:
            by_clock = np.concatenate([block.clock_ns for block in blocks if block.clock_ns is not None]) - late_ns
            known = by_clock[np.isfinite(by_clock)]
            first_ns = min(first_ns, float(np.median(known))) if known.size else first_ns
        stamp_ns = round(first_ns)
        if self._newest_ns is not None:
            stamp_ns = max(stamp_ns, self._newest_ns + 1)
        self._newest_ns = stamp_ns
        turn_ns = self.turn_ns
        angle = np.concatenate([block.angle_rad for block in blocks])
        yield ScanReading(
            stamp_ns=stamp_ns,
            beam_period_ns=self.beam_ns,
            scan_period_ns=round(self._count * self.beam_ns if turn_ns is None else turn_ns),
            bearing_rad=bearings(angle),
            range_m=self.limits.ranges(np.concatenate([block.distance_m for block in blocks])),
            range_min_m=self.limits.range_min_m,
            range_max_m=self.limits.range_max_m,
            intensity=np.concatenate([block.intensity for block in blocks]).astype(np.float32),
        )


def bearings(angle_rad: F64) -> F64:
    """(N,) clockwise angles of one turn as counter-clockwise bearings, the first in -pi..pi, no jump after it."""
    return np.unwrap(math.pi - np.mod(angle_rad + math.pi, _TURN))
