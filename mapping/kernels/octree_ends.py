"""Compiled loops that put a cloud into the octree (S32), first: the voxels that rays end in, and groups of such rays.

What is made of a cloud:

    names   (N,) int64      where each ray ends: voxel << 1 | 1 for a hit; -1 says nothing
    starts  (N + 1,) int32  first ray of each run of equal names, then N;  before: (N,) int32, the group's run before
    groups  (R, GROUP) int64  see below;  table: (2^k,) int32, groups by a hash of their voxels, else -1
    count   (COUNT_LENGTH,) int64  see below
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.octree import BRICK, BRICK_BITS, LEVELS, SIDE, reset_path
from mapping.kernels.octree_marks import NO_ROOM, WORDS, place_of, shortcut_of

VOXEL = 0  # of `groups`
RAYS = 1
HEAD = 2  # latest run, -1 at the end
MET = 3  # whether one of them is a hit
GROUP = 4

GROUPS = 0  # of `count`
SAID_NOTHING = 1
WALKED = 2
COUNT_LENGTH = 3

NO_ENTRY = -(1 << 20)  # no entry of a node is this
AXIS_BITS = LEVELS + BRICK_BITS
AXIS = (1 << AXIS_BITS) - 1


@njit(cache=True, nogil=True)
def end_of(px: float, py: float, pz: float, hit: bool, x0: float, y0: float, z0: float, scale: Any) -> Any:
    """(x, y, z, kind) of the ray from (x0, y0, z0) [voxels] to the point (px, py, pz) [m], in voxels.

    kind: -1 says nothing, 0 no obstacle at its end, 1 a hit.  scale: (5,) metres of a voxel, the longest range, the
    origin [m]; a longer ray is cut.
    """
    half = float(SIDE // 2)
    resolution, longest = scale[0], scale[1]
    kind = np.int64(1 if hit else 0)
    x, y, z = px / resolution + half, py / resolution + half, pz / resolution + half
    if longest < np.inf:
        dx, dy, dz = px - scale[2], py - scale[3], pz - scale[4]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length > longest:
            cut = longest / length
            x, y, z = x0 + (x - x0) * cut, y0 + (y - y0) * cut, z0 + (z - z0) * cut
            kind = np.int64(0)
    if not (0.0 <= x < SIDE and 0.0 <= y < SIDE and 0.0 <= z < SIDE):
        kind = np.int64(-1)
    return x, y, z, kind


@njit(cache=True, nogil=True)
def start_of(i: Any, origin: Any, scale: Any) -> Any:
    """(x, y, z) where ray i begins, in voxels; the same in metres into `scale`, see `end_of`."""
    half = float(SIDE // 2)
    scale[2], scale[3], scale[4] = origin[i, 0], origin[i, 1], origin[i, 2]
    return origin[i, 0] / scale[0] + half, origin[i, 1] / scale[0] + half, origin[i, 2] / scale[0] + half


@njit(cache=True, nogil=True)
def name_ends(
    origin: Any, points: Any, resolution: float, longest: float, is_hit: Any, names: Any, starts: Any
) -> int:  # fmt: skip
    """Fill `names` and `starts`; how many runs there are."""
    n = points.shape[0]
    half = float(SIDE // 2)
    first_hit = np.int64(1 if is_hit.size > 1 or is_hit[0] else 0)
    if origin.shape[0] == 1 and longest == np.inf:
        for i in range(n):
            x, y, z = (
                points[i, 0] / resolution + half,
                points[i, 1] / resolution + half,
                points[i, 2] / resolution + half,
            )
            inside = (x >= 0.0) & (x < SIDE) & (y >= 0.0) & (y < SIDE) & (z >= 0.0) & (z < SIDE)
            voxel = (np.int64(z) << AXIS_BITS | np.int64(y)) << AXIS_BITS | np.int64(x)
            names[i] = voxel << 1 | first_hit if inside else np.int64(-1)
    else:
        scale = np.array([resolution, longest, 0.0, 0.0, 0.0])
        x0, y0, z0 = start_of(np.int64(0), origin, scale)
        for i in range(n):
            if origin.shape[0] > 1:
                x0, y0, z0 = start_of(i, origin, scale)
            x, y, z, kind = end_of(points[i, 0], points[i, 1], points[i, 2], first_hit == 1, x0, y0, z0, scale)
            names[i] = -1
            if kind >= 0 and 0.0 <= x0 < SIDE and 0.0 <= y0 < SIDE and 0.0 <= z0 < SIDE:
                names[i] = ((np.int64(z) << AXIS_BITS | np.int64(y)) << AXIS_BITS | np.int64(x)) << 1 | kind
    if is_hit.size > 1:
        for i in range(n):
            if names[i] >= 0 and not is_hit[i]:
                names[i] &= ~np.int64(1)
    runs = 0
    last = np.int64(-2)
    for i in range(n):
        starts[runs] = i  # another ray's number after it if this one's run goes on
        runs += names[i] != last
        last = names[i]
    starts[runs] = n
    return runs


@njit(cache=True, nogil=True)
def slot_of(voxel: Any, table: Any, groups: Any) -> Any:
    """Where in `table` the group of a voxel is, or would be."""
    mixed = (voxel & 0xFFFFFF) * 0x9E3779 + (voxel >> 24) * 0x85EBCB  # below 2^49
    at = (mixed ^ mixed >> 20) & (table.size - 1)
    while table[at] >= 0 and groups[np.int64(table[at]), VOXEL] != voxel:
        at = (at + 1) & (table.size - 1)
    return at


@njit(cache=True, nogil=True)
def mark_ends(
    begin: int, refuse: bool, runs: int, names: Any, starts: Any, before: Any, groups: Any, table: Any, count: Any,
    nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any, free_bricks: Any, state: Any, touched: Any,
    left: Any, marks: Any, shortcuts: Any, path: Any, refused: Any,
) -> int:  # fmt: skip
    """Mark the voxels of ends as hits, and put rays into groups by the voxel of their end, from run `begin` on.

    Returns r when there is no room for the end of run r, `runs` at the end. refuse: pass it over, refused = 1 of each.
    """
    reset_path(path)
    for run in range(begin, runs):
        name, first, end = names[starts[run]], np.int64(starts[run]), np.int64(starts[run + 1])
        if name < 0:
            count[SAID_NOTHING] += end - first
            continue
        voxel, met = name >> 1, name & 1
        slot = slot_of(voxel, table, groups)
        group = np.int64(table[slot])
        if met == 1 and (group < 0 or groups[group, MET] == 0):
            x, y, z = voxel & AXIS, voxel >> AXIS_BITS & AXIS, voxel >> 2 * AXIS_BITS
            bx, by, bz = x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS
            cell = shortcut_of(bx, by, bz)
            brick = (bz << LEVELS | by) << LEVELS | bx
            if shortcuts[cell, 0] != brick:
                place = place_of(
                    bx, by, bz, NO_ENTRY, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks, state, touched,
                    left, path,
                )  # fmt: skip
                if place == NO_ROOM:
                    if not refuse:
                        return int(run)
                    refused[first:end] = 1
                    continue
                shortcuts[cell, 0], shortcuts[cell, 1] = brick, place
            place = shortcuts[cell, 1]
            at, bit = np.uint64(place * WORDS + (z & 7)), np.uint64(1) << np.uint64((y & 7) << 3 | (x & 7))
            left[place] -= marks[at] & bit == 0
            marks[at] |= bit
            marks[at + np.uint64(BRICK)] |= bit
        if group < 0:
            group = count[GROUPS]
            count[GROUPS] += 1
            table[slot] = group
            groups[group, VOXEL], groups[group, RAYS], groups[group, HEAD], groups[group, MET] = voxel, 0, -1, 0
        groups[group, RAYS] += end - first
        groups[group, MET] |= met
        before[run] = groups[group, HEAD]
        groups[group, HEAD] = run
    return runs
