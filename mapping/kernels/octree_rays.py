"""Compiled loops that put rays into the octree (S32): a cloud's ends, the voxels before them, and the evidence of both.

Ends are marked first, and rays told apart by the voxel that they end in: a group each. In a dense cloud nearly all
voxels that a ray passes have a mark from another one. So one ray of each group is walked; then it is looked which
voxels of the group's shaft, all that its rays can pass on their way, have no mark yet, and only rays whose directions
may lead through one of those are walked. What is marked in the end is the same, voxel by voxel, as if each was.

The tree's arrays are those of mapping.kernels.octree. What an insertion under way adds:

    marks      (T * WORDS,) uint64  of each touched brick: which voxels have a mark, then which of those a hit; a word
               for each z, a bit for y, x
    touched    (T,) int64    bricks by their place in `marks`;  left: (T,) int32, voxels without a mark of each
    shortcuts  (SHORTCUTS, 2) int64  name of a brick, its place or KEPT; -1, KEPT where there is none yet
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

from mapping.kernels.octree import (
    BRICK,
    BRICK_BITS,
    BRICK_TOP,
    BRICK_VOXELS,
    BRICKS_BACK,
    LEVELS,
    NODE_TOP,
    NODES_BACK,
    SIDE,
    TOUCHED,
    UNKNOWN,
    dissolve_brick,
    find_entry,
    make_brick,
    reset_path,
)

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
KEPT = -1  # a region that is as free as it can be
NO_ROOM = -2
NO_ENTRY = -(1 << 20)  # no entry of a node is this
WORDS = 2 * BRICK  # of 64 voxels: which have a mark, and which of those a hit
EACH_ROW = np.uint64(0x0101010101010101)
OPEN = 64  # voxels of a shaft that are looked after at once
SLACK = 1e-6  # of a slope: more than 4 bytes round off
MARGIN = 1e-6  # voxels: what rounding may move a ray
TINY = 1e-9  # voxels: nearer to the origin no ray can have left the voxels within MARGIN of it
SHORTCUTS = 1 << 13
AXIS_BITS = LEVELS + BRICK_BITS


@njit(cache=True, nogil=True)
def shortcut_of(x: Any, y: Any, z: Any) -> Any:
    """Where the place of a brick is remembered."""
    return (x ^ y << 4 ^ z << 8) & (SHORTCUTS - 1)


@njit(cache=True, nogil=True)
def place_of(
    x: Any, y: Any, z: Any, keep: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any,
    free_bricks: Any, state: Any, touched: Any, left: Any, path: Any,
) -> Any:  # fmt: skip
    """The place in `marks` of a brick, which it is given if it has none, made if need be: or KEPT, or NO_ROOM."""
    entry = find_entry(x, y, z, nodes, path)
    if entry == keep:
        return np.int64(KEPT)
    if entry <= 0:
        for_nodes = (nodes.shape[0] - state[NODE_TOP] + state[NODES_BACK]) // LEVELS
        for_bricks = brick_at.shape[0] - state[BRICK_TOP] + state[BRICKS_BACK]
        if min(for_nodes, min(for_bricks, touched.size - state[TOUCHED])) < 1:
            return np.int64(NO_ROOM)
        entry = make_brick(x, y, z, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks, state, path)
    place = np.int64(mark_of[entry])
    if place < 0:
        place = state[TOUCHED]
        if place == touched.size:
            return np.int64(NO_ROOM)
        touched[place], left[place], mark_of[entry] = entry, BRICK_VOXELS, place
        state[TOUCHED] += 1
    return place


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


@njit(cache=True, nogil=True)
def voxel_at(t: float, ties: bool, v0: float, way: float, per: float, step: Any, first: Any, last: Any) -> Any:
    """The voxel along one axis that a ray is in after all borders that it passes before t, or at t if `ties`.

    Border k is passed at (k - v0) * per, in the very numbers the walk uses.  first, last: the voxels it can be, in
    the order of the ray.
    """
    v = np.int64(math.floor(v0 + way * t)) - step
    if step > 0:
        v = min(max(v, first), last)
        while v < last and ((v + 1 - v0) * per < t or (ties and (v + 1 - v0) * per == t)):
            v += 1
    else:
        v = max(min(v, first), last)
        while v > last and ((v - v0) * per < t or (ties and (v - v0) * per == t)):
            v -= 1
    return v


@njit(cache=True, nogil=True)
def place_if_any(x: Any, y: Any, z: Any, keep: Any, nodes: Any, mark_of: Any, path: Any) -> Any:
    """The place in `marks` of a brick, NO_ROOM if it has none, KEPT if no mark is needed there."""
    entry = find_entry(x, y, z, nodes, path)
    if entry > 0:
        return np.int64(mark_of[entry] if mark_of[entry] >= 0 else NO_ROOM)
    return np.int64(KEPT if entry == keep else NO_ROOM)


@njit(cache=True, nogil=True)
def bounds_across(start: float, least: float, most: float, near: float, far: float, last: Any, is_end: bool) -> Any:
    """Voxels along one axis, low and high, that a shaft touches in a layer from `near` to `far` from the origin.

    is_end: the layer where its rays end, in voxel `last` of this axis.
    """
    if is_end:
        low = np.int64(math.floor(start + least * near - MARGIN))
        high = np.int64(math.floor(start + most * near + MARGIN))
        return min(low, last), max(high, last)
    low = np.int64(math.floor(start + least * (near if least > 0.0 else far) - MARGIN))
    high = np.int64(math.floor(start + most * (near if most < 0.0 else far) + MARGIN))
    return max(low, 0), min(high, SIDE - 1)  # outside of the cube no ray passes


@njit(cache=True, nogil=True)
def open_voxels(
    begin: Any, major: Any, forward: Any, start: Any, last: Any, slopes: Any, keep: Any, nodes: Any,
    mark_of: Any, left: Any, marks: Any, shortcuts: Any, path: Any, open_at: Any, open_slopes: Any,
) -> Any:  # fmt: skip
    """Voxels without a mark in the shaft of a group's rays: (how many, layer to go on with).

    Layer by layer across the major axis, from `begin` layers from the origin's on. No more than OPEN, whole layers; -1
    for the first if not even one layer is so small.
    start: (3,) origin.  last: (3,) voxel where the rays end, which is left out.  slopes: (4,) least and greatest way
    along the next axis a and the one after it, b, for one voxel along the major one.
    open_at: (OPEN,) int64, word and bit of each in `marks`, -1 where there is no brick yet.  open_slopes: (4, OPEN)
    slopes that any ray through it has.  Regions of entry `keep` count as marked.
    """
    a, b = (major + 1) % 3, (major + 2) % 3
    start_m, start_a, start_b = start[major], start[a], start[b]
    last_a, last_b = last[a], last[b]
    own = np.int64(start_m)
    layers = abs(last[major] - own)
    found = 0
    done = np.int64(begin)
    while done <= layers:
        layer = own + done if forward else own - done
        near = max(TINY, layer - start_m if forward else start_m - (layer + 1))
        far = max(TINY, layer + 1 - start_m if forward else start_m - layer)
        low_a, high_a = bounds_across(start_a, float(slopes[0]), float(slopes[1]), near, far, last_a, done == layers)
        low_b, high_b = bounds_across(start_b, float(slopes[2]), float(slopes[3]), near, far, last_b, done == layers)
        if found + (high_a - low_a + 1) * (high_b - low_b + 1) > OPEN:
            return (found if found > 0 else -1), done
        low_x, high_x = (layer, layer) if major == 0 else (low_b, high_b) if major == 1 else (low_a, high_a)
        low_y, high_y = (low_a, high_a) if major == 0 else (layer, layer) if major == 1 else (low_b, high_b)
        low_z, high_z = (low_b, high_b) if major == 0 else (low_a, high_a) if major == 1 else (layer, layer)
        for bz in range(low_z >> BRICK_BITS, (high_z >> BRICK_BITS) + 1):
            for by in range(low_y >> BRICK_BITS, (high_y >> BRICK_BITS) + 1):
                for bx in range(low_x >> BRICK_BITS, (high_x >> BRICK_BITS) + 1):
                    cell = shortcut_of(bx, by, bz)
                    place = shortcuts[cell, 1]
                    if shortcuts[cell, 0] != (bz << LEVELS | by) << LEVELS | bx:
                        place = place_if_any(bx, by, bz, keep, nodes, mark_of, path)
                    if place == KEPT or (place >= 0 and left[np.uint64(place)] == 0):
                        continue
                    first_x, end_x = max(low_x - (bx << BRICK_BITS), 0), min(high_x - (bx << BRICK_BITS), 7)
                    first_y, end_y = max(low_y - (by << BRICK_BITS), 0), min(high_y - (by << BRICK_BITS), 7)
                    first_z, end_z = max(low_z - (bz << BRICK_BITS), 0), min(high_z - (bz << BRICK_BITS), 7)
                    asked = np.uint64((1 << (end_x + 1)) - (1 << first_x)) * (
                        EACH_ROW >> np.uint64(8 * (7 - end_y + first_y)) << np.uint64(8 * first_y)
                    )
                    for vz in range(first_z, end_z + 1):
                        word = place * WORDS + vz
                        missing = asked & ~marks[np.uint64(word)] if place >= 0 else asked
                        if missing == 0:
                            continue
                        for vy in range(first_y, end_y + 1):
                            for vx in range(first_x, end_x + 1):
                                bit = vy << BRICK_BITS | vx
                                if missing >> np.uint64(bit) & np.uint64(1) == 0:
                                    continue
                                x, y, z = bx << BRICK_BITS | vx, by << BRICK_BITS | vy, bz << BRICK_BITS | vz
                                va = y if major == 0 else z if major == 1 else x
                                vb = z if major == 0 else x if major == 1 else y
                                if done == layers and va == last_a and vb == last_b:
                                    continue
                                open_at[found] = word << 6 | bit if place >= 0 else np.int64(-1)
                                below, above = va - start_a - MARGIN, va + 1 - start_a + MARGIN
                                open_slopes[0, found] = below / (near if below < 0.0 else far)
                                open_slopes[1, found] = above / (far if above < 0.0 else near)
                                below, above = vb - start_b - MARGIN, vb + 1 - start_b + MARGIN
                                open_slopes[2, found] = below / (near if below < 0.0 else far)
                                open_slopes[3, found] = above / (far if above < 0.0 else near)
                                found += 1
        done += 1
    return found, done


@njit(cache=True, nogil=True)
def still_open(open_at: Any, open_slopes: Any, count: Any, marks: Any) -> Any:
    """Keep those without a mark; how many they are."""
    kept = 0
    for k in range(count):
        if open_at[k] >= 0 and marks[np.uint64(open_at[k] >> 6)] >> np.uint64(open_at[k] & 63) & np.uint64(1):
            continue
        open_at[kept] = open_at[k]
        for s in range(4):
            open_slopes[s, kept] = open_slopes[s, k]
        kept += 1
    return kept


@njit(cache=True, nogil=True)
def rays_of_group(
    head: Any, runs: Any, start: Any, major: Any, forward: Any, points: Any, scale: Any, rays: Any, slope: Any,
) -> int:  # fmt: skip
    """rays: (N,) int32 of a group, slope: (N, 2) of each, as in `fans`; how many they are."""
    a, b = (major + 1) % 3, (major + 2) % 3
    size = 0
    run = head
    while run >= 0:
        for i in range(runs[run, 0], runs[run, 1]):
            x, y, z, _ = end_of(points[i, 0], points[i, 1], points[i, 2], True, start[0], start[1], start[2], scale)
            wx, wy, wz = x - start[0], y - start[1], z - start[2]
            along = wx if major == 0 else wy if major == 1 else wz
            to_slope = 1.0 / abs(along)
            u = (wx if a == 0 else wy if a == 1 else wz) * to_slope
            v = (wx if b == 0 else wy if b == 1 else wz) * to_slope
            rays[size], slope[size, 0], slope[size, 1] = i, u, v
            size += 1
        run = np.int64(runs[run, 2])
    return size


@njit(cache=True, nogil=True)
def mark_ways(
    begin: int, refuse: bool, first_only: bool, least: int, origin: Any, points: Any, resolution: float,
    longest: float, is_hit: Any, keep: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any,
    free_bricks: Any, state: Any, touched: Any, left: Any, marks: Any, shortcuts: Any, runs: Any, groups: Any,
    members: Any, fans: Any, count: Any, rays: Any, slope: Any, path: Any, refused: Any,
) -> int:  # fmt: skip
    """Mark as FREE the voxels from the origin up to, without, that of the end [AW87], of the rays of groups.

    first_only: one ray of each group of at least `least` rays, all of others. Else those rays of the large groups that
    may pass a voxel without a mark; the others' are done.
    A walk goes from brick to brick, and from voxel to voxel where a brick has voxels without a mark.
    keep: the entry that more free evidence does not change: such regions are passed, too.
    Returns g when there is no room for group g, their number at the end. refuse: end such a ray there, refused[i] = 1.
    No axis takes more steps than there are borders between the two ends, so rounding cannot make a walk run past.
    """
    reset_path(path)
    start, last = np.empty(3), np.empty(3, np.int64)
    slopes = fans[0]
    open_at, open_slopes = np.empty(OPEN, np.int64), np.empty((4, OPEN))
    scale = np.array([resolution, longest, 0.0, 0.0, 0.0])
    x0, y0, z0 = start_of(np.int64(0), origin, scale)
    start[0], start[1], start[2] = x0, y0, z0
    mask = (1 << AXIS_BITS) - 1
    run: Any = np.int64(-1)
    for group in range(begin, count[GROUPS]):
        voxel = groups[group]
        x1, y1, z1 = voxel & mask, voxel >> AXIS_BITS & mask, voxel >> 2 * AXIS_BITS
        last[0], last[1], last[2] = x1, y1, z1
        lx, ly, lz = abs(x1 - np.int64(x0)), abs(y1 - np.int64(y0)), abs(z1 - np.int64(z0))
        layers = max(lx, max(ly, lz))
        large = members[group, RAYS] >= least and layers >= NEAR_LAYERS and origin.shape[0] == 1
        if not (first_only or large):
            continue
        size, wanted = 0, 0
        done: Any = np.int64(0)
        major = 0 if lx == layers else 1 if ly == layers else 2
        forward = last[major] > start[major]
        if first_only:
            run = np.int64(members[group, HEAD])
            while run >= 0:
                for i in range(runs[run, 0], runs[run, 1]):
                    rays[size] = i
                    size += 1
                    if large:
                        break
                run = np.int64(-1 if large else runs[run, 2])
        else:
            slopes = fans[group]
        while first_only or done <= layers:
            if not first_only:
                wanted, done = open_voxels(
                    done, major, forward, start, last, slopes, keep, nodes, mark_of, left, marks, shortcuts,
                    path, open_at, open_slopes,
                )  # fmt: skip
                if wanted == 0:
                    continue
                if size == 0:
                    size = rays_of_group(
                        np.int64(members[group, HEAD]), runs, start, major, forward, points, scale, rays, slope
                    )
            for k in range(size):
                if not first_only and wanted >= 0:
                    u, v = slope[k, 0], slope[k, 1]
                    may = False
                    for q in range(wanted):
                        may |= (
                            (open_slopes[0, q] <= u)
                            & (u <= open_slopes[1, q])
                            & (open_slopes[2, q] <= v)
                            & (v <= open_slopes[3, q])
                        )
                    if not may:
                        continue
                ray = np.int64(rays[k])
                if origin.shape[0] > 1:
                    x0, y0, z0 = start_of(ray, origin, scale)
                ex, ey, ez, _ = end_of(points[ray, 0], points[ray, 1], points[ray, 2], True, x0, y0, z0, scale)
                count[WALKED] += 1
                x, y, z = np.int64(x0), np.int64(y0), np.int64(z0)
                # Border k along an axis is passed at (k - x0) * per_x of the way.
                way_x, way_y, way_z = ex - x0, ey - y0, ez - z0
                per_x = 1.0 / way_x if x1 != x else np.inf
                per_y = 1.0 / way_y if y1 != y else np.inf
                per_z = 1.0 / way_z if z1 != z else np.inf
                sx, sy, sz = (
                    np.int64(1 if x1 >= x else -1),
                    np.int64(1 if y1 >= y else -1),
                    np.int64(1 if z1 >= z else -1),
                )
                ax, ay, az = np.int64(1 if x1 >= x else 0), np.int64(1 if y1 >= y else 0), np.int64(1 if z1 >= z else 0)
                to_x = (x + ax - x0) * per_x if x != x1 else np.inf
                to_y = (y + ay - y0) * per_y if y != y1 else np.inf
                to_z = (z + az - z0) * per_z if z != z1 else np.inf
                steps = abs(x1 - x) + abs(y1 - y) + abs(z1 - z)
                while steps > 0:
                    bx, by, bz = x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS
                    entered, axis = 0.0, -1  # when and across which border, if bricks without holes were passed
                    while True:
                        cell = shortcut_of(bx, by, bz)
                        name = (bz << LEVELS | by) << LEVELS | bx
                        if shortcuts[cell, 0] != name:
                            place = place_of(
                                bx, by, bz, keep, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks, state,
                                touched, left, path,
                            )  # fmt: skip
                            if place == NO_ROOM:
                                if not refuse:
                                    return int(group)
                                refused[ray] = 1
                                steps = np.int64(0)
                                break
                            shortcuts[cell, 0], shortcuts[cell, 1] = name, place
                        place = shortcuts[cell, 1]
                        if place >= 0 and left[place] > 0:
                            break
                        if axis < 0:
                            brick_x = (((bx + ax) << BRICK_BITS) - x0) * per_x if bx != x1 >> BRICK_BITS else np.inf
                            brick_y = (((by + ay) << BRICK_BITS) - y0) * per_y if by != y1 >> BRICK_BITS else np.inf
                            brick_z = (((bz + az) << BRICK_BITS) - z0) * per_z if bz != z1 >> BRICK_BITS else np.inf
                        if brick_x < brick_y and brick_x < brick_z:
                            entered, axis = brick_x, 0
                            bx += sx
                            brick_x = (((bx + ax) << BRICK_BITS) - x0) * per_x if bx != x1 >> BRICK_BITS else np.inf
                        elif brick_y < brick_z:
                            entered, axis = brick_y, 1
                            by += sy
                            brick_y = (((by + ay) << BRICK_BITS) - y0) * per_y if by != y1 >> BRICK_BITS else np.inf
                        elif brick_z < np.inf:
                            entered, axis = brick_z, 2
                            bz += sz
                            brick_z = (((bz + az) << BRICK_BITS) - z0) * per_z if bz != z1 >> BRICK_BITS else np.inf
                        else:
                            steps = np.int64(0)
                            break
                    if steps == 0:
                        break
                    if axis >= 0:
                        low_x, low_y, low_z = bx << BRICK_BITS, by << BRICK_BITS, bz << BRICK_BITS
                        x = low_x + (0 if sx > 0 else BRICK - 1)
                        y = low_y + (0 if sy > 0 else BRICK - 1)
                        z = low_z + (0 if sz > 0 else BRICK - 1)
                        last_x = x1 if bx == x1 >> BRICK_BITS else low_x + (BRICK - 1 if sx > 0 else 0)
                        last_y = y1 if by == y1 >> BRICK_BITS else low_y + (BRICK - 1 if sy > 0 else 0)
                        last_z = z1 if bz == z1 >> BRICK_BITS else low_z + (BRICK - 1 if sz > 0 else 0)
                        # What began in this brick's slab has not come from its border.
                        x = np.int64(x0) if bx == np.int64(x0) >> BRICK_BITS else x
                        y = np.int64(y0) if by == np.int64(y0) >> BRICK_BITS else y
                        z = np.int64(z0) if bz == np.int64(z0) >> BRICK_BITS else z
                        if axis != 0:
                            x = voxel_at(entered, False, x0, way_x, per_x, sx, x, last_x)
                        if axis != 1:
                            y = voxel_at(entered, axis == 0, y0, way_y, per_y, sy, y, last_y)
                        if axis != 2:
                            z = voxel_at(entered, True, z0, way_z, per_z, sz, z, last_z)
                        to_x = (x + ax - x0) * per_x if x != x1 else np.inf
                        to_y = (y + ay - y0) * per_y if y != y1 else np.inf
                        to_z = (z + az - z0) * per_z if z != z1 else np.inf
                        steps = abs(x1 - x) + abs(y1 - y) + abs(z1 - z)
                    base = place * WORDS
                    fresh = 0
                    while steps > 0:
                        at, bit = np.uint64(base + (z & 7)), np.uint64(1) << np.uint64((y & 7) << 3 | (x & 7))
                        fresh += marks[at] & bit == 0
                        marks[at] |= bit
                        steps -= 1
                        if to_x < to_y and to_x < to_z:
                            x += sx
                            to_x = (x + ax - x0) * per_x if x != x1 else np.inf
                            if x >> BRICK_BITS != bx:
                                break
                        elif to_y < to_z:
                            y += sy
                            to_y = (y + ay - y0) * per_y if y != y1 else np.inf
                            if y >> BRICK_BITS != by:
                                break
                        else:
                            z += sz
                            to_z = (z + az - z0) * per_z if z != z1 else np.inf
                            if z >> BRICK_BITS != bz:
                                break
                    left[place] -= fresh
                if not first_only and wanted > 0:
                    wanted = still_open(open_at, open_slopes, wanted, marks)
                    if wanted == 0:
                        break
            if first_only or wanted < 0:
                break
    return int(count[GROUPS])


@njit(cache=True, nogil=True)
def settle(
    hit: Any, miss: Any, lowest: Any, highest: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any,
    free_nodes: Any, free_bricks: Any, state: Any, touched: Any, marks: Any, path: Any,
) -> None:  # fmt: skip
    """End of an insertion: each marked voxel gets its evidence, once; bricks that are of one value leave the pool."""
    for k in range(state[TOUCHED]):
        slot = np.int64(touched[k])
        low, high = np.int32(127), np.int32(-128)
        for z in range(BRICK):
            base, word = np.uint64(slot * BRICK_VOXELS + z * 64), np.uint64(k * WORDS + z)
            marked, met = marks[word], marks[word + np.uint64(BRICK)]
            marks[word], marks[word + np.uint64(BRICK)] = 0, 0
            for v in range(np.uint64(64)):
                value = np.int32(bricks[base + v])
                known = np.int32(0) if value == UNKNOWN else value
                known += np.int32(hit) if met >> v & np.uint64(1) else np.int32(-miss)
                known = min(max(known, np.int32(lowest)), np.int32(highest))
                value = known if marked >> v & np.uint64(1) else value
                bricks[base + v] = np.int8(value)
                low, high = min(low, value), max(high, value)
        mark_of[slot] = -1
        if low == high:
            touched[k] = -slot
    for k in range(state[TOUCHED]):
        if touched[k] < 0:
            dissolve_brick(np.int64(-touched[k]), nodes, bricks, brick_at, free_nodes, free_bricks, state, path)
    state[TOUCHED] = 0
