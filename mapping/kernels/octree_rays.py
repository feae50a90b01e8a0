"""Compiled loops that put a cloud into the octree (S32), then: the voxels before the ends.

Ends are marked first, and rays told apart by the voxel that they end in: a group each. In a dense cloud nearly all
voxels that a ray passes have a mark from another one. So one ray of each group is walked; then it is looked which
voxels of the group's shaft, all that its rays can pass on their way, have no mark yet, and only rays whose directions
may lead through one of those are walked. What is marked in the end is the same, voxel by voxel, as if each was.

Arrays as in mapping.kernels.octree, octree_marks and octree_ends.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.octree import BRICK, BRICK_BITS, LEVELS, reset_path
from mapping.kernels.octree_ends import AXIS, AXIS_BITS, GROUPS, HEAD, RAYS, VOXEL, WALKED, end_of, start_of
from mapping.kernels.octree_marks import NO_ROOM, WORDS, place_of, shortcut_of
from mapping.kernels.octree_shafts import (
    OPEN,
    all_marked,
    first_open_layer,
    open_voxels,
    rays_of_group,
    slopes_of_group,
    slopes_of_voxel,
    still_open,
)

NEAR_LAYERS = 2  # a group nearer than that has no shaft: its rays need not all go forward


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


@njit(cache=True, nogil=True, inline="always")
def walk(
    ray: Any, voxel: Any, refuse: bool, start: Any, end: Any, keep: Any, nodes: Any, bricks: Any, brick_at: Any,
    mark_of: Any, free_nodes: Any, free_bricks: Any, state: Any, touched: Any, left: Any, marks: Any, shortcuts: Any,
    path: Any, refused: Any,
) -> bool:  # fmt: skip
    """Mark the voxels that a ray passes, from the origin up to, without, that of the end [AW87]; False: no room.

    voxel, start, end: (3,) voxel of the end, places in voxels.  refuse: where there is no room, end the ray instead,
    refused[ray] = 1.
    A walk goes from brick to brick, and from voxel to voxel where a brick has voxels without a mark.
    No axis takes more steps than there are borders between the two ends, so rounding cannot make a walk run past.
    """
    x0, y0, z0 = start[0], start[1], start[2]
    ex, ey, ez = end[0], end[1], end[2]
    x1, y1, z1 = voxel[0], voxel[1], voxel[2]
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
                        return False
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
    return True


@njit(cache=True, nogil=True)
def list_rays(head: Any, starts: Any, before: Any, rays: Any) -> Any:
    """rays: (N,) int32 of a group; how many they are."""
    size = np.int64(0)
    run = head
    while run >= 0:
        for i in range(starts[run], starts[run + 1]):
            rays[size] = i
            size += 1
        run = np.int64(before[run])
    return size


@njit(cache=True, nogil=True)
def may_pass(u: float, v: float, count: Any, open_slopes: Any) -> bool:
    """Whether a ray of these slopes may pass one of `count` voxels."""
    may = False
    for q in range(count):
        may |= (open_slopes[0, q] <= u) & (u <= open_slopes[1, q]) & (open_slopes[2, q] <= v) & (v <= open_slopes[3, q])
    return may


@njit(cache=True, nogil=True)
def mark_ways(
    begin: int, refuse: bool, first_only: bool, least: int, many: int, origin: Any, points: Any, resolution: float,
    longest: float, keep: Any, starts: Any, before: Any, groups: Any, count: Any, rays: Any, slope: Any, nodes: Any,
    bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any, free_bricks: Any, state: Any, touched: Any, left: Any,
    marks: Any, shortcuts: Any, path: Any, refused: Any,
) -> int:  # fmt: skip
    """Mark the voxels that the rays of groups pass before they end.

    first_only: one ray of each group that has `least` rays or lies next to the origin, all of others. Else those rays
    of the first kind of groups that may pass a voxel without a mark; the others' are done.  many: rays of a group of
    which first the shaft of the whole voxel is looked through, as to ask each for its slope takes longer.
    keep: the entry that more free evidence does not change: such regions are passed, too.
    Returns g when there is no room for group g, their number at the end. refuse: see `walk`.
    """
    reset_path(path)
    start, end, voxel, slopes = np.empty(3), np.empty(3), np.empty(3, np.int64), np.empty(4)
    open_at, open_slopes = np.empty(OPEN, np.int64), np.empty((4, OPEN))
    scale = np.array([resolution, longest, 0.0, 0.0, 0.0])
    one_origin = origin.shape[0] == 1
    start[0], start[1], start[2] = start_of(np.int64(0), origin, scale)
    for group in range(begin, count[GROUPS]):
        name, head = groups[group, VOXEL], groups[group, HEAD]
        voxel[0], voxel[1], voxel[2] = name & AXIS, name >> AXIS_BITS & AXIS, name >> 2 * AXIS_BITS
        lx, ly, lz = (
            abs(voxel[0] - np.int64(start[0])),
            abs(voxel[1] - np.int64(start[1])),
            abs(voxel[2] - np.int64(start[2])),
        )
        layers = max(lx, max(ly, lz))
        is_near = layers < NEAR_LAYERS
        large = one_origin and (groups[group, RAYS] >= least or is_near)
        if not (first_only or large) or (one_origin and layers == 0):
            continue
        major = 0 if lx == layers else 1 if ly == layers else 2
        forward = voxel[major] > start[major]
        size, wanted = np.int64(0), np.int64(-1)  # voxels without a mark that are known; -1: all may be
        done: Any = np.int64(0)
        by_shaft = False
        if first_only and large:
            size, rays[0] = np.int64(1), starts[head]
        elif first_only:
            size = list_rays(head, starts, before, rays)
        elif is_near:
            ox, oy, oz = np.int64(start[0]), np.int64(start[1]), np.int64(start[2])
            if all_marked(
                min(ox, voxel[0]), max(ox, voxel[0]), min(oy, voxel[1]), max(oy, voxel[1]), min(oz, voxel[2]),
                max(oz, voxel[2]), keep, nodes, mark_of, left, marks, shortcuts, path,
            ):  # fmt: skip
                continue
            size = list_rays(head, starts, before, rays)
        else:
            if groups[group, RAYS] >= many:
                slopes_of_voxel(voxel, major, start, slopes)
                done = first_open_layer(
                    done, major, forward, start, voxel, slopes, keep, nodes, mark_of, left, marks, shortcuts, path
                )  # fmt: skip
                if done > layers:
                    continue
            slopes_of_group(head, starts, before, origin, major, points, slopes)
            done = first_open_layer(
                done, major, forward, start, voxel, slopes, keep, nodes, mark_of, left, marks, shortcuts, path
            )  # fmt: skip
            if done > layers:
                continue
            size, by_shaft = rays_of_group(head, starts, before, origin, major, points, rays, slope), True
        while not by_shaft or done <= layers:
            if by_shaft:
                wanted, done = open_voxels(
                    done, major, forward, start, voxel, slopes, keep, nodes, mark_of, left, marks, shortcuts, path,
                    open_at, open_slopes,
                )  # fmt: skip
                if wanted == 0:
                    continue
            for k in range(size):
                if by_shaft and wanted >= 0 and not may_pass(slope[k, 0], slope[k, 1], wanted, open_slopes):
                    continue
                ray = np.int64(rays[k])
                if not one_origin:
                    start[0], start[1], start[2] = start_of(ray, origin, scale)
                end[0], end[1], end[2], _ = end_of(
                    points[ray, 0], points[ray, 1], points[ray, 2], True, start[0], start[1], start[2], scale
                )  # fmt: skip
                count[WALKED] += 1
                if not walk(
                    ray, voxel, refuse, start, end, keep, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks,
                    state, touched, left, marks, shortcuts, path, refused,
                ):  # fmt: skip
                    return int(group)
                if by_shaft and wanted > 0:
                    wanted = still_open(open_at, open_slopes, wanted, marks)
                    if wanted == 0:
                        break
            if wanted < 0:
                break
    return int(count[GROUPS])
