"""Compiled loops of the sector maps (S34 to S40).

What a sensor has seen is a star polygon about the sensor: every beam a thin sector as long as its range, nothing where
no beam looked. Its corners are given in the frame of the virtual sensor. An area is free only if it holds no border
of that polygon and lies inside it; the vehicle's own outline needs no looking at.
Sectors of a polar map: n wedges of `width` from `start`, the last one ends at start + span.

Those that run for every sweep and cone keep the interpreter's lock: each takes 0.2 ms at most, there are some fifty a
sweep, and after each another thread may have the lock for a millisecond. In a trial with two busy threads beside it a
turn of 40 short kernels took 0.9 ms (nine of ten below 1.0 ms) with the lock, 1.1 ms (4.5 ms) giving it up each time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.no_echo import reach_without_echo

TWO_PI = 2.0 * math.pi
CELL_SLACK_M = 1e-9
EDGE_RAD = 1e-9  # bearings closer to an edge than this lie on it
CLEAR_RAD = 1e-7  # bearings farther from an edge than this are surely on its one side
TOUCH_M = 1e-9  # a shorter stretch is a touch
MAX_CUTS = 64  # of one segment with the outline of the vehicle


@njit(cache=True)
def sector_of(bearing: float, start: float, width: float, span: float, count: int) -> int:
    """Index of the sector that holds a bearing, -1 if none does. A lower edge belongs to its sector; so does stop."""
    along = (bearing - start) % TWO_PI
    if along > TWO_PI - EDGE_RAD:
        along = 0.0
    if along > span + EDGE_RAD:
        return -1
    return min(int((along + EDGE_RAD) / width), count - 1)


@njit(cache=True)
def point_in_polygon(x: float, y: float, polygon: Any) -> bool:
    """Even-odd rule; no polygon holds nothing."""
    inside = False
    previous = len(polygon) - 1
    for corner in range(len(polygon)):
        ax, ay = polygon[previous, 0], polygon[previous, 1]
        bx, by = polygon[corner, 0], polygon[corner, 1]
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            inside = not inside
        previous = corner
    return inside


@njit(cache=True, nogil=True)
def inside_polygon(x: Any, y: Any, polygon: Any) -> Any:
    """Which of many points lie in a polygon."""
    inside = np.zeros(len(x), dtype=np.bool_)
    for k in range(len(x)):
        inside[k] = point_in_polygon(x[k], y[k], polygon)
    return inside


@njit(cache=True)
def border_distances(bearing: Any, polygon: Any) -> Any:
    """Where each ray from the origin crosses the polygon for the last time, 0 if never, NaN for a NaN bearing."""
    result = np.zeros(len(bearing))
    for k in range(len(bearing)):
        if math.isnan(bearing[k]):
            result[k] = math.nan
            continue
        ux, uy = math.cos(bearing[k]), math.sin(bearing[k])
        previous = len(polygon) - 1
        for corner in range(len(polygon)):
            ax, ay = polygon[previous, 0], polygon[previous, 1]
            ex, ey = polygon[corner, 0] - ax, polygon[corner, 1] - ay
            previous = corner
            across = ux * ey - uy * ex
            if across == 0.0:
                continue
            along = (ax * ey - ay * ex) / across
            at = (ax * uy - ay * ux) / across
            if along > result[k] and -1e-12 <= at <= 1.0 + 1e-12:
                result[k] = along
    return result


@njit(cache=True)
def nearest_on(ax: float, ay: float, bx: float, by: float) -> tuple[float, float]:
    """The point of a segment nearest to the origin."""
    ex, ey = bx - ax, by - ay
    square = ex * ex + ey * ey
    t = 0.0
    if square > 0.0:
        t = min(max(-(ax * ex + ay * ey) / square, 0.0), 1.0)
    return ax + t * ex, ay + t * ey


@njit(cache=True)
def nearest_outside(ax: float, ay: float, bx: float, by: float, polygon: Any, reach: float) -> float:
    """How near a segment comes to the origin outside the polygon; inf if it stays inside.

    reach: no corner of the polygon is farther from the origin.
    """
    nx, ny = nearest_on(ax, ay, bx, by)
    near = math.hypot(nx, ny)
    if near > reach or len(polygon) == 0:
        return near
    cuts = np.empty(MAX_CUTS)
    cuts[0] = 0.0
    count = 1
    ex, ey = bx - ax, by - ay
    previous = len(polygon) - 1
    for corner in range(len(polygon)):
        px, py = polygon[previous, 0], polygon[previous, 1]
        fx, fy = polygon[corner, 0] - px, polygon[corner, 1] - py
        previous = corner
        across = ex * fy - ey * fx
        if across == 0.0:
            continue
        t = ((px - ax) * fy - (py - ay) * fx) / across
        u = ((px - ax) * ey - (py - ay) * ex) / across
        if 0.0 < t < 1.0 and 0.0 <= u <= 1.0:
            if count == MAX_CUTS - 1:
                return near  # more than we keep book of: as if all of it were outside
            cuts[count] = t
            count += 1
    cuts[count] = 1.0
    count += 1
    order = np.sort(cuts[:count])
    best = math.inf
    for k in range(count - 1):
        lo, hi = order[k], order[k + 1]
        middle = 0.5 * (lo + hi)
        if (hi - lo) * (abs(ex) + abs(ey)) < TOUCH_M:
            continue
        if point_in_polygon(ax + middle * ex, ay + middle * ey, polygon):
            continue
        nx, ny = nearest_on(ax + lo * ex, ay + lo * ey, ax + hi * ex, ay + hi * ey)
        best = min(best, math.hypot(nx, ny))
    return best


@njit(cache=True)
def clip_to_wedge(
    ax: float, ay: float, bx: float, by: float, lo_x: float, lo_y: float, hi_x: float, hi_y: float
) -> tuple[float, float]:
    """The stretch t0 <= t <= t1 of a segment between two rays from the origin, at most half a turn apart.

    t0 > t1: none of it.
    """
    t0, t1 = 0.0, 1.0
    # left of the lower ray, then right of the upper one
    for side in range(2):
        if side == 0:
            at_a, at_b = lo_x * ay - lo_y * ax, lo_x * by - lo_y * bx
        else:
            at_a, at_b = hi_y * ax - hi_x * ay, hi_y * bx - hi_x * by
        if at_a < 0.0 and at_b < 0.0:
            return 1.0, 0.0
        if at_a < 0.0:
            t0 = max(t0, at_a / (at_a - at_b))
        elif at_b < 0.0:
            t1 = min(t1, at_a / (at_a - at_b))
    return t0, t1


@njit(cache=True)
def gaps_between(bearing: Any) -> Any:
    """(N - 1,) angles between neighbouring bearings, at most half a turn each."""
    gaps = np.empty(len(bearing) - 1)
    for k in range(len(gaps)):
        gaps[k] = abs((bearing[k + 1] - bearing[k] + math.pi) % TWO_PI - math.pi)
    return gaps


@njit(cache=True)
def are_ascending(bearing: Any) -> bool:
    """Whether (N,) bearings, N > 0, never fall and lie within one turn."""
    for k in range(1, len(bearing)):
        if not bearing[k] >= bearing[k - 1]:
            return False
    return bool(bearing[-1] - bearing[0] < TWO_PI)


@njit(cache=True)
def thin_sectors(
    bearing: Any, distance: Any, range_max: float, gap_max: float, spacing: float
) -> tuple[Any, Any, Any, Any, Any]:
    """Thin sectors of beams: lo, hi, length (M,) of those with a length, lo, hi (K,) of all valid ones.

    bearing: (N,) ascending within one turn.  Neighbours no farther apart than gap_max meet half-way, others leave half
    a spacing.  length: as in mapping.no_echo for a beam that saw nothing; none where nothing is proved free.
    """
    count = len(bearing)
    lo, hi = np.empty(count), np.empty(count)
    for k in range(count):
        gap = bearing[k + 1] - bearing[k] if k + 1 < count else bearing[0] + TWO_PI - bearing[k]
        reach = 0.5 * gap if gap <= gap_max else 0.5 * spacing
        hi[k] = bearing[k] + reach
        lo[k + 1 if k + 1 < count else 0] = bearing[k + 1 if k + 1 < count else 0] - reach
    silent = np.empty(count)
    if range_max < math.inf:
        reach_without_echo(bearing, distance, range_max, gap_max, silent)
    seen_lo, seen_hi, length = np.empty(count), np.empty(count), np.empty(count)
    looked_lo, looked_hi = np.empty(count), np.empty(count)
    sees = looks = 0
    for k in range(count):
        r = distance[k]
        if r == math.inf:
            r = silent[k] if range_max < math.inf else 0.0
        elif r > 0.0:
            r = r if r <= range_max else 0.0
        elif r == 0.0 or r == -math.inf:  # too close
            r = 0.0
        else:  # invalid; a negative number is no range
            continue
        looked_lo[looks], looked_hi[looks] = lo[k], hi[k]
        looks += 1
        if r > 0.0:
            seen_lo[sees], seen_hi[sees], length[sees] = lo[k], hi[k], r
            sees += 1
    return seen_lo[:sees], seen_hi[:sees], length[:sees], looked_lo[:looks], looked_hi[:looks]


@njit(cache=True)
def point_in_star(px: float, py: float, first: float, lo: Any, hi: Any, length: Any, anywhere: bool) -> bool:
    """Whether a point, seen from the sensor, lies in a star: within the chord of a thin sector.

    lo, hi, length: (M,) ascending, apart, M > 0.  first: lo[0] - EDGE_RAD.  anywhere: in the direction of a thin
    sector, at any distance.
    """
    along = (math.atan2(py, px) - first) % TWO_PI + first
    at = max(np.searchsorted(lo, along + EDGE_RAD, side="right") - 1, 0)
    if along > hi[at] + EDGE_RAD:
        return False
    return anywhere or math.hypot(px, py) <= length[at] * math.cos(0.5 * (hi[at] - lo[at]))


@njit(cache=True)
def in_star(points: Any, x: float, y: float, yaw: float, lo: Any, hi: Any, length: Any, anywhere: bool) -> Any:
    """(N,) which of (N, 2) points lie in a star about the sensor at x, y, yaw; see point_in_star."""
    inside = np.zeros(len(points), dtype=np.bool_)
    if len(lo) == 0:
        return inside
    cos, sin = math.cos(yaw), math.sin(yaw)
    first = lo[0] - EDGE_RAD
    for k in range(len(points)):
        dx, dy = points[k, 0] - x, points[k, 1] - y
        inside[k] = point_in_star(cos * dx + sin * dy, cos * dy - sin * dx, first, lo, hi, length, anywhere)
    return inside


@njit(cache=True)
def beam_ends(bearing: Any, distance: Any, range_min: float, least: float, x: float, y: float, yaw: float) -> Any:
    """(M, 2) obstacles that a fan of beams met, of a sensor that stands at x, y, yaw; too close: at range_min."""
    points = np.empty((len(bearing), 2))
    count = 0
    for k in range(len(bearing)):
        r = range_min if distance[k] == -math.inf else distance[k]
        if not 0.0 <= r < math.inf and distance[k] != -math.inf:
            continue
        r = max(r, least)
        angle = bearing[k] + yaw
        points[count, 0], points[count, 1] = x + r * math.cos(angle), y + r * math.sin(angle)
        count += 1
    return points[:count]


@njit(cache=True)
def nearer_than_both(obstacle: Any, first: Any, second: Any) -> Any:
    """Indices of finite obstacles (N,) that are nearer than both others."""
    found = np.empty(len(obstacle), dtype=np.int64)
    count = 0
    for k in range(len(obstacle)):
        if math.isfinite(obstacle[k]) and obstacle[k] < first[k] and obstacle[k] < second[k]:
            found[count] = k
            count += 1
    return found[:count]


@njit(cache=True)
def judge(
    obstacle: Any, u: Any, v: Any, free: Any, blind: Any, stamp: Any, fresh: Any, source: Any, all_heard: bool,
    now_ns: int, states: Any,
) -> tuple[Any, Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """What the findings (F, N) of all channels come to for each of N sectors; the rules: mapping/sectors/evidence.py.

    stamp, fresh: (F, N).  source: (F,).  states: values of OBSTACLE, FREE, UNKNOWN, STALE.  Returns (N,) state,
    distance, u, v, age, source and free as in Verdict. Of equals the first finding counts.
    """
    rows, count = obstacle.shape
    is_obstacle, is_free, is_unknown, is_stale = states
    state = np.full(count, is_unknown, dtype=np.int8)
    distance, at_u, at_v = np.full(count, math.nan), np.full(count, math.nan), np.full(count, math.nan)
    age, of, all_free = np.full(count, -1, dtype=np.int64), np.full(count, -1, dtype=np.int16), np.zeros(count)
    for sector in range(count):
        nearest, seen, old, any_near = math.inf, 0.0, math.inf, math.inf
        at_nearest, at_seen, at_old, at_any = 0, 0, 0, 0
        is_blind = False
        for row in range(rows):
            met, through = obstacle[row, sector], free[row, sector]
            if met < any_near:
                any_near, at_any = met, row
            if fresh[row, sector]:
                is_blind = is_blind or blind[row, sector]
                if met < nearest:
                    nearest, at_nearest = met, row
                if through > seen:
                    seen, at_seen = through, row
            else:
                knew = met if met < math.inf else (through if through > 0.0 else math.inf)
                if knew < old:
                    old, at_old = knew, row
        shown, decides = math.inf, -1
        at = at_nearest
        if old < nearest * (1.0 - 1e-12):
            state[sector], shown, at, decides = is_stale, any_near, at_any, at_old
        elif nearest < math.inf:
            state[sector], shown, decides = is_obstacle, nearest, at_nearest
            if not is_blind and all_heard:
                all_free[sector] = min(seen, nearest)
        elif seen > 0.0 and not is_blind and all_heard:
            state[sector], decides = is_free, at_seen
            distance[sector] = all_free[sector] = seen
        if decides < 0:
            continue
        if shown < math.inf:
            distance[sector], at_u[sector], at_v[sector] = shown, u[at, sector], v[at, sector]
        age[sector] = max(now_ns - stamp[decides, sector], 0)
        of[sector] = source[decides]
    return state, distance, at_u, at_v, age, of, all_free


@njit(cache=True)
def well_within(
    bearing: float, x: float, y: float, start: float, width: float, count: int, edge_x: Any, edge_y: Any
) -> int:
    """The sector that a point at this bearing lies well inside, -1 if that is not sure."""
    if width > 3.0:
        return -1
    sector = int((bearing - start) % TWO_PI / width)
    return sector if sector < count and well_inside(x, y, sector, edge_x, edge_y) else -1


@njit(cache=True)
def star_border(lo: Any, hi: Any, length: Any, x: float, y: float, yaw: float) -> Any:
    """(M, 2) corners of the union of thin sectors about (x, y), ascending and apart, with chords for arcs.

    Where two do not touch, the border goes home to (x, y) and out again.
    """
    corners = np.empty((3 * len(lo), 2))
    count = 0
    last, ux, uy = math.nan, 0.0, 0.0
    for k in range(len(lo)):
        if lo[k] != last:  # else neighbours meet
            ux, uy = math.cos(lo[k] + yaw), math.sin(lo[k] + yaw)
        corners[count, 0], corners[count, 1] = x + length[k] * ux, y + length[k] * uy
        last = hi[k]
        ux, uy = math.cos(last + yaw), math.sin(last + yaw)
        corners[count + 1, 0], corners[count + 1, 1] = x + length[k] * ux, y + length[k] * uy
        count += 2
        following = lo[k + 1] if k + 1 < len(lo) else lo[0] + TWO_PI
        if following - hi[k] > EDGE_RAD:
            corners[count, 0], corners[count, 1] = x, y
            count += 1
    return corners[:count]


@njit(cache=True)
def well_inside(x: float, y: float, sector: int, edge_x: Any, edge_y: Any) -> bool:
    """Whether a point lies in a sector narrower than half a turn and nowhere near its edges."""
    slack = CLEAR_RAD * (abs(x) + abs(y))
    past_lower = edge_x[sector] * y - edge_y[sector] * x
    before_upper = edge_y[sector + 1] * x - edge_x[sector + 1] * y
    return bool(past_lower > slack and before_upper > slack)


@njit(cache=True)
def free_reach(border: Any, edges: Any, width: float, polygon: Any, reach: float, range_max: float) -> Any:
    """How near the border of a star polygon comes to the origin within each sector, outside the vehicle's outline.

    border: (M, 2) corners of the closed polygon, virtual sensor frame.  Returns (N,), at most range_max.
    """
    count = len(edges) - 1
    start, span = edges[0], edges[-1] - edges[0]
    free = np.full(count, range_max)
    edge_x, edge_y = np.cos(edges), np.sin(edges)
    corners = len(border)
    if corners == 0:
        free[:] = 0.0
        return free
    bx, by = border[corners - 1, 0], border[corners - 1, 1]
    here = -1  # the sector that a lies well inside, if it is known
    for corner in range(corners):
        ax, ay = bx, by
        bx, by = border[corner, 0], border[corner, 1]
        if ax == bx and ay == by:
            continue
        nx, ny = nearest_on(ax, ay, bx, by)
        near = math.hypot(nx, ny)
        if here >= 0 and near > reach and well_inside(bx, by, here, edge_x, edge_y):
            free[here] = min(free[here], near)  # all of it lies in this sector, outside the vehicle
            continue
        a_rad, b_rad = math.atan2(ay, ax), math.atan2(by, bx)
        here = well_within(b_rad, bx, by, start, width, count, edge_x, edge_y)
        if near >= range_max:
            continue
        turn = (b_rad - a_rad + math.pi) % TWO_PI - math.pi
        lo = (a_rad if turn >= 0.0 else b_rad) - EDGE_RAD
        along = (lo - start) % TWO_PI
        sweep = abs(turn) + 2.0 * EDGE_RAD
        if near < 1e-9:  # the border runs through the origin itself
            along, sweep = 0.0, TWO_PI
        for lap in range(2):
            first = along - lap * TWO_PI
            last = first + sweep
            if last < 0.0 or first > span:
                continue
            low, high = math.floor(first / width), math.floor(last / width)
            for sector in range(max(0, low), min(count - 1, high) + 1):
                if near >= free[sector]:
                    continue
                if low == high and near > reach:  # all of it lies in this sector, outside the vehicle
                    free[sector] = near
                    continue
                t0, t1 = clip_to_wedge(
                    ax, ay, bx, by, edge_x[sector], edge_y[sector], edge_x[sector + 1], edge_y[sector + 1]
                )
                ex, ey = bx - ax, by - ay
                if (t1 - t0) * (abs(ex) + abs(ey)) < TOUCH_M:
                    continue  # it passes by, or ends on the edge
                found = nearest_outside(ax + t0 * ex, ay + t0 * ey, ax + t1 * ex, ay + t1 * ey, polygon, reach)
                free[sector] = min(free[sector], found)
    return free


@njit(cache=True)
def free_from_origin(lo: Any, hi: Any, length: Any, edges: Any, width: float, range_max: float) -> Any:
    """free_reach for a sensor that stands on the virtual origin: the shortest beam of each sector, exact.

    lo, hi, length: (M,) the thin sectors of the beams, ascending, together at most one turn; gaps are not free.
    """
    count = len(edges) - 1
    start, span = edges[0], edges[-1] - edges[0]
    free = np.full(count, range_max)
    covered = np.zeros(count)
    for beam in range(len(lo)):
        along = (lo[beam] - start) % TWO_PI
        sweep = hi[beam] - lo[beam]
        for lap in range(2):
            first = along - lap * TWO_PI
            last = first + sweep
            if last < 0.0 or first > span:
                continue
            for sector in range(max(0, int(first / width)), min(count - 1, int(last / width)) + 1):
                begin, end = edges[sector] - start, edges[sector + 1] - start
                common = min(last, end) - max(first, begin)
                if common > EDGE_RAD:
                    covered[sector] += common
                    free[sector] = min(free[sector], length[beam])
    for sector in range(count):
        if covered[sector] < edges[sector + 1] - edges[sector] - 1e-6:
            free[sector] = 0.0
    return free


@njit(cache=True)
def nearest_in_sectors(x: Any, y: Any, edges: Any, width: float, range_max: float) -> tuple[Any, Any]:
    """Per sector the distance and bearing of the nearest of many points; inf and NaN where there is none."""
    count = len(edges) - 1
    start, span = edges[0], edges[-1] - edges[0]
    best = np.full(count, math.inf)
    at = np.full(count, math.nan)
    edge_x, edge_y = np.cos(edges), np.sin(edges)
    found = np.full(count, -1, dtype=np.int64)
    here = -1
    for k in range(len(x)):
        distance = math.hypot(x[k], y[k])
        if not distance <= range_max:
            continue
        sector = here
        if here < 0 or not well_inside(x[k], y[k], here, edge_x, edge_y):
            bearing = math.atan2(y[k], x[k])
            sector = sector_of(bearing, start, width, span, count)
            here = well_within(bearing, x[k], y[k], start, width, count, edge_x, edge_y)
        if sector >= 0 and distance < best[sector]:
            best[sector] = distance
            found[sector] = k
    for sector in range(count):
        if found[sector] >= 0:
            at[sector] = math.atan2(y[found[sector]], x[found[sector]])
    return best, at


@njit(cache=True)
def arc_in_sectors(arc: Any, off_axis: Any, edges: Any, width: float, range_max: float) -> tuple[Any, Any]:
    """Per sector the nearest point of a polyline, and the bearing of the point nearest to the axis.

    arc: (M, 2) corners, virtual sensor frame.  off_axis: (M,) absolute angle of each corner off the sensor's axis.
    Returns (N,) distances, inf where the line does not pass, and (N,) bearings, NaN there.
    """
    count = len(edges) - 1
    start, span = edges[0], edges[-1] - edges[0]
    best = np.full(count, math.inf)
    at = np.full(count, math.nan)
    least = np.full(count, math.inf)
    edge_x, edge_y = np.cos(edges), np.sin(edges)
    for k in range(len(arc) - 1):
        ax, ay, bx, by = arc[k, 0], arc[k, 1], arc[k + 1, 0], arc[k + 1, 1]
        a_rad, b_rad = math.atan2(ay, ax), math.atan2(by, bx)
        turn = (b_rad - a_rad + math.pi) % TWO_PI - math.pi
        along = ((a_rad if turn >= 0.0 else b_rad) - EDGE_RAD - start) % TWO_PI
        sweep = abs(turn) + 2.0 * EDGE_RAD
        for lap in range(2):
            first = along - lap * TWO_PI
            last = first + sweep
            if last < 0.0 or first > span:
                continue
            for sector in range(max(0, int(first / width)), min(count - 1, int(last / width)) + 1):
                t0, t1 = clip_to_wedge(
                    ax, ay, bx, by, edge_x[sector], edge_y[sector], edge_x[sector + 1], edge_y[sector + 1]
                )
                if t0 > t1 or (t1 - t0) * abs(turn) < EDGE_RAD < abs(turn):
                    continue  # it only touches the edge
                ex, ey = bx - ax, by - ay
                nx, ny = nearest_on(ax + t0 * ex, ay + t0 * ey, ax + t1 * ex, ay + t1 * ey)
                distance = math.hypot(nx, ny)
                if distance > range_max:
                    continue
                best[sector] = min(best[sector], distance)
                at_t0 = off_axis[k] + t0 * (off_axis[k + 1] - off_axis[k])
                at_t1 = off_axis[k] + t1 * (off_axis[k + 1] - off_axis[k])
                t = t0 if at_t0 <= at_t1 else t1
                if min(at_t0, at_t1) < least[sector]:
                    least[sector] = min(at_t0, at_t1)
                    at[sector] = math.atan2(ay + t * ey, ax + t * ex)
    return best, at


@njit(cache=True)
def cells_between(start: float, end: float, edge: float, count: int) -> tuple[int, int]:
    """First and last cell along an axis that a stretch from start to end touches; the first greater: none."""
    low, high = min(start, end) - CELL_SLACK_M, max(start, end) + CELL_SLACK_M
    return max(0, math.floor(low / edge)), min(count - 1, math.floor(high / edge))


@njit(cache=True)
def columns_in_row(
    ax: float, ay: float, ex: float, ey: float, row: int, edge: float, cols: int
) -> tuple[float, float, int, int]:
    """Of a segment from a along e: the stretch of t within a row of cells, and its first and last column there."""
    t0, t1 = between(ay, ey, row * edge - CELL_SLACK_M, (row + 1) * edge + CELL_SLACK_M)
    if t0 > t1:
        return t0, t1, 0, -1
    low, high = cells_between(ax + t0 * ex, ax + t1 * ex, edge, cols)
    return t0, t1, low, high


@njit(cache=True)
def line_through_cells(
    line: Any, x0: float, y0: float, edge: float, rows: int, cols: int, polygon: Any, reach: float
) -> tuple[Any, Any, Any]:
    """Per cell of a raster, how near a polyline comes to the origin within it, outside the vehicle's outline.

    Returns (rows, cols) distances, inf where the line does not pass, and x, y of that point (of the whole stretch,
    where the outline is in the way).
    """
    best = np.full((rows, cols), math.inf)
    at_x = np.full((rows, cols), math.nan)
    at_y = np.full((rows, cols), math.nan)
    for k in range(len(line) - 1):
        ax, ay, bx, by = line[k, 0] - x0, line[k, 1] - y0, line[k + 1, 0] - x0, line[k + 1, 1] - y0
        ex, ey = bx - ax, by - ay
        if ex == 0.0 and ey == 0.0:
            continue
        row_lo, row_hi = cells_between(ay, by, edge, rows)
        for row in range(row_lo, row_hi + 1):
            t0, t1, col_lo, col_hi = columns_in_row(ax, ay, ex, ey, row, edge, cols)
            for col in range(col_lo, col_hi + 1):
                u0, u1 = between(ax, ex, col * edge - CELL_SLACK_M, (col + 1) * edge + CELL_SLACK_M)
                u0, u1 = max(u0, t0), min(u1, t1)
                if u0 > u1:
                    continue
                px, py = ax + u0 * ex + x0, ay + u0 * ey + y0
                qx, qy = ax + u1 * ex + x0, ay + u1 * ey + y0
                distance = nearest_outside(px, py, qx, qy, polygon, reach)
                if distance < best[row, col]:
                    best[row, col] = distance
                    at_x[row, col], at_y[row, col] = nearest_on(px, py, qx, qy)
    return best, at_x, at_y


@njit(cache=True)
def between(start: float, step: float, low: float, high: float) -> tuple[float, float]:
    """The stretch of t in [0, 1] for which low <= start + t * step <= high; the first greater: none."""
    if step == 0.0:
        if low <= start <= high:
            return 0.0, 1.0
        return 1.0, 0.0
    t0, t1 = (low - start) / step, (high - start) / step
    if t0 > t1:
        t0, t1 = t1, t0
    return max(t0, 0.0), min(t1, 1.0)


@njit(cache=True)
def cells_crossed(
    line: Any, x0: float, y0: float, edge: float, rows: int, cols: int, polygon: Any, reach: float
) -> Any:
    """(rows, cols) through which cells of a raster the closed polyline (M, 2) passes outside the vehicle's outline."""
    crossed = np.zeros((rows, cols), dtype=np.bool_)
    for k in range(len(line)):
        after = k + 1 if k + 1 < len(line) else 0
        ax, ay, bx, by = line[k, 0] - x0, line[k, 1] - y0, line[after, 0] - x0, line[after, 1] - y0
        ex, ey = bx - ax, by - ay
        if ex == 0.0 and ey == 0.0:
            continue
        row_lo, row_hi = cells_between(ay, by, edge, rows)
        for row in range(row_lo, row_hi + 1):
            t0, t1, col_lo, col_hi = columns_in_row(ax, ay, ex, ey, row, edge, cols)
            for col in range(col_lo, col_hi + 1):
                if crossed[row, col]:
                    continue
                u0, u1 = between(ax, ex, col * edge - CELL_SLACK_M, (col + 1) * edge + CELL_SLACK_M)
                u0, u1 = max(u0, t0), min(u1, t1)
                if u0 <= u1:
                    px, py = ax + u0 * ex + x0, ay + u0 * ey + y0
                    qx, qy = ax + u1 * ex + x0, ay + u1 * ey + y0
                    crossed[row, col] = nearest_outside(px, py, qx, qy, polygon, reach) < math.inf
    return crossed


