"""Compiled loops of plane extraction (S12): cells, RANSAC and PCA in them, growing, labels, outlines.

Points are sorted once along a Morton curve, so that a cell of any size is a run of neighbours: `key[k]` interleaves the
bits of a point's indices on the finest lattice, and a cell of depth d owns the points whose keys agree above the lowest
3 (deepest - d) bits. A cell's row holds what growing needs:

    WEIGHT CX CY CZ XX XY XZ YY YZ ZZ   weighted moments of its inliers: sum, centre of gravity, scatter about it
    NX NY NZ D                          its plane <n, p> = D
    COUNT                               inliers
    SIGMA                               range noise at its centre
    DOUBT                               standard deviation of the normal's direction, rad

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

WEIGHT, CX, CY, CZ, XX, XY, XZ, YY, YZ, ZZ, NX, NY, NZ, D, COUNT, SIGMA, DOUBT = range(17)
ROW = 17
BITS = 20  # of an index on the finest lattice: 3 of them fit a key, with room for a mark

# Columns of a rule vector, made by PlaneRules.vector().
MIN_POINTS, ITERATIONS, INLIER_M, INLIER_SIGMAS, COSINE, APART_M, SHARE, REFINE, SEED = range(9)
SIGMA_M, SIGMA_PER_M2, FLAT_M, WARP, STEP_PER_M2, CELL_M = range(9, 15)
RULES = 15

_MISS = 0.001  # chance of stopping before a plane that is there was hit
_STEPS_A_CELL = 6.0
_JOIN_SLOPES = 5.0  # parts of one plane differ in direction by at most so many times what it may warp
_WAVE = 0.06  # a surface's scatter about its plane, against that along its shorter side: 0.06 is a kink of 14 degrees
_ROUGHER = 3.0  # and against that of its parts about theirs: a step scatters more, a wave does not
_FOREIGN = 0.5  # tolerances: the start of a cell's own plane
_NEAR = 64  # planes that a point may belong to
_OVER = 0.05  # share of a plane's points that lie beyond another at which it ends
_SIDE_LEAST = 10  # points, to say that it ends
_WORST_DOUBT = 0.13  # rad: half of what normals of neighbours may differ by


# ----------------------------------------------------------------------------------------------------- sorting in cells


@njit(cache=True, nogil=True)
def spread(v: int) -> Any:
    """The bits of an index (0 <= v < 2^20), two zeros between."""
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


@njit(cache=True, nogil=True)
def squeeze(v: int) -> Any:
    """The index that `spread` spread."""
    v = v & 0x1249249249249249
    v = (v | (v >> 2)) & 0x10C30C30C30C30C3
    v = (v | (v >> 4)) & 0x100F00F00F00F00F
    v = (v | (v >> 8)) & 0x1F0000FF0000FF
    v = (v | (v >> 16)) & 0x1F00000000FFFF
    return (v | (v >> 32)) & 0x1FFFFF


@njit(cache=True, nogil=True)
def morton_keys(points: Any, corner: Any, size_m: float, first: int, last: int, key: Any) -> None:
    """Keys (N,) of points (N, 3), from first to last - 1, on a lattice of cells of size_m with its first corner."""
    top = (1 << BITS) - 1
    for k in range(np.uint64(first), np.uint64(last)):
        i = min(max(math.floor((points[k, 0] - corner[0]) / size_m), 0), top)
        j = min(max(math.floor((points[k, 1] - corner[1]) / size_m), 0), top)
        h = min(max(math.floor((points[k, 2] - corner[2]) / size_m), 0), top)
        key[k] = spread(i) | (spread(j) << 1) | (spread(h) << 2)


@njit(cache=True, nogil=True)
def sort_by_key(key: Any) -> Any:
    """(order, sorted keys): stable radix sort of keys >= 0, eleven bits a pass.

    Key and place go in one number where both fit, which halves what is moved.
    """
    n = key.size
    most = 0
    for k in range(n):
        most = max(most, key[k])
    places = 0
    while (n >> places) > 0:
        places += 1
    together = (most >> (62 - places)) == 0
    order = np.arange(0 if together else n)
    now, after = key.copy(), np.empty(n, np.int64)
    other = np.empty(order.size, np.int64)
    shift, stop = 0, 0
    while (most >> stop) > 0:
        stop += 1
    if together:
        for k in range(n):
            now[k] = (key[k] << places) | k
        shift, stop = places, stop + places
    start = np.empty(2048, np.int64)
    while shift < stop:
        start[:] = 0
        for k in range(n):
            start[(now[k] >> shift) & 2047] += 1
        at = 0
        for b in range(2048):
            count = start[b]
            start[b] = at
            at += count
        for k in range(n):
            b = (now[k] >> shift) & 2047
            at = start[b]
            start[b] = at + 1
            after[at] = now[k]
            if not together:
                other[at] = order[k]
        now, after = after, now
        order, other = other, order
        shift += 11
    if together:
        order = after
        for k in range(n):
            order[k] = now[k] & ((1 << places) - 1)
            now[k] >>= places
    return order, now


@njit(cache=True, nogil=True)
def usable(points: Any, farthest_m: float, low: Any, high: Any) -> Any:
    """(N,) whether a point is finite and not beyond; low, high (3,): least and greatest coordinates of those."""
    n = points.shape[0]
    good = np.empty(n, np.bool_)
    limit = farthest_m * farthest_m
    x0, y0, z0 = math.inf, math.inf, math.inf
    x1, y1, z1 = -math.inf, -math.inf, -math.inf
    for k in range(n):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        good[k] = x * x + y * y + z * z <= limit  # NaN fails
        if good[k]:
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    low[0], low[1], low[2] = x0, y0, z0
    high[0], high[1], high[2] = x1, y1, z1
    return good


@njit(cache=True, nogil=True)
def gather(points: Any, order: Any, first: int, last: int, x: Any, y: Any, z: Any) -> None:
    """Columns in sorted order, from first to last - 1."""
    for k in range(np.uint64(first), np.uint64(last)):
        i = np.uint64(order[k])
        x[k], y[k], z[k] = points[i, 0], points[i, 1], points[i, 2]


@njit(cache=True, nogil=True)
def weigh(x: Any, y: Any, z: Any, rules: Any, weight: Any) -> None:
    """Weights 1/sigma^2 by range from the sensor, which is the origin."""
    for k in range(x.size):
        sigma = noise(x[k] * x[k] + y[k] * y[k] + z[k] * z[k], rules)
        weight[k] = 1.0 / (sigma * sigma)


@njit(cache=True, nogil=True)
def noise(range2: float, rules: Any) -> Any:
    """Standard deviation of a range, by its square."""
    return rules[SIGMA_M] + rules[SIGMA_PER_M2] * range2


@njit(cache=True, nogil=True)
def runs_of(key: Any, shift: int) -> Any:
    """(C + 1,) where runs of keys that agree above `shift` bits begin, and the end."""
    n = key.size
    count = 0
    for k in range(n):
        if k == 0 or (key[k] >> shift) != (key[k - 1] >> shift):
            count += 1
    start = np.empty(count + 1, np.int64)
    count = 0
    for k in range(n):
        if k == 0 or (key[k] >> shift) != (key[k - 1] >> shift):
            start[count] = k
            count += 1
    start[count] = n
    return start


@njit(cache=True, nogil=True)
def run_end(key: Any, begin: int, end: int, shift: int) -> Any:
    """Where the run of keys that agree with that of `begin` above `shift` bits ends, at most `end`."""
    wanted = key[begin] >> shift
    low, high = begin + 1, end
    while low < high:
        middle = (low + high) // 2
        if (key[middle] >> shift) == wanted:
            low = middle + 1
        else:
            high = middle
    return low


# ----------------------------------------------------------------------------------------------------------- PCA


@njit(cache=True, nogil=True)
def add_scatter(a: Any, b: Any, out: Any) -> None:
    """Moments (first ten columns) of two sets of points together; out may be a."""
    wa, wb = a[WEIGHT], b[WEIGHT]
    w = wa + wb
    if w <= 0.0:
        return
    dx, dy, dz = b[CX] - a[CX], b[CY] - a[CY], b[CZ] - a[CZ]
    f, g = wa * wb / w, wb / w
    out[XX], out[XY], out[XZ] = a[XX] + b[XX] + f * dx * dx, a[XY] + b[XY] + f * dx * dy, a[XZ] + b[XZ] + f * dx * dz
    out[YY], out[YZ], out[ZZ] = a[YY] + b[YY] + f * dy * dy, a[YZ] + b[YZ] + f * dy * dz, a[ZZ] + b[ZZ] + f * dz * dz
    out[CX], out[CY], out[CZ] = a[CX] + g * dx, a[CY] + g * dy, a[CZ] + g * dz
    out[WEIGHT] = w


@njit(cache=True, nogil=True)
def scatter_of(
    x: Any, y: Any, z: Any, weight: Any, begin: int, end: int, nx: float, ny: float, nz: float, d: float,
    limit: float, row: Any,
) -> Any:  # fmt: skip
    """Weighted moments of the points within limit of a plane, into row; returns how many. Centred: exact far away."""
    x0, y0, z0 = x[begin], y[begin], z[begin]
    n = 0
    w = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for k in range(np.uint64(begin), np.uint64(end)):
        if abs(nx * x[k] + ny * y[k] + nz * z[k] - d) <= limit:
            u, v, t, m = x[k] - x0, y[k] - y0, z[k] - z0, weight[k]
            n += 1
            w += m
            sx += m * u
            sy += m * v
            sz += m * t
            xx += m * u * u
            xy += m * u * v
            xz += m * u * t
            yy += m * v * v
            yz += m * v * t
            zz += m * t * t
    row[WEIGHT], row[COUNT] = w, n
    if n > 0:
        row[CX], row[CY], row[CZ] = x0 + sx / w, y0 + sy / w, z0 + sz / w
        row[XX], row[XY], row[XZ] = xx - sx * sx / w, xy - sx * sy / w, xz - sx * sz / w
        row[YY], row[YZ], row[ZZ] = yy - sy * sy / w, yz - sy * sz / w, zz - sz * sz / w
    return n


@njit(cache=True, nogil=True)
def fit_plane(row: Any) -> Any:
    """Plane of a row's moments (eq. 5.23) into the row: the eigenvector of the smallest eigenvalue, by Jacobi turns.

    The normal's largest component is positive.  Returns the eigenvalues (smallest, middle, largest), never below 0.
    """
    a, b, c = row[XX], row[YY], row[ZZ]
    p, q, r = row[XY], row[XZ], row[YZ]
    ax, bx, cx = 1.0, 0.0, 0.0  # the directions of a, b and c: scalars, since a small array here costs as much as
    ay, by, cy = 0.0, 1.0, 0.0  # the turns
    az, bz, cz = 0.0, 0.0, 1.0
    for _ in range(12):
        off = abs(p) + abs(q) + abs(r)
        if off <= 1e-15 * (abs(a) + abs(b) + abs(c)):
            break
        if p != 0.0:  # turn x and y
            t, cs, sn = _turn(a, b, p)
            a, b, p, q, r = a - t * p, b + t * p, 0.0, cs * q - sn * r, sn * q + cs * r
            ax, bx = cs * ax - sn * bx, sn * ax + cs * bx
            ay, by = cs * ay - sn * by, sn * ay + cs * by
            az, bz = cs * az - sn * bz, sn * az + cs * bz
        if q != 0.0:  # x and z
            t, cs, sn = _turn(a, c, q)
            a, c, q, p, r = a - t * q, c + t * q, 0.0, cs * p - sn * r, sn * p + cs * r
            ax, cx = cs * ax - sn * cx, sn * ax + cs * cx
            ay, cy = cs * ay - sn * cy, sn * ay + cs * cy
            az, cz = cs * az - sn * cz, sn * az + cs * cz
        if r != 0.0:  # y and z
            t, cs, sn = _turn(b, c, r)
            b, c, r, p, q = b - t * r, c + t * r, 0.0, cs * p - sn * q, sn * p + cs * q
            bx, cx = cs * bx - sn * cx, sn * bx + cs * cx
            by, cy = cs * by - sn * cy, sn * by + cs * cy
            bz, cz = cs * bz - sn * cz, sn * bz + cs * cz
    least, nx, ny, nz = a, ax, ay, az
    if b < least:
        least, nx, ny, nz = b, bx, by, bz
    if c < least:
        least, nx, ny, nz = c, cx, cy, cz
    most = max(a, b, c)
    middle = a + b + c - least - most
    largest = nx
    if abs(ny) > abs(largest):
        largest = ny
    if abs(nz) > abs(largest):
        largest = nz
    if largest < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    row[NX], row[NY], row[NZ] = nx, ny, nz
    row[D] = nx * row[CX] + ny * row[CY] + nz * row[CZ]
    return max(least, 0.0), max(middle, 0.0), max(most, 0.0)


@njit(cache=True, nogil=True)
def _turn(a: float, b: float, p: float) -> Any:
    """(tangent, cosine, sine) of the turn that makes the off-diagonal p of [[a, p], [p, b]] zero."""
    theta = (b - a) / (2.0 * p)
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    if theta < 0.0:
        t = -t
    c = 1.0 / math.sqrt(t * t + 1.0)
    return t, c, t * c


# ---------------------------------------------------------------------------------------------------------- RANSAC


@njit(cache=True, nogil=True)
def seeded(key: int, seed: int) -> Any:
    """A generator's first state for a cell: by its place and the seed, whoever works on it and when."""
    v = (key ^ (key >> 31) ^ seed) & 0x7FFFFFFF
    return (v * 2654435761 + 12345) & 0xFFFFFFFF


