"""Compiled loops of the octree's rays (S32): what no ray has marked yet in the shaft that a group of rays passes.

Arrays as in mapping.kernels.octree_marks and octree_ends.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.octree import BRICK, BRICK_BITS, LEVELS, SIDE
from mapping.kernels.octree_marks import KEPT, WORDS, place_if_any, shortcut_of

EACH_ROW = np.uint64(0x0101010101010101)
OPEN = 64  # voxels of a shaft that are looked after at once
MARGIN = 1e-6  # voxels: what rounding may move a ray
SLACK = 1e-8  # of a slope: more than rounding is, which may also move it within MARGIN
TINY = 1e-9  # voxels: nearer to the origin no ray can have left the voxels within MARGIN of it


@njit(cache=True, nogil=True)
def slopes_of_voxel(voxel: Any, major: Any, start: Any, slopes: Any) -> None:
    """slopes: (4,) that no ray from `start` to a place in the voxel exceeds; it is not in the layer of `start`."""
    ahead = voxel[major] - start[major]
    near, far = (ahead, ahead + 1.0) if ahead > 0.0 else (-ahead - 1.0, -ahead)
    for k in range(2):
        axis = (major + 1 + k) % 3
        below, above = voxel[axis] - start[axis] - MARGIN, voxel[axis] + 1 - start[axis] + MARGIN
        slopes[2 * k] = below / (near if below < 0.0 else far)
        slopes[2 * k + 1] = above / (far if above < 0.0 else near)


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
def all_marked(
    low_x: Any, high_x: Any, low_y: Any, high_y: Any, low_z: Any, high_z: Any, keep: Any, nodes: Any, mark_of: Any,
    left: Any, marks: Any, shortcuts: Any, path: Any,
) -> bool:  # fmt: skip
    """Whether each voxel of a box, its borders included, has a mark or lies in a region of entry `keep`."""
    for bz in range(low_z >> BRICK_BITS, (high_z >> BRICK_BITS) + 1):
        for by in range(low_y >> BRICK_BITS, (high_y >> BRICK_BITS) + 1):
            for bx in range(low_x >> BRICK_BITS, (high_x >> BRICK_BITS) + 1):
                cell = shortcut_of(bx, by, bz)
                place = shortcuts[cell, 1]
                if shortcuts[cell, 0] != (bz << LEVELS | by) << LEVELS | bx:
                    place = place_if_any(bx, by, bz, keep, nodes, mark_of, path)
                if place == KEPT:
                    continue
                if place < 0:
                    return False
                if left[np.uint64(place)] == 0:
                    continue
                first_z, end_z = max(low_z - (bz << BRICK_BITS), 0), min(high_z - (bz << BRICK_BITS), 7)
                asked = square_of(
                    low_x - (bx << BRICK_BITS),
                    high_x - (bx << BRICK_BITS),
                    low_y - (by << BRICK_BITS),
                    high_y - (by << BRICK_BITS),
                )
                missing = np.uint64(0)
                for word in range(place * WORDS + first_z, place * WORDS + end_z + 1):
                    missing |= asked & ~marks[np.uint64(word)]
                if missing != 0:
                    return False
    return True


@njit(cache=True, nogil=True)
def square_of(low_x: Any, high_x: Any, low_y: Any, high_y: Any) -> Any:
    """Bits of a word in `marks` from low to high, as far as they lie in it."""
    first_x, end_x, first_y, end_y = max(low_x, 0), min(high_x, 7), max(low_y, 0), min(high_y, 7)
    return np.uint64((1 << (end_x + 1)) - (1 << first_x)) * (
        EACH_ROW >> np.uint64(8 * (7 - end_y + first_y)) << np.uint64(8 * first_y)
    )


@njit(cache=True, nogil=True)
def first_open_layer(
    begin: Any, major: Any, forward: Any, start: Any, last: Any, slopes: Any, keep: Any, nodes: Any, mark_of: Any,
    left: Any, marks: Any, shortcuts: Any, path: Any,
) -> Any:  # fmt: skip
    """The first layer from `begin` on that may have a voxel without a mark in a shaft; behind the last: none has.

    Arguments as of `open_voxels`. It is looked through layers of one brick at once as long as that succeeds.
    """
    a, b = (major + 1) % 3, (major + 2) % 3
    start_m, start_a, start_b = start[major], start[a], start[b]
    own = np.int64(start_m)
    layers = abs(last[major] - own)
    done = np.int64(begin)
    most: Any = np.int64(BRICK)
    while done <= layers:
        first = own + done if forward else own - done
        ahead = BRICK - (first & 7) if forward else (first & 7) + 1
        ahead = min(ahead, min(most, max(layers - done, np.int64(1))))
        near = max(TINY, first - start_m if forward else start_m - (first + 1))
        far = max(TINY, first + ahead - start_m if forward else start_m - (first + 1 - ahead))
        low_a, high_a = bounds_across(start_a, slopes[0], slopes[1], near, far, last[a], done == layers)
        low_b, high_b = bounds_across(start_b, slopes[2], slopes[3], near, far, last[b], done == layers)
        low_m, high_m = (first, first + ahead - 1) if forward else (first + 1 - ahead, first)
        low_x, high_x = (low_m, high_m) if major == 0 else (low_b, high_b) if major == 1 else (low_a, high_a)
        low_y, high_y = (low_a, high_a) if major == 0 else (low_m, high_m) if major == 1 else (low_b, high_b)
        low_z, high_z = (low_b, high_b) if major == 0 else (low_a, high_a) if major == 1 else (low_m, high_m)
        if all_marked(low_x, high_x, low_y, high_y, low_z, high_z, keep, nodes, mark_of, left, marks, shortcuts, path):
            done += ahead
            most = np.int64(BRICK)
        elif ahead == 1:
            return done
        else:
            most = ahead >> 1
    return done


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
                    asked = square_of(first_x, end_x, first_y, end_y)
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
def slopes_of_group(head: Any, starts: Any, before: Any, origin: Any, major: Any, points: Any, slopes: Any) -> None:
    """slopes: (4,) least and greatest of a group's rays, see `open_voxels`."""
    a, b = (major + 1) % 3, (major + 2) % 3
    origin_m, origin_a, origin_b = origin[0, major], origin[0, a], origin[0, b]
    least_u, most_u, least_v, most_v = np.inf, -np.inf, np.inf, -np.inf
    run = head
    while run >= 0:
        for i in range(starts[run], starts[run + 1]):
            to_slope = 1.0 / abs(points[i, major] - origin_m)
            u, v = (points[i, a] - origin_a) * to_slope, (points[i, b] - origin_b) * to_slope
            least_u, most_u, least_v, most_v = min(least_u, u), max(most_u, u), min(least_v, v), max(most_v, v)
        run = np.int64(before[run])
    slopes[0], slopes[1], slopes[2], slopes[3] = least_u - SLACK, most_u + SLACK, least_v - SLACK, most_v + SLACK


@njit(cache=True, nogil=True)
def rays_of_group(
    head: Any, starts: Any, before: Any, origin: Any, major: Any, points: Any, rays: Any, slope: Any
) -> Any:  # fmt: skip
    """rays: (N,) int32 of a group; slope: (N, 2) of each, as in `slopes_of_group`. How many they are."""
    a, b = (major + 1) % 3, (major + 2) % 3
    size = np.int64(0)
    run = head
    while run >= 0:
        for i in range(starts[run], starts[run + 1]):
            to_slope = 1.0 / abs(points[i, major] - origin[0, major])
            rays[size] = i
            slope[size, 0] = (points[i, a] - origin[0, a]) * to_slope
            slope[size, 1] = (points[i, b] - origin[0, b]) * to_slope
            size += 1
        run = np.int64(before[run])
    return size