@njit(cache=True)
def free_cells(
    lo: Any, hi: Any, length: Any, x: float, y: float, yaw: float,
    x0: float, y0: float, edge: float, rows: int, cols: int, polygon: Any, reach: float,
    corner_exempt: Any, middle_exempt: Any, under_vehicle: Any, far: Any,
) -> Any:  # fmt: skip
    """(rows * cols,) of cells that lie in a star as a whole (but for what the vehicle covers) their `far`, else 0.

    lo, hi, length: the star of a sensor at x, y, yaw.  Exempt: (rows + 1) * (cols + 1) corners, and middles, that need
    not be seen. Where no border passes, a cell is inside or outside as a whole, and its corners tell which.
    """
    free = np.zeros(rows * cols)
    if len(lo) == 0:
        return free
    crossed = cells_crossed(star_border(lo, hi, length, x, y, yaw), x0, y0, edge, rows, cols, polygon, reach)
    seen = np.zeros(len(corner_exempt), dtype=np.int8)  # of corners: 0 not looked at yet, 1 in the star, -1 not
    cos, sin = math.cos(yaw), math.sin(yaw)
    first = lo[0] - EDGE_RAD
    for row in range(rows):
        for col in range(cols):
            cell = row * cols + col
            if crossed[row, col] or under_vehicle[cell]:
                continue
            whole = True
            for corner in range(5):
                if corner < 4:
                    at_row, at_col = row + corner // 2, col + corner % 2
                    at = at_row * (cols + 1) + at_col
                    if seen[at] == 0:
                        dx, dy = x0 + at_col * edge - x, y0 + at_row * edge - y
                        own = point_in_star(cos * dx + sin * dy, cos * dy - sin * dx, first, lo, hi, length, False)
                        seen[at] = 1 if own or corner_exempt[at] else -1
                    whole = seen[at] > 0
                elif not middle_exempt[cell]:
                    dx, dy = x0 + (col + 0.5) * edge - x, y0 + (row + 0.5) * edge - y
                    whole = point_in_star(cos * dx + sin * dy, cos * dy - sin * dx, first, lo, hi, length, False)
                if not whole:
                    break
            if whole:
                free[cell] = far[cell]
    return free


