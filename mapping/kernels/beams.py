"""Compiled loops over the beams of one sweep, before anything is drawn from it.

Short: they keep the interpreter's lock, see sectors.py.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.sectors import point_in_polygon

TWO_PI = 2.0 * math.pi


@njit(cache=True)
def angle_between(a: float, b: float) -> float:
    """How far two bearings are apart, 0 to pi."""
    turn = abs(a - b) % TWO_PI
    return min(turn, TWO_PI - turn)


@njit(cache=True)
def goes_on(r: float, r_next: float, r_second: float, turn: float, turn_on: float, off_m: float) -> bool:
    """Whether a beam of length r ends on the straight wall through the ends of the next two to one side."""
    if not (r_second > 0.0 and math.isfinite(r_second) and turn_on > 0.0):
        return False
    # A line in polar form: 1/r = A cos(bearing) + B sin(bearing), so from any three of its points
    # sin(turn_on) / r = sin(turn + turn_on) / r_next - sin(turn) / r_second.
    inverse = (math.sin(turn + turn_on) / r_next - math.sin(turn) / r_second) / math.sin(turn_on)
    # Each of the three may be off by off_m: the first derivatives of r by them, at small turns; but half of the step is
    # no noise.
    off = min(off_m * (1.0 + 2.0 * (r / r_next) ** 2 + (r / r_second) ** 2), 0.5 * abs(r - r_next))
    return bool(inverse > 0.0 and abs(r - 1.0 / inverse) <= off)


@njit(cache=True)
def drop_mixed(
    bearing: Any, distance: Any, cot_grazing: float, step_m: float, off_m: float, widest: float, kept: Any
) -> int:
    """Copy (N,) distances into kept (N,), with NaN for those of mixed pixels; returns how many.

    The beams are a turn or a part of one in order. A beam is judged by its neighbours, two to either side; the first of
    either side must be there: see mapping.mixed_pixels.
    """
    n = len(distance)
    for k in range(n):
        kept[k] = distance[k]
    if n < 5:
        return 0
    steep = np.zeros(n, np.bool_)  # a loop without branches, which the compiler makes wide; few beams are
    for k in range(np.uint64(1), np.uint64(n - 1)):
        up, down = distance[k + 1] - distance[k], distance[k] - distance[k - 1]  # NaN fails
        steep[k] = ((up > step_m) & (down > step_m)) | ((up < -step_m) & (down < -step_m))
    steep[0] = steep[n - 1] = True  # looked at below
    dropped = 0
    for k in range(n):
        if not steep[k]:
            continue
        after = k + 1 if k + 1 < n else 0
        r, r_before, r_after = distance[k], distance[k - 1], distance[after]
        up, down = r_after - r, r - r_before
        if not (min(up, down) > step_m or max(up, down) < -step_m):
            continue
        if not (r_before > 0.0 and r > 0.0 and r_after > 0.0 and math.isfinite(up + down)):
            continue
        turn_before, turn_after = angle_between(bearing[k], bearing[k - 1]), angle_between(bearing[k], bearing[after])
        narrow, wide = min(turn_before, turn_after), max(turn_before, turn_after)
        if narrow <= 0.0 or wide > widest or wide > 1.5 * narrow:
            continue
        # Chords to both sides run along the beam: much farther that way than across it.
        if abs(down) < cot_grazing * min(r, r_before) * turn_before:
            continue
        if abs(up) < cot_grazing * min(r, r_after) * turn_after:
            continue
        last = after + 1 if after + 1 < n else 0
        if goes_on(r, r_before, distance[k - 2], turn_before, angle_between(bearing[k - 1], bearing[k - 2]), off_m):
            continue
        if goes_on(r, r_after, distance[last], turn_after, angle_between(bearing[after], bearing[last]), off_m):
            continue
        kept[k] = math.nan
        dropped += 1
    return dropped


@njit(cache=True)
def close_narrow_gaps(bearing: Any, narrow_m: float, kept: Any) -> int:
    """In place: +inf of (N,) distances becomes NaN between two ends less than narrow_m apart; returns how many.

    The beams are a turn or a part of one in order. See mapping.narrow_gaps.
    """
    n = len(kept)
    first = -1  # a beam with a range to begin with
    for k in range(n):
        if kept[k] > 0.0 and math.isfinite(kept[k]):
            first = k
            break
    if first < 0:
        return 0
    usual = abs(bearing[n - 1] - bearing[0]) / max(n - 1, 1)
    is_turn = n > 2 and angle_between(bearing[n - 1], bearing[0]) < 2.0 * usual
    dropped, last, gap, is_open = 0, first, 0, False
    for step in range(1, n + 1):
        k = (first + step) % n
        if k == 0 and not is_turn:
            is_open = True  # the end of the field of view
        r = kept[k]
        if not (r > 0.0 and math.isfinite(r)):
            gap += r == math.inf
            is_open = is_open or r <= 0.0
            continue
        if gap > 0 and not is_open:
            a, turn = kept[last], angle_between(bearing[k], bearing[last])
            if a * a + r * r - 2.0 * a * r * math.cos(turn) < narrow_m * narrow_m:
                for back in range(1, n):
                    j = (k - back) % n
                    if j == last:
                        break
                    if kept[j] == math.inf:
                        kept[j] = math.nan
                        dropped += 1
        last, gap, is_open = k, 0, False
    return dropped


@njit(cache=True)
def drop_own(
    bearing: Any, distance: Any, x_m: float, y_m: float, yaw_rad: float, polygon: Any, too_close_m: float, kept: Any
) -> int:
    """Copy (N,) distances into kept (N,), with NaN for those that end in a polygon (V, 2); returns how many.

    x_m, y_m, yaw_rad: the sensor in the polygon's frame.  too_close_m: where -inf ends; NaN: nowhere.
    Where no distance is within reach of the polygon nothing is written, and -1 is returned.
    """
    reach = 0.0
    for k in range(len(polygon)):
        reach = max(reach, math.hypot(polygon[k, 0], polygon[k, 1]))
    reach += math.hypot(x_m, y_m)
    near = 0
    for k in range(len(distance)):
        near += distance[k] <= reach
    if near == 0:
        return -1
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    dropped = 0
    for k in range(len(distance)):
        r = distance[k]
        kept[k] = r
        if r == -math.inf:
            r = too_close_m
        if not 0.0 <= r <= reach:
            continue
        along, across = r * math.cos(bearing[k]), r * math.sin(bearing[k])
        if point_in_polygon(x_m + c * along - s * across, y_m + s * along + c * across, polygon):
            kept[k] = math.nan
            dropped += 1
    return dropped
