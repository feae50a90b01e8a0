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
from mapping.kernels.octree_ends import AXIS_BITS, GROUPS, HEAD, NEAR_LAYERS, RAYS, WALKED, end_of, start_of
from mapping.kernels.octree_marks import NO_ROOM, WORDS, place_of, shortcut_of
from mapping.kernels.octree_shafts import OPEN, open_voxels, rays_of_group, still_open


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