@njit(cache=True, nogil=True)
def ransac(x: Any, y: Any, z: Any, begin: int, end: int, limit: float, iterations: int, state: int) -> Any:
    """(inliers, nx, ny, nz, d) of the best of planes through three points each; 0 inliers if all were collinear.

    Stops when a plane with more inliers than the best would have been hit with probability 1 - _MISS: the book's
    iterations are the most that are tried.
    """
    n = end - begin
    best, bx, by, bz, bd = 0, 0.0, 0.0, 0.0, 0.0
    needed = iterations
    done = 0
    while done < needed:
        done += 1
        state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
        i = begin + (((state >> 8) * n) >> 24)
        state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
        j = begin + (((state >> 8) * n) >> 24)
        state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
        k = begin + (((state >> 8) * n) >> 24)
        ax, ay, az = x[j] - x[i], y[j] - y[i], z[j] - z[i]
        cx, cy, cz = x[k] - x[i], y[k] - y[i], z[k] - z[i]
        nx, ny, nz = ay * cz - az * cy, az * cx - ax * cz, ax * cy - ay * cx
        area2 = nx * nx + ny * ny + nz * nz
        longest2 = max(ax * ax + ay * ay + az * az, cx * cx + cy * cy + cz * cz)
        if area2 <= 1e-4 * longest2 * longest2 or area2 < 1e-200:  # equal or collinear
            continue
        f = 1.0 / math.sqrt(area2)
        nx, ny, nz = nx * f, ny * f, nz * f
        d = nx * x[i] + ny * y[i] + nz * z[i]
        count = inliers_of(x, y, z, begin, end, nx, ny, nz, d, limit)
        if count > best:
            best, bx, by, bz, bd = count, nx, ny, nz, d
            share = count / n
            hit = share * share * share
            if hit >= 1.0:
                break
            needed = min(needed, done + int(math.log(_MISS) / math.log(1.0 - hit)))
    return best, bx, by, bz, bd


