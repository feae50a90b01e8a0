"""A device's clock fitted to the host's: unwrapped, screened, and a line under the delays. Pure.

A message can arrive late, never early. So the truth lies along the lower edge of host minus device time: of all
lines below every sample the one closest to them [Moon, Skelly, Towsley 1999: an edge of the lower convex hull, the one
over the mean device time]. Where the device can be asked for its time, question and answer enclose the offset; what
its data then needs on top, at least, is a constant that is found in the first seconds and taken off for good.

    device time   as read, unwrapped, ns; a counter that ticks is on average half a tick behind its own time
    host time     monotonic ns, at which the host could have known, wire time taken off
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

from drivers.readings import ClockFit

_MS = 1_000_000


class EnvelopeLine:
    """host = device + offset + drift * device, under the samples of a sliding window. Times in ns.

    bin_ns: of each span this long the least delayed sample is kept.  bins: how many spans the window holds.
    straight_after_ns: while samples span less than this, drift is taken as 0.  drift_limit_ppm: quartz is better.
    """

    def __init__(
        self,
        *,
        bin_ns: int = 500 * _MS,
        bins: int = 240,
        straight_after_ns: int = 15_000 * _MS,
        drift_limit_ppm: float = 500.0,
    ) -> None:
        self.samples = 0
        self._bin_ns = bin_ns
        self._straight_after_ns = straight_after_ns
        self._drift_limit = drift_limit_ppm * 1e-6
        self._kept: deque[tuple[float, float]] = deque(maxlen=bins)  # device time, delay, both from the origin
        self._bin = 0
        self._origin_device = 0
        self._origin_delay = 0
        self._base = 0.0  # delay at device time _at
        self._at = 0.0
        self._drift = 0.0
        self._recent: deque[float] = deque(maxlen=256)  # delay above the line

    def add(self, device_ns: int, host_ns: int) -> None:
        """Take a sample. Device times must not go back."""
        if self.samples == 0:
            self._origin_device, self._origin_delay = device_ns, host_ns - device_ns
        self.samples += 1
        at, delay = float(device_ns - self._origin_device), float(host_ns - device_ns - self._origin_delay)
        changed = self._keep(at, delay)
        if changed:
            self._fit()
        self._recent.append(delay - self._delay_at(at))

    def host_ns(self, device_ns: int) -> int:
        """Host time of a device time. Needs a sample."""
        return device_ns + self._origin_delay + round(self._delay_at(float(device_ns - self._origin_device)))

    @property
    def drift_ppm(self) -> float:
        """How much longer a device second is than a host second makes it: host = ... (1 + drift)."""
        return self._drift * 1e6

    @property
    def jitter_ns(self) -> float:
        """Standard deviation of the delays above the line, newest 256 samples."""
        if len(self._recent) < 2:
            return 0.0
        mean = sum(self._recent) / len(self._recent)
        return math.sqrt(sum((value - mean) ** 2 for value in self._recent) / len(self._recent))

    def _delay_at(self, at: float) -> float:
        return self._base + self._drift * (at - self._at)

    def _keep(self, at: float, delay: float) -> bool:
        """Remember the sample if it is the least delayed of its bin; whether the line must be looked at again."""
        this_bin = int(at // self._bin_ns)
        if not self._kept or this_bin != self._bin:
            self._bin = this_bin
            self._kept.append((at, delay))
            return True
        if delay - self._delay_at(at) < self._kept[-1][1] - self._delay_at(self._kept[-1][0]):
            self._kept[-1] = (at, delay)
            return delay < self._delay_at(at)
        return False

    def _fit(self) -> None:
        points = list(self._kept)
        if points[-1][0] - points[0][0] < self._straight_after_ns:
            self._at, self._base, self._drift = 0.0, min(delay for _, delay in points), 0.0
            return
        hull = _lower_hull(points)
        mean = sum(at for at, _ in points) / len(points)
        left, right = next((a, b) for a, b in pairwise(hull) if b[0] >= mean)
        drift = (right[1] - left[1]) / (right[0] - left[0])
        self._drift = min(max(drift, -self._drift_limit), self._drift_limit)
        self._at = mean
        # With the limit in force the edge is no longer below all: lower the line until it is.
        self._base = min(delay - self._drift * (at - mean) for at, delay in points)


def _lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The lower convex hull of points with rising first coordinate (Andrew's chain)."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) >= 2 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _turns_right(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])


class DeviceClock:
    """Host time for the stamps of one device, from its answers to "what time is it" and from its data.

    wrap_ns: the stamp starts again at 0 after this.  tick_ns: its resolution.
    A stamp that cannot be is refused: not later than the one before, earlier than its bytes allow, or much later
    without following the one before in step. Three refused stamps that agree with each other are a device that
    was started again: the fit then begins anew with them.
    """

    EARLY_NS = 5 * _MS  # a sample below the line by more than this contradicts it
    LATE_NS = 100 * _MS  # the host is held up for less than this, or the stamps prove that it was longer
    LEARNING_NS = 400 * _MS  # the same two while the delay of the data is not known yet
    LEARN_SAMPLES = 40
    LEARN_SPAN_NS = 1000 * _MS
    AGREE_NS = 60 * _MS

    def __init__(self, *, wrap_ns: int, tick_ns: int) -> None:
        self._wrap_ns = wrap_ns
        self._half_tick_ns = tick_ns // 2
        self._tick_ns = tick_ns
        self.restart()

    def restart(self) -> None:
        """Forget everything: the device's clock may have been set to 0."""
        self._last: tuple[int, int] | None = None  # device (unwrapped), host
        self._offset_low: int | None = None  # from questions: offset is between these
        self._offset_high = 0
        self._learning: list[tuple[int, int]] | None = []
        self._line = EnvelopeLine()
        self._delay_ns = -self._half_tick_ns
        self._refused: list[tuple[int, int]] = []

    @property
    def anchored(self) -> bool:
        """Whether questions were answered, so that the offset does not hang on the delay of the data."""
        return self._offset_low is not None

    @property
    def fit(self) -> ClockFit | None:
        """The fit so far: host = offset + device * (1 + drift) with the device time as unwrapped here."""
        if self._last is None:
            return None
        line = self._line
        if self._learning is None:
            return ClockFit(line.host_ns(self._half_tick_ns), line.drift_ppm, line.jitter_ns, line.samples)
        jitter = (self._offset_high - self._offset_low) / 2.0 if self._offset_low is not None else 0.0
        return ClockFit(self._learning_offset() + self._half_tick_ns, 0.0, jitter, max(len(self._learning), 1))

    def ask(self, stamp_ns: int, *, sent_ns: int, received_ns: int) -> bool:
        """Take the answer to a question for the time: it was read between sent_ns and received_ns.

        Returns False for an answer that the others contradict; it counts as the first one of a new fit.
        """
        device = self._unwrap(stamp_ns, received_ns)
        low, high = sent_ns - device - self._tick_ns, received_ns - device
        self._last = (device, received_ns)
        if self._offset_low is not None:
            if low <= self._offset_high and high >= self._offset_low:
                self._offset_low, self._offset_high = max(low, self._offset_low), min(high, self._offset_high)
                return True
            self.restart()
            self._last = (stamp_ns, received_ns)
            low, high = sent_ns - stamp_ns - self._tick_ns, received_ns - stamp_ns
            self._offset_low, self._offset_high = low, high
            return False
        self._offset_low, self._offset_high = low, high
        return True

    def place(self, stamp_ns: int, host_ns: int, *, period_ns: float) -> tuple[int, int] | None:
        """Device time (unwrapped) and host time of a stamp whose data could not have come before host_ns.

        period_ns: the time from one stamp to the next, or some multiple of it.  None if the stamp is refused.
        """
        device = self._unwrap(stamp_ns, host_ns)
        if not self._credible(device, host_ns, period_ns):
            return self._refuse(stamp_ns, host_ns)
        self._refused.clear()
        return self._accept(device, host_ns)

    def _unwrap(self, stamp_ns: int, host_ns: int) -> int:
        """The whole turns that host time says have passed, also over silences of any length."""
        if self._last is None:
            return stamp_ns
        expected = self._last[0] + host_ns - self._last[1]
        return stamp_ns + round((expected - stamp_ns) / self._wrap_ns) * self._wrap_ns

    def _credible(self, device: int, host_ns: int, period_ns: float) -> bool:
        if self._last is None:
            return True
        step = device - self._last[0]
        has_data = bool(self._learning) or self._learning is None
        if has_data and step <= 0:
            return False
        delay = host_ns - self._host_of(device)
        if self._learning is not None:
            if abs(delay) <= self.LEARNING_NS:
                return True
        elif -self.EARLY_NS - 3e-4 * step <= delay <= self.LATE_NS:
            return True
        return delay > 0 and has_data and _in_step(step, period_ns)

    def _host_of(self, device: int) -> int:
        if self._learning is None:
            return self._line.host_ns(device + self._half_tick_ns)
        return device + self._half_tick_ns + self._learning_offset()

    def _learning_offset(self) -> int:
        """Host minus device time while the data's delay is being learned: from questions, else the least delay."""
        if self._offset_low is not None:
            return (self._offset_low + self._offset_high) // 2
        if self._learning:
            return min(host - device - self._half_tick_ns for device, host in self._learning) - self._delay_ns
        assert self._last is not None
        return self._last[1] - self._last[0]

    def _accept(self, device: int, host_ns: int) -> tuple[int, int]:
        self._last = (device, host_ns)
        if self._learning is None:
            self._line.add(device + self._half_tick_ns, host_ns - self._delay_ns)
            return device, self._host_of(device)
        self._learning.append((device, host_ns))
        placed = self._host_of(device)
        span = device - self._learning[0][0]
        if len(self._learning) >= self.LEARN_SAMPLES and span >= self.LEARN_SPAN_NS:
            self._end_learning(self._learning)
        return device, placed

    def _end_learning(self, samples: list[tuple[int, int]]) -> None:
        if self._offset_low is not None:
            least = min(host - device - self._half_tick_ns for device, host in samples)
            self._delay_ns = least - self._learning_offset()
        self._learning = None
        for device, host in samples:
            self._line.add(device + self._half_tick_ns, host - self._delay_ns)

    def _refuse(self, stamp_ns: int, host_ns: int) -> tuple[int, int] | None:
        self._refused = [*self._refused[-2:], (stamp_ns, host_ns)]
        if len(self._refused) < 3 or not self._refused_agree():
            return None
        samples = self._refused
        self.restart()
        placed = None
        for stamp, host in samples:
            placed = self._accept(self._unwrap(stamp, host), host)
        return placed

    def _refused_agree(self) -> bool:
        first_stamp, first_host = self._refused[0]
        last_device = None
        for stamp, host in self._refused:
            device = stamp + round((first_stamp + host - first_host - stamp) / self._wrap_ns) * self._wrap_ns
            if abs((host - device) - (first_host - first_stamp)) > self.AGREE_NS:
                return False
            if last_device is not None and device <= last_device:
                return False
            last_device = device
        return True


def _in_step(step_ns: int, period_ns: float) -> bool:
    """Whether a step between stamps is a few whole periods, to a tenth of one (or the tick of a ms counter)."""
    turns = round(step_ns / period_ns)
    return 1 <= turns <= 40 and abs(step_ns - turns * period_ns) <= max(0.1 * period_ns, 2 * _MS)
