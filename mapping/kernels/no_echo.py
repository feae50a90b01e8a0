"""Compiled loop of silence: how far a beam that saw nothing is free. The rule: mapping/no_echo.py.

Short: it keeps the interpreter's lock, see sectors.py.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

TWO_PI = 2.0 * math.pi
WIDE_RAD, WIDE_M = TWO_PI / 3.0, 2.0  # so much silence in a row is believed so far, whatever is beside it
OPEN_RAD, OPEN_M = math.pi - 1e-6, 12.0
NEIGHBOUR_FACTOR = 1.5  # neighbours are no farther apart than this many times the usual spacing
MAX_WEDGE_RAD = 0.2  # farther apart, beams are separate sensors
SAMPLES = 31


@njit(cache=True)
def turn_to(bearing: Any, k: int) -> float:
    """From the beam before to beam k; to the first one from the last."""
    if k > 0:
        return float(abs(bearing[k] - bearing[k - 1]))
    return float(abs(TWO_PI - abs(bearing[len(bearing) - 1] - bearing[0])))


@njit(cache=True)
def widest_gap(bearing: Any) -> float:
    """How far apart two beams (N,) in order may be and still be neighbours, by the middle one of some of the steps."""
    steps = len(bearing) - 1
    if steps < 1:
        return 0.0
    taken = np.empty(min(SAMPLES, steps))
    for i in range(len(taken)):
        k = (2 * i + 1) * steps // (2 * len(taken)) + 1
        turn = abs(bearing[k] - bearing[k - 1])
        j = i
        while j > 0 and taken[j - 1] > turn:
            taken[j] = taken[j - 1]
            j -= 1
        taken[j] = turn
    return float(min(NEIGHBOUR_FACTOR * taken[len(taken) // 2], MAX_WEDGE_RAD))


@njit(cache=True)
def is_echo(r: float, range_max_m: float) -> bool:
    """Whether a beam met something within the sensor's reach."""
    return bool(0.0 < r <= range_max_m and r < math.inf)


@njit(cache=True)
def reach_without_echo(bearing: Any, distance: Any, range_max_m: float, gap_max: float, reach: Any) -> int:
    """Into reach (N,): how far each beam that is +inf may be called free; others are left. Returns how many there are.

    The beams are a turn or a part of one in order; two farther apart than gap_max have something unseen between them.
    The rule: see mapping.no_echo.
    """
    n, silent, filled = len(distance), 0, 0
    for k in range(n):
        silent += distance[k] == math.inf
    if silent == 0:
        return 0
    for first in range(n):
        before = first - 1 if first > 0 else n - 1
        is_joined = turn_to(bearing, first) <= gap_max
        if distance[first] != math.inf or (is_joined and distance[before] == math.inf):
            continue
        last, span = first, 0.0
        while True:
            after = last + 1 if last + 1 < n else 0
            turn = turn_to(bearing, after)
            if turn > gap_max or distance[after] != math.inf:
                break
            last, span = after, span + turn
        is_between = is_joined and turn <= gap_max
        is_between = is_between and is_echo(distance[before], range_max_m) and is_echo(distance[after], range_max_m)
        filled += fill_run(bearing, distance, first, last, span, is_between, range_max_m, reach)
    if filled == 0:  # a whole turn
        for k in range(n):
            reach[k] = min(OPEN_M, range_max_m)
    return silent


@njit(cache=True)
def fill_run(
    bearing: Any, distance: Any, first: int, last: int, span: float, is_between: bool, range_max_m: float, reach: Any
) -> int:
    """reach_without_echo for beams in a row that saw nothing, from `first` to `last`, with span radians between them.

    is_between: whether the beams beside them met something. Returns how many beams.
    """
    n = len(distance)
    before, after = first - 1 if first > 0 else n - 1, last + 1 if last + 1 < n else 0
    wide = OPEN_M if span >= OPEN_RAD else WIDE_M if span >= WIDE_RAD else 0.0
    a, b, turn = distance[before], distance[after], turn_to(bearing, first) + span + turn_to(bearing, after)
    is_between = is_between and turn < math.pi
    k, phi, count = first, turn_to(bearing, first), 0
    while True:
        far = wide
        if is_between:  # the straight line through both ends, in polar form
            across = a * math.sin(phi) + b * math.sin(max(turn - phi, 0.0))
            if across > 0.0:
                far = max(far, a * b * math.sin(turn) / across)
        reach[k] = min(far, range_max_m)
        count += 1
        if k == last:
            return count
        k = k + 1 if k + 1 < n else 0
        phi += turn_to(bearing, k)