@njit(cache=True, nogil=True)
def inliers_of(
    x: Any, y: Any, z: Any, begin: int, end: int, nx: float, ny: float, nz: float, d: float, limit: float
) -> Any:
    """How many points are within limit of a plane: a loop without branches, which the compiler makes wide if it knows
    that no index counts from the end."""
    count = 0
    for k in range(np.uint64(begin), np.uint64(end)):
        count += abs(nx * x[k] + ny * y[k] + nz * z[k] - d) <= limit
    return count


@njit(cache=True, nogil=True)
def fit_cell(x: Any, y: Any, z: Any, weight: Any, begin: int, end: int, state: int, rules: Any, row: Any) -> Any:
    """The plane of one cell into row (step 3: RANSAC, then PCA on its inliers); returns the share of inliers, 0 if
    there is no plane: too few inliers, or its direction is in doubt."""
    n = end - begin
    limit = rules[INLIER_M]
    least = rules[MIN_POINTS]
    if rules[REFINE] > 0.0:
        middle = (begin + end) // 2
        sigma = noise(x[middle] * x[middle] + y[middle] * y[middle] + z[middle] * z[middle], rules)
        limit = min(limit, rules[INLIER_SIGMAS] * sigma + rules[FLAT_M])
        scatter_of(x, y, z, weight, begin, end, 0.0, 0.0, 0.0, 0.0, 1.0, row)  # most cells hold one plane: try it
        fit_plane(row)
        count = inliers_of(x, y, z, begin, end, row[NX], row[NY], row[NZ], row[D], limit)
        if count < 0.95 * n:
            count, nx, ny, nz, d = ransac(x, y, z, begin, end, limit, int(rules[ITERATIONS]), state)
            row[NX], row[NY], row[NZ], row[D] = nx, ny, nz, d
    else:
        count, nx, ny, nz, d = ransac(x, y, z, begin, end, limit, int(rules[ITERATIONS]), state)
        row[NX], row[NY], row[NZ], row[D] = nx, ny, nz, d
    if count < least or count < 3:
        row[COUNT] = 0.0
        return 0.0
    count = scatter_of(x, y, z, weight, begin, end, row[NX], row[NY], row[NZ], row[D], limit, row)
    small, middle_value, _ = fit_plane(row)
    range2 = row[CX] * row[CX] + row[CY] * row[CY] + row[CZ] * row[CZ]
    row[SIGMA] = noise(range2, rules)
    variance = max(small, row[WEIGHT] * row[SIGMA] ** 2 if rules[REFINE] > 0.0 else 0.0)
    row[DOUBT] = math.sqrt(variance / (count * middle_value)) if middle_value > 0.0 else math.inf
    if middle_value <= 0.0 or (rules[REFINE] > 0.0 and row[DOUBT] > _WORST_DOUBT):
        row[COUNT] = 0.0
        return 0.0
    return count / n


