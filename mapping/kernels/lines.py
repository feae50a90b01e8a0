"""Compiled loops of line maps (S03 to S07, S10): from beams to lines in one call, and the pair test of fusion.

A line's row holds what the map needs to go on: ends, and the weighted moments of its supporting points, from which
angle, distance and their covariance follow in closed form.

    START_X START_Y END_X END_Y     free space is to the right of a walk from start to end
    WEIGHT CX CY SXX SXY SYY        sum of weights 1/sigma^2, centre of gravity, scatter about it
    COUNT                           supporting points
    SEEN                            scans they came from

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

START_X, START_Y, END_X, END_Y, WEIGHT, CX, CY, SXX, SXY, SYY, COUNT, SEEN = range(12)
ROW = 12

# Columns of a rule vector, made by LineRules.vector().
GAP_M, GAP_BEAMS, SPLIT_M, SPLIT_SIGMAS, FLAT_M, MERGE_CHI2, SMALLEST, MIN_POINTS, MIN_LENGTH_M = range(9)
SIGMA_M, SIGMA_PER_M, BEARING_SIGMA_RAD = range(9, 12)
RULES = 12

_TRIM_SIGMAS = 2.5
_TRIM_SHARE = 4  # at most a quarter of a run is trimmed from each end


# ----------------------------------------------------------------------------------------------------- S03 segmentation


@njit(cache=True, nogil=True)
def points_of_beams(
    cosine: Any, sine: Any, range_m: Any, near_m: float, far_m: float, x: Any, y: Any, beam: Any
) -> Any:
    """Points of the beams with near_m <= range <= far_m (and > 0); NaN and infinities fail. Returns how many."""
    n = 0
    for i in range(range_m.size):
        r = range_m[i]
        if r >= near_m and r > 0.0 and r <= far_m:
            x[n] = r * cosine[i]
            y[n] = r * sine[i]
            beam[n] = i
            n += 1
    return n


@njit(cache=True, nogil=True)
def are_near(x: Any, y: Any, i: int, j: int, gap_m: float, spacing: float) -> Any:
    """Whether two points belong together: closer than d = max(gap_m, spacing * the smaller range)."""
    dx, dy = x[i] - x[j], y[i] - y[j]
    d2 = dx * dx + dy * dy
    if d2 < gap_m * gap_m:
        return True
    if spacing <= 0.0:
        return False
    r2 = min(x[i] * x[i] + y[i] * y[i], x[j] * x[j] + y[j] * y[j])
    return d2 < spacing * spacing * r2


@njit(cache=True, nogil=True)
def seam(x: Any, y: Any, n: int, gap_m: float, spacing: float) -> Any:
    """Where to cut a full turn so that no cluster straddles the cut: (first point, True if there is no such place).

    Neither the two points at the cut nor any across one stray point belong together. A ring without such a place is
    cut at its farthest point, which is a corner, not the middle of a wall.
    """
    if n < 4:
        return 0, False
    farthest, far2 = 0, -1.0
    for k in range(n):
        a, b, after = (k - 1) % n, (k - 2) % n, (k + 1) % n
        if not (
            are_near(x, y, a, k, gap_m, spacing)
            or are_near(x, y, b, k, gap_m, spacing)
            or are_near(x, y, a, after, gap_m, spacing)
        ):
            return k, False
        r2 = x[k] * x[k] + y[k] * y[k]
        if r2 > far2:
            farthest, far2 = k, r2
    return farthest, True


@njit(cache=True, nogil=True)
def segment(x: Any, y: Any, n: int, gap_m: float, spacing: float, smallest: int, label: Any) -> Any:
    """Algorithm 5.1 with its erratum: label (n,) becomes the cluster of each point, -1 auxiliary. Returns how many.

    Where the book stops with two points to go and leaves the last one out, the last pair is compared like any other.
    """
    if n == 0:
        return 0
    i, m = 0, 0
    label[0] = 0
    while i < n - 1:
        if are_near(x, y, i, i + 1, gap_m, spacing):
            label[i + 1] = m
            i += 1
        elif i + 2 >= n:  # the last point stands alone
            m += 1
            label[i + 1] = m
            i += 1
        elif are_near(x, y, i, i + 2, gap_m, spacing):
            label[i + 1] = -1
            label[i + 2] = m
            i += 2  # erratum: the book goes on with the stray point
        elif are_near(x, y, i + 1, i + 2, gap_m, spacing):
            m += 1
            label[i + 1] = m
            label[i + 2] = m
            i += 2
        else:
            label[i + 1] = -1
            m += 1
            label[i + 2] = m
            i += 2  # erratum, as above
    return drop_small_clusters(label, n, m + 1, smallest)


@njit(cache=True, nogil=True)
def drop_small_clusters(label: Any, n: int, clusters: int, smallest: int) -> Any:
    """Clusters of at most `smallest` points become auxiliary; the others are numbered anew. Returns how many stay."""
    size = np.zeros(clusters, np.int64)
    for k in range(n):
        if label[k] >= 0:
            size[label[k]] += 1
    kept = 0
    for c in range(clusters):
        if size[c] > smallest:
            size[c] = kept
            kept += 1
        else:
            size[c] = -1
    for k in range(n):
        if label[k] >= 0:
            label[k] = size[label[k]]
    return kept


# ------------------------------------------------------------------------------------------------------------ S04 split


@njit(cache=True, nogil=True)
def farthest_from_chord(x: Any, y: Any, first: int, last: int) -> Any:
    """(index, distance) of the point farthest from the line through two points (eq. 5.3, by the direction's sine and
    cosine); of the two ends of a closed ring, which stand together, the distance is that from the first."""
    dx, dy = x[last] - x[first], y[last] - y[first]
    length2 = dx * dx + dy * dy
    at, most = first, 0.0
    if length2 > 0.0:
        for k in range(first + 1, last):
            h = abs((y[k] - y[first]) * dx - (x[k] - x[first]) * dy)
            if h > most:
                at, most = k, h
        most /= math.sqrt(length2)
    if most * most >= length2:  # a chord shorter than the bulge says nothing about a direction
        at, most = first, 0.0
        for k in range(first + 1, last):
            h = (y[k] - y[first]) ** 2 + (x[k] - x[first]) ** 2
            if h > most:
                at, most = k, h
        most = math.sqrt(most)
    return at, most


@njit(cache=True, nogil=True)
def split(
    x: Any, y: Any, first: int, last: int, rules: Any, run_first: Any, run_last: Any, runs: int, stack: Any
) -> Any:
    """Iterative end point fit of points first to last: appends runs that share their ends; returns the new number.

    About n log n; n^2 in the worst case (every point an end of its own), as the method is.
    """
    depth = 0
    stack[0] = last
    low = first
    while depth >= 0:
        high = stack[depth]
        at, h = farthest_from_chord(x, y, low, high)
        if h > tolerance(x[at], y[at], rules) and low < at < high:
            depth += 1
            stack[depth] = at
        else:
            run_first[runs] = low
            run_last[runs] = high
            runs += 1
            low = high
            depth -= 1
    return runs


@njit(cache=True, nogil=True)
def tolerance(x: float, y: float, rules: Any) -> Any:
    """How far off its line a point may be: the larger of the fixed limit and some sigmas of range noise."""
    sigma = rules[SIGMA_M] + rules[SIGMA_PER_M] * math.sqrt(x * x + y * y)
    return max(rules[SPLIT_M], rules[SPLIT_SIGMAS] * sigma)


# ------------------------------------------------------------------------------------------------------ S05 regression


@njit(cache=True, nogil=True)
def moments(x: Any, y: Any, first: int, end: int) -> Any:
    """(n, cx, cy, sxx, sxy, syy) of points first to end - 1, all of weight 1; centred twice, so exact far away."""
    n = end - first
    if n <= 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x0, y0 = x[first], y[first]
    sx = sy = sxx = sxy = syy = 0.0
    for k in range(first, end):
        u, v = x[k] - x0, y[k] - y0
        sx += u
        sy += v
        sxx += u * u
        sxy += u * v
        syy += v * v
    return float(n), x0 + sx / n, y0 + sy / n, sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n


@njit(cache=True, nogil=True)
def add_moments(w1: float, x1: float, y1: float, a1: float, b1: float, c1: float, w2: float, x2: float, y2: float,
                a2: float, b2: float, c2: float) -> Any:  # fmt: skip
    """Moments of two sets of points together."""
    w = w1 + w2
    if w <= 0.0:
        return w1, x1, y1, a1, b1, c1
    dx, dy = x2 - x1, y2 - y1
    f = w1 * w2 / w
    return w, x1 + dx * w2 / w, y1 + dy * w2 / w, a1 + a2 + f * dx * dx, b1 + b2 + f * dx * dy, c1 + c2 + f * dy * dy


@njit(cache=True, nogil=True)
def residual(sxx: float, sxy: float, syy: float) -> Any:
    """Sum of squared distances from the regression line: the smaller eigenvalue of the scatter, never below 0."""
    return max(0.0, 0.5 * (sxx + syy - math.sqrt((sxx - syy) ** 2 + 4.0 * sxy * sxy)))


@njit(cache=True, nogil=True)
def weighted_moments(x: Any, y: Any, first: int, last: int, nx: float, ny: float, rules: Any) -> Any:
    """Moments with weights 1/sigma^2, sigma the error of a point across a line whose normal is (nx, ny).

    Range noise acts along the beam, bearing noise across it: sigma^2 = (sr * cos)^2 + (r * sb * sin)^2, the angle that
    of the beam to the normal.
    """
    x0, y0 = x[first], y[first]
    w = sx = sy = sxx = sxy = syy = 0.0
    for k in range(first, last + 1):
        r2 = x[k] * x[k] + y[k] * y[k]
        r = math.sqrt(r2)
        toward = nx * x[k] + ny * y[k]
        c2 = min(1.0, toward * toward / r2) if r2 > 0.0 else 1.0
        sr = rules[SIGMA_M] + rules[SIGMA_PER_M] * r
        sb = r * rules[BEARING_SIGMA_RAD]
        wk = 1.0 / (sr * sr * c2 + sb * sb * (1.0 - c2) + rules[FLAT_M] * rules[FLAT_M])
        u, v = x[k] - x0, y[k] - y0
        w += wk
        sx += wk * u
        sy += wk * v
        sxx += wk * u * u
        sxy += wk * u * v
        syy += wk * v * v
    return w, x0 + sx / w, y0 + sy / w, sxx - sx * sx / w, sxy - sx * sy / w, syy - sy * sy / w


@njit(cache=True, nogil=True)
def merge_runs(x: Any, y: Any, run_first: Any, run_last: Any, begin: int, end: int, rules: Any, sums: Any) -> Any:
    """Join neighbouring runs of one cluster that noise has cut apart; returns the new end of the list.

    Two runs are one line if drawing one line instead of two costs no more than chance: the sum of squared distances
    grows by at most MERGE_CHI2 variances, plus what walls that are flat to FLAT_M may cost. The variance is the
    noise model's or the runs' own, whichever is larger.
    """
    top = begin
    for k in range(begin, end):
        run_first[top], run_last[top] = run_first[k], run_last[k]
        n, cx, cy, a, b, c = moments(x, y, run_first[k], run_last[k] + (1 if k == end - 1 else 0))
        sums[top, 0], sums[top, 1], sums[top, 2], sums[top, 3], sums[top, 4], sums[top, 5] = n, cx, cy, a, b, c
        top += 1
        while top - 2 >= begin and one_line(sums[top - 2], sums[top - 1], rules):
            p, q = sums[top - 2], sums[top - 1]
            n, cx, cy, a, b, c = add_moments(
                p[0], p[1], p[2], p[3], p[4], p[5], q[0], q[1], q[2], q[3], q[4], q[5]
            )  # fmt: skip
            p[0], p[1], p[2], p[3], p[4], p[5] = n, cx, cy, a, b, c
            run_last[top - 2] = run_last[top - 1]
            top -= 1
    return top


@njit(cache=True, nogil=True)
def one_line(p: Any, q: Any, rules: Any) -> Any:
    """The test of merge_runs, for moments of weight 1."""
    n, cx, cy, a, b, c = add_moments(p[0], p[1], p[2], p[3], p[4], p[5], q[0], q[1], q[2], q[3], q[4], q[5])
    apart = residual(p[3], p[4], p[5]) + residual(q[3], q[4], q[5])
    sigma = rules[SIGMA_M] + rules[SIGMA_PER_M] * math.sqrt(cx * cx + cy * cy)
    variance = max(sigma * sigma, apart / max(n - 4.0, 1.0))
    together = residual(a, b, c)
    limit = max(rules[SPLIT_M], rules[SPLIT_SIGMAS] * sigma)
    if together > n * limit * limit / 4.0:
        return False
    return together - apart <= rules[MERGE_CHI2] * variance + n * rules[FLAT_M] * rules[FLAT_M]


@njit(cache=True, nogil=True)
def settle_corners(x: Any, y: Any, run_first: Any, run_last: Any, begin: int, end: int) -> None:
    """Give the point that two runs of a cluster share to the one that it fits better, judged without it."""
    for k in range(begin, end - 1):
        corner = run_last[k]
        if corner - run_first[k] < 3 or run_last[k + 1] - corner < 3:
            continue
        before = off_line(x, y, run_first[k], corner - 1, corner)
        after = off_line(x, y, corner + 1, run_last[k + 1], corner)
        if before <= after:
            run_first[k + 1] = corner + 1
        else:
            run_last[k] = corner - 1


@njit(cache=True, nogil=True)
def off_line(x: Any, y: Any, first: int, last: int, point: int) -> Any:
    """Distance of a point from the regression line of points first to last."""
    _, cx, cy, a, b, c = moments(x, y, first, last + 1)
    gamma = 0.5 * math.atan2(2.0 * b, a - c)
    return abs((y[point] - cy) * math.cos(gamma) - (x[point] - cx) * math.sin(gamma))


@njit(cache=True, nogil=True)
def trim(x: Any, y: Any, first: int, last: int, rules: Any) -> Any:
    """Leave points at the ends out that are not on the line: (first, last), at most a quarter from each end."""
    n, cx, cy, a, b, c = moments(x, y, first, last + 1)
    gamma = 0.5 * math.atan2(2.0 * b, a - c)
    nx, ny = -math.sin(gamma), math.cos(gamma)
    sigma = rules[SIGMA_M] + rules[SIGMA_PER_M] * math.sqrt(cx * cx + cy * cy)
    limit = _TRIM_SIGMAS * math.sqrt(max(sigma * sigma, residual(a, b, c) / max(n - 2.0, 1.0)))
    most = (last - first + 1) // _TRIM_SHARE
    low, high = first, last
    while low - first < most and abs(nx * (x[low] - cx) + ny * (y[low] - cy)) > limit:
        low += 1
    while last - high < most and abs(nx * (x[high] - cx) + ny * (y[high] - cy)) > limit:
        high -= 1
    return low, high


@njit(cache=True, nogil=True)
def fit(x: Any, y: Any, first: int, last: int, rules: Any, row: Any) -> Any:
    """One run's line (S05, S06): trimmed, weighted regression, ends shifted onto it.

    False if it is too short, has too few points, or they scatter by more than the tolerance (rms).
    Points come counter-clockwise, so the line goes from the last to the first (S08).
    """
    first, last = trim(x, y, first, last, rules)
    if last - first + 1 < rules[MIN_POINTS]:
        return False
    n, cx, cy, a, b, c = moments(x, y, first, last + 1)
    gamma = 0.5 * math.atan2(2.0 * b, a - c)
    w, cx, cy, a, b, c = weighted_moments(x, y, first, last, -math.sin(gamma), math.cos(gamma), rules)
    if residual(a, b, c) > w * tolerance(cx, cy, rules) ** 2:
        return False  # a heap of points, not a wall
    gamma = 0.5 * math.atan2(2.0 * b, a - c)
    ux, uy = math.cos(gamma), math.sin(gamma)
    start = ux * (x[last] - cx) + uy * (y[last] - cy)
    end = ux * (x[first] - cx) + uy * (y[first] - cy)
    if abs(end - start) < rules[MIN_LENGTH_M]:
        return False
    row[START_X], row[START_Y] = cx + start * ux, cy + start * uy
    row[END_X], row[END_Y] = cx + end * ux, cy + end * uy
    row[WEIGHT], row[CX], row[CY], row[SXX], row[SXY], row[SYY] = w, cx, cy, a, b, c
    row[COUNT], row[SEEN] = n, 1.0
    return True


# --------------------------------------------------------------------------------------------------------- in one call


@njit(cache=True, nogil=True)
def lines_of_points(x: Any, y: Any, beam: Any, n: int, full_turn: bool, spacing: float, rules: Any, rows: Any,
                    beams: Any) -> Any:  # fmt: skip
    """Lines of n points in counter-clockwise order, sensor at the origin; returns how many rows were filled.

    spacing: GAP_BEAMS times the angle between beams.  beams: (K, 2) beam of the first and the last supporting point.
    """
    if n < 2:
        return 0
    if full_turn:
        cut, _ring = seam(x, y, n, rules[GAP_M], spacing)
        x, y, beam = turned(x, n, cut), turned(y, n, cut), turned(beam, n, cut)
    label = np.empty(n, np.int64)
    clusters = segment(x, y, n, rules[GAP_M], spacing, int(rules[SMALLEST]), label)
    px, py, pb = np.empty(n), np.empty(n), np.empty(n, np.int64)
    run_first, run_last, stack = np.empty(n + 1, np.int64), np.empty(n + 1, np.int64), np.empty(n + 1, np.int64)
    sums = np.empty((n + 1, 6))
    runs, filled, k = 0, 0, 0
    for c in range(clusters):
        first = filled
        while k < n and label[k] <= c:
            if label[k] == c:
                px[filled], py[filled], pb[filled] = x[k], y[k], beam[k]
                filled += 1
            k += 1
        begin = runs
        runs = split(px, py, first, filled - 1, rules, run_first, run_last, runs, stack)
        runs = merge_runs(px, py, run_first, run_last, begin, runs, rules, sums)
        settle_corners(px, py, run_first, run_last, begin, runs)
    count = 0
    for j in range(runs):
        if count < rows.shape[0] and fit(px, py, run_first[j], run_last[j], rules, rows[count]):
            beams[count, 0], beams[count, 1] = pb[run_first[j]], pb[run_last[j]]
            count += 1
    return count


@njit(cache=True, nogil=True)
def turned(values: Any, n: int, first: int) -> Any:
    """The first n values, begun at another place."""
    out = np.empty_like(values[:n])
    out[: n - first] = values[first:n]
    out[n - first :] = values[:first]
    return out


@njit(cache=True, nogil=True)
def lines_of_beams(cosine: Any, sine: Any, range_m: Any, near_m: float, far_m: float, full_turn: bool, spacing: float,
                   rules: Any, rows: Any, beams: Any) -> Any:  # fmt: skip
    """From ranges to lines; see lines_of_points."""
    n = range_m.size
    x, y, beam = np.empty(n), np.empty(n), np.empty(n, np.int64)
    n = points_of_beams(cosine, sine, range_m, near_m, far_m, x, y, beam)
    return lines_of_points(x, y, beam, n, full_turn, spacing, rules, rows, beams)


# ---------------------------------------------------------------------------------------------------------- S07 fusion


@njit(cache=True, nogil=True)
def overlap(row: Any, other: Any, angle_cos: float, offset_m: float, gap_m: float) -> Any:
    """By how many metres two lines overlap along the longer one (negative: the gap); -inf if they are not one line.

    They are one line if they run in the same direction, every end of the shorter is within offset_m of the longer, the
    gap is below gap_m, and all four ends are within offset_m of the line that the points of both make.
    """
    nothing = -np.inf
    dx, dy = row[END_X] - row[START_X], row[END_Y] - row[START_Y]
    ex, ey = other[END_X] - other[START_X], other[END_Y] - other[START_Y]
    d2, e2 = dx * dx + dy * dy, ex * ex + ey * ey
    if d2 < e2:
        row, other = other, row
        dx, dy, ex, ey, d2, e2 = ex, ey, dx, dy, e2, d2
    if e2 == 0.0 or dx * ex + dy * ey < angle_cos * math.sqrt(d2 * e2):
        return nothing
    length = math.sqrt(d2)
    ux, uy = dx / length, dy / length
    sx, sy = other[START_X] - row[START_X], other[START_Y] - row[START_Y]
    tx, ty = other[END_X] - row[START_X], other[END_Y] - row[START_Y]
    if abs(ux * sy - uy * sx) > offset_m or abs(ux * ty - uy * tx) > offset_m:
        return nothing
    common = min(length, ux * tx + uy * ty) - max(0.0, ux * sx + uy * sy)
    if common <= -gap_m:
        return nothing
    _, cx, cy, a, b, c = joint_moments(row, other)
    gamma = 0.5 * math.atan2(2.0 * b, a - c)
    nx, ny = -math.sin(gamma), math.cos(gamma)
    for line in (row, other):
        for k in (START_X, END_X):
            if abs(nx * (line[k] - cx) + ny * (line[k + 1] - cy)) > offset_m:
                return nothing
    return common


@njit(cache=True, nogil=True)
def joint_moments(p: Any, q: Any) -> Any:
    """Moments of the points of two rows together."""
    return add_moments(
        p[WEIGHT], p[CX], p[CY], p[SXX], p[SXY], p[SYY], q[WEIGHT], q[CX], q[CY], q[SXX], q[SXY], q[SYY]
    )  # fmt: skip


@njit(cache=True, nogil=True)
def fuse_rows(row: Any, other: Any, out: Any) -> None:
    """The line of the points of both rows, as long as both together, in row's direction. out may be one of them."""
    w, cx, cy, a, b, c = joint_moments(row, other)
    gamma = 0.5 * math.atan2(2.0 * b, a - c)
    ux, uy = math.cos(gamma), math.sin(gamma)
    if ux * (row[END_X] - row[START_X]) + uy * (row[END_Y] - row[START_Y]) < 0.0:
        ux, uy = -ux, -uy
    low, high = np.inf, -np.inf
    for line in (row, other):
        for k in (START_X, END_X):
            t = ux * (line[k] - cx) + uy * (line[k + 1] - cy)
            low, high = min(low, t), max(high, t)
    count, seen = row[COUNT] + other[COUNT], row[SEEN] + other[SEEN]
    out[START_X], out[START_Y], out[END_X], out[END_Y] = cx + low * ux, cy + low * uy, cx + high * ux, cy + high * uy
    out[WEIGHT], out[CX], out[CY], out[SXX], out[SXY], out[SYY] = w, cx, cy, a, b, c
    out[COUNT], out[SEEN] = count, seen