@njit(cache=True)
def nearest_in_cells(x: Any, y: Any, x0: float, y0: float, edge: float, rows: int, cols: int) -> tuple[Any, Any, Any]:
    """Per cell of a raster the nearest of many points: its distance from the origin (inf: none), x and y."""
    best = np.full((rows, cols), math.inf)
    at_x = np.full((rows, cols), math.nan)
    at_y = np.full((rows, cols), math.nan)
    for k in range(len(x)):
        col, row = math.floor((x[k] - x0) / edge + 1e-9), math.floor((y[k] - y0) / edge + 1e-9)
        if 0 <= row < rows and 0 <= col < cols:
            distance = math.hypot(x[k], y[k])
            if distance < best[row, col]:
                best[row, col] = distance
                at_x[row, col], at_y[row, col] = x[k], y[k]
    return best, at_x, at_y


@njit(cache=True, nogil=True)
def artos_update(
    counters: Any, touched: Any, row0: int, col0: int, resolution: float,
    origin_x: float, origin_y: float, yaw: float, start: float, width: float, span: float,
    blocked: Any, obstacle: Any, at: Any, reach: Any, area: Any, limit: int, step: int,
) -> None:  # fmt: skip
    """One step of the two-step update for one polar sector map; see mapping.sectors.artos.

    blocked: (R, C) cells hit in this update.  obstacle, at: (N,) distance and bearing of obstacles, NaN none.
    reach: (N,) up to which a sector frees, 0 nothing.  area: first row, end row, first and end column, in the window.
    step: 1 counts up the cells of obstacles, 2 counts down the cells nearer than reach.
    """
    rows, cols = counters.shape
    count = len(reach)
    if step == 1:
        for sector in range(count):
            if math.isnan(obstacle[sector]):
                continue
            x = origin_x + obstacle[sector] * math.cos(yaw + at[sector])
            y = origin_y + obstacle[sector] * math.sin(yaw + at[sector])
            row, col = math.floor(y / resolution) - row0, math.floor(x / resolution) - col0
            if 0 <= row < rows and 0 <= col < cols:
                counters[row, col] = min(counters[row, col] + 1, limit)
                touched[row, col] = True
                blocked[row, col] = True
        return
    farthest = 0.0
    for sector in range(count):
        farthest = max(farthest, reach[sector])
    farthest_square = farthest * farthest
    for row in range(area[0], area[1]):
        y = (row + row0 + 0.5) * resolution - origin_y
        for col in range(area[2], area[3]):
            x = (col + col0 + 0.5) * resolution - origin_x
            square = x * x + y * y
            if square >= farthest_square or blocked[row, col]:
                continue
            sector = sector_of(math.atan2(y, x) - yaw, start, width, span, count)
            if sector >= 0 and square < reach[sector] * reach[sector]:
                counters[row, col] = max(counters[row, col] - 1, -limit)
                touched[row, col] = True


