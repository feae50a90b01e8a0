"""One cluster becomes straight lines: end point fit, regression, shifted ends (S04 to S06).

The forms of the book one by one; `mapping.lines.extract` does all of them in one compiled call.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import lines as kernels
from mapping.lines.lines import as_points

F64 = NDArray[np.float64]


def chord_distance(points: ArrayLike) -> F64:
    """(N,) distance of each point from the line through the first and the last.

    h_i = |(y_i - y_q) cos psi - (x_i - x_q) sin psi|, psi = atan2(y_r - y_q, x_r - x_q) (eq. 5.3; the book's tan psi
    fails on vertical chords). If both ends are the same point: the distance from it.
    """
    p = as_points(points)
    if len(p) == 0:
        return np.empty(0)
    away = p - p[0]
    way = p[-1] - p[0]
    if not np.any(way):
        return np.asarray(np.hypot(away[:, 0], away[:, 1]))
    psi = math.atan2(way[1], way[0])
    return np.asarray(np.abs(away[:, 1] * math.cos(psi) - away[:, 0] * math.sin(psi)))


def split_at_end_points(points: ArrayLike, tolerance_m: float) -> list[slice]:
    """Cut one cluster into straight runs by iterative end point fit.

    points: (N, 2) in order.  tolerance_m: a run bends at its farthest point from the chord, if that is farther.
    Where a chord is shorter than the bulge over it (a ring seen from inside), distances are those from its first end.
    Returns slices that cover the points in order, neighbours sharing an end point; none if N < 2.
    Raises ValueError if points are not (N, 2) and finite or the tolerance is negative. About n log n; n^2 if nearly
    every point is a corner, as on a circle with a tolerance near 0.
    Source: S04 [DH73].
    """
    p = as_points(points)
    if not (math.isfinite(tolerance_m) and tolerance_m >= 0.0):
        raise ValueError(f"tolerance_m must be >= 0, got {tolerance_m}")
    n = len(p)
    if n < 2:
        return []
    rules = np.zeros(kernels.RULES)
    rules[kernels.SPLIT_M] = tolerance_m
    first, last, stack = (np.empty(n, dtype=np.int64) for _ in range(3))
    count = kernels.split(p[:, 0].copy(), p[:, 1].copy(), 0, n - 1, rules, first, last, 0, stack)
    return [slice(int(a), int(b) + 1) for a, b in zip(first[:count], last[:count])]


@dataclass(frozen=True, slots=True)
class Regression:
    """A line <n, p> = distance_m with n = (cos angle, sin angle), distance_m >= 0.

    centre_m: (2,) centre of gravity of the points, on the line.  direction_rad: gamma, of the line itself, in
    (-pi/2, pi/2].  covariance: (2, 2) of (angle, distance).  sum_of_squares: of the weighted distances.
    """

    angle_rad: float
    distance_m: float
    covariance: F64
    centre_m: F64
    direction_rad: float
    sum_of_squares: float


def regression_line(points: ArrayLike, *, sigma_m: ArrayLike = 1.0, across_m: ArrayLike | None = None) -> Regression:
    """The line with the least weighted sum of squared distances, weights 1/sigma^2, and how sure it is.

    points: (N, 2), N >= 2, not all the same.  sigma_m: of each point, (N,) or one for all; what it is weighted by.
    across_m: the error of each point across the line, where it is not sigma_m (a beam along a wall errs along it);
    then the covariance says what these errors do to a fit with those weights.
    gamma = 1/2 atan2(2a, b), a = sum w (x - xs)(y - ys), b = sum w ((x - xs)^2 - (y - ys)^2): the minimum, whatever
    the direction. First-order covariance: delta gamma = sum w t e / sum w t^2, delta offset = sum w e / sum w, t along
    the line from the centre of gravity, and d = <n, c> turns with the angle by -<u, c>.
    Raises ValueError for fewer or equal points, other shapes, numbers that are not finite, sigmas not above 0.
    Source: S05, eqs. 5.10 to 5.16; the book prints b equal to a, and its roots hold the maximum as well.
    """
    p = as_points(points)
    sigma = _sigmas(sigma_m, len(p), "sigma_m")
    error = sigma if across_m is None else _sigmas(across_m, len(p), "across_m")
    if len(p) < 2 or not np.any(p != p[0]):
        raise ValueError("a line needs two different points")
    w = 1.0 / sigma**2
    total = float(w.sum())
    centre = w @ p / total
    dx, dy = (p - centre).T
    a, b = float(w @ (dx * dy)), float(w @ (dx * dx - dy * dy))
    gamma = 0.5 * math.atan2(2.0 * a, b)
    u, n = np.array([math.cos(gamma), math.sin(gamma)]), np.array([-math.sin(gamma), math.cos(gamma)])
    t, h = u[0] * dx + u[1] * dy, n[0] * dx + n[1] * dy
    distance = float(n @ centre)
    if distance < 0.0:
        n, distance = -n, -distance
    spread = float(w @ (t * t))
    if spread < 1e-150:
        raise ValueError("a line needs two different points: these are too close to tell apart")
    turn = float((w * t * error) @ (w * t * error)) / spread**2
    shift = float((w * error) @ (w * error)) / total**2
    both = float((w * t * error) @ (w * error)) / (spread * total)
    # An error across moves the line along +h; seen from n, which may point the other way, both signs change together.
    lever = n[1] * centre[0] - n[0] * centre[1]
    side = 1.0 if n @ np.array([-u[1], u[0]]) > 0.0 else -1.0
    both *= side
    covariance = np.array(
        [
            [turn, both - lever * turn],
            [both - lever * turn, shift - 2.0 * lever * both + lever * lever * turn],
        ]
    )
    angle = math.atan2(float(n[1]), float(n[0]))
    return Regression(angle, distance, covariance, centre, gamma, float(w @ (h * h)))


def shift_to_line(points: ArrayLike, line: Regression) -> F64:
    """Points (N, 2) moved onto a line by the shortest way: dx = -h sin gamma, dy = +h cos gamma, h towards the line.

    Source: S06, eqs. 5.20 and 5.21; the book prints +h sin for dx, which is not perpendicular.
    """
    p = as_points(points)
    gamma = line.direction_rad
    h = (line.centre_m[1] - p[:, 1]) * math.cos(gamma) - (line.centre_m[0] - p[:, 0]) * math.sin(gamma)
    return np.stack((p[:, 0] - h * math.sin(gamma), p[:, 1] + h * math.cos(gamma)), axis=-1)


def _sigmas(value: ArrayLike, n: int, name: str) -> F64:
    sigma = np.asarray(value, dtype=np.float64)
    if sigma.shape not in ((), (n,)):
        raise ValueError(f"{name} is one number or ({n},), got {sigma.shape}")
    if not (np.all(np.isfinite(sigma)) and np.all(sigma > 0.0)):
        raise ValueError(f"{name} must be above 0 and finite")
    return np.broadcast_to(sigma, (n,))
