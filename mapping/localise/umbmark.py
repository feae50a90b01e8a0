"""UMBmark: what driving a square both ways round tells about the wheels.

Source: Borenstein and Feng, "Measurement and correction of systematic odometry errors in mobile robots", IEEE T-RA
12(6), 1996. Where the robot ends, minus where its odometry says it ends, in the frame of its start; the square's
first leg lies along x. Unequal wheels bend the legs, a wrong track width turns the corners too far: the first drift
changes its sign with the direction, the second does not, so means of both directions tell them apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SIDE_M = 4.0


@dataclass(frozen=True, slots=True)
class Umbmark:
    """What the squares say.

    worst_m: the measure, the farther one of the two clusters' centres of gravity (E_max,syst).  clockwise,
    counter: (2,) those centres, metres.  spread_m: deviation about them, what is not systematic.  wheel_ratio: right
    diameter over left.  track_factor: actual track width over the nominal one.
    """

    worst_m: float
    clockwise: F64
    counter: F64
    spread_m: float
    wheel_ratio: float
    track_factor: float


def umbmark(clockwise: F64, counter: F64, *, track_width_m: float, side_m: float = SIDE_M) -> Umbmark:
    """Evaluate return errors (n, 2) and (m, 2), metres: measured end minus end by odometry, runs in both directions.

    The ratio and the factor are first order in the errors, as in the paper. ValueError without a run each way.
    """
    cw, ccw = np.atleast_2d(clockwise), np.atleast_2d(counter)
    if cw.shape[1:] != (2,) or ccw.shape[1:] != (2,) or not len(cw) or not len(ccw):
        raise ValueError("UMBmark needs return errors (n, 2) of runs in both directions")
    if not side_m > 0.0 or not track_width_m > 0.0:
        raise ValueError("the square's side and the track width are positive lengths in metres")
    a, b = cw.mean(axis=0), ccw.mean(axis=0)
    off = np.concatenate((cw - a, ccw - b))
    corner = (a[0] + b[0]) / (-4.0 * side_m)  # alpha: turned too far at each corner
    bend = (a[0] - b[0]) / (-4.0 * side_m)  # beta: turned along each leg
    half_pi = 0.5 * math.pi
    ratio = 1.0
    if abs(bend) > 1e-12:
        radius = 0.5 * side_m / math.sin(0.5 * bend)
        ratio = (radius + 0.5 * track_width_m) / (radius - 0.5 * track_width_m)
    worst = max(math.hypot(*a), math.hypot(*b))
    return Umbmark(worst, a, b, float(np.sqrt(np.mean(off**2))), ratio, float(half_pi / (half_pi - corner)))


def square_end(
    actual: tuple[float, float, float], nominal: tuple[float, float, float], *, side_m: float = SIDE_M, way: int
) -> F64:
    """(2,) where a robot ends that drives a square by its odometry, which ends at the start by its own account.

    actual, nominal: left and right gain and track width.  way: +1 counter-clockwise, -1 clockwise.  It turns on the
    spot in each corner, the last one included.
    """
    if way not in (1, -1):
        raise ValueError("way is +1 or -1")
    left, right = actual[0] / nominal[0], actual[1] / nominal[1]
    half_turn = way * 0.25 * math.pi * nominal[2]  # of one wheel in a corner
    x = y = yaw = 0.0
    for rolled_left, rolled_right in [(side_m, side_m), (-half_turn, half_turn)] * 4:
        forward = 0.5 * (left * rolled_left + right * rolled_right)
        turn = (right * rolled_right - left * rolled_left) / actual[2]
        chord = forward * float(np.sinc(turn / (2.0 * math.pi)))
        x, y = x + chord * math.cos(yaw + 0.5 * turn), y + chord * math.sin(yaw + 0.5 * turn)
        yaw += turn
    return np.array([x, y])