@njit(cache=True)
def arc_cells(
    origin_x: float, origin_y: float, radius: float, lo: float, hi: float, resolution: float, out: Any
) -> int:
    """The cells an arc passes, in order: it is cut wherever it crosses a line of the grid. Returns how many.

    out: (M, 2) int64 with room for 8 * radius / resolution + 20 cells.
    """
    left, right = origin_x - radius, origin_x + radius
    low, high = origin_y - radius, origin_y + radius
    cols = math.floor(right / resolution) - math.floor(left / resolution)
    rows = math.floor(high / resolution) - math.floor(low / resolution)
    cuts = np.empty(2 * (rows + cols) + 2)
    cuts[0], cuts[1] = lo, hi
    count = 2
    for k in range(cols):
        across = ((math.floor(left / resolution) + 1 + k) * resolution - origin_x) / radius
        half = math.acos(min(max(across, -1.0), 1.0))
        for angle in (half, -half):
            along = lo + (angle - lo) % TWO_PI
            if along < hi:
                cuts[count] = along
                count += 1
    for k in range(rows):
        across = ((math.floor(low / resolution) + 1 + k) * resolution - origin_y) / radius
        half = math.asin(min(max(across, -1.0), 1.0))
        for angle in (half, math.pi - half):
            along = lo + (angle - lo) % TWO_PI
            if along < hi:
                cuts[count] = along
                count += 1
    order = np.sort(cuts[:count])
    found = 0
    for k in range(count - 1):
        middle = 0.5 * (order[k] + order[k + 1])
        row = math.floor((origin_y + radius * math.sin(middle)) / resolution)
        col = math.floor((origin_x + radius * math.cos(middle)) / resolution)
        if found == 0 or out[found - 1, 0] != row or out[found - 1, 1] != col:
            out[found, 0], out[found, 1] = row, col
            found += 1
    return found


