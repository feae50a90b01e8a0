"""Compiled loops of feature maps (S15 to S22, S25): range-image segments, anchors, histograms, graph matching.

An anchor's row:

    X Y             position
    KIND            FALSE_EDGE, WALL_END, CORNER, JUMP_EDGE or VIRTUAL
    BEFORE AFTER    direction from the anchor along the wall at smaller, at larger bearings; NaN where there is none
    LENGTH          of the longest wall that meets it [m]
    BEAM            index of the nearest beam; -1 if no beam hit it

Walls have the free side they were seen from, so `before` and `after` tell the two faces of a thing apart.
Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.lines import END_X, START_X

X, Y, KIND, BEFORE, AFTER, LENGTH, BEAM = range(7)
ROW = 7
FALSE_EDGE, WALL_END, CORNER, JUMP_EDGE, VIRTUAL = range(1, 6)

# Marks of range_image_segments.
INSIDE, STRAY, EDGE, FALSE = range(4)


# ------------------------------------------------------------------------------------------- S18 range-image segments


@njit(cache=True, nogil=True)
def range_image_segments(range_m: Any, jump_m: float, per_m: float, label: Any, mark: Any) -> Any:
    """Algorithm 5.3: segment of each beam (-1: none) and its mark; returns how many segments there are.

    s = max(jump_m, per_m * the smaller range).  A beam without a finite range ends what was before it.
    """
    n = range_m.size
    for i in range(n):
        label[i] = -1
        mark[i] = INSIDE
    count, i = 0, 0
    while i < n:
        if not math.isfinite(range_m[i]):
            i += 1
            continue
        label[i] = count
        while i + 1 < n and math.isfinite(range_m[i + 1]):
            r = range_m[i]
            step = abs(range_m[i + 1] - r)
            if step <= max(jump_m, per_m * min(r, range_m[i + 1])):
                label[i + 1] = count
                i += 1
                continue
            third = i + 2 < n and math.isfinite(range_m[i + 2])
            if third and abs(range_m[i + 2] - r) <= max(jump_m, per_m * min(r, range_m[i + 2])):
                mark[i + 1] = STRAY
                label[i + 2] = count
                i += 2
                continue
            if third:
                onward = abs(range_m[i + 2] - range_m[i + 1])
                if onward > max(jump_m, per_m * min(range_m[i + 1], range_m[i + 2])):
                    mark[i + 1] = FALSE  # neither side's: a mixed pixel, or a thin thing
                    i += 1
                    break
            mark[i] = EDGE
            break
        count += 1
        i += 1
    return count


# --------------------------------------------------------------------------------------------------------- S19 anchors


@njit(cache=True, nogil=True)
def surface_angles(x: Any, y: Any, label: Any, half_m: float, angle: Any) -> None:
    """Direction of the surface at each point, in [-pi/2, pi/2): regression over neighbours of its segment within
    half_m; NaN where fewer than three points are there."""
    n = x.size
    for i in range(n):
        angle[i] = np.nan
        if label[i] < 0:
            continue
        count, sx, sy, sxx, sxy, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for side in (-1, 1):
            k = i if side < 0 else i + 1
            while 0 <= k < n:
                if label[k] >= 0:
                    if label[k] != label[i]:
                        break
                    dx, dy = x[k] - x[i], y[k] - y[i]
                    if dx * dx + dy * dy > half_m * half_m:
                        break
                    count += 1
                    sx += dx
                    sy += dy
                    sxx += dx * dx
                    sxy += dx * dy
                    syy += dy * dy
                k += side
        if count >= 3:
            a = sxy - sx * sy / count
            b = (sxx - sx * sx / count) - (syy - sy * sy / count)
            turn = 0.5 * math.atan2(2.0 * a, b)
            angle[i] = turn - math.pi if turn >= 0.5 * math.pi else turn


@njit(cache=True, nogil=True)
def anchors_of_lines(
    cosine: Any, sine: Any, range_m: Any, near_m: float, far_m: float, full_turn: bool, rows: Any, beams: Any,
    count: int, gap_m: float, spacing: float, bend_cos: float, corner_m: float, look: int, out: Any,
) -> Any:  # fmt: skip
    """Anchors at the ends of the walls of one scan; returns how many rows of out were filled.

    rows, beams: count lines of mapping.kernels.lines, in order of bearing.  look: how many beams past a wall's end
    tell what it is.  A corner belongs to the wall before it; each wall's two ends are looked at.
    """
    found = 0
    for j in range(count):
        for side in (-1, 1):
            if found == out.shape[0]:
                return found
            other = j + side
            if full_turn and count > 1:
                other = (other + count) % count
            has_other = 0 <= other < count and other != j
            kind = end_kind(
                cosine, sine, range_m, near_m, far_m, full_turn, rows, beams, j, other if has_other else -1, side,
                gap_m, spacing, look,
            )  # fmt: skip
            if kind == 0 or (kind == CORNER and side < 0):
                continue
            # Scans run counter-clockwise and free space is to the right: a wall starts at its larger bearing.
            here = START_X if side > 0 else END_X
            there = END_X if side > 0 else START_X
            ex, ey = rows[j, here], rows[j, here + 1]
            wx, wy = rows[j, there] - ex, rows[j, there + 1] - ey
            length = math.sqrt(wx * wx + wy * wy)
            row = out[found]
            row[X], row[Y], row[KIND], row[LENGTH] = ex, ey, kind, length
            row[BEFORE], row[AFTER] = np.nan, np.nan
            row[BEAM] = beams[j, 1] if side > 0 else beams[j, 0]
            if kind != CORNER:
                row[BEFORE if side > 0 else AFTER] = math.atan2(wy, wx)
                found += 1
                continue
            vx, vy = rows[other, START_X] - rows[other, END_X], rows[other, START_X + 1] - rows[other, END_X + 1]
            other_length = math.sqrt(vx * vx + vy * vy)
            cross = wx * vy - wy * vx
            cosine_bend = abs(wx * vx + wy * vy) / (length * other_length)
            if cosine_bend > bend_cos:
                continue  # the same wall goes on, or a step in it
            ox, oy = rows[other, END_X] - ex, rows[other, END_X + 1] - ey
            t = (ox * vy - oy * vx) / cross
            cx, cy = ex + t * wx, ey + t * wy
            reach = max(corner_m, 2.0 * spacing * math.sqrt(ex * ex + ey * ey))
            if (cx - ex) ** 2 + (cy - ey) ** 2 > reach * reach:
                continue
            if (cx - ex - ox) ** 2 + (cy - ey - oy) ** 2 > reach * reach:
                continue
            row[X], row[Y] = cx, cy
            row[BEFORE], row[AFTER] = math.atan2(wy, wx), math.atan2(vy, vx)
            row[LENGTH] = max(length, other_length)
            found += 1
    return found


@njit(cache=True, nogil=True)
def end_kind(
    cosine: Any, sine: Any, range_m: Any, near_m: float, far_m: float, full_turn: bool, rows: Any, beams: Any, j: int,
    other: int, side: int, gap_m: float, spacing: float, look: int,
) -> Any:  # fmt: skip
    """What the end of line j at larger (side 1) or smaller (-1) bearings is; 0 if the beams there do not tell.

    Nor do they where the next point lies on the wall's own line: beams only became too sparse to follow it.
    """
    n = range_m.size
    ux, uy = rows[j, END_X] - rows[j, START_X], rows[j, END_X + 1] - rows[j, START_X + 1]
    length = math.sqrt(ux * ux + uy * uy)
    ux, uy = ux / length, uy / length
    end = beams[j, 1] if side > 0 else beams[j, 0]
    begin = -1
    if other >= 0:
        begin = beams[other, 0] if side > 0 else beams[other, 1]
    if begin == end:
        return CORNER
    at = end
    r = range_m[at]
    x, y = r * cosine[at], r * sine[at]
    hits = 0
    for step in range(1, 2 * look + 1):
        k = end + side * step
        if full_turn:
            k = (k + n) % n
        elif k < 0 or k >= n:
            return 0  # the field of view ends
        if k == begin:
            # the other wall: one with this if near, else a jump between them
            px, py = range_m[k] * cosine[k], range_m[k] * sine[k]
            if near_points(x, y, px, py, gap_m, spacing):
                return CORNER
            return JUMP_EDGE if range_m[k] > r else FALSE_EDGE
        rk = range_m[k]
        if rk == np.inf or (rk > far_m):
            return JUMP_EDGE
        if not (rk >= near_m and rk > 0.0):
            continue  # invalid or too close: look further
        px, py = rk * cosine[k], rk * sine[k]
        if near_points(x, y, px, py, gap_m, spacing):
            hits += 1
            if hits >= look:
                return WALL_END
            x, y, r = px, py, rk
            continue
        off = (px - rows[j, END_X]) * uy - (py - rows[j, END_X + 1]) * ux
        if abs(off) < gap_m + 0.02 * rk and rk > r:
            return 0
        # A single stray point does not end a surface (algorithm 5.3).
        k2 = k + side
        if full_turn:
            k2 = (k2 + n) % n
        if 0 <= k2 < n and k2 != begin:
            r2 = range_m[k2]
            is_hit = r2 >= near_m and r2 > 0.0 and r2 <= far_m
            if is_hit and near_points(x, y, r2 * cosine[k2], r2 * sine[k2], gap_m, spacing):
                continue
        return JUMP_EDGE if rk > r else FALSE_EDGE
    return WALL_END if hits > 0 else 0


@njit(cache=True, nogil=True)
def near_points(x: float, y: float, px: float, py: float, gap_m: float, spacing: float) -> Any:
    """Whether two points are on one surface; as mapping.kernels.lines.are_near."""
    d2 = (px - x) ** 2 + (py - y) ** 2
    if d2 < gap_m * gap_m:
        return True
    r2 = min(x * x + y * y, px * px + py * py)
    return d2 < spacing * spacing * r2


# ------------------------------------------------------------------------------------------------ S22 graph comparison


@njit(cache=True, nogil=True)
def angle_between(a: float, b: float) -> Any:
    """The difference a - b in [-pi, pi)."""
    turn = 2.0 * math.pi
    return (a - b + math.pi) - turn * math.floor((a - b + math.pi) / turn) - math.pi


@njit(cache=True, nogil=True)
def are_alike(p: Any, q: Any, yaw: float, turn_tolerance: float) -> Any:
    """Whether anchor p, turned by yaw, may be anchor q: a wall that both have must run the same way.

    A corner seen from one side only is a jump edge, so kinds may differ where a wall agrees; anchors that share no
    wall are alike if their kinds are the same.
    """
    if (p[KIND] == VIRTUAL) != (q[KIND] == VIRTUAL):
        return False
    shared = False
    for k in (BEFORE, AFTER):
        if math.isfinite(p[k]) and math.isfinite(q[k]):
            if abs(angle_between(p[k] + yaw, q[k])) > turn_tolerance:
                return False
            shared = True
    return shared or (p[KIND] == q[KIND] and not (math.isfinite(p[BEFORE]) or math.isfinite(p[AFTER])))


@njit(cache=True, nogil=True)
def correspondences(
    a: Any, b: Any, dx: float, dy: float, yaw: float, near_m: float, turn_tolerance: float, partner: Any
) -> Any:
    """Anchors of a, moved by the pose, and the nearest alike anchors of b: one to one, nearest first by order of a.

    partner: (N,) index in b or -1.  Returns (how many, sum of squared distances).
    """
    c, s = math.cos(yaw), math.sin(yaw)
    count, squares = 0, 0.0
    for i in range(a.shape[0]):
        partner[i] = -1
        px, py = dx + c * a[i, X] - s * a[i, Y], dy + s * a[i, X] + c * a[i, Y]
        best, at = near_m * near_m, -1
        for j in range(b.shape[0]):
            d2 = (b[j, X] - px) ** 2 + (b[j, Y] - py) ** 2
            if d2 < best and are_alike(a[i], b[j], yaw, turn_tolerance):
                best, at = d2, j
        if at < 0:
            continue
        taken = False
        for k in range(i):
            taken = taken or partner[k] == at
        if taken:
            continue
        partner[i] = at
        count += 1
        squares += best
    return count, squares


@njit(cache=True, nogil=True)
def rigid_fit(a: Any, b: Any, partner: Any, pose: Any) -> Any:
    """Least squares pose (3,) that lays the anchors of a on their partners in b; False with fewer than two."""
    count, ax, ay, bx, by = 0, 0.0, 0.0, 0.0, 0.0
    for i in range(a.shape[0]):
        j = partner[i]
        if j >= 0:
            count += 1
            ax += a[i, X]
            ay += a[i, Y]
            bx += b[j, X]
            by += b[j, Y]
    if count < 2:
        return False
    ax, ay, bx, by = ax / count, ay / count, bx / count, by / count
    dot, cross = 0.0, 0.0
    for i in range(a.shape[0]):
        j = partner[i]
        if j >= 0:
            px, py, qx, qy = a[i, X] - ax, a[i, Y] - ay, b[j, X] - bx, b[j, Y] - by
            dot += px * qx + py * qy
            cross += px * qy - py * qx
    if dot == 0.0 and cross == 0.0:
        return False
    yaw = math.atan2(cross, dot)
    c, s = math.cos(yaw), math.sin(yaw)
    pose[0], pose[1], pose[2] = bx - (c * ax - s * ay), by - (s * ax + c * ay), yaw
    return True


@njit(cache=True, nogil=True)
def settle(a: Any, b: Any, near_m: float, turn_tolerance: float, pose: Any, partner: Any) -> Any:
    """Correspondences at a pose, the pose they imply, and correspondences there; pose changes. (count, squares)."""
    count, squares = correspondences(a, b, pose[0], pose[1], pose[2], near_m, turn_tolerance, partner)
    if count >= 2 and rigid_fit(a, b, partner, pose):
        count, squares = correspondences(a, b, pose[0], pose[1], pose[2], near_m, turn_tolerance, partner)
    return count, squares


@njit(cache=True, nogil=True)
def pair_pose(p: Any, q: Any, k: Any, m: Any, pose: Any) -> None:
    """The pose (3,) that lays anchors p, q on k, m: their middles on each other, their edges parallel."""
    yaw = math.atan2(m[Y] - k[Y], m[X] - k[X]) - math.atan2(q[Y] - p[Y], q[X] - p[X])
    c, s = math.cos(yaw), math.sin(yaw)
    mx, my = 0.5 * (p[X] + q[X]), 0.5 * (p[Y] + q[Y])
    pose[0] = 0.5 * (k[X] + m[X]) - (c * mx - s * my)
    pose[1] = 0.5 * (k[Y] + m[Y]) - (s * mx + c * my)
    pose[2] = angle_between(yaw, 0.0)


@njit(cache=True, nogil=True)
def compare_graphs(
    a: Any, b: Any, edges_a: Any, edges_b: Any, length_a: Any, length_b: Any, tolerance_m: float, near_m: float,
    turn_tolerance: float, best_pose: Any, best_partner: Any,
) -> Any:  # fmt: skip
    """The pose under which most anchors of a have partners in b, from pairs of equal distance, largest first.

    edges: (E, 2) vertices by falling length (E,).  Returns (count, sum of squares) of the best; ties: less squares.
    """
    most, least = 0, np.inf
    pose, partner = np.empty(3), np.empty(a.shape[0], dtype=np.int64)
    possible = min(a.shape[0], b.shape[0])
    start = 0
    for e in range(edges_a.shape[0]):
        while start < length_b.size and length_b[start] > length_a[e] + tolerance_m:
            start += 1
        f = start
        while f < length_b.size and length_b[f] >= length_a[e] - tolerance_m:
            for flip in range(2):
                i, j = edges_a[e, 0], edges_a[e, 1]
                k, m = edges_b[f, flip], edges_b[f, 1 - flip]
                pair_pose(a[i], a[j], b[k], b[m], pose)
                if not (
                    are_alike(a[i], b[k], pose[2], turn_tolerance) and are_alike(a[j], b[m], pose[2], turn_tolerance)
                ):
                    continue
                count, squares = settle(a, b, near_m, turn_tolerance, pose, partner)
                if count > most or (count == most and squares < least):
                    most, least = count, squares
                    best_pose[:] = pose
                    best_partner[:] = partner
            f += 1
        if most == possible:
            break
    return most, least


# ----------------------------------------------------------------------------------------------------- S20 orientation


@njit(cache=True, nogil=True)
def chords(points: Any, span_m: float, gap_m: float, out: Any) -> Any:
    """From each point to the first later one at least span_m away, no step between wider than gap_m; how many.

    A point whose surface ends before has none.  Worst case N^2, when all points lie within span_m.
    """
    count = 0
    for i in range(points.shape[0] - 1):
        for k in range(i + 1, points.shape[0]):
            sx, sy = points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1]
            if sx * sx + sy * sy > gap_m * gap_m:
                break
            dx, dy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
            if dx * dx + dy * dy >= span_m * span_m:
                out[count, 0], out[count, 1] = dx, dy
                count += 1
                break
    return count


# --------------------------------------------------------------------------------- S25 index over distances, proposals

ENTRY_SCENE, ENTRY_FROM, ENTRY_TO = range(3)


@njit(cache=True, nogil=True)
def pair_key(distance: int, alpha: int, beta: int, sides: int, turns: int) -> Any:
    """Number of a bin of the index: distance bin, directions of a wall at either end against the edge, which walls."""
    return ((distance * turns + alpha) * turns + beta) * 4 + sides


@njit(cache=True, nogil=True)
def index_entries(
    anchors: Any, first: Any, scenes: Any, shortest_m: float, longest_m: float, step_m: float, turns: int,
    keys: Any, entries: Any,
) -> Any:  # fmt: skip
    """Every ordered pair of anchors with walls, once for each choice of a wall at either end.

    anchors: (A, ROW) of all scenes, first: (S + 1,) where each begins; scenes: (S,) their numbers.  keys (K,) and
    entries (K, 3) are filled as far as they reach; returns how many there are.
    """
    count = 0
    for at in range(scenes.size):
        for i in range(first[at], first[at + 1]):
            for j in range(first[at], first[at + 1]):
                if i == j or anchors[i, KIND] == VIRTUAL or anchors[j, KIND] == VIRTUAL:
                    continue
                dx, dy = anchors[j, X] - anchors[i, X], anchors[j, Y] - anchors[i, Y]
                d = math.sqrt(dx * dx + dy * dy)
                if d < shortest_m or d >= longest_m:
                    continue
                bearing = math.atan2(dy, dx)
                for side_i in range(2):
                    if not math.isfinite(anchors[i, BEFORE + side_i]):
                        continue
                    for side_j in range(2):
                        if not math.isfinite(anchors[j, BEFORE + side_j]):
                            continue
                        if count < keys.size:
                            alpha = turn_bin(anchors[i, BEFORE + side_i] - bearing, turns)
                            beta = turn_bin(anchors[j, BEFORE + side_j] - bearing, turns)
                            keys[count] = pair_key(int(d / step_m), alpha, beta, 2 * side_i + side_j, turns)
                            entries[count, ENTRY_SCENE] = scenes[at]
                            entries[count, ENTRY_FROM] = i - first[at]
                            entries[count, ENTRY_TO] = j - first[at]
                        count += 1
    return count


@njit(cache=True, nogil=True)
def turn_bin(angle: float, turns: int) -> Any:
    """Which of `turns` bins of a full turn an angle lies in."""
    share = angle / (2.0 * math.pi)
    return int((share - math.floor(share)) * turns) % turns


@njit(cache=True, nogil=True)
def neighbour_bins(value: float, first: Any) -> Any:
    """The bin of a value in units of bins, and its nearer neighbour: every difference below half a bin is met."""
    at = math.floor(value)
    other = at + 1 if value - at >= 0.5 else at - 1
    return int(at), int(other)


@njit(cache=True, nogil=True)
def slot_of(scene: int, ix: int, iy: int, iyaw: int, table_key: Any) -> Any:
    """The place of a bin of poses in an open hash table whose size is a power of two; -1 if the table is full."""
    key = ((np.int64(scene) * 4096 + (ix & 4095)) * 4096 + (iy & 4095)) * 64 + iyaw + 1
    mask = table_key.size - 1
    at = (key * np.int64(-7046029254386353131) >> 20) & mask
    for _ in range(64):
        if table_key[at] == 0:
            table_key[at] = key
            return at
        if table_key[at] == key:
            return at
        at = (at + 1) & mask
    return -1


@njit(cache=True, nogil=True)
def vote(
    query: Any, edges: Any, length: Any, anchors: Any, first: Any, starts: Any, entries: Any, step_m: float,
    turns: int, shortest_m: float, tolerance_m: float, turn_tolerance: float, bin_m: float, bin_rad: float,
    most_votes: int, table_key: Any, table_scene: Any, table_last: Any, table_sum: Any,
) -> Any:  # fmt: skip
    """Poses of the query in the frames of stored scenes, one vote for each edge that both have, largest edges first.

    query (N, ROW), edges (E, 2) by falling length (E,); starts: where each bin's entries begin.  table_*: an empty
    hash table over (scene, pose bin): the last edge that voted there, from 1 (an edge votes once), sums of x, y, cosine
    and sine of yaw weighted by length, and of weights.  Returns how many votes there were.
    """
    pose = np.empty(3)
    votes = 0
    distances = starts.size // (4 * turns * turns)
    for e in range(edges.shape[0]):
        d = length[e]
        if d < shortest_m or votes >= most_votes:
            break
        i, j = edges[e, 0], edges[e, 1]
        bearing = math.atan2(query[j, Y] - query[i, Y], query[j, X] - query[i, X])
        here_d = neighbour_bins(d / step_m, 0)
        for side_i in range(2):
            wall_i = query[i, BEFORE + side_i]
            if not math.isfinite(wall_i):
                continue
            alpha = turn_share(wall_i - bearing) * turns
            here_a = neighbour_bins(alpha, 0)
            for side_j in range(2):
                wall_j = query[j, BEFORE + side_j]
                if not math.isfinite(wall_j):
                    continue
                beta = turn_share(wall_j - bearing) * turns
                here_b = neighbour_bins(beta, 0)
                for nd in range(2):
                    if here_d[nd] < 0 or here_d[nd] >= distances:
                        continue
                    for na in range(2):
                        for nb in range(2):
                            key = pair_key(
                                here_d[nd], here_a[na] % turns, here_b[nb] % turns, 2 * side_i + side_j, turns
                            )
                            for at in range(starts[key], starts[key + 1]):
                                scene = entries[at, ENTRY_SCENE]
                                p = anchors[first[scene] + entries[at, ENTRY_FROM]]
                                q = anchors[first[scene] + entries[at, ENTRY_TO]]
                                stored = math.sqrt((q[X] - p[X]) ** 2 + (q[Y] - p[Y]) ** 2)
                                if abs(stored - d) > tolerance_m:
                                    continue
                                pair_pose(query[i], query[j], p, q, pose)
                                if not (
                                    are_alike(query[i], p, pose[2], turn_tolerance)
                                    and are_alike(query[j], q, pose[2], turn_tolerance)
                                ):
                                    continue
                                votes += 1
                                slot = slot_of(
                                    scene,
                                    math.floor(pose[0] / bin_m),
                                    math.floor(pose[1] / bin_m),
                                    math.floor((pose[2] + math.pi) / bin_rad) & 63,
                                    table_key,
                                )
                                if slot < 0 or table_last[slot] == e + 1:
                                    continue
                                table_last[slot] = e + 1
                                table_scene[slot] = scene
                                table_sum[slot, 0] += d * pose[0]
                                table_sum[slot, 1] += d * pose[1]
                                table_sum[slot, 2] += d * math.cos(pose[2])
                                table_sum[slot, 3] += d * math.sin(pose[2])
                                table_sum[slot, 4] += d
    return votes


@njit(cache=True, nogil=True)
def turn_share(angle: float) -> Any:
    """An angle as a share of a full turn, in [0, 1)."""
    share = angle / (2.0 * math.pi)
    return share - math.floor(share)


@njit(cache=True, nogil=True)
def settle_proposals(
    query: Any, anchors: Any, first: Any, scenes: Any, poses: Any, near_m: float, turn_tolerance: float,
    count: Any, squares: Any,
) -> None:  # fmt: skip
    """Correspondences at each proposed pose (P, 3) in the frame of its scene (P,); poses become those they imply."""
    partner = np.empty(query.shape[0], dtype=np.int64)
    for k in range(scenes.size):
        stored = anchors[first[scenes[k]] : first[scenes[k] + 1]]
        count[k], squares[k] = settle(query, stored, near_m, turn_tolerance, poses[k], partner)
