"""Compiled loops of localisation in a known grid: surfaces of its walls, scans laid on them, beams held against them.

Cells are indexed [row, col] from the lower left corner of the grid; positions are metres in the frame of that corner
(x with col, y with row), so that cell (row, col) covers [col r, (col + 1) r) and y alike. Wrappers shift to the map.
A robot's points are given in its base frame, one laser's or several lasers' alike.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.localise_match import solve3

UNKNOWN, FREE, WALL = 0, 1, 2
EXPLAINED, THROUGH, UNEXPECTED, UNSEEN = 0, 1, 2, 3
LEVELS = 3
MATCH_LENGTH = 12  # pose (3), upper triangle of H (6), robust cost, partners, steps
VAGUE_M = 0.2  # so far from a wall an end on unknown ground may lie behind it
_GRAZING = 0.35  # a beam flatter than this to a wall (sine of the angle) may pass along it


@njit(cache=True, nogil=True)
def surfaces(weight: Any, wall: Any, half: int, resolution_m: float, out: Any) -> None:
    """out: (W, 5) float32 of the W wall cells by row: a point of the surface x, y, its normal, how little it is a line.

    weight: (R, C) uint8, how sure each cell is wall; cells within `half` count, the nearer the more. The point is the
    foot of the cell's centre on the line through its neighbours; isotropy is 0 on a line, 1 at a lone post.
    """
    rows, cols = wall.shape
    spread = 2.0 * (0.5 * half) ** 2
    at = -1
    for r in range(rows):
        for c in range(cols):
            if not wall[r, c]:
                continue
            at += 1
            total, mx, my, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for v in range(max(0, r - half), min(rows, r + half + 1)):
                for u in range(max(0, c - half), min(cols, c + half + 1)):
                    if not wall[v, u]:
                        continue
                    dx, dy = float(u - c), float(v - r)
                    w = weight[v, u] * math.exp(-(dx * dx + dy * dy) / spread)
                    total += w
                    mx += w * dx
                    my += w * dy
                    xx += w * dx * dx
                    xy += w * dx * dy
                    yy += w * dy * dy
            mx, my = mx / total, my / total
            xx, xy, yy = xx / total - mx * mx, xy / total - mx * my, yy / total - my * my
            middle, half_gap = 0.5 * (xx + yy), math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
            angle = 0.5 * math.atan2(2.0 * xy, xx - yy)  # of the longer axis
            nx, ny = -math.sin(angle), math.cos(angle)
            foot = mx * nx + my * ny  # the cell's centre moves along the normal only
            out[at, 0] = (c + 0.5 + foot * nx) * resolution_m
            out[at, 1] = (r + 0.5 + foot * ny) * resolution_m
            out[at, 2], out[at, 3] = nx, ny
            small, large = middle - half_gap + 1.0 / 12.0, middle + half_gap + 1.0 / 12.0  # a cell's own spread
            out[at, 4] = small / large


@njit(cache=True, nogil=True)
def match(
    px: Any, py: Any, stride: int, nearest: Any, surface: Any, resolution_m: float,
    guess: Any, prior: Any, reach_m: Any, scale_m: Any, most_steps: int, result: Any,
) -> None:  # fmt: skip
    """Lay points (N,) of a base frame on the nearest surfaces: robust Gauss-Newton from guess (3,), coarse to fine.

    prior: (3, 3) weight of staying at the guess, in points.  reach_m, scale_m: (LEVELS,).  A point pulls along the
    normal, and along the surface as far as that is no line.
    result: (MATCH_LENGTH,), as said there; steps is -1 where the equations have no solution.
    """
    rows, cols = nearest.shape
    x, y, yaw = guess[0], guess[1], guess[2]
    h, g, step = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    level, cost, partners = 0, 0.0, 0
    for done in range(most_steps):
        last = level == LEVELS - 1
        h[:, :] = 0.0
        g[:] = 0.0
        cost, partners = 0.0, 0
        square, reach = scale_m[level] ** 2, reach_m[level] ** 2
        c, s = math.cos(yaw), math.sin(yaw)
        for i in range(0, len(px), stride):
            rx, ry = c * px[i] - s * py[i], s * px[i] + c * py[i]
            ex, ey = x + rx, y + ry
            u, v = math.floor(ex / resolution_m), math.floor(ey / resolution_m)
            if not (u >= 0 and v >= 0 and u < cols and v < rows):
                continue
            at = nearest[v, u]
            if at < 0:
                continue
            dx, dy = ex - surface[at, 0], ey - surface[at, 1]
            nx, ny = np.float64(surface[at, 2]), np.float64(surface[at, 3])
            across, along = dx * nx + dy * ny, dy * nx - dx * ny
            if dx * dx + dy * dy > reach:
                continue
            held = max(0.0, surface[at, 4] - 0.1)
            e2 = across * across + held * along * along
            inside = square / (square + e2)
            w = inside * inside
            j = rx * ny - ry * nx
            k = rx * nx + ry * ny
            wt = w * held
            h[0, 0] += w * nx * nx + wt * ny * ny
            h[0, 1] += w * nx * ny - wt * nx * ny
            h[1, 1] += w * ny * ny + wt * nx * nx
            h[0, 2] += w * nx * j - wt * ny * k
            h[1, 2] += w * ny * j + wt * nx * k
            h[2, 2] += w * j * j + wt * k * k
            g[0] += w * nx * across - wt * ny * along
            g[1] += w * ny * across + wt * nx * along
            g[2] += w * j * across + wt * k * along
            cost += 1.0 - inside
            partners += 1
        result[3], result[4], result[5] = h[0, 0], h[0, 1], h[0, 2]
        result[6], result[7], result[8] = h[1, 1], h[1, 2], h[2, 2]
        h[1, 0], h[2, 0], h[2, 1] = h[0, 1], h[0, 2], h[1, 2]
        dyaw = yaw - guess[2]
        for a in range(3):
            for b in range(3):
                h[a, b] += prior[a, b]
            g[a] += prior[a, 0] * (x - guess[0]) + prior[a, 1] * (y - guess[1]) + prior[a, 2] * dyaw
            h[a, a] += 1e-6
        result[11] = done + 1.0
        if not solve3(h, g, step):
            result[11] = -1.0
            break
        x, y, yaw = x - step[0], y - step[1], yaw - step[2]
        moved = math.sqrt(step[0] * step[0] + step[1] * step[1]) + 3.0 * abs(step[2])
        if not last:
            level = LEVELS - 1 if moved < 0.03 else level + 1
        elif moved < 1e-3:
            break
    result[0], result[1], result[2] = x, y, yaw
    result[9], result[10] = cost, float(partners)


@njit(cache=True, nogil=True)
def match_many(
    px: Any, py: Any, stride: int, nearest: Any, surface: Any, resolution_m: float,
    guesses: Any, priors: Any, reach_m: Any, scale_m: Any, most_steps: int, results: Any,
) -> None:  # fmt: skip
    """match for guesses (K, 3) and priors (K, 3, 3) into results (K, MATCH_LENGTH)."""
    for k in range(len(guesses)):
        match(
            px, py, stride, nearest, surface, resolution_m,
            guesses[k], priors[k], reach_m, scale_m, most_steps, results[k],
        )  # fmt: skip


@njit(cache=True, nogil=True)
def cast(
    kind: Any, room: Any, nearest: Any, surface: Any, resolution_m: float,
    x: float, y: float, dx: float, dy: float, longest_m: float,
) -> tuple[float, int]:  # fmt: skip
    """How far a ray from x, y along the unit vector dx, dy goes through free cells, and what ends it.

    room: (R, C) float32, distance to the nearest cell that is not free [m].  Walls met at a grazing angle are passed
    by: in a grid, a beam along a corridor scratches its wall. Ends: WALL, UNKNOWN, or FREE beyond longest_m.
    """
    rows, cols = kind.shape
    t = 0.0
    while t < longest_m:
        u, v = math.floor((x + t * dx) / resolution_m), math.floor((y + t * dy) / resolution_m)
        if not (u >= 0 and v >= 0 and u < cols and v < rows) or kind[v, u] == UNKNOWN:
            return t, UNKNOWN
        if kind[v, u] == WALL:
            at = nearest[v, u]
            if abs(surface[at, 2] * dx + surface[at, 3] * dy) > _GRAZING:
                return t, WALL
        t += max(0.5 * resolution_m, room[v, u] - 0.71 * resolution_m)
    return t, FREE


@njit(cache=True, nogil=True)
def judge(
    ox: Any, oy: Any, px: Any, py: Any, stride: int, kind: Any, room: Any, nearest: Any, surface: Any,
    resolution_m: float, pose: Any, near_m: float, apart_m: Any, log_apart: Any, log_else: Any, votes: Any,
) -> float:  # fmt: skip
    """Hold beams against the map at a pose (3,): each ends on a wall, went through one, met something that is not in
    the map, or looked where nothing is known. Returns their joint log likelihood; votes (4,) counts them.

    ox, oy: (N,) where beams start, px, py: (N,) where they end, base frame.  log_apart: (M,) log likelihood of an end
    so far from the nearest wall (apart_m, (M,) ascending, for a beam of no length; 8 % more for each metre of it),
    linear in between.  log_else: (4,) of beams whose end has no wall near: EXPLAINED stands for unknown ground that has
    a wall near, but not as near as VAGUE_M.
    """
    rows, cols = kind.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    total = 0.0
    votes[:] = 0.0
    for i in range(0, len(px), stride):
        sx, sy = pose[0] + c * ox[i] - s * oy[i], pose[1] + s * ox[i] + c * oy[i]
        ex, ey = pose[0] + c * px[i] - s * py[i], pose[1] + s * px[i] + c * py[i]
        z = math.sqrt((ex - sx) ** 2 + (ey - sy) ** 2)
        if z <= 0.0:
            continue
        slack = 0.35 + 0.04 * z
        through, crossed_free = False, z <= slack
        if z > slack:
            _, what = cast(kind, room, nearest, surface, resolution_m, sx, sy, (ex - sx) / z, (ey - sy) / z, z - slack)
            through, crossed_free = what == WALL, what == FREE
        if through:
            votes[THROUGH] += 1.0
            total += log_else[THROUGH]
            continue
        u, v = math.floor(ex / resolution_m), math.floor(ey / resolution_m)
        inside = u >= 0 and v >= 0 and u < cols and v < rows
        free = inside and kind[v, u] == FREE
        d, vague = math.inf, 1.0 + 0.08 * z
        if inside and nearest[v, u] >= 0:
            at = nearest[v, u]
            d = math.sqrt((ex - surface[at, 0]) ** 2 + (ey - surface[at, 1]) ** 2)
        if d <= near_m + 0.01 * z:
            votes[EXPLAINED] += 1.0
        elif free and crossed_free:
            votes[UNEXPECTED] += 1.0
        else:
            votes[UNSEEN] += 1.0
        d /= vague
        if d >= apart_m[-1]:
            total += log_else[UNEXPECTED] if free else log_else[UNSEEN]
        elif inside and kind[v, u] == UNKNOWN and d >= VAGUE_M:
            total += log_else[EXPLAINED]
        else:
            total += _between(apart_m, log_apart, d)
    return total


@njit(cache=True, nogil=True)
def _between(x: Any, y: Any, at: float) -> float:
    """Linear interpolation; x (M,) ascending."""
    if at <= x[0]:
        return float(y[0])
    n = 1
    while n < len(x) - 1 and x[n] < at:
        n += 1
    return float(y[n - 1] + (y[n] - y[n - 1]) * (at - x[n - 1]) / (x[n] - x[n - 1]))


@njit(cache=True, nogil=True)
def judge_many(
    ox: Any, oy: Any, px: Any, py: Any, stride: int, kind: Any, room: Any, nearest: Any, surface: Any,
    resolution_m: float, poses: Any, near_m: float, apart_m: Any, log_apart: Any, log_else: Any,
    votes: Any, logs: Any,
) -> None:  # fmt: skip
    """judge at poses (K, 3): votes (K, 4), logs (K,)."""
    for k in range(len(poses)):
        logs[k] = judge(
            ox, oy, px, py, stride, kind, room, nearest, surface, resolution_m, poses[k], near_m,
            apart_m, log_apart, log_else, votes[k],
        )  # fmt: skip


@njit(cache=True, nogil=True)
def apart(poses: Any, metres: float, radians: float, kept: Any) -> int:
    """kept: gets the rows of poses (K, 3), best first, that lie so far from every one kept before, as many as it holds;
    returns how many there are."""
    count = 0
    for row in range(len(poses)):
        if count == len(kept):
            break
        alone = True
        for n in range(count):
            dx, dy = poses[kept[n], 0] - poses[row, 0], poses[kept[n], 1] - poses[row, 1]
            turned = abs(poses[kept[n], 2] - poses[row, 2]) % (2.0 * math.pi)
            if math.hypot(dx, dy) < metres and min(turned, 2.0 * math.pi - turned) < radians:
                alone = False
                break
        if alone:
            kept[count] = row
            count += 1
    return count
