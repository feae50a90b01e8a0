"""Compiled loop of lines that are no more (S10, forgetting): what a sweep's beams do at each place of each line.

A place is a whole multiple of the station along x or y, whichever a line follows more, so that a line that moves a
little keeps its places. Its key: number along, bin across, axis.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

OFFSET = 1 << 19  # of numbers and bins, so that keys are positive


@njit(cache=True, nogil=True)
def axis_of(x0: float, y0: float, x1: float, y1: float) -> Any:
    """0 where a line follows x more than y, else 1."""
    return 1 if abs(y1 - y0) > abs(x1 - x0) else 0


@njit(cache=True, nogil=True)
def key_of(number: int, across: float, across_m: float, axis: int) -> Any:
    """Name of a place: its number along the axis and where it lies across it, metres."""
    return ((number + OFFSET) << 22) | ((math.floor(across / across_m + 0.5) + OFFSET) << 1) | axis


@njit(cache=True, nogil=True)
def places_of(x0: float, y0: float, x1: float, y1: float, step_m: float, across_m: float, key: Any, share: Any) -> Any:
    """Keys of a line's places from start to end, and how far each lies on the way from 0 to 1. Returns how many."""
    axis = axis_of(x0, y0, x1, y1)
    a0, a1, b0, b1 = (x0, x1, y0, y1) if axis == 0 else (y0, y1, x0, x1)
    if abs(a1 - a0) < 1e-9:
        return 0
    first, last = math.ceil(min(a0, a1) / step_m), math.floor(max(a0, a1) / step_m)
    n = 0
    for i in range(min(last - first + 1, key.size)):
        number = first + i if a1 > a0 else last - i
        share[n] = (number * step_m - a0) / (a1 - a0)
        key[n] = key_of(number, b0 + share[n] * (b1 - b0), across_m, axis)
        n += 1
    return n


@njit(cache=True, nogil=True)
def look(
    ends: Any, bearing: Any, range_m: Any, x: float, y: float, yaw: float, step_m: float, across_m: float,
    reach_m: float, margin_m: float, straight_rad: float, steepest_rad: float, widest_rad: float,
    hit: Any, through: Any, line: Any, tilt: Any,
) -> Any:  # fmt: skip
    """Places that echo, and those that beams go through.

    ends: (L, 4).  bearing: (N,) rising, sensor frame; range_m: (N,), NaN where a beam says nothing.  x, y, yaw: the
    sensor's pose.  widest_rad: farther apart two beams say nothing about what is between them.
    hit: (M,) keys of places where a beam ends.  through, line, tilt: (M,) keys, line and angle from the perpendicular
    of those where both beams beside it end beyond, and are straight.  What exceeds M is left out.  Returns both counts.
    """
    hits, passed = 0, 0
    n = bearing.size
    sine_straight, sine_steepest = math.sin(straight_rad), math.sin(steepest_rad)
    for k in range(ends.shape[0]):
        x0, y0, x1, y1 = ends[k, 0], ends[k, 1], ends[k, 2], ends[k, 3]
        axis = axis_of(x0, y0, x1, y1)
        a0, a1, b0, b1 = (x0, x1, y0, y1) if axis == 0 else (y0, y1, x0, x1)
        here = x if axis == 0 else y
        length = math.hypot(x1 - x0, y1 - y0)
        if abs(a1 - a0) < 1e-9:
            continue
        first = math.ceil(max(min(a0, a1), here - reach_m) / step_m)
        last = math.floor(min(max(a0, a1), here + reach_m) / step_m)
        for number in range(first, last + 1):
            share = (number * step_m - a0) / (a1 - a0)
            dx, dy = x0 + share * (x1 - x0) - x, y0 + share * (y1 - y0) - y
            reach = math.hypot(dx, dy)
            if reach >= reach_m or reach <= margin_m:
                continue
            aslant = abs(dx * (x1 - x0) + dy * (y1 - y0)) / (reach * length)
            if aslant > sine_steepest:
                continue
            turn = math.atan2(dy, dx) - yaw - bearing[0]
            at = bearing[0] + turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi))
            if at > bearing[n - 1]:
                continue
            low, high = 0, n - 1
            while high - low > 1:
                middle = (low + high) // 2
                if bearing[middle] <= at:
                    low = middle
                else:
                    high = middle
            if bearing[high] - bearing[low] > widest_rad:
                continue
            r0, r1 = range_m[low], range_m[high]
            if abs(r0 - reach) < margin_m or abs(r1 - reach) < margin_m:
                if hits < hit.size:
                    hit[hits] = key_of(number, b0 + share * (b1 - b0), across_m, axis)
                    hits += 1
            elif aslant <= sine_straight and r0 > reach + margin_m and r1 > reach + margin_m and passed < through.size:
                through[passed] = key_of(number, b0 + share * (b1 - b0), across_m, axis)
                line[passed] = k
                tilt[passed] = math.asin(min(1.0, aslant))
                passed += 1
    return hits, passed
