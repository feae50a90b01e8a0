"""What a scan's points weigh: centre of gravity, moments, the ellipse of inertia, and smoothing (S15 to S17)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.lines.lines import as_points

F64 = NDArray[np.float64]


def checked_points(points: ArrayLike) -> F64:
    """(N, 2) finite points; ValueError otherwise, also if squares of them would overflow."""
    p = as_points(points)
    if p.size and float(np.abs(p).max()) > 1e100:
        raise ValueError("points lie beyond 1e100 m: their squares are no numbers any more")
    return p


def checked_weights(weight: ArrayLike | None, count: int) -> F64:
    """(N,) weights >= 0, ones if None; ValueError otherwise."""
    if weight is None:
        return np.ones(count)
    w = np.asarray(weight, dtype=np.float64)
    if w.shape != (count,):
        raise ValueError(f"weight is ({count},) like the points, got {w.shape}")
    if not (np.all(np.isfinite(w)) and np.all(w >= 0.0)):
        raise ValueError("weights are finite and >= 0")
    return w


def arc_weights(points: ArrayLike, *, gap_m: float = 0.5, full_turn: bool = False) -> F64:
    """The length of surface that each point of a scan stands for: half the way to either neighbour, (N,) [m].

    points: (N, 2) in order of bearing.  gap_m: neighbours farther apart are on different surfaces, and no length lies
    between them.  full_turn: the last point is followed by the first.
    A scan samples by angle, so what is near counts more; weighted by arc length, the moments are those of the walls
    and do not depend on where on them the beams fell.  Source: S15.  ValueError if points are not (N, 2) and finite.
    """
    p = checked_points(points)
    if not gap_m > 0.0:
        raise ValueError(f"gap_m must be above 0, got {gap_m}")
    weight = np.zeros(len(p))
    if len(p) < 2:
        return weight
    step = np.hypot(*np.diff(p, axis=0).T)
    step[step > gap_m] = 0.0
    weight[:-1] += 0.5 * step
    weight[1:] += 0.5 * step
    if full_turn and len(p) > 2:
        closing = float(np.hypot(*(p[0] - p[-1])))
        if closing <= gap_m:
            weight[0] += 0.5 * closing
            weight[-1] += 0.5 * closing
    return weight


def moment(points: ArrayLike, p: int, q: int, *, weight: ArrayLike | None = None, central: bool = False) -> float:
    """M_pq = sum w x^p y^q / sum w (with w = 1: 1/N sum x^p y^q).

    points: (N, 2).  central: about the centre of gravity instead of the origin, so that moving the points changes
    nothing.  ValueError without points, if all weights are 0, for orders below 0, or if the powers overflow.
    """
    if p < 0 or q < 0:
        raise ValueError(f"orders of a moment are >= 0, got {p}, {q}")
    at, w = _weighed(points, weight)
    if central:
        at = at - _mean(at, w)
    with np.errstate(over="ignore", invalid="ignore"):
        value = float(np.sum(w * at[:, 0] ** p * at[:, 1] ** q) / np.sum(w))
    if not math.isfinite(value):
        raise ValueError(f"the moment {p}, {q} of points so far away is too large a number")
    return value


def centre_of_gravity(points: ArrayLike, *, weight: ArrayLike | None = None) -> F64:
    """(x_s, y_s) = (M_10, M_01) (eqs. 5.25, 5.26), (2,) [m].  With arc_weights that of the walls.

    ValueError without points, or if all weights are 0.
    """
    return _mean(*_weighed(points, weight))


@dataclass(frozen=True, slots=True)
class Inertia:
    """Moments of inertia of points about axes through their centre of gravity, and the ellipse they form.

    centre: (x_s, y_s).  sxx, sxy, syy: mean (or weighted mean) of dx^2, dx dy, dy^2 [m^2].
    """

    centre: tuple[float, float]
    sxx: float
    sxy: float
    syy: float

    def about(self, axis_rad: ArrayLike) -> F64:
        """f(psi) = S_yy cos^2 psi - 2 S_xy sin psi cos psi + S_xx sin^2 psi: the mean of squared distances to the axis
        under psi; any shape.  (Eqs. 5.35 and 5.36 lost terms and a sign in print.)"""
        c, s = np.cos(np.asarray(axis_rad, dtype=np.float64)), np.sin(np.asarray(axis_rad, dtype=np.float64))
        return np.asarray(self.syy * c * c - 2.0 * self.sxy * s * c + self.sxx * s * s)

    @property
    def direction_rad(self) -> float:
        """The axis of least inertia, in [-pi/2, pi/2): where the points are longest. 0 where they are round."""
        turn = 0.5 * math.atan2(2.0 * self.sxy, self.sxx - self.syy)
        return turn - math.pi if turn >= 0.5 * math.pi else turn

    @property
    def least(self) -> float:
        """Smallest moment, >= 0 [m^2]."""
        return max(0.0, 0.5 * (self.sxx + self.syy) - self._radius)

    @property
    def most(self) -> float:
        """Largest moment [m^2]."""
        return 0.5 * (self.sxx + self.syy) + self._radius

    @property
    def axis_ratio(self) -> float:
        """Short by long axis of the ellipse, sqrt(least / most), in [0, 1]; 1 if all points are one.

        Neither it nor the direction relative to the scene changes when the robot moves or turns.
        """
        return math.sqrt(self.least / self.most) if self.most > 0.0 else 1.0

    @property
    def _radius(self) -> float:
        return math.hypot(0.5 * (self.sxx - self.syy), self.sxy)


def inertia(points: ArrayLike, *, weight: ArrayLike | None = None) -> Inertia:
    """Moments of inertia (eqs. 5.27 to 5.36, S16), divided by the sum of weights so that scans of any size compare.

    ValueError without points, or if all weights are 0.
    """
    p, w = _weighed(points, weight)
    centre = _mean(p, w)
    d, total = p - centre, np.sum(w)
    sxx, sxy, syy = (float(np.sum(w * d[:, a] * d[:, b]) / total) for a, b in ((0, 0), (0, 1), (1, 1)))
    return Inertia((float(centre[0]), float(centre[1])), sxx, sxy, syy)


def smoothed_distances(points: ArrayLike, *, steepness: float = 5.0) -> F64:
    """Distances from the centre of gravity, what is far away damped: d / (1 + exp(a (d - d_0) / d_0)), (N,) [m].

    d_0: the mean distance (eq. 5.37).  steepness: a; at d_0 half is left, well beyond nothing (eq. 5.38, S17).
    All zeros if all points are one.  ValueError without points, or if steepness is not above 0.
    """
    p, w = _weighed(points, None)
    if not (math.isfinite(steepness) and steepness > 0.0):
        raise ValueError(f"steepness must be above 0, got {steepness}")
    d = np.hypot(*(p - _mean(p, w)).T)
    mean = float(np.mean(d))
    if mean == 0.0:
        return np.zeros(len(p))
    return np.asarray(d / (1.0 + np.exp(np.minimum(steepness * (d - mean) / mean, 700.0))))


def smoothed_inertia(points: ArrayLike, *, steepness: float = 5.0, weight: ArrayLike | None = None) -> Inertia:
    """The same moments with every point drawn in to its smoothed distance, so that a glimpse down a far corridor does
    not outweigh the room.  Errors as of inertia and smoothed_distances."""
    p, w = _weighed(points, weight)
    centre = _mean(p, np.ones(len(p)))
    d = np.hypot(*(p - centre).T)
    drawn = smoothed_distances(p, steepness=steepness) / np.where(d > 0.0, d, 1.0)
    return inertia(centre + (p - centre) * drawn[:, None], weight=w)


def _weighed(points: ArrayLike, weight: ArrayLike | None) -> tuple[F64, F64]:
    p = checked_points(points)
    if len(p) == 0:
        raise ValueError("there are no points: nothing has a centre of gravity")
    w = checked_weights(weight, len(p))
    if not np.sum(w) > 0.0:
        raise ValueError("all weights are 0")
    return p, w / np.max(w)


def _mean(p: F64, w: F64) -> F64:
    return np.asarray(np.sum(w[:, None] * p, axis=0) / np.sum(w))