@njit(cache=True, nogil=True)
def fit_cells(
    x: Any, y: Any, z: Any, weight: Any, key: Any, start: Any, first: int, last: int, depth: int, book_depth: int,
    deepest: int, rules: Any, row: Any, begin: Any, end: Any, level: Any,
) -> Any:  # fmt: skip
    """Planes of the cells under runs first to last - 1 of `start`, which are those of `depth`; returns how many cells.

    A cell that is larger than the book's (depth < book_depth) is cut into eight while that leaves each part points
    enough; one of the book's size or less while one plane does not explain it (rules SHARE). Cells come in the order
    of their points and cover all of them; those without a plane have COUNT 0.
    """
    cells = 0
    least = rules[MIN_POINTS]
    room = 8 * (BITS + 2)
    stack_begin, stack_end, stack_level = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    for run in range(first, last):
        stack_begin[0], stack_end[0], stack_level[0] = start[run], start[run + 1], depth
        top = 1
        while top > 0:
            top -= 1
            b, e, here = stack_begin[top], stack_end[top], stack_level[top]
            n = e - b
            cut = here < book_depth and n >= 8.0 * least
            row[cells, COUNT] = 0.0
            if not cut and n >= least:
                state = seeded(key[b] >> (3 * (deepest - here)), int(rules[SEED]))
                share = fit_cell(x, y, z, weight, b, e, state, rules, row[cells])
                cut = share < rules[SHARE] and here < deepest and n >= 2.0 * least
                if cut and rules[STEP_PER_M2] > 0.0:  # a part as small as a step of depth would look across the steps
                    size = rules[CELL_M] * 2.0 ** (book_depth - here - 1)
                    range2 = x[b] * x[b] + y[b] * y[b] + z[b] * z[b]
                    cut = size >= _STEPS_A_CELL * rules[STEP_PER_M2] * range2
            if not cut:
                begin[cells], end[cells], level[cells] = b, e, here
                cells += 1
                continue
            shift = 3 * (deepest - here - 1)
            at, parts = b, 0
            while at < e:  # the last part goes to the bottom of the stack's new part, so that they come out in order
                stop = run_end(key, at, e, shift)
                stack_begin[top + parts], stack_end[top + parts], stack_level[top + parts] = at, stop, here + 1
                parts += 1
                at = stop
            for k in range(parts // 2):
                i, j = top + k, top + parts - 1 - k
                stack_begin[i], stack_begin[j] = stack_begin[j], stack_begin[i]
                stack_end[i], stack_end[j] = stack_end[j], stack_end[i]
            top += parts
    return cells


@njit(cache=True, nogil=True)
def local_noise(
    x: Any, y: Any, z: Any, ones: Any, key: Any, deepest: int, smallest: int, most: int, least: int, samples: int,
    range_m: Any, sigma: Any,
) -> Any:  # fmt: skip
    """Scatter of points about the planes of small cells, and the cells' range; returns how many were looked at.

    Small: the first on the way down that holds at most `most` points, or is of depth `smallest`; those with less than
    `least` say nothing.  sigma is corrected for the three numbers that a plane takes.  ones: (N,), weights.
    """
    n = key.size
    stride = max(1, n // max(samples, 1))
    row = np.zeros(ROW)
    found, at = 0, 0
    while at < n and found < range_m.size:
        depth, begin = 0, first_of_run(key, at, 0, 3 * deepest)
        stop = run_end(key, at, n, 3 * deepest)
        while stop - begin > most and depth < smallest:
            depth += 1
            shift = 3 * (deepest - depth)
            begin = first_of_run(key, at, begin, shift)
            stop = run_end(key, at, stop, shift)
        if stop - begin >= least:
            count = scatter_of(x, y, z, ones, begin, stop, 0.0, 0.0, 0.0, 0.0, 1.0, row)
            small, middle, _ = fit_plane(row)
            if middle > 4.0 * small:
                range_m[found] = math.sqrt(row[CX] ** 2 + row[CY] ** 2 + row[CZ] ** 2)
                sigma[found] = math.sqrt(small / (count - 3.0))
                found += 1
        at = max(stop, at + stride)
    return found


@njit(cache=True, nogil=True)
def first_of_run(key: Any, at: int, low: int, shift: int) -> Any:
    """The first index from low on whose key agrees with that of `at` above `shift` bits."""
    wanted = key[at] >> shift
    high = at
    while low < high:
        middle = (low + high) // 2
        if (key[middle] >> shift) == wanted:
            high = middle
        else:
            low = middle + 1
    return low


# ---------------------------------------------------------------------------------------------------------- neighbours


@njit(cache=True, nogil=True)
def names_of_cells(key: Any, begin: Any, level: Any, deepest: int) -> Any:
    """(mark, index): a table in which cells are found by their names (see put, get)."""
    cells = begin.size
    size = 16
    while size < 3 * cells:
        size *= 2
    mark, index = np.full(size, -1, np.int64), np.empty(size, np.int64)
    for c in range(cells):
        put(mark, index, tagged(key[begin[c]], level[c], deepest), c)
    return mark, index


@njit(cache=True, nogil=True)
def pairs_of_cells(
    mark: Any, index: Any, key: Any, begin: Any, level: Any, deepest: int, from_cell: int, to_cell: int, pair: Any
) -> Any:
    """Cells that touch, corners included: (c, other) for c from from_cell to to_cell - 1 into pair; returns how many.

    Each pair is told once: by the smaller cell, of equal ones by the first.
    """
    pairs = 0
    place = np.empty((3, 3), np.int64)
    parent, owner = np.empty(27, np.int64), np.empty(27, np.int64)  # larger neighbours are met several times
    for c in range(from_cell, to_cell):
        own = key[begin[c]] >> (3 * (deepest - level[c]))
        top = 1 << (BITS - (deepest - level[c]))
        for axis in range(3):  # the three places along each axis, -1 outside the lattice
            middle = squeeze(own >> axis)
            for step in range(3):
                at = middle + step - 1
                place[axis, step] = spread(at) << axis if 0 <= at < top else -1
        before = pairs
        parents = 0
        for step in range(27):
            a, b, d = place[0, step // 9], place[1, step // 3 % 3], place[2, step % 3]
            if step == 13 or a < 0 or b < 0 or d < 0:
                continue
            there = a | b | d
            other = get(mark, index, (1 << (3 * (BITS - deepest + level[c]))) | there)
            there >>= 3
            if other < 0 and there != own >> 3:  # no cell that is as large; what holds c was cut, and is none itself
                k = 0
                while k < parents and parent[k] != there:
                    k += 1
                if k == parents:
                    parent[k], owner[k] = there, larger_cell(mark, index, there, level[c] - 1, deepest)
                    parents += 1
                other = owner[k]
            if other < 0 or other == c or (level[other] == level[c] and other < c):
                continue
            new = True
            if level[other] < level[c]:
                for k in range(before, pairs):
                    if pair[k, 1] == other:
                        new = False
                        break
            if new:
                pair[pairs, 0], pair[pairs, 1] = c, other
                pairs += 1
    return pairs


@njit(cache=True, nogil=True)
def larger_cell(mark: Any, index: Any, there: int, depth: int, deepest: int) -> Any:
    """The cell of this depth or less in which a place lies, -1 if none does."""
    other = -1
    while depth >= 0 and other < 0:
        other = get(mark, index, (1 << (3 * (BITS - deepest + depth))) | there)
        there >>= 3
        depth -= 1
    return other


@njit(cache=True, nogil=True)
def neighbours_of_pairs(pair: Any, cells: int) -> Any:
    """(first, neighbour): cells that touch cell c are neighbour[first[c]: first[c + 1]]."""
    pairs = pair.shape[0]
    first = np.zeros(cells + 1, np.int64)
    for k in range(pairs):
        first[pair[k, 0] + 1] += 1
        first[pair[k, 1] + 1] += 1
    for c in range(cells):
        first[c + 1] += first[c]
    fill, neighbour = first[:-1].copy(), np.empty(2 * pairs, np.int64)
    for k in range(pairs):
        a, b = pair[k, 0], pair[k, 1]
        neighbour[fill[a]] = b
        neighbour[fill[b]] = a
        fill[a] += 1
        fill[b] += 1
    return first, neighbour


@njit(cache=True, nogil=True)
def tagged(key: int, depth: int, deepest: int) -> Any:
    """A cell's name: its key at its depth under a mark bit, so that no two depths share one."""
    up = deepest - depth
    return (1 << (3 * (BITS - up))) | (key >> (3 * up))


@njit(cache=True, nogil=True)
def slot_of(name: int, size: int) -> Any:
    """Where to look for a name first; size is a power of two."""
    v = name ^ (name >> 33)
    v = (v & 0x3FFFFFFF) * 2654435761 + (v >> 30)
    return (v ^ (v >> 15)) & (size - 1)


@njit(cache=True, nogil=True)
def put(mark: Any, index: Any, name: int, value: int) -> None:
    """Into an open-addressed table that has room."""
    at = slot_of(name, mark.size)
    while mark[at] >= 0:
        at = (at + 1) & (mark.size - 1)
    mark[at], index[at] = name, value


@njit(cache=True, nogil=True)
def get(mark: Any, index: Any, name: int) -> Any:
    """The value of a name, -1 if it is not there."""
    at, last = np.uint64(slot_of(name, mark.size)), np.uint64(mark.size - 1)
    while mark[at] >= 0:
        if mark[at] == name:
            return index[at]
        at = (at + np.uint64(1)) & last
    return -1


# ------------------------------------------------------------------------------------------------------ region growing


@njit(cache=True, nogil=True)
def grow(row: Any, seeds: Any, first: Any, neighbour: Any, wide: bool, rules: Any, region: Any, sums: Any) -> Any:
    """Step 4: regions of cells whose planes continue each other; region (C,) becomes each cell's, -1 without a plane.

    A neighbour joins if its normal is within the angle and its centre of gravity within the distance of the plane of
    the cell that it touches. Refined, it is also held against the plane of the whole region so far, with a distance
    by the noise: a region cannot bend away. wide: only against that, with the book's distance.
    sums (C, ROW): the first of them become the regions' moments and planes. Returns how many.
    """
    cells = region.size
    queue = np.empty(cells, np.int64)
    for c in range(cells):
        region[c] = -1
    regions = 0
    by_neighbour, by_region = not wide, not wide and rules[REFINE] > 0.0
    for seed in seeds:
        if region[seed] >= 0 or row[seed, COUNT] <= 0.0:
            continue
        whole = sums[regions]
        whole[:] = row[seed]
        region[seed] = regions
        queue[0] = seed
        head, tail, fitted = 0, 1, 1
        while head < tail:
            c = queue[head]
            head += 1
            for k in range(first[c], first[c + 1]):
                other = neighbour[k]
                if region[other] >= 0 or row[other, COUNT] <= 0.0:
                    continue
                if by_neighbour and not continues(row[c], row[other], rules, rules[APART_M]):
                    continue
                if by_region and not continues(whole, row[other], rules, allowed(whole, row[other], rules)):
                    continue
                if wide and not continues(whole, row[other], rules, rules[APART_M]):
                    continue
                region[other] = regions
                queue[tail] = other
                tail += 1
                add_scatter(whole, row[other], whole)
                whole[COUNT] += row[other, COUNT]
                if tail <= 8 or tail >= fitted + fitted // 4:
                    fit_plane(whole)
                    fitted = tail
        fit_plane(whole)
        regions += 1
    return regions


@njit(cache=True, nogil=True)
def continues(a: Any, b: Any, rules: Any, apart_m: float) -> Any:
    """Whether plane b goes on where plane a is: normals within the angle, b's centre within apart_m of a."""
    along = a[NX] * b[NX] + a[NY] * b[NY] + a[NZ] * b[NZ]
    if abs(along) < rules[COSINE]:
        return False
    return abs(a[NX] * b[CX] + a[NY] * b[CY] + a[NZ] * b[CZ] - a[D]) <= apart_m


@njit(cache=True, nogil=True)
def allowed(a: Any, b: Any, rules: Any) -> Any:
    """How far b's centre may be off the plane of a: by noise, by what planes are not flat, more the farther away."""
    dx, dy, dz = b[CX] - a[CX], b[CY] - a[CY], b[CZ] - a[CZ]
    noise_m = rules[INLIER_SIGMAS] * max(a[SIGMA], b[SIGMA]) + rules[FLAT_M]
    return min(noise_m + rules[WARP] * math.sqrt(dx * dx + dy * dy + dz * dz), max(noise_m, rules[APART_M]))


@njit(cache=True, nogil=True)
def join_regions(region: Any, first: Any, neighbour: Any, sums: Any, regions: int, rules: Any) -> Any:
    """Regions that touch become one where they are one plane (`one_plane`), in the order of their cells.

    sums become theirs; region is renumbered. Returns how many are left.
    """
    parent = np.arange(regions)
    both = np.zeros(ROW)
    for c in range(region.size):
        if region[c] < 0:
            continue
        for k in range(first[c], first[c + 1]):
            other = neighbour[k]
            if other < c or region[other] < 0:
                continue
            a, b = root_of(parent, region[c]), root_of(parent, region[other])
            if a == b or not one_plane(sums[a], sums[b], rules, both):
                continue
            keep, gone = min(a, b), max(a, b)
            parent[gone] = keep
            both[COUNT] = sums[a, COUNT] + sums[b, COUNT]
            both[SIGMA] = sums[keep, SIGMA]
            sums[keep] = both
    number = np.full(regions, -1, np.int64)
    left = 0
    for r in range(regions):
        if parent[r] == r:
            number[r] = left
            sums[left] = sums[r]
            left += 1
    for c in range(region.size):
        if region[c] >= 0:
            region[c] = number[root_of(parent, region[c])]
    return left


@njit(cache=True, nogil=True)
def gather_flat(region: Any, regions: int, row: Any, wide: Any, wide_sums: Any, rules: Any, sums: Any) -> Any:
    """Regions most of whose cells lie in one of the wide regions (C,) become one, if that is flat as a whole: seen
    against its size and against its parts (_WAVE, _ROUGHER). A floor that sags or a ceiling that waves stays one plane;
    a vault does not, nor two planes with a step between. region and sums change; returns how many are left."""
    wides = wide_sums.shape[0]
    cells, within = np.zeros(regions, np.int64), np.zeros(regions, np.int64)
    home = np.full(regions, -1, np.int64)
    for turn in range(2):  # a vote for the wide region of most cells (Boyer and Moore), then its count
        for c in range(region.size):
            r = region[c]
            if r < 0:
                continue
            if turn == 0:
                if cells[r] == 0:
                    home[r] = wide[c]
                cells[r] += 1 if home[r] == wide[c] else -1
            else:
                within[r] += 1 if home[r] == wide[c] else -1
    apart = np.zeros(wides)
    for r in range(regions):
        if home[r] >= 0 and within[r] > 0:
            apart[home[r]] += square_sum(sums[r])
    flat = np.zeros(wides, np.bool_)
    for h in range(wides):
        small, middle, _ = fit_plane(wide_sums[h])
        most = wide_sums[h, WEIGHT] * (0.5 * rules[INLIER_M]) ** 2
        flat[h] = small <= _WAVE * _WAVE * middle and small <= most and small <= _ROUGHER * _ROUGHER * apart[h]
    number, of_wide = np.full(regions, -1, np.int64), np.full(wides, -1, np.int64)
    left = 0
    for r in range(regions):
        h = home[r]
        if h >= 0 and within[r] > 0 and flat[h]:
            if of_wide[h] < 0:
                of_wide[h] = left
                left += 1
            number[r] = of_wide[h]
        else:
            number[r] = left
            left += 1
    sums[:] = 0.0
    for c in range(region.size):
        if region[c] >= 0:
            r = number[region[c]]
            region[c] = r
            if sums[r, WEIGHT] == 0.0:
                sums[r] = row[c]
            else:
                add_scatter(sums[r], row[c], sums[r])
                sums[r, COUNT] += row[c, COUNT]
    for r in range(left):
        fit_plane(sums[r])
    return left


@njit(cache=True, nogil=True)
def root_of(parent: Any, r: int) -> Any:
    """The region that r was joined to in the end."""
    while parent[r] != r:
        parent[r] = parent[parent[r]]
        r = parent[r]
    return r


@njit(cache=True, nogil=True)
def one_plane(a: Any, b: Any, rules: Any, both: Any) -> Any:
    """Whether parts continue each other: each one's centre is near the other's plane, and all points together scatter
    hardly more than apart. both becomes their moments and plane."""
    limit = allowed(a, b, rules)
    if not (continues(a, b, rules, limit) and continues(b, a, rules, limit)):
        return False
    if abs(a[NX] * b[NX] + a[NY] * b[NY] + a[NZ] * b[NZ]) < math.cos(_JOIN_SLOPES * rules[WARP]):
        return False
    add_scatter(a, b, both)
    small, _, _ = fit_plane(both)
    apart = square_sum(a) + square_sum(b)
    return small <= 1.3 * apart + both[WEIGHT] * (0.5 * limit) ** 2


@njit(cache=True, nogil=True)
def square_sum(a: Any) -> Any:
    """Weighted sum of squared distances of a row's points from its plane: n' S n."""
    x, y, z = a[NX], a[NY], a[NZ]
    twice = x * y * a[XY] + x * z * a[XZ] + y * z * a[YZ]
    return max(0.0, x * x * a[XX] + y * y * a[YY] + z * z * a[ZZ] + 2.0 * twice)


# ------------------------------------------------------------------------------------------------------------- labels


@njit(cache=True, nogil=True)
def label_inliers(
    x: Any, y: Any, z: Any, begin: Any, end: Any, row: Any, region: Any, limit: float, label: Any
) -> None:
    """The book's labels: a cell's inliers belong to its region; all else is -1."""
    for c in range(region.size):
        for k in range(begin[c], end[c]):
            off = abs(row[c, NX] * x[k] + row[c, NY] * y[k] + row[c, NZ] * z[k] - row[c, D])
            label[k] = region[c] if region[c] >= 0 and off <= limit else -1


@njit(cache=True, nogil=True)
def touching_regions(region: Any, first: Any, neighbour: Any) -> Any:
    """(mark, index, pairs): a table of the pairs of regions that have touching cells, by `pair_name` (see put, get)."""
    size = 64
    mark, index = np.full(size, -1, np.int64), np.empty(size, np.int64)
    pairs, last = 0, np.int64(-1)
    for c in range(region.size):
        for k in range(first[c], first[c + 1]):
            other = region[neighbour[k]]
            if other <= region[c] or region[c] < 0:
                continue
            name = pair_name(region[c], other)
            if name == last or get(mark, index, name) >= 0:
                continue
            if 3 * pairs >= mark.size:
                old_mark, old_index = mark, index
                mark, index = np.full(2 * old_mark.size, -1, np.int64), np.empty(2 * old_mark.size, np.int64)
                for i in range(old_mark.size):
                    if old_mark[i] >= 0:
                        put(mark, index, old_mark[i], old_index[i])
            put(mark, index, name, pairs)
            last = name
            pairs += 1
    return mark, index, pairs


@njit(cache=True, nogil=True)
def pair_name(a: int, b: int) -> Any:
    """The name of two regions, whichever comes first."""
    return (min(a, b) << 31) | max(a, b)


@njit(cache=True, nogil=True)
def edges_of_sides(sides: Any, edge: Any) -> None:
    """Where planes end at each other: edge (E, 2) becomes (alpha, beta) of pairs a < b that do, zeros of others.

    sides (E, 4): of the points of a, how many lie before and behind b, clear of it, and of those of b before and behind
    a. If nearly all of a plane's lie on one side of the other, and so for the other's, both end where they meet, and a
    point belongs to a where alpha A + beta B > 0, A and B its signed distances: that is which side of the middle
    between both it lies on. Noise moves a point off both at once and drops out of the difference.
    """
    for e in range(sides.shape[0]):
        a_before, a_behind, b_before, b_behind = sides[e, 0], sides[e, 1], sides[e, 2], sides[e, 3]
        edge[e, 0], edge[e, 1] = 0.0, 0.0
        if min(a_before, a_behind) > _OVER * (a_before + a_behind):
            continue
        if min(b_before, b_behind) > _OVER * (b_before + b_behind):
            continue
        if a_before + a_behind < _SIDE_LEAST or b_before + b_behind < _SIDE_LEAST:
            continue
        edge[e, 0] = -1.0 if b_before > b_behind else 1.0
        edge[e, 1] = 1.0 if a_before > a_behind else -1.0


@njit(cache=True, nogil=True)
def label_nearest(
    x: Any, y: Any, z: Any, begin: Any, end: Any, region: Any, first: Any, neighbour: Any, plane: Any, rms: Any,
    rules: Any, mark: Any, index: Any, edge: Any, from_cell: int, to_cell: int, label: Any, sides: Any,
) -> None:  # fmt: skip
    """Labels of the points of cells from_cell to to_cell - 1: of the planes of its cell and of those that touch it,
    the one that is fewest tolerances away, if that is less than one; else -1. Of two planes that end at each other
    (`edges_of_sides`) the side counts that a point lies on. Otherwise the cell's own plane has a start of _FOREIGN, or
    every plane that ends on a table would cut a strip out of it.

    plane: (R, 4) n and d; rms: (R,), a tolerance grows with what a plane's own points scatter.  mark, index: pairs of
    regions (`touching_regions`).  edge: (E, 2).  sides: (E, 4), counted here, or (0, 4).
    """
    near, off = np.empty(_NEAR, np.int64), np.empty(_NEAR)
    pair = np.full((_NEAR, _NEAR), -1, np.int64)
    for c in range(from_cell, to_cell):
        count = 0
        if region[c] >= 0:
            near[0] = region[c]
            count = 1
        for k in range(first[c], first[c + 1]):
            r = region[neighbour[k]]
            if r < 0 or count == near.size:
                continue
            new = True
            for i in range(count):
                if near[i] == r:
                    new = False
                    break
            if new:
                near[count] = r
                count += 1
        for i in range(count):
            for j in range(i):
                pair[i, j] = get(mark, index, pair_name(near[i], near[j]))
                pair[j, i] = pair[i, j]
        for k in range(np.uint64(begin[c]), np.uint64(end[c])):
            at, best = -1, 0.0
            sigma = noise(x[k] * x[k] + y[k] * y[k] + z[k] * z[k], rules)
            for i in range(count):
                r = near[i]
                off[i] = plane[r, 0] * x[k] + plane[r, 1] * y[k] + plane[r, 2] * z[k] - plane[r, 3]
                apart = abs(off[i]) / (rules[INLIER_SIGMAS] * max(sigma, rms[r]) + rules[FLAT_M])
                if apart > 1.0:
                    continue
                if r != region[c]:
                    apart += _FOREIGN
                if at >= 0:
                    e = pair[i, at]
                    if e >= 0 and edge[e, 0] != 0.0:
                        a, b = (i, at) if r < near[at] else (at, i)
                        if (edge[e, 0] * off[a] + edge[e, 1] * off[b] > 0.0) == (a == at):
                            continue
                    elif apart >= best:
                        continue
                at, best = i, apart
            label[k] = near[at] if at >= 0 else -1
            if at < 0 or sides.shape[0] == 0:
                continue
            for i in range(count):
                e = pair[i, at]
                if i != at and e >= 0:
                    limit = rules[INLIER_SIGMAS] * max(sigma, rms[near[i]]) + rules[FLAT_M]
                    if abs(off[i]) > limit:
                        sides[e, (0 if near[at] < near[i] else 2) + (1 if off[i] < 0.0 else 0)] += 1


@njit(cache=True, nogil=True)
def sums_of_labels(x: Any, y: Any, z: Any, weight: Any, label: Any, centre: Any, sums: Any) -> None:
    """Weighted moments (R, ROW) of the points of each label, about centres (R, 3) near them; COUNT, too."""
    sums[:] = 0.0
    for k in range(label.size):
        r = label[k]
        if r < 0:
            continue
        u, v, t, m = x[k] - centre[r, 0], y[k] - centre[r, 1], z[k] - centre[r, 2], weight[k]
        s = sums[r]
        s[COUNT] += 1.0
        s[WEIGHT] += m
        s[CX] += m * u
        s[CY] += m * v
        s[CZ] += m * t
        s[XX] += m * u * u
        s[XY] += m * u * v
        s[XZ] += m * u * t
        s[YY] += m * v * v
        s[YZ] += m * v * t
        s[ZZ] += m * t * t
    for r in range(sums.shape[0]):
        s = sums[r]
        w = s[WEIGHT]
        if w <= 0.0:
            continue
        a, b, c = s[CX] / w, s[CY] / w, s[CZ] / w
        s[XX] -= w * a * a
        s[XY] -= w * a * b
        s[XZ] -= w * a * c
        s[YY] -= w * b * b
        s[YZ] -= w * b * c
        s[ZZ] -= w * c * c
        s[CX], s[CY], s[CZ] = centre[r, 0] + a, centre[r, 1] + b, centre[r, 2] + c
        fit_plane(s)


@njit(cache=True, nogil=True)
def leave_out(weak: Any, number: Any) -> None:
    """Regions that are weak (R,) vanish from numbers (of cells or of points)."""
    for k in range(number.size):
        if number[k] >= 0 and weak[number[k]]:
            number[k] = -1


@njit(cache=True, nogil=True)
def labels_as_given(found: Any, order: Any, usable: Any, rank: Any, label: Any) -> None:
    """label (N,) of points as they were given, found (M,) as they were sorted; both become ranks of regions."""
    for k in range(found.size):
        if found[k] >= 0:
            found[k] = rank[found[k]]
        label[np.uint64(usable[np.uint64(order[k])])] = found[k]


@njit(cache=True, nogil=True)
def rms_of(sums: Any) -> Any:
    """(R,) of the distances of the points of rows (R, ROW) from their planes."""
    rms = np.zeros(sums.shape[0])
    for r in range(sums.shape[0]):
        if sums[r, WEIGHT] > 0.0:
            rms[r] = math.sqrt(square_sum(sums[r]) / sums[r, WEIGHT])
    return rms


# ------------------------------------------------------------------------------------------------------------ outlines


@njit(cache=True, nogil=True)
def groups_of(label: Any, regions: int) -> Any:
    """(first, member): points of label r are member[first[r]: first[r + 1]], in their order."""
    first = np.zeros(regions + 1, np.int64)
    for k in range(label.size):
        if label[k] >= 0:
            first[label[k] + 1] += 1
    for r in range(regions):
        first[r + 1] += first[r]
    fill, member = first[:-1].copy(), np.empty(first[regions], np.int64)
    for k in range(label.size):
        r = label[k]
        if r >= 0:
            member[fill[r]] = k
            fill[r] += 1
    return first, member


@njit(cache=True, nogil=True)
def hulls(x: Any, y: Any, z: Any, first: Any, member: Any, centre: Any, along: Any, across: Any, corner: Any) -> Any:
    """Convex hulls of groups of points in their planes: (K + 1,) where each begins in corner (N, 2), counter-clockwise
    as the axes along, across (R, 3) from centre (R, 3) span the plane.

    Points inside the octagon of the extremes in eight directions are left out first; n log n in the rest.
    """
    regions = first.size - 1
    begins = np.zeros(regions + 1, np.int64)
    made = 0
    for r in range(regions):
        mine = member[first[r] : first[r + 1]]
        n = mine.size
        u, v = np.empty(n), np.empty(n)
        for k in range(n):
            i = np.uint64(mine[k])
            a, b, c = x[i] - centre[r, 0], y[i] - centre[r, 1], z[i] - centre[r, 2]
            u[k] = a * along[r, 0] + b * along[r, 1] + c * along[r, 2]
            v[k] = a * across[r, 0] + b * across[r, 1] + c * across[r, 2]
        kept = outside_octagon(u, v)
        made = chain(u[kept], v[kept], corner, made)
        begins[r + 1] = made
    return begins


@njit(cache=True, nogil=True)
def outside_octagon(u: Any, v: Any) -> Any:
    """Indices of points that are not strictly inside the octagon of their extremes: all corners of the hull are."""
    n = u.size
    extreme = np.zeros(8, np.int64)
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = -math.inf
    for k in range(n):
        a, b = u[k], v[k]
        if -a > m0:
            m0, extreme[0] = -a, k
        if -a - b > m1:
            m1, extreme[1] = -a - b, k
        if -b > m2:
            m2, extreme[2] = -b, k
        if a - b > m3:
            m3, extreme[3] = a - b, k
        if a > m4:
            m4, extreme[4] = a, k
        if a + b > m5:
            m5, extreme[5] = a + b, k
        if b > m6:
            m6, extreme[6] = b, k
        if b - a > m7:
            m7, extreme[7] = b - a, k
    side = np.zeros((8, 3))  # a point is inside where side 0 u + side 1 v > side 2, for all sides
    for s in range(8):
        i, j = extreme[s], extreme[(s + 1) % 8]
        du, dv = u[j] - u[i], v[j] - v[i]
        span = abs(du) + abs(dv)
        if span == 0.0:
            side[s, 2] = -1.0  # no side
            continue
        side[s, 0], side[s, 1] = -dv, du
        side[s, 2] = du * v[i] - dv * u[i] + 1e-12 * span * (abs(u[i]) + abs(v[i]) + span)  # so near a side: kept
    outside = np.zeros(n, np.bool_)
    for s in range(8):
        p, q, c = side[s, 0], side[s, 1], side[s, 2]
        for k in range(n):
            outside[k] |= p * u[k] + q * v[k] <= c
    kept = np.empty(n, np.int64)
    count = 0
    for k in range(n):
        kept[count] = k
        count += outside[k]
    return kept[:count]


@njit(cache=True, nogil=True)
def chain(u: Any, v: Any, corner: Any, made: int) -> Any:
    """Convex hull by two monotone chains, appended to corner from `made` on; returns the new end."""
    n = u.size
    by_u = np.argsort(u, kind="mergesort")
    k = 0
    while k < n:  # equal u: by v
        j = k + 1
        while j < n and u[by_u[j]] == u[by_u[k]]:
            j += 1
        if j - k > 1:
            part = by_u[k:j].copy()
            by_u[k:j] = part[np.argsort(v[part], kind="mergesort")]
        k = j
    start = made
    for turn in range(2):
        base = made
        for step in range(n):
            i = by_u[step] if turn == 0 else by_u[n - 1 - step]
            while (
                made - base >= 2
                and (corner[made - 1, 0] - corner[made - 2, 0]) * (v[i] - corner[made - 2, 1])
                - (corner[made - 1, 1] - corner[made - 2, 1]) * (u[i] - corner[made - 2, 0])
                <= 0.0
            ):
                made -= 1
            corner[made, 0], corner[made, 1] = u[i], v[i]
            made += 1
        made -= 1  # the last is the first of the other chain
    return max(made, start + 1) if n else start
