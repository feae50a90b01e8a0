"""How far odometry is to be believed: learned from how it agrees with what is matched."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class Trust:
    """How much worse odometry is than its model says: running root mean squares, translation and rotation.

    Only steps that move teach, and none by more than five times what was believed: one slip is no character.
    """

    LEARN = 0.03
    MOST = 5.0
    LEAST = 1.0
    LARGEST = 50.0

    def __init__(self, factor: float) -> None:
        self._square_m = self._square_rad = factor * factor

    @property
    def factor_m(self) -> float:
        """For translations."""
        return math.sqrt(self._square_m)

    @property
    def factor_rad(self) -> float:
        """For rotations."""
        return math.sqrt(self._square_rad)

    def learn(self, off_m: float, off_rad: float) -> None:
        """A step was so many (trusted) deviations off."""
        self._square_m = self._after(self._square_m, off_m)
        self._square_rad = self._after(self._square_rad, off_rad)

    def _after(self, square: float, off: float) -> float:
        grown = square * (1.0 + self.LEARN * (min(off, self.MOST) ** 2 - 1.0))
        return min(max(grown, self.LEAST**2), self.LARGEST**2)


@dataclass(frozen=True, slots=True)
class _Span:
    """A piece of the way on which scans can tell how odometry turns.

    along_m, turned_rad: by odometry, signed: what biases grow with.  way_m, turns_rad: all of it, forth and back.
    off_rad: how far the matches turn from odometry.  rough: of its steps, those whose scans lie on no planes.
    """

    along_m: float = 0.0
    turned_rad: float = 0.0
    way_m: float = 0.0
    turns_rad: float = 0.0
    off_rad: float = 0.0
    steps: int = 0
    rough: int = 0

    def and_step(self, along_m: float, turn_rad: float, off_rad: float, *, is_rough: bool) -> _Span:
        """The same with one more step."""
        return _Span(
            self.along_m + along_m, self.turned_rad + turn_rad, self.way_m + abs(along_m),
            self.turns_rad + abs(turn_rad), self.off_rad + off_rad, self.steps + 1, self.rough + is_rough,
        )  # fmt: skip


class Heading:
    """How truly odometry turns, learned where scans can tell, so that it can be judged where they cannot.

    Scans on planes tell, over spans of the way: a single match errs as much as good wheels do, but over some metres on
    the same walls it errs hardly more, while what wheels are off adds up. A bias (so much a metre, so much of a turn:
    wheels that are not alike, a track width that is wrong) is learned apart from what is left, by recursive least
    squares; each span is judged by what was known before it.

    Hedges, and rising ground that a level laser cuts, move along with the robot: match after match is turned the same
    way, and each looks fair. Two variances tell: scans that lie on no planes disagree with odometry by their own errors
    and its own. If that is more than twice what odometry's own are, odometry is the better of the two.
    """

    SPAN_M = 3.0
    SPAN_RAD = math.radians(60.0)
    ROUGH_SHARE = 0.1  # of a span's steps, beside one
    ENOUGH = 12  # spans, to say anything
    REMEMBERED = 60
    MOST_RAD = math.radians(20.0)
    LEAST_RAD = math.radians(0.25)  # what matches at both ends of a span are off
    CHANCE = 1.645  # deviations: one in twenty seems as good by chance
    SIGNIFICANT = 2.0  # deviations of a bias
    FORGOTTEN = 1e-4  # of what is known of biases, with each span
    ROUGH_ENOUGH = 20  # scans
    ROUGH_REMEMBERED = 100
    MOST_ROUGH_RAD = math.radians(3.0)
    BETTER = 2.0

    def __init__(self, rad_per_m: float, share: float) -> None:
        """rad_per_m, share: standard deviations of the biases, before anything was seen."""
        self._span = _Span()
        self._square_rad2, self._spans = 0.0, 0  # of a span's length
        self._bias: F64 = np.zeros(2)  # rad per metre, share of the turn
        self._sure_bias = (0.0, 0.0)
        self._first: F64 = np.diag([rad_per_m**2, share**2])
        self._covariance = self._first.copy()
        self._rough_rad2 = self._expected_rad2 = 0.0
        self._rough_scans = 0

    def sigma_rad(self, way_m: float, turn_rad: float) -> float:
        """Standard deviation of odometry's turn in a step, bias taken off: no better than what was seen may be by
        chance; infinite if too little was seen."""
        n = min(self._spans, self.REMEMBERED)
        if n < self.ENOUGH:
            return math.inf
        part = 2.0 / (9.0 * n)  # of chi squared with n degrees of freedom, as Wilson and Hilferty have it
        by_chance = (1.0 - part - self.CHANCE * math.sqrt(part)) ** 3
        return math.sqrt(self._square_rad2 / by_chance * self._share(way_m, turn_rad))

    def bias_rad(self, along_m: float, turn_rad: float) -> float:
        """How far a step turns more than odometry says, as far as that is more than chance."""
        return self._sure_bias[0] * along_m + self._sure_bias[1] * turn_rad

    @property
    def is_better(self) -> bool:
        """Whether odometry turns more truly than matches of scans that lie on no planes."""
        return self._rough_scans >= self.ROUGH_ENOUGH and self._rough_rad2 > self.BETTER * self._expected_rad2

    def step(self, along_m: float, turn_rad: float, off_rad: float, left_rad: float, *, is_rough: bool) -> None:
        """One step by odometry, and what its scan says.

        off_rad: how far the pose that was taken turns from odometry's.  left_rad: how much farther the match would
        have, if nothing had held it.  is_rough: it lies on no planes.
        """
        if is_rough and abs(along_m) > 0.01:
            self._learn_rough(along_m, turn_rad, off_rad + left_rad)
        span = self._span = self._span.and_step(along_m, turn_rad, off_rad, is_rough=is_rough)
        if span.rough > min(span.steps - 1, 1 + self.ROUGH_SHARE * span.steps):
            self._span = _Span()
        elif not is_rough and (span.way_m >= self.SPAN_M or span.turns_rad >= self.SPAN_RAD):
            self._learn(replace(span, off_rad=span.off_rad + left_rad))
            self._span = _Span()

    def _share(self, way_m: float, turn_rad: float) -> float:
        """Of a span's length."""
        return abs(way_m) / self.SPAN_M + abs(turn_rad) / self.SPAN_RAD

    def _learn(self, span: _Span) -> None:
        grows = np.array([span.along_m, span.turned_rad])
        off_rad = min(abs(span.off_rad - self.bias_rad(span.along_m, span.turned_rad)), self.MOST_RAD)
        share = self._share(span.way_m, span.turns_rad)
        self._spans += 1
        self._square_rad2 += (off_rad**2 / share - self._square_rad2) / min(self._spans, self.REMEMBERED)
        noise = max(self._square_rad2, self.LEAST_RAD**2) * share
        spread = self._covariance @ grows
        gain = spread / (float(grows @ spread) + noise)
        self._bias = self._bias + gain * (span.off_rad - float(self._bias @ grows))
        known = self._covariance - np.outer(gain, spread)
        self._covariance = known + self.FORGOTTEN * (self._first - known)
        is_sure = np.abs(self._bias) > self.SIGNIFICANT * np.sqrt(np.diag(self._covariance))
        along, turning = np.where(is_sure, self._bias, 0.0).tolist()
        self._sure_bias = (along, turning)

    def _learn_rough(self, along_m: float, turn_rad: float, off_rad: float) -> None:
        sigma_rad = self.sigma_rad(along_m, turn_rad)
        if math.isinf(sigma_rad):
            return
        off_rad = min(abs(off_rad - self.bias_rad(along_m, turn_rad)), self.MOST_ROUGH_RAD)
        self._rough_scans += 1
        rate = 1.0 / min(self._rough_scans, self.ROUGH_REMEMBERED)
        self._rough_rad2 += rate * (off_rad**2 - self._rough_rad2)
        self._expected_rad2 += rate * (sigma_rad**2 - self._expected_rad2)
