"""Compiled loops that put a cloud into the octree (S32), first: the voxels that rays end in, and groups of such rays.

What is made of a cloud:

    runs       (N, 3) int32  first and end of rays that end in one voxel one after the other; the group's run before
    groups     (N,) int64    voxel;  members: (N, 2) int32, rays, latest run, -1 at the end
    fans       (N, 4) float32  least and greatest slope of a group's rays, to the axis after the major one and to the
               next: voxels along it for one along the major axis, which is that of the most layers of voxels between
    table      (2^k,) int32  groups by a hash of their voxels, else -1
    count      (COUNT_LENGTH,) int64  see below
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.octree import BRICK, BRICK_BITS, LEVELS, SIDE, reset_path
from mapping.kernels.octree_marks import NO_ROOM, WORDS, place_of, shortcut_of

FREE = 1  # kinds of ends: the ray met nothing there
HIT = 2

RAYS = 0  # of `members`
HEAD = 1

RUNS = 0  # of `count`
GROUPS = 1
SAID_NOTHING = 2
WALKED = 3
COUNT_LENGTH = 4

NEAR_LAYERS = 2  # a group nearer than that is walked ray by ray: its rays need not all go forward
NO_ENTRY = -(1 << 20)  # no entry of a node is this
SLACK = 1e-6  # of a slope: more than 4 bytes round off
MARGIN = 1e-6  # voxels: what rounding may move a ray
AXIS_BITS = LEVELS + BRICK_BITS


@njit(cache=True, nogil=True)
def end_of(px: float, py: float, pz: float, hit: bool, x0: float, y0: float, z0: float, scale: Any) -> Any:
    """(x, y, z, kind) of the ray from (x0, y0, z0) [voxels] to the point (px, py, pz) [m], in voxels.

    kind: 0 says nothing, FREE no obstacle at its end, HIT.  scale: (5,) metres of a voxel, the longest range, the
    origin [m]; a longer ray is cut.
    """
    half = float(SIDE // 2)
    resolution, longest = scale[0], scale[1]
    kind = np.int64(HIT if hit else FREE)
    x, y, z = px / resolution + half, py / resolution + half, pz / resolution + half
    if longest < np.inf:
        dx, dy, dz = px - scale[2], py - scale[3], pz - scale[4]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length > longest:
            cut = longest / length
            x, y, z = x0 + (x - x0) * cut, y0 + (y - y0) * cut, z0 + (z - z0) * cut
            kind = np.int64(FREE)
    if not (0.0 <= x < SIDE and 0.0 <= y < SIDE and 0.0 <= z < SIDE):
        kind = np.int64(0)
    return x, y, z, kind


@njit(cache=True, nogil=True)
def start_of(i: Any, origin: Any, scale: Any) -> Any:
    """(x, y, z) where ray i begins, in voxels; the same in metres into `scale`, see `end_of`."""
    half = float(SIDE // 2)
    scale[2], scale[3], scale[4] = origin[i, 0], origin[i, 1], origin[i, 2]
    return origin[i, 0] / scale[0] + half, origin[i, 1] / scale[0] + half, origin[i, 2] / scale[0] + half


@njit(cache=True, nogil=True)
def group_of(voxel: Any, table: Any, groups: Any, members: Any, fans: Any, count: Any) -> Any:
    """The group of a voxel, an empty one if it is new."""
    mixed = (voxel & 0xFFFFFF) * 0x9E3779 + (voxel >> 24) * 0x85EBCB  # below 2^49
    at = (mixed ^ mixed >> 20) & (table.size - 1)
    group = np.int64(table[at])
    while group >= 0:
        if groups[group] == voxel:
            return group
        at = (at + 1) & (table.size - 1)
        group = np.int64(table[at])
    group = count[GROUPS]
    count[GROUPS] += 1
    table[at] = group
    groups[group], members[group, RAYS], members[group, HEAD] = voxel, 0, -1
    fans[group, 0], fans[group, 1], fans[group, 2], fans[group, 3] = np.inf, -np.inf, np.inf, -np.inf
    return group


@njit(cache=True, nogil=True)
def sure_from(voxel: Any, resolution: float) -> float:
    """Metres from where on a place is in that voxel or one after it, whatever rounding does."""
    return (np.float64(voxel - SIDE // 2) + MARGIN) * resolution


@njit(cache=True, nogil=True)
def widen_fan(fans: Any, group: Any, least_u: float, most_u: float, least_v: float, most_v: float) -> None:
    """Let a group's fan hold these slopes."""
    fans[group, 0] = min(fans[group, 0], np.float32(least_u - SLACK))
    fans[group, 1] = max(fans[group, 1], np.float32(most_u + SLACK))
    fans[group, 2] = min(fans[group, 2], np.float32(least_v - SLACK))
    fans[group, 3] = max(fans[group, 3], np.float32(most_v + SLACK))