@njit(cache=True)
def cone_cells(
    origin_x: float, origin_y: float, yaw: float, start: float, width: float, span: float, reach: Any,
    resolution: float, row0: int, col0: int, free: Any,
) -> None:  # fmt: skip
    """Mark the cells whose middle lies in a sector, nearer than its reach. free: (R, C) bool, from (row0, col0)."""
    rows, cols = free.shape
    for row in range(rows):
        y = (row + row0 + 0.5) * resolution - origin_y
        for col in range(cols):
            x = (col + col0 + 0.5) * resolution - origin_x
            sector = sector_of(math.atan2(y, x) - yaw, start, width, span, len(reach))
            if sector >= 0 and math.hypot(x, y) < reach[sector]:
                free[row, col] = True


@njit(cache=True)
def nearest_cells_in_sectors(
    kinds: Any, row0: int, col0: int, resolution: float, origin_x: float, origin_y: float, yaw: float, edges: Any,
    width: float, range_max: float, body: Any, body_reach: float,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Per sector the nearest occupied cell and the nearest unknown one, by their edges within the sector.

    kinds: (R, C) int8, 0 free, 1 occupied, 2 unknown; what lies outside is unknown.  edges: of sectors, sensor frame.
    body: (V, 2) the vehicle's outline, sensor frame: what is unknown within it does not count.
    Returns (N,) distance to occupied, inf none, its bearing, distance to unknown.
    """
    rows, cols = kinds.shape
    count = len(edges) - 1
    start, span = edges[0], edges[-1] - edges[0]
    edge_x, edge_y = np.cos(edges), np.sin(edges)
    occupied = np.full(count, math.inf)
    at = np.full(count, math.nan)
    unknown = np.full(count, range_max)
    c, s = math.cos(yaw), math.sin(yaw)
    corner = np.empty((4, 2))
    nothing = np.empty((0, 2))
    for index in range(rows * cols + 1):
        outside = index == rows * cols  # last, the patch itself: beyond its border nothing is known
        if outside:
            kind, row, col, tall, wide = 2, 0, 0, rows, cols
        else:
            row, col, tall, wide = index // cols, index % cols, 1, 1
            kind = int(kinds[row, col])
            if kind == 0:
                continue
        x_lo, y_lo = (col + col0) * resolution - origin_x, (row + row0) * resolution - origin_y
        x_hi, y_hi = x_lo + wide * resolution, y_lo + tall * resolution
        within = x_lo <= 0.0 <= x_hi and y_lo <= 0.0 <= y_hi
        if not outside:
            near = math.hypot(max(x_lo, -x_hi, 0.0), max(y_lo, -y_hi, 0.0))
            if near >= range_max:
                continue
        if within != outside:  # the origin stands on the cell, or off the patch
            if kind == 1:
                occupied[:] = 0.0
                at[:] = 0.5 * (edges[1:] + edges[:-1])
            elif body_reach == 0.0 or outside:
                unknown[:] = 0.0
            if outside:
                continue
        for k in range(4):
            x, y = (x_hi if k == 1 or k == 2 else x_lo), (y_hi if k >= 2 else y_lo)
            corner[k, 0], corner[k, 1] = c * x + s * y, c * y - s * x
        for k in range(4):
            ax, ay = corner[k - 1, 0], corner[k - 1, 1]
            bx, by = corner[k, 0], corner[k, 1]
            ex, ey = bx - ax, by - ay
            a_rad, b_rad = math.atan2(ay, ax), math.atan2(by, bx)
            turn = (b_rad - a_rad + math.pi) % TWO_PI - math.pi
            along = ((a_rad if turn >= 0.0 else b_rad) - EDGE_RAD - start) % TWO_PI
            sweep = abs(turn) + 2.0 * EDGE_RAD
            px, py = nearest_on(ax, ay, bx, by)
            if math.hypot(px, py) < 1e-9:
                along, sweep = 0.0, TWO_PI
            for lap in range(2):
                first = along - lap * TWO_PI
                last = first + sweep
                if last < 0.0 or first > span:
                    continue
                for sector in range(max(0, math.floor(first / width)), min(count - 1, math.floor(last / width)) + 1):
                    t0, t1 = clip_to_wedge(
                        ax, ay, bx, by, edge_x[sector], edge_y[sector], edge_x[sector + 1], edge_y[sector + 1]
                    )
                    if (t1 - t0) * (abs(ex) + abs(ey)) < TOUCH_M:
                        continue
                    ux, uy = ax + t0 * ex, ay + t0 * ey
                    vx, vy = ax + t1 * ex, ay + t1 * ey
                    if kind == 1:
                        px, py = nearest_on(ux, uy, vx, vy)
                        distance = math.hypot(px, py)
                        if distance < occupied[sector]:
                            occupied[sector] = distance
                            at[sector] = math.atan2(py, px)
                    else:
                        polygon = body if body_reach > 0.0 else nothing
                        unknown[sector] = min(unknown[sector], nearest_outside(ux, uy, vx, vy, polygon, body_reach))
    return occupied, at, unknown
