"""Compiled loops of a scan as a table of bearings, and of its surfaces' normals.

A scan is kept as a table of bearing bins ("view"), so that the neighbours of a point in another scan are found by
its bearing there and not by a tree. A view's arrays are (B,) float32, a store of views has them as (K, B):

    x, y     mean end point of the beams in the bin, sensor frame [m]; 0 where the bin is empty
    nx, ny   unit normal of the surface there, towards the sensor; 0 where there is none
    quality  EMPTY no point, 0 a point without a normal, up to 1 a point on a straight surface
    frame    (4,) float64 of a view: bearing of the first bin's lower edge, width of a bin, bins, 1 if they close a turn
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

EMPTY = -1.0
FIRST, WIDTH, BINS, CLOSED = 0, 1, 2, 3

NEIGHBOURS = 8  # points on either side that may define a normal

GRAZING_BINS = 2  # on either side of one, of which a line is made
GRAZING_OFF_M = 0.04  # the worst of them
GRAZING_GAP_M = 2.0  # farther apart they are no wall
GRAZING_SINE = math.sin(math.radians(35.0))  # of the angle between beam and wall
GRAZING_QUALITY = 0.5
GRAZING_REFUSED = -1.0


@njit(cache=True, nogil=True)
def bearing_of(x: float, y: float) -> float:
    """atan2(y, x) to within 1e-5 rad, several times as fast; 0 for the origin."""
    ax, ay = abs(x), abs(y)
    high, low = max(ax, ay), min(ax, ay)
    if high == 0.0:
        return 0.0
    a = low / high
    s = a * a
    angle = a + a * s * (-0.332966 + s * (0.1951828 + s * (-0.1198186 + s * (0.0558058 - s * 0.0128082))))
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@njit(cache=True, nogil=True)
def bin_of(bearing: float, frame: Any) -> Any:
    """Bin of a bearing, whole turns taken off; may lie outside an open table."""
    turn = 2.0 * math.pi
    behind = bearing - frame[FIRST]
    middle = 0.5 * frame[BINS] * frame[WIDTH]
    behind -= turn * math.floor((behind - middle) / turn + 0.5)
    return math.floor(behind / frame[WIDTH])


@njit(cache=True, nogil=True)
def fill_table(
    bearing: Any, distance: Any, nearest_m: float, farthest_m: float, frame: Any, x: Any, y: Any, quality: Any
) -> int:
    """Beams (N,) into a view: of each bin the nearest surface, the mean of its beams. Returns the number of points.

    The mean of points of one straight surface lies on that surface, so nothing is biased by averaging.
    """
    bins = int(frame[BINS])
    front = np.full(bins, np.inf)
    share = np.zeros(bins, dtype=np.int64)
    for b in range(len(x)):
        x[b] = 0.0
        y[b] = 0.0
        quality[b] = EMPTY
    at = np.full(len(bearing), -1, dtype=np.int64)
    for i in range(len(bearing)):
        r = distance[i]
        if not (r >= nearest_m and r <= farthest_m) or not math.isfinite(bearing[i]):
            continue
        b = bin_of(bearing[i], frame)
        if frame[CLOSED] > 0.0:
            b %= bins
        if 0 <= b < bins:
            at[i] = b
            front[b] = min(front[b], r)
    sum_x, sum_y = np.zeros(bins), np.zeros(bins)
    for i in range(len(bearing)):
        b = at[i]
        if b >= 0 and distance[i] <= front[b] + 0.05 + 0.01 * front[b]:
            sum_x[b] += distance[i] * math.cos(bearing[i])
            sum_y[b] += distance[i] * math.sin(bearing[i])
            share[b] += 1
    count = 0
    for b in range(bins):
        if share[b] > 0:
            x[b] = sum_x[b] / share[b]
            y[b] = sum_y[b] / share[b]
            quality[b] = 0.0
            count += 1
    return count


@njit(cache=True, nogil=True)
def fill_depths(bearing: Any, distance: Any, frame: Any, nearest: Any, farthest: Any) -> None:
    """Nearest and farthest finite range of the beams (N,) in each bin (B,); inf and -inf where there is none."""
    bins = int(frame[BINS])
    for b in range(bins):
        nearest[b], farthest[b] = math.inf, -math.inf
    for i in range(len(bearing)):
        if not (math.isfinite(bearing[i]) and math.isfinite(distance[i])):
            continue
        b = bin_of(bearing[i], frame)
        if frame[CLOSED] > 0.0:
            b %= bins
        if 0 <= b < bins:
            nearest[b] = min(nearest[b], distance[i])
            farthest[b] = max(farthest[b], distance[i])


@njit(cache=True, nogil=True)
def count_changed(
    bearing: Any, distance: Any, sensor: Any, least_m: float, frame: Any, nearest: Any, farthest: Any,
    slack_m: float, slack_share: float,
) -> tuple[int, int]:  # fmt: skip
    """Beams (N,), each from its own pose sensor (N, 3) in the frame of the bins, held against the surfaces there.

    Returns how many could be judged, all three bins about their bearing having a surface, and how many of those end
    neither between the nearest and the farthest of these nor within the slack of them.
    """
    bins = int(frame[BINS])
    judged, changed = 0, 0
    for i in range(len(bearing)):
        r = distance[i]
        if not (r >= least_m) or not math.isfinite(bearing[i]):
            continue
        at = bearing[i] + sensor[i, 2]
        far = math.inf
        if r < math.inf:
            px, py = sensor[i, 0] + r * math.cos(at), sensor[i, 1] + r * math.sin(at)
            at, far = bearing_of(px, py), math.sqrt(px * px + py * py)
        middle = bin_of(at, frame)
        low, high, found = math.inf, -math.inf, 0
        for b in (middle - 1, middle, middle + 1):
            if frame[CLOSED] > 0.0:
                b %= bins
            elif b < 0 or b >= bins:
                continue
            if nearest[b] < math.inf:
                low, high, found = min(low, nearest[b]), max(high, farthest[b]), found + 1
        if found < 3:
            continue
        judged += 1
        slack = slack_m + slack_share * high
        if far < low - slack or far > high + slack:
            changed += 1
    return judged, changed


@njit(cache=True, nogil=True)
def surface_normals(x: Any, y: Any, frame: Any, nx: Any, ny: Any, quality: Any, roughness_m: float) -> int:
    """Normals of a view by principal components of each point's neighbours on the same surface; how many were found.

    Neighbours are walked to on both sides while each lies near the one before it, within reach of the point. A point
    whose neighbours are no line (second deviation above a third of the first) keeps quality 0.
    """
    bins = int(frame[BINS])
    closed = frame[CLOSED] > 0.0
    found = 0
    for i in range(len(x)):
        nx[i] = 0.0
        ny[i] = 0.0
    for i in range(bins):
        if quality[i] == EMPTY:
            continue
        px, py = np.float64(x[i]), np.float64(y[i])
        spacing = math.sqrt(px * px + py * py) * frame[WIDTH]
        gap = min(max(0.12, 3.0 * spacing), 0.8)
        reach = max(0.15, 2.5 * spacing)
        count, sx, sy, sxx, sxy, syy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
        for side in (-1, 1):
            last_x, last_y, k = px, py, i
            for _ in range(NEIGHBOURS):
                k += side
                if closed:
                    k = (k + bins) % bins
                elif k < 0 or k >= bins:
                    break
                if quality[k] == EMPTY:
                    continue
                dx, dy = x[k] - px, y[k] - py
                if (x[k] - last_x) ** 2 + (y[k] - last_y) ** 2 > gap * gap or dx * dx + dy * dy > reach * reach:
                    break
                last_x, last_y = np.float64(x[k]), np.float64(y[k])
                count += 1
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
        if count < 3:
            continue
        mx, my = sx / count, sy / count
        a, b, d = sxx / count - mx * mx, sxy / count - mx * my, syy / count - my * my
        along = 0.5 * math.atan2(2.0 * b, a - d)
        root = math.sqrt(0.25 * (a - d) ** 2 + b * b)
        large, small = 0.5 * (a + d) + root, max(0.5 * (a + d) - root, 0.0)
        if large <= 1e-9 or small > 0.12 * large:
            continue
        normal_x, normal_y = -math.sin(along), math.cos(along)
        if normal_x * px + normal_y * py > 0.0:
            normal_x, normal_y = -normal_x, -normal_y
        nx[i] = normal_x
        ny[i] = normal_y
        quality[i] = 1.0 / (1.0 + small / (roughness_m * roughness_m))
        found += 1
    return found


@njit(cache=True, nogil=True)
def grazing_normals(x: Any, y: Any, frame: Any, nx: Any, ny: Any, quality: Any) -> int:
    """Normals of points on walls that beams graze; how many were found. To be called after surface_normals.

    A beam every degree meets a corridor's wall, five metres ahead, only every half a metre and more: too far apart to
    be taken for one surface by their distance. That five bins in a row lie on one line, or four where a wall ends,
    tells as much.
    """
    bins = int(frame[BINS])
    normal = np.empty(2)
    found = 0
    for i in range(bins):
        if quality[i] != 0.0:
            continue
        for low, high in (
            (-GRAZING_BINS, GRAZING_BINS),
            (-GRAZING_BINS, GRAZING_BINS - 1),
            (1 - GRAZING_BINS, GRAZING_BINS),
        ):
            if line_through(i, low, high, x, y, frame, quality, normal):
                nx[i] = normal[0]
                ny[i] = normal[1]
                found += 1
                break
    for i in range(bins):
        if quality[i] == 0.0 and (nx[i] != 0.0 or ny[i] != 0.0):
            quality[i] = GRAZING_QUALITY
    return found


@njit(cache=True, nogil=True)
def line_through(i: int, low: int, high: int, x: Any, y: Any, frame: Any, quality: Any, normal: Any) -> bool:
    """Whether the points of bins i + low to i + high lie on one line that the beam of bin i grazes; normal (2,): its
    normal, towards the sensor."""
    bins = int(frame[BINS])
    count = high - low + 1
    px, py = np.float64(x[i]), np.float64(y[i])
    sx, sy, sxx, sxy, syy, last_x, last_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(low, high + 1):
        b = i + k
        if frame[CLOSED] > 0.0:
            b = (b + bins) % bins
        elif b < 0 or b >= bins:
            return False
        if quality[b] == EMPTY:
            return False
        dx, dy = x[b] - px, y[b] - py
        if k > low and (dx - last_x) ** 2 + (dy - last_y) ** 2 > GRAZING_GAP_M * GRAZING_GAP_M:
            return False
        last_x, last_y = dx, dy
        sx += dx
        sy += dy
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
    mx, my = sx / count, sy / count
    a, b2, d = sxx / count - mx * mx, sxy / count - mx * my, syy / count - my * my
    along = 0.5 * math.atan2(2.0 * b2, a - d)
    ux, uy = -math.sin(along), math.cos(along)
    away = ux * px + uy * py
    if abs(away) > GRAZING_SINE * math.sqrt(px * px + py * py):
        return False
    for k in range(low, high + 1):
        b = (i + k + bins) % bins
        if abs((x[b] - px - mx) * ux + (y[b] - py - my) * uy) > GRAZING_OFF_M:
            return False
    side = -1.0 if away > 0.0 else 1.0
    normal[0] = side * ux
    normal[1] = side * uy
    return True