@njit(cache=True, nogil=True)
def best_partner(row: Any, table: Any, candidates: Any, angle_cos: float, offset_m: float, gap_m: float) -> Any:
    """The candidate that overlaps a row most, -1 if none is the same line; of equals the first."""
    best, most = -1, -np.inf
    for k in range(candidates.size):
        common = overlap(row, table[candidates[k]], angle_cos, offset_m, gap_m)
        if common > most:
            best, most = candidates[k], common
    return best


# --------------------------------------------------------------------------------------------------------- S10 queries


@njit(cache=True, nogil=True)
def cast_rays(
    ends: Any, ox: float, oy: float, cosine: Any, sine: Any, reach_m: float, distance_m: Any, hit: Any
) -> None:
    """Distance to and index of the first line on each ray, +inf and -1 where there is none within reach_m.

    ends: (K, 4) start and end.  Every ray against every line: what is not near is left out by the caller.
    """
    for r in range(cosine.size):
        dx, dy = cosine[r], sine[r]
        nearest, at = np.inf, -1
        for k in range(ends.shape[0]):
            ax, ay = ends[k, 0] - ox, ends[k, 1] - oy
            bx, by = ends[k, 2] - ox, ends[k, 3] - oy
            side_a, side_b = dx * ay - dy * ax, dx * by - dy * bx
            if (side_a > 0.0 and side_b > 0.0) or (side_a < 0.0 and side_b < 0.0) or side_a == side_b:
                continue
            t = side_a / (side_a - side_b)
            along = dx * (ax + t * (bx - ax)) + dy * (ay + t * (by - ay))
            if 0.0 <= along < nearest and along <= reach_m:
                nearest, at = along, k
        distance_m[r] = nearest
        hit[r] = at
