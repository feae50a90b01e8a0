"""Compiled loops of scan matching: point-to-line alignment of a view on others, and how they agree.

Views are as in localise_table. Poses are rows (x, y, yaw) in float64. Bounds: every index is clipped or wrapped before
it is used.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.localise_table import BINS, CLOSED, EMPTY, GRAZING_GAP_M, WIDTH, bearing_of, bin_of

WIDEST_BINS = 24.0  # half of the widest window of bearings that is searched
ASIDE_SLACK_RAD = 1e-4  # more than bearing_of and the rounding of points are off
FARTHEST_ASIDE_RAD = 1.4
FACING = 0.6  # cosine: surfaces that meet under a larger angle are not the same one
GRAZING_SHARE = 0.75  # of the spacing of beams on a wall: how far from one of its points the wall is taken to go on

CONVERGED = 4e-4

LEVELS = 4
RESULT_POSE, RESULT_HESSIAN, RESULT_COST, RESULT_COUNT, RESULT_STEPS, RESULT_LENGTH = 0, 3, 9, 10, 11, 12


@njit(cache=True, nogil=True)
def nearest_bin(px: float, py: float, reach_m: float, coarse: bool, x: Any, y: Any, quality: Any, frame: Any) -> int:
    """The bin of a view whose point with a normal lies nearest to (px, py), within reach_m; -1 if none does.

    Points within reach lie within asin(reach / range) of its bearing. coarse: every other bin of wide windows only.
    Bins are looked at from the point's own bearing outwards, on both sides in turn: what lies `a` radians aside is at
    least r sin(a) away, and sin(a) at least a (1 - h^2 / 6) up to the window's half h. Of points that are equally near,
    that of the lowest bin counts.
    """
    bins = int(frame[BINS])
    width = frame[WIDTH]
    r = math.sqrt(px * px + py * py)
    half = WIDEST_BINS
    if r > reach_m:
        half = min(half, 1.05 * reach_m / (r * width) + 0.5)
    middle = bin_of(bearing_of(px, py), frame)
    low, high = middle - int(half), middle + int(half)
    first = low
    if frame[CLOSED] == 0.0:
        low, high = max(low, 0), min(high, bins - 1)
        first = low
    step = 2 if coarse and half > 5.0 else 1
    down = first + (min(max(middle, first), high) - first) // step * step
    up = down + step
    widest = min((half + 1.0) * width, FARTHEST_ASIDE_RAD)
    per_rad = r * (1.0 - widest * widest / 6.0)
    aside = -width - ASIDE_SLACK_RAD
    best, at, at_k = reach_m * reach_m, -1, 0
    while down >= low or up <= high:
        apart = per_rad * min(aside, FARTHEST_ASIDE_RAD)
        if apart > 0.0 and apart * apart > best:
            break
        for k in (down, up):
            if k < low or k > high:
                continue
            b = k
            if b < 0:
                b += bins
            elif b >= bins:
                b -= bins
            if quality[b] > 0.0:
                dx, dy = x[b] - px, y[b] - py
                square = dx * dx + dy * dy
                if square < best or (square == best and at >= 0 and k < at_k):
                    best, at, at_k = square, b, k
        down -= step
        up += step
        aside += step * width
    return at


@njit(cache=True, nogil=True)
def grazed_bin(
    px: float, py: float, ux: float, uy: float, reach_m: float, x: Any, y: Any, nx: Any, ny: Any, quality: Any,
    frame: Any,
) -> int:  # fmt: skip
    """The bin next to a point's bearing on whose wall, grazed by beams, the point (px, py) of normal (ux, uy) lies.

    It lies within reach_m of the tangent line and no farther along it than beams of that view lie apart there; -1 if
    there is none.
    """
    bins = int(frame[BINS])
    middle = bin_of(bearing_of(px, py), frame)
    best, at = reach_m, -1
    for k in range(middle - 1, middle + 2):
        b = k
        if frame[CLOSED] > 0.0:
            b = (b + bins) % bins
        elif b < 0 or b >= bins:
            continue
        if not quality[b] > 0.0 or nx[b] * ux + ny[b] * uy < FACING:
            continue
        qx, qy = np.float64(x[b]), np.float64(y[b])
        away = -(qx * nx[b] + qy * ny[b])
        dx, dy = px - qx, py - qy
        e = abs(dx * nx[b] + dy * ny[b])
        along = abs(dy * nx[b] - dx * ny[b])
        if e < best and along * away < GRAZING_SHARE * (qx * qx + qy * qy) * frame[WIDTH] and along < GRAZING_GAP_M:
            best, at = e, b
    return at


@njit(cache=True, nogil=True)
def add_pair(
    sx: Any, sy: Any, snx: Any, sny: Any, squality: Any, stride: int, offset: int,
    x: Any, y: Any, nx: Any, ny: Any, quality: Any, frame: Any,
    dx: float, dy: float, turn: float, reach_m: float, scale_m: float, coarse: bool, partner: Any, known: bool,
    sums: Any,
) -> None:  # fmt: skip
    """Add one pair of views to the normal equations of (dx, dy, turn), the source's pose in the reference's frame.

    partner: (B,) the reference's bin of each point of the source, -1 for none: found, or taken as it is if `known`.
    sums: (11,) upper triangle of H (6), gradient (3), robust cost, number of correspondences. Weights are those of
    Geman and McClure: (s^2 / (s^2 + e^2))^2 with s = scale_m, e the distance from the reference's tangent line.
    """
    c, s = math.cos(turn), math.sin(turn)
    square = scale_m * scale_m
    h0, h1, h2, h3, h4, h5, g0, g1, g2, cost, count = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(offset, len(sx), stride):
        if squality[i] == EMPTY:
            continue
        rx, ry = c * sx[i] - s * sy[i], s * sx[i] + c * sy[i]
        px, py = rx + dx, ry + dy
        if known:
            b = partner[i]
            if b < 0:
                continue
        else:
            partner[i] = -1
            tx, ty = c * snx[i] - s * sny[i], s * snx[i] + c * sny[i]
            b = nearest_bin(px, py, reach_m, coarse, x, y, quality, frame)
            if b < 0:
                if not squality[i] > 0.0:
                    continue
                b = grazed_bin(px, py, tx, ty, reach_m, x, y, nx, ny, quality, frame)
                if b < 0:
                    continue
            if squality[i] > 0.0 and tx * nx[b] + ty * ny[b] < FACING:
                continue
            partner[i] = b
        ux, uy = np.float64(nx[b]), np.float64(ny[b])
        e = (px - x[b]) * ux + (py - y[b]) * uy
        inside = square / (square + e * e)
        w = quality[b] * inside * inside
        j = rx * uy - ry * ux
        h0 += w * ux * ux
        h1 += w * ux * uy
        h2 += w * ux * j
        h3 += w * uy * uy
        h4 += w * uy * j
        h5 += w * j * j
        g0 += w * ux * e
        g1 += w * uy * e
        g2 += w * j * e
        cost += 1.0 - inside
        count += 1.0
    for at, value in enumerate((h0, h1, h2, h3, h4, h5, g0, g1, g2, cost, count)):
        sums[at] += value


@njit(cache=True, nogil=True)
def add_turned(sums: Any, yaw: float, total: Any) -> None:
    """Add sums of add_pair, whose translations are in a frame turned by yaw, to totals in the outer frame."""
    c, s = math.cos(yaw), math.sin(yaw)
    total[0] += c * c * sums[0] - 2.0 * c * s * sums[1] + s * s * sums[3]
    total[1] += c * s * (sums[0] - sums[3]) + (c * c - s * s) * sums[1]
    total[2] += c * sums[2] - s * sums[4]
    total[3] += s * s * sums[0] + 2.0 * c * s * sums[1] + c * c * sums[3]
    total[4] += s * sums[2] + c * sums[4]
    total[5] += sums[5]
    total[6] += c * sums[6] - s * sums[7]
    total[7] += s * sums[6] + c * sums[7]
    total[8] += sums[8]
    total[9] += sums[9]
    total[10] += sums[10]


@njit(cache=True, nogil=True)
def solve3(h: Any, g: Any, out: Any) -> bool:
    """out = H^-1 g for H (3, 3) positive definite given in full; False if it is not. Cholesky."""
    if not h[0, 0] > 0.0:
        return False
    l00 = math.sqrt(h[0, 0])
    l10, l20 = h[1, 0] / l00, h[2, 0] / l00
    d = h[1, 1] - l10 * l10
    if not d > 0.0:
        return False
    l11 = math.sqrt(d)
    l21 = (h[2, 1] - l20 * l10) / l11
    d = h[2, 2] - l20 * l20 - l21 * l21
    if not d > 0.0:
        return False
    l22 = math.sqrt(d)
    a = g[0] / l00
    b = (g[1] - l10 * a) / l11
    e = (g[2] - l20 * a - l21 * b) / l22
    out[2] = e / l22
    out[1] = (b - l21 * out[2]) / l11
    out[0] = (a - l10 * out[1] - l20 * out[2]) / l00
    return True


@njit(cache=True, nogil=True)
def align(
    sx: Any, sy: Any, snx: Any, sny: Any, squality: Any,
    x: Any, y: Any, nx: Any, ny: Any, quality: Any, frames: Any, rows: Any, poses: Any,
    guess: Any, prior: Any, reach_m: Any, scale_m: Any, most_steps: int, same_partners: float, result: Any,
) -> None:  # fmt: skip
    """Pose of a source view that lays it on several reference views at once (point to line, Gauss-Newton).

    rows: (R,) which views of the store are references; poses: (R, 3) theirs.  guess: (3,).  prior: (3, 3) weight of
    staying at the guess, in points.  reach_m, scale_m: (LEVELS,) from coarse to fine; the coarse levels see every
    other point and reference, and are left as soon as steps are small.  same_partners: after a smaller step, metres and
    a third of radians, partners are not looked for again.
    result: (RESULT_LENGTH,) pose, upper triangle of H in points, robust cost, correspondences, steps (-1: failed).
    """
    pose = guess.copy()
    partner = np.empty((len(rows), len(sx)), dtype=np.int32)
    known = False
    total, sums = np.zeros(11), np.zeros(11)
    h, g, step = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    level = 0
    for done in range(most_steps):
        last = level == LEVELS - 1
        stride = 1 if last or len(sx) < 120 else 2
        total[:] = 0.0
        for k in range(0, len(rows), 1 if last or len(rows) < 4 else 2):
            row = rows[k] if last else rows[len(rows) - 1 - k]
            ref = poses[k] if last else poses[len(rows) - 1 - k]
            c, s = math.cos(ref[2]), math.sin(ref[2])
            dx, dy = pose[0] - ref[0], pose[1] - ref[1]
            sums[:] = 0.0
            add_pair(
                sx, sy, snx, sny, squality, stride, done % stride,
                x[row], y[row], nx[row], ny[row], quality[row], frames[row],
                c * dx + s * dy, c * dy - s * dx, pose[2] - ref[2], reach_m[level], scale_m[level], not last,
                partner[k], known, sums,
            )  # fmt: skip
            add_turned(sums, ref[2], total)
        weight = 1.0 if last else 0.25  # coarse levels see a quarter of the pairs
        h[0, 0], h[0, 1], h[0, 2] = total[0], total[1], total[2]
        h[1, 0], h[1, 1], h[1, 2] = total[1], total[3], total[4]
        h[2, 0], h[2, 1], h[2, 2] = total[2], total[4], total[5]
        for a in range(3):
            g[a] = total[6 + a]
            for b in range(3):
                h[a, b] += weight * prior[a, b]
                g[a] += weight * prior[a, b] * (pose[b] - guess[b])
            h[a, a] += 1e-6
        if not solve3(h, g, step):
            result[RESULT_STEPS] = -1.0
            return
        for a in range(3):
            pose[a] -= step[a]
        moved = math.sqrt(step[0] * step[0] + step[1] * step[1]) + 3.0 * abs(step[2])
        result[RESULT_STEPS] = done + 1.0
        if not last:
            level = LEVELS - 1 if moved < 0.04 else level + 1
        elif moved < CONVERGED:
            break
        known = last and moved < same_partners
    for a in range(3):
        result[RESULT_POSE + a] = pose[a]
    for a in range(6):
        result[RESULT_HESSIAN + a] = total[a]
    result[RESULT_COST] = total[9]
    result[RESULT_COUNT] = total[10]


@njit(cache=True, nogil=True)
def compare(
    sx: Any, sy: Any, squality: Any, x: Any, y: Any, quality: Any, frames: Any, rows: Any, poses: Any, pose: Any,
    near_m: float, votes: Any,
) -> None:  # fmt: skip
    """How a view at `pose` (3,) agrees with reference views: votes (3,) points explained, refuted, unseen.

    A point is explained if some reference has a point within near_m (growing with the spacing of its beams). It is
    refuted if none has, and some reference's beam through its bearing (and both neighbours) ended well behind it:
    that reference saw through the surface. It is unseen if no reference looked there or all saw something nearer.
    """
    for i in range(len(sx)):
        if squality[i] == EMPTY:
            continue
        explained, refuted = False, False
        for k in range(len(rows)):
            ref, row = poses[k], rows[k]
            frame = frames[row]
            bins = int(frame[BINS])
            c, s = math.cos(ref[2]), math.sin(ref[2])
            ct, st = math.cos(pose[2] - ref[2]), math.sin(pose[2] - ref[2])
            ox, oy = pose[0] - ref[0], pose[1] - ref[1]
            px = ct * sx[i] - st * sy[i] + c * ox + s * oy
            py = st * sx[i] + ct * sy[i] + c * oy - s * ox
            r = math.sqrt(px * px + py * py)
            near = near_m + 0.5 * r * frame[WIDTH]
            middle = bin_of(bearing_of(px, py), frame)
            half = min(WIDEST_BINS, near / (max(r, near) * frame[WIDTH]) + 1.0)
            behind, looked = 0, 0
            for at in range(middle - int(half), middle + int(half) + 1):
                b = at
                if frame[CLOSED] > 0.0:
                    b = (b + bins) % bins
                elif b < 0 or b >= bins:
                    continue
                if quality[row, b] == EMPTY:
                    continue
                if (x[row, b] - px) ** 2 + (y[row, b] - py) ** 2 <= near * near:
                    explained = True
                    break
                if abs(at - middle) <= 1:
                    looked += 1
                    far = math.sqrt(x[row, b] ** 2 + y[row, b] ** 2)
                    behind += far > r + 0.3 + 0.05 * r
            if explained:
                break
            refuted = refuted or (looked == 3 and behind == 3)
        if explained:
            votes[0] += 1.0
        elif refuted:
            votes[1] += 1.0
        else:
            votes[2] += 1.0
