"""Compiled loops about a sensor that moves while it measures: a pose for every beam, the sweep as of one instant.

Short: they keep the interpreter's lock, see sectors.py.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.no_echo import reach_without_echo, widest_gap

TWO_PI = 2.0 * math.pi
SMALL_RAD = 1e-6


@njit(cache=True)
def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % TWO_PI - math.pi


@njit(cache=True)
def arc_coefficients(w: float) -> tuple[float, float]:
    """sin(w)/w and (1 - cos(w))/w, by series near 0."""
    if abs(w) < SMALL_RAD:
        return 1.0 - w * w / 6.0, w / 2.0
    return math.sin(w) / w, (1.0 - math.cos(w)) / w


FOUND, NOT_YET, GONE = 0, 1, 2


@njit(cache=True)
def poses_at(asked: Any, stamps: Any, pose: Any, stretch: Any, found: Any) -> int:
    """Poses at asked times (N,) along arcs of constant twist between the two poses around each, into found (N, 3).

    stamps: (M,) rising, M >= 2.  NOT_YET if any time lies beyond them, else GONE if any lies before them, or if an arc
    would cross from one stretch to another.
    """
    oldest, newest = stamps[0], stamps[-1]
    is_gone = False
    for k in range(len(asked)):
        if asked[k] > newest:
            return NOT_YET
        is_gone |= asked[k] < oldest
    if is_gone:
        return GONE
    known = -1  # the arc whose coefficients are at hand
    at = 1
    cos = sin = vx = vy = turn = span = 0.0
    for k in range(len(asked)):
        t = asked[k]
        if t < stamps[at - 1] or t > stamps[at]:
            at = min(max(np.searchsorted(stamps, t), 1), len(stamps) - 1)
        if at != known:
            known = at
            x0, y0, yaw0 = pose[at - 1, 0], pose[at - 1, 1], pose[at - 1, 2]
            cos, sin = math.cos(yaw0), math.sin(yaw0)
            turn = wrapped(pose[at, 2] - yaw0)
            a, b = arc_coefficients(turn)
            dx, dy = pose[at, 0] - x0, pose[at, 1] - y0
            x, y = cos * dx + sin * dy, cos * dy - sin * dx  # the motion in the start's frame
            norm = a * a + b * b
            vx, vy = (a * x + b * y) / norm, (a * y - b * x) / norm
            span = float(stamps[at] - stamps[at - 1])
        if stretch[at] != stretch[at - 1] and t != stamps[at - 1] and t != stamps[at]:
            return GONE
        share = (t - stamps[at - 1]) / span
        a, b = arc_coefficients(share * turn)
        x, y = share * (a * vx - b * vy), share * (b * vx + a * vy)
        found[k, 0] = pose[at - 1, 0] + cos * x - sin * y
        found[k, 1] = pose[at - 1, 1] + sin * x + cos * y
        found[k, 2] = wrapped(pose[at - 1, 2] + share * turn)
    return FOUND


@njit(cache=True)
def along_arc(start: Any, end: Any, share: Any) -> Any:
    """(N, 3) poses at shares (N,) of the way from one pose (3,) to another along the arc of constant twist."""
    found = np.empty((len(share), 3))
    cos, sin = math.cos(start[2]), math.sin(start[2])
    turn = wrapped(end[2] - start[2])
    a, b = arc_coefficients(turn)
    dx, dy = end[0] - start[0], end[1] - start[1]
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    norm = a * a + b * b
    vx, vy = (a * x + b * y) / norm, (a * y - b * x) / norm
    for k in range(len(share)):
        a, b = arc_coefficients(share[k] * turn)
        x, y = share[k] * (a * vx - b * vy), share[k] * (b * vx + a * vy)
        found[k, 0] = start[0] + cos * x - sin * y
        found[k, 1] = start[1] + sin * x + cos * y
        found[k, 2] = wrapped(start[2] + share[k] * turn)
    return found


@njit(cache=True)
def carried(pose: Any, x: float, y: float, yaw: float) -> Any:
    """(N, 3) poses a_from_c of many a_from_b (N, 3) and one b_from_c; yaw is not wrapped."""
    moved = np.empty_like(pose)
    for k in range(len(pose)):
        cos, sin = math.cos(pose[k, 2]), math.sin(pose[k, 2])
        moved[k, 0] = pose[k, 0] + cos * x - sin * y
        moved[k, 1] = pose[k, 1] + sin * x + cos * y
        moved[k, 2] = pose[k, 2] + yaw
    return moved


@njit(cache=True)
def placed(pose: Any, x: float, y: float, yaw: float) -> Any:
    """(N, 3) poses a_from_c of one a_from_b and many b_from_c (N, 3); yaw is not wrapped."""
    moved = np.empty_like(pose)
    cos, sin = math.cos(yaw), math.sin(yaw)
    for k in range(len(pose)):
        moved[k, 0] = x + cos * pose[k, 0] - sin * pose[k, 1]
        moved[k, 1] = y + sin * pose[k, 0] + cos * pose[k, 1]
        moved[k, 2] = yaw + pose[k, 2]
    return moved


@njit(cache=True)
def seen_at_once(
    sensor: Any, ref_x: float, ref_y: float, ref_yaw: float, bearing: Any, distance: Any
) -> tuple[Any, Any, Any]:
    """Beams, each measured from its own pose sensor (N, 3), as seen from one pose of the same frame.

    Returns bearings and ranges (N,) and where each beam started (N, 2). A beam without a length is turned, not moved.
    """
    count = len(bearing)
    new_bearing, new_distance, origin = np.empty(count), np.empty(count), np.empty((count, 2))
    cos, sin = math.cos(ref_yaw), math.sin(ref_yaw)
    for k in range(count):
        dx, dy = sensor[k, 0] - ref_x, sensor[k, 1] - ref_y
        ox, oy = cos * dx + sin * dy, cos * dy - sin * dx
        origin[k, 0], origin[k, 1] = ox, oy
        angle = bearing[k] + wrapped(sensor[k, 2] - ref_yaw)
        if math.isfinite(distance[k]):
            x, y = ox + distance[k] * math.cos(angle), oy + distance[k] * math.sin(angle)
            new_bearing[k], new_distance[k] = math.atan2(y, x), math.hypot(x, y)
        else:
            new_bearing[k], new_distance[k] = wrapped(angle), distance[k]
    return new_bearing, new_distance, origin


@njit(cache=True)
def seen_from(
    sensor: Any,
    at_x: float,
    at_y: float,
    at_yaw: float,
    bearing: Any,
    distance: Any,
    new_bearing: Any,
    new_distance: Any,
) -> None:
    """Beams, each measured from its own pose sensor (N, 3), as from one pose of that frame, into new_* (N,).

    Bearings stay near those that were measured, whole turns included. A beam without a length is turned, not moved.
    """
    cos, sin = math.cos(at_yaw), math.sin(at_yaw)
    for k in range(len(bearing)):
        turned = bearing[k] + (sensor[k, 2] - at_yaw)
        new_bearing[k], new_distance[k] = turned, distance[k]
        if math.isfinite(distance[k]):
            angle = bearing[k] + sensor[k, 2]
            dx = sensor[k, 0] + distance[k] * math.cos(angle) - at_x
            dy = sensor[k, 1] + distance[k] * math.sin(angle) - at_y
            x, y = cos * dx + sin * dy, cos * dy - sin * dx
            new_bearing[k] = turned + wrapped(math.atan2(y, x) - turned)
            new_distance[k] = math.hypot(x, y)


@njit(cache=True)
def rolled_covariance(
    covariance: Any, yaw: float, way: float, turn: float, track: float, left_var: float, right_var: float
) -> Any:
    """Covariance (3, 3) of x, y, yaw after both wheels of a differential drive rolled on along an arc.

    yaw: before it.  way: length of the arc.  turn: along it.  left_var, right_var: of the two travels, in m^2.
    """
    h = 0.5 * turn
    if abs(h) < 1e-4:
        share, bend = 1.0 - h * h / 6.0, -h / 3.0
    else:
        share, bend = math.sin(h) / h, (h * math.cos(h) - math.sin(h)) / (h * h)
    chord = way * share
    c, s = math.cos(yaw + h), math.sin(yaw + h)
    by_pose = np.eye(3)
    by_pose[0, 2], by_pose[1, 2] = -s * chord, c * chord
    by_travel = np.empty((3, 2))
    for wheel in range(2):
        half = (-0.5 if wheel == 0 else 0.5) / track  # of the chord's own turn by this travel
        longer = 0.5 * share + way * bend * half
        by_travel[0, wheel] = c * longer - s * chord * half
        by_travel[1, wheel] = s * longer + c * chord * half
        by_travel[2, wheel] = 2.0 * half
    moved = np.zeros((3, 3))
    for row in range(3):
        for col in range(3):
            for i in range(3):
                for j in range(3):
                    moved[row, col] += by_pose[row, i] * covariance[i, j] * by_pose[col, j]
            moved[row, col] += by_travel[row, 0] * left_var * by_travel[col, 0]
            moved[row, col] += by_travel[row, 1] * right_var * by_travel[col, 1]
    return moved


@njit(cache=True)
def beam_lines(
    pose: Any, bearing: Any, distance: Any, range_min: float, range_max: float, reach: float, clear_no_return: bool
) -> tuple[Any, Any, Any, Any]:
    """Beams from a pose each (N, 3): where they start and end (N, 2), whether they prove free space, and an obstacle.

    The beams are in order of bearing.  reach: beyond it a beam is cut; how far one is free that saw nothing:
    mapping.no_echo.  A beam that proves nothing ends at NaN.
    """
    count = len(bearing)
    origin, end = np.empty((count, 2)), np.empty((count, 2))
    free, hit = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    silent = np.empty(count)
    if clear_no_return:
        reach_without_echo(bearing, distance, range_max, widest_gap(bearing), silent)
    for k in range(count):
        x, y, yaw, r = pose[k, 0], pose[k, 1], pose[k, 2], distance[k]
        origin[k, 0], origin[k, 1] = x, y
        placed = math.isfinite(x) and math.isfinite(y) and math.isfinite(yaw)
        length = math.nan
        if 0.0 <= r <= range_max:
            length = min(r, reach)
            free[k], hit[k] = placed, placed and r <= reach
        elif r == math.inf and clear_no_return and silent[k] > 0.0:
            length = min(silent[k], reach)
            free[k] = placed
        elif r == -math.inf and range_min > 0.0:
            length = range_min
            hit[k] = placed
        angle = bearing[k] + yaw
        end[k, 0], end[k, 1] = x + length * math.cos(angle), y + length * math.sin(angle)
    return origin, end, free, hit
