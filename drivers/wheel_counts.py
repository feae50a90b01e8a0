"""Counts of two wheels to wheel readings, for devices that keep a running count and may lose it. Pure.

    wrap       a count of 32 bits goes round, either way: differences are taken modulo its range
    damage     one sample far off, the next back in line (protocols without a checksum): dropped, nothing is lost
    reset      the device begins again near zero: the two counts stay there, and what was rolled is not known
    gap        so long that the count could have gone half round, or the device booted: not known either

A sample that the wheels cannot have reached waits for the next one, which tells damage from a reset.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.readings import SourceCounters, WheelReading

FULL_RANGE = 1 << 32
_SHORTEST_GAP_NS = 20_000_000  # stamps of two samples may lie closer than the samples did
_BOOT_NS = 200_000_000  # no board begins anew in less
_ZERO_JUMP_TICKS = 8  # both wheels on exactly 0 at once, from farther than this, is no motion
_LONG_AGO = -(1 << 62)


@dataclass(frozen=True, slots=True)
class _Sample:
    stamp_ns: int
    raw: tuple[int, int]


class WheelCounts:
    """Running totals of a left and a right wheel from counts sampled at the same instant.

    range_ticks: the counts are known modulo this.  max_ticks_per_s: no wheel counts faster.  counters: drops go there,
    `count_implausible` (one sample out of line), `count_reset` (it began anew), `count_gap` (a gap that hides motion).
    """

    def __init__(self, counters: SourceCounters, *, max_ticks_per_s: float, range_ticks: int = FULL_RANGE) -> None:
        if not max_ticks_per_s > 0.0:
            raise ValueError(f"max_ticks_per_s {max_ticks_per_s}: above 0")
        self._counters = counters
        self._range = range_ticks
        self._ticks_per_ns = max_ticks_per_s * 1e-9
        self._totals = (0, 0)
        self._last: _Sample | None = None
        self._suspect: _Sample | None = None
        self._last_stamp_ns = _LONG_AGO

    def restart(self) -> None:
        """The next sample follows from nothing: the wire was opened anew, or the device said that it began anew."""
        self._last = self._suspect = None

    def advance(self, left: int, right: int, stamp_ns: int) -> WheelReading | None:
        """Take a sample; None if it has to wait for the next one to be believed. Stamps of readings rise strictly."""
        sample = _Sample(stamp_ns, (left, right))
        last, suspect = self._last, self._suspect
        self._suspect = None
        if last is None:
            return self._accept(sample, (0, 0), continuous=False)
        if self._could_hide_a_wrap(last, sample):
            self._counters.drop("count_gap")
            return self._accept(sample, (0, 0), continuous=False)
        if suspect is not None and self._began_anew(last, suspect, sample):
            self._counters.drop("count_reset")
            return self._accept(sample, self._steps(suspect, sample), continuous=False)
        if suspect is not None:
            self._counters.drop("count_implausible")
        if self._follows(last, sample):
            if self._may_have_booted(last, sample):
                self._counters.drop("count_gap")
                return self._accept(sample, (0, 0), continuous=False)
            return self._accept(sample, self._steps(last, sample), continuous=True)
        self._suspect = sample
        return None

    def _accept(self, sample: _Sample, steps: tuple[int, int], *, continuous: bool) -> WheelReading:
        self._last = sample
        self._totals = (self._totals[0] + steps[0], self._totals[1] + steps[1])
        self._last_stamp_ns = max(sample.stamp_ns, self._last_stamp_ns + 1)
        return WheelReading(self._last_stamp_ns, *self._totals, continuous)

    # ---- what two samples tell

    def _steps(self, before: _Sample, after: _Sample) -> tuple[int, int]:
        """The shorter way round from one sample to the other."""
        half = self._range // 2
        left, right = ((b - a + half) % self._range - half for a, b in zip(before.raw, after.raw))
        return left, right

    def _reach(self, before: _Sample, after: _Sample) -> float:
        return self._ticks_per_ns * max(after.stamp_ns - before.stamp_ns, _SHORTEST_GAP_NS)

    def _distance(self, before: _Sample, after: _Sample) -> int:
        return max(abs(step) for step in self._steps(before, after))

    def _follows(self, before: _Sample, after: _Sample) -> bool:
        """Whether the wheels can have rolled from one to the other."""
        jumped_to_zero = after.raw == (0, 0) and self._distance(before, after) > _ZERO_JUMP_TICKS
        if jumped_to_zero and 0 not in before.raw:
            return False
        return self._distance(before, after) <= self._reach(before, after)

    def _began_anew(self, last: _Sample, suspect: _Sample, sample: _Sample) -> bool:
        """Whether a sample confirms the suspect one before it rather than the last that was believed."""
        to_suspect = self._distance(suspect, sample)
        return to_suspect <= self._reach(suspect, sample) and to_suspect < self._distance(last, sample)

    def _could_hide_a_wrap(self, before: _Sample, after: _Sample) -> bool:
        return 2 * self._reach(before, after) >= self._range

    def _may_have_booted(self, before: _Sample, after: _Sample) -> bool:
        """After a gap long enough to boot in: a count that may have come from zero as well as from the last sample."""
        if after.stamp_ns - before.stamp_ns < _BOOT_NS:
            return False
        from_zero = self._steps(_Sample(before.stamp_ns, (0, 0)), after)
        moved = self._steps(before, after)
        reach = self._reach(before, after)
        return any(step != 0 and abs(way) <= reach for step, way in zip(moved, from_zero))


# ---- two devices that speak when they like


@dataclass(slots=True)
class _Track:
    """The two newest samples of one wheel: (stamp, count)."""

    before: tuple[int, int] | None = None
    newest: tuple[int, int] | None = None


class Meeting:
    """Brings the samples of two wheels that come at different times to common ones. The later speaker is interpolated.

    range_ticks: the counts are known modulo this.  longest_gap_ns: across more nothing is interpolated.
    """

    def __init__(self, *, longest_gap_ns: int, range_ticks: int = FULL_RANGE) -> None:
        self._longest_gap_ns = longest_gap_ns
        self._range = range_ticks
        self.restart()

    def restart(self) -> None:
        """Forget all samples."""
        self._tracks = (_Track(), _Track())
        self._met_ns = _LONG_AGO

    def add(self, side: int, count: int, stamp_ns: int) -> tuple[int, int, int] | None:
        """A sample of the left (0) or right (1) wheel; (left, right, stamp) at the newest time known of both."""
        track = self._tracks[side]
        if track.newest is not None and stamp_ns <= track.newest[0]:
            return None
        track.before, track.newest = track.newest, (stamp_ns, count)
        if any(each.newest is None for each in self._tracks):
            return None
        at_ns = min(each.newest[0] for each in self._tracks if each.newest is not None)
        if at_ns <= self._met_ns:
            return None
        counts = [self._at(each, at_ns) for each in self._tracks]
        left, right = counts
        if left is None or right is None:
            return None
        self._met_ns = at_ns
        return left, right, at_ns

    def _at(self, track: _Track, stamp_ns: int) -> int | None:
        """The count at a time between the two newest samples, None outside."""
        assert track.newest is not None
        t1, x1 = track.newest
        if stamp_ns == t1:
            return x1
        if track.before is None:
            return None
        t0, x0 = track.before
        if not t0 <= stamp_ns < t1 or t1 - t0 > self._longest_gap_ns:
            return None
        half = self._range // 2
        step = (x1 - x0 + half) % self._range - half
        return (x0 + round(step * (stamp_ns - t0) / (t1 - t0))) % self._range