@njit(cache=True, nogil=True)
def mark_ends(
    begin: int, refuse: bool, origin: Any, points: Any, resolution: float, longest: float, is_hit: Any, nodes: Any,
    bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any, free_bricks: Any, state: Any, touched: Any, left: Any,
    marks: Any, shortcuts: Any, runs: Any, groups: Any, members: Any, fans: Any, table: Any, count: Any, path: Any,
    refused: Any,
) -> int:  # fmt: skip
    """Mark the voxels of ends as HIT, and put rays into groups by the voxel of their end, from ray `begin` on.

    Returns i when there is no room for the end of ray i, N at the end. refuse: pass such a ray over, refused[i] = 1.
    """
    reset_path(path)
    scale = np.array([resolution, longest, 0.0, 0.0, 0.0])
    one_origin, one_hit = origin.shape[0] == 1, is_hit.size == 1
    cx, cy, cz, seen = np.int64(-1), np.int64(-1), np.int64(-1), np.int64(0)
    run, group = np.int64(-1), np.int64(-1)
    x0, y0, z0 = start_of(np.int64(0), origin, scale)
    own_x, own_y, own_z = np.int64(0), np.int64(0), np.int64(0)
    if one_origin:
        own_x, own_y, own_z = np.int64(x0), np.int64(y0), np.int64(z0)
    low_x, low_y, low_z, high_x, high_y, high_z = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0  # metres: surely in the same voxel
    has_fan: Any = False
    major, a, b = 0, 1, 2
    least_u, most_u, least_v, most_v = np.inf, -np.inf, np.inf, -np.inf
    start_m, start_a, start_b = 0.0, 0.0, 0.0  # metres
    for i in range(begin, points.shape[0]):
        px, py, pz, hit = points[i, 0], points[i, 1], points[i, 2], is_hit[i if not one_hit else 0]
        if (
            low_x <= px <= high_x and low_y <= py <= high_y and low_z <= pz <= high_z and hit == (seen == HIT)
        ):  # fmt: skip
            runs[run, 1] = i + 1
            members[group, RAYS] += 1
            if has_fan:
                to_slope = 1.0 / abs(points[i, major] - start_m)
                u, v = (points[i, a] - start_a) * to_slope, (points[i, b] - start_b) * to_slope
                least_u, most_u, least_v, most_v = min(least_u, u), max(most_u, u), min(least_v, v), max(most_v, v)
            continue
        if run >= 0:
            widen_fan(fans, group, least_u, most_u, least_v, most_v)
        if not one_origin:
            x0, y0, z0 = start_of(i, origin, scale)
        ex, ey, ez, kind = end_of(px, py, pz, hit, x0, y0, z0, scale)
        if not one_origin and not (0.0 <= x0 < SIDE and 0.0 <= y0 < SIDE and 0.0 <= z0 < SIDE):
            kind = np.int64(0)
        if kind == 0:
            count[SAID_NOTHING] += 1
            cx, high_x, run = np.int64(-1), -np.inf, np.int64(-1)
            continue
        x, y, z = np.int64(ex), np.int64(ey), np.int64(ez)
        same = x == cx and y == cy and z == cz
        if kind == HIT and not (same and seen == HIT):
            bx, by, bz = x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS
            cell = shortcut_of(bx, by, bz)
            name = (bz << LEVELS | by) << LEVELS | bx
            if shortcuts[cell, 0] != name:
                place = place_of(
                    bx, by, bz, NO_ENTRY, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks, state, touched,
                    left, path,
                )  # fmt: skip
                if place == NO_ROOM:
                    if not refuse:
                        return int(i)
                    refused[i] = 1
                    cx, high_x, run = np.int64(-1), -np.inf, np.int64(-1)
                    continue
                shortcuts[cell, 0], shortcuts[cell, 1] = name, place
            place = shortcuts[cell, 1]
            at, bit = np.uint64(place * WORDS + (z & 7)), np.uint64(1) << np.uint64((y & 7) << 3 | (x & 7))
            left[place] -= marks[at] & bit == 0
            marks[at] |= bit
            marks[at + np.uint64(BRICK)] |= bit
        if not same:
            cx, cy, cz, seen = x, y, z, kind
            group = group_of((z << AXIS_BITS | y) << AXIS_BITS | x, table, groups, members, fans, count)
            run = count[RUNS]
            count[RUNS] += 1
            runs[run, 0], runs[run, 2] = i, members[group, HEAD]
            members[group, HEAD] = run
            layers = max(abs(x - own_x), max(abs(y - own_y), abs(z - own_z)))
            has_fan = one_origin and layers >= NEAR_LAYERS
            major = 0 if abs(x - own_x) == layers else 1 if abs(y - own_y) == layers else 2
            a, b = (1, 2) if major == 0 else (2, 0) if major == 1 else (0, 1)
            start_m, start_a, start_b = origin[0, major], origin[0, a], origin[0, b]
            least_u, most_u, least_v, most_v = np.inf, -np.inf, np.inf, -np.inf
            if one_origin and longest == np.inf:
                low_x, high_x = sure_from(x, resolution), -sure_from(SIDE - 1 - x, resolution)
                low_y, high_y = sure_from(y, resolution), -sure_from(SIDE - 1 - y, resolution)
                low_z, high_z = sure_from(z, resolution), -sure_from(SIDE - 1 - z, resolution)
        seen = max(seen, kind)
        runs[run, 1] = i + 1
        members[group, RAYS] += 1
        if has_fan:
            to_slope = 1.0 / abs(points[i, major] - start_m)
            u, v = (points[i, a] - start_a) * to_slope, (points[i, b] - start_b) * to_slope
            least_u, most_u, least_v, most_v = min(least_u, u), max(most_u, u), min(least_v, v), max(most_v, v)
    if run >= 0:
        widen_fan(fans, group, least_u, most_u, least_v, most_v)
    return int(points.shape[0])
