"""Compiled loops of the octree (S32): rays into voxels, look-ups, sums of two trees, pruning, bytes.

The tree ends in bricks of 8 x 8 x 8 voxels, so that a ray walks arrays and goes through the tree only from brick to
brick, and there from the deepest node that the two have in common. LEVELS levels of nodes stand above the bricks:
level l chooses a child by bit l of the brick's coordinates.

    nodes     (M, 8) int32   a child each: 0 unknown; above 0 a node, or at level 0 a brick; below 0 one value for all
                             of it, value - UNIFORM.  nodes[0] is the root
    bricks    (B * 512,) int8  log-odds in steps, UNKNOWN never observed; [z, y, x] within a brick.  Brick 0 is not used
    brick_at  (B, 3) int32   x, y, z of each brick
    mark_of   (B,) int32     its place in `marks` during an insertion, else -1
    marks     (T * 512,) uint8  what this insertion says of each voxel: 0 nothing, FREE, HIT; all 0 between insertions
    state     (5,) int64     see below; free_nodes, free_bricks: stacks of what was given back

Of a dense cloud from one place (a depth image) nearly all voxels that a ray passes have a mark already. So rays are
told apart by tiles of directions; some of each tile are walked, then it is looked how far the whole pyramid over a tile
is marked, and the others begin there. What is marked in the end is the same, voxel by voxel.

Coordinates are in voxels, from 0 to SIDE; the caller has moved the origin to the middle.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

LEVELS = 13
BRICK_BITS = 3
BRICK = 1 << BRICK_BITS
BRICK_VOXELS = BRICK**3
SIDE = 1 << (LEVELS + BRICK_BITS)  # voxels along an edge of the root

UNKNOWN = -128
UNIFORM = 256

FREE = 1
HIT = 2

NODE_TOP = 0  # nodes ever used; those given back lie on a stack
NODES_BACK = 1
BRICK_TOP = 2
BRICKS_BACK = 3
TOUCHED = 4
STATE_LENGTH = 5

TILES = 96  # along an edge of the cube of directions
TILE_LEAST = 32  # rays of a tile, for it to be looked at as a whole
TILE_MARGIN = 1e-6  # voxels: what rounding may move a ray
SHORTCUTS = 1 << 13
PATH_LENGTH = LEVELS + 4  # nodes from the brick's parent up, then x, y, z of the brick, then the lowest valid level
_X, _Y, _Z, _LOW = LEVELS, LEVELS + 1, LEVELS + 2, LEVELS + 3


@njit(cache=True, nogil=True)
def new_node(nodes: Any, free_nodes: Any, state: Any, content: Any) -> Any:
    """A node whose children all are `content`; there must be room."""
    if state[NODES_BACK] > 0:
        state[NODES_BACK] -= 1
        node = np.int64(free_nodes[state[NODES_BACK]])
    else:
        node = state[NODE_TOP]
        state[NODE_TOP] += 1
    for k in range(8):
        nodes[node, k] = content
    return node


@njit(cache=True, nogil=True)
def new_brick(
    x: Any, y: Any, z: Any, content: Any, bricks: Any, brick_at: Any, mark_of: Any, free_bricks: Any, state: Any
) -> Any:
    """A brick filled with what a child entry said; there must be room."""
    if state[BRICKS_BACK] > 0:
        state[BRICKS_BACK] -= 1
        slot = np.int64(free_bricks[state[BRICKS_BACK]])
    else:
        slot = state[BRICK_TOP]
        state[BRICK_TOP] += 1
    value = np.int8(UNKNOWN if content == 0 else content + UNIFORM)
    base = np.uint64(slot * BRICK_VOXELS)
    for k in range(np.uint64(BRICK_VOXELS)):
        bricks[base + k] = value
    brick_at[slot, 0], brick_at[slot, 1], brick_at[slot, 2] = x, y, z
    mark_of[slot] = -1
    return slot


@njit(cache=True, nogil=True)
def reset_path(path: Any) -> None:
    """Begin at the root. path: (PATH_LENGTH,) int64."""
    path[_X], path[_Y], path[_Z] = 0, 0, 0
    path[_LOW] = LEVELS - 1
    path[LEVELS - 1] = 0


@njit(cache=True, nogil=True)
def common_level(x: Any, y: Any, z: Any, path: Any) -> Any:
    """Level of the deepest node that the path and brick (x, y, z) share."""
    differ = (x ^ path[_X]) | (y ^ path[_Y]) | (z ^ path[_Z])
    level = np.int64(path[_LOW])
    while differ >> (level + 1):
        level += 1
    return level


@njit(cache=True, nogil=True)
def find_entry(x: Any, y: Any, z: Any, nodes: Any, path: Any) -> Any:
    """The entry that holds brick (x, y, z): a brick (above 0), or what is said of all around it (0 or below)."""
    level = common_level(x, y, z, path)
    path[_X], path[_Y], path[_Z] = x, y, z
    while True:
        octant = ((z >> level) & 1) << 2 | ((y >> level) & 1) << 1 | ((x >> level) & 1)
        entry = np.int64(nodes[path[level], octant])
        if entry <= 0 or level == 0:
            path[_LOW] = level
            return entry
        level -= 1
        path[level] = entry


@njit(cache=True, nogil=True)
def make_brick(
    x: Any, y: Any, z: Any, keep: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any,
    free_bricks: Any, state: Any, path: Any,
) -> Any:  # fmt: skip
    """The brick (x, y, z), made if need be; 0 and nothing changed if all around it has the value of entry `keep`."""
    entry = find_entry(x, y, z, nodes, path)
    if entry > 0:
        return entry
    if entry == keep:
        return np.int64(0)
    level = path[_LOW]
    while level > 0:
        octant = ((z >> level) & 1) << 2 | ((y >> level) & 1) << 1 | ((x >> level) & 1)
        node = new_node(nodes, free_nodes, state, entry)
        nodes[path[level], octant] = node
        level -= 1
        path[level] = node
    path[_LOW] = 0
    slot = new_brick(x, y, z, entry, bricks, brick_at, mark_of, free_bricks, state)
    nodes[path[0], (z & 1) << 2 | (y & 1) << 1 | (x & 1)] = slot
    return slot


@njit(cache=True, nogil=True)
def place_in_marks(slot: Any, mark_of: Any, touched: Any, left: Any, state: Any) -> Any:
    """The place of a brick among those touched, which it is from now on."""
    place = np.int64(mark_of[slot])
    if place < 0:
        place = state[TOUCHED]
        touched[place] = slot
        left[place] = BRICK_VOXELS
        mark_of[slot] = place
        state[TOUCHED] += 1
    return place


@njit(cache=True, nogil=True)
def room_left(nodes: Any, brick_at: Any, touched: Any, state: Any) -> Any:
    """How many bricks, each with all its nodes, can still be made and marked."""
    for_nodes = (nodes.shape[0] - state[NODE_TOP] + state[NODES_BACK]) // LEVELS
    for_bricks = brick_at.shape[0] - state[BRICK_TOP] + state[BRICKS_BACK]
    return min(for_nodes, min(for_bricks, touched.size - state[TOUCHED]))


@njit(cache=True, nogil=True)
def shortcut_of(x: Any, y: Any, z: Any) -> Any:
    """Where the place of a brick is remembered. shortcuts: (SHORTCUTS, 2) int64, name of the brick, its place or -1."""
    return (x ^ y << 4 ^ z << 8) & (SHORTCUTS - 1)


@njit(cache=True, nogil=True)
def place_rays(
    origin: Any, points: Any, resolution: float, longest: float, is_hit: Any, end: Any, kind: Any
) -> int:  # fmt: skip
    """Rays in voxels, cut to `longest`; how many say nothing, being not finite or not in the cube.

    origin: (1, 3) or (N, 3), points: (N, 3) metres.  is_hit: (N,), or (1,) for all.
    end: (N, 3) voxels.  kind: (N,) uint8, 0 says nothing, FREE no obstacle at its end, HIT.
    """
    said_nothing = 0
    half = float(SIDE // 2)
    for i in range(points.shape[0]):
        o = min(i, origin.shape[0] - 1)
        kind[i] = HIT if is_hit[min(i, is_hit.size - 1)] else FREE
        scale = 1.0
        if longest < np.inf:
            dx, dy, dz = points[i, 0] - origin[o, 0], points[i, 1] - origin[o, 1], points[i, 2] - origin[o, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length > longest:
                scale = longest / length
                kind[i] = FREE
        for axis in range(3):
            start = origin[o, axis] / resolution + half
            value = points[i, axis] / resolution + half
            if scale < 1.0:
                value = start + (value - start) * scale
            if not (0.0 <= value < SIDE and 0.0 <= start < SIDE):
                kind[i] = 0
            end[i, axis] = value
        said_nothing += kind[i] == 0
    return said_nothing


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
def tiles_of_rays(origin: Any, resolution: float, end: Any, kind: Any, tile: Any, layers: Any) -> None:
    """Rays from one origin (1, 3) by direction: tile (N,) int32, -1 for those that say nothing.

    A tile is a square of TILES x TILES on a face of a cube around the origin: all its rays have the same major axis,
    the one along which they go farthest, and none is outside of the pyramid over it.
    layers: (N,) int32, layers of voxels across the major axis from the origin's to that of the end.
    """
    half = float(SIDE // 2)
    x0, y0, z0 = origin[0, 0] / resolution + half, origin[0, 1] / resolution + half, origin[0, 2] / resolution + half
    x, y, z = np.int64(x0), np.int64(y0), np.int64(z0)
    for i in range(end.shape[0]):
        tile[i] = -1
        if kind[i] == 0:
            continue
        dx, dy, dz = end[i, 0] - x0, end[i, 1] - y0, end[i, 2] - z0
        if abs(dx) >= abs(dy) and abs(dx) >= abs(dz):
            major, along, u, v = 0, dx, dy, dz
            layers[i] = abs(np.int64(end[i, 0]) - x)
        elif abs(dy) >= abs(dz):
            major, along, u, v = 1, dy, dz, dx
            layers[i] = abs(np.int64(end[i, 1]) - y)
        else:
            major, along, u, v = 2, dz, dx, dy
            layers[i] = abs(np.int64(end[i, 2]) - z)
        if along == 0.0:
            continue
        to_tiles = 0.5 * TILES / abs(along)
        at_u: Any = min(max(np.int64(u * to_tiles + 0.5 * TILES), 0), TILES - 1)
        at_v: Any = min(max(np.int64(v * to_tiles + 0.5 * TILES), 0), TILES - 1)
        tile[i] = ((2 * major + (1 if along > 0.0 else 0)) * TILES + at_v) * TILES + at_u


@njit(cache=True, nogil=True)
def order_of_tiles(tile: Any) -> Any:
    """(order, first): rays of tile t are order[first[t]: first[t + 1]], in their order; those of none are left out."""
    first = np.zeros(6 * TILES * TILES + 1, np.int64)
    for i in range(tile.size):
        if tile[i] >= 0:
            first[tile[i] + 1] += 1
    for t in range(first.size - 1):
        first[t + 1] += first[t]
    fill, order = first[:-1].copy(), np.empty(first[-1], np.int64)
    for i in range(tile.size):
        t = tile[i]
        if t >= 0:
            order[fill[t]] = i
            fill[t] += 1
    return order, first


@njit(cache=True, nogil=True)
def some_and_rest(order: Any, first: Any, stride: int) -> Any:
    """Every stride-th ray of each tile, all of those of less than TILE_LEAST; and the rest, in the order of the cloud,
    in which ends and points lie in memory."""
    chosen = np.empty(order.size, np.int64)
    is_rest = np.zeros(0 if order.size == 0 else order.max() + 1, np.bool_)
    count = 0
    for t in range(first.size - 1):
        size = first[t + 1] - first[t]
        for k in range(size):
            i = order[first[t] + k]
            if size < TILE_LEAST or k % stride == 0:
                chosen[count] = i
                count += 1
            else:
                is_rest[i] = True
    return chosen[:count], np.flatnonzero(is_rest)


@njit(cache=True, nogil=True)
def marked_layers(
    order: Any, first: Any, layers: Any, origin: Any, resolution: float, keep: Any, nodes: Any, mark_of: Any,
    marks: Any, path: Any, skip: Any,
) -> None:  # fmt: skip
    """How far the rays of a tile need not be walked: skip (N,) int32 becomes layers << 2 | major axis.

    Layer by layer from the origin on, as long as every voxel that the tile's pyramid touches there has a mark (or is
    within a region of entry `keep`): then so has every voxel of each of its rays. No farther than the layer in which
    the first of them ends. Tiles of less than TILE_LEAST rays are left alone.
    """
    reset_path(path)
    half = float(SIDE // 2)
    start, low, high = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        start[axis] = origin[0, axis] / resolution + half
    known_x, known_y, known_z, place = np.int64(-1), np.int64(-1), np.int64(-1), np.int64(-1)
    for t in range(first.size - 1):
        if first[t + 1] - first[t] < TILE_LEAST:
            continue
        major, up = t // (TILES * TILES) // 2, t // (TILES * TILES) % 2
        a, b = (major + 1) % 3, (major + 2) % 3
        u, v = (t % TILES) * (2.0 / TILES) - 1.0, (t // TILES % TILES) * (2.0 / TILES) - 1.0
        most = np.int64(SIDE)
        for k in range(first[t], first[t + 1]):
            most = min(most, np.int64(layers[order[k]]))
        done: Any = np.int64(0)
        own = np.int64(start[major])
        while done < most:
            layer = own + done if up else own - done
            near = 0.0 if done == 0 else (layer - start[major] if up else start[major] - (layer + 1))
            far = layer + 1 - start[major] if up else start[major] - layer
            for axis, edge in ((a, u), (b, v)):
                other = edge + 2.0 / TILES
                low[axis] = np.int64(math.floor(start[axis] + min(edge * near, edge * far) - TILE_MARGIN))
                high[axis] = np.int64(math.floor(start[axis] + max(other * near, other * far) + TILE_MARGIN))
            low[major], high[major] = layer, layer
            whole = min(low[0], min(low[1], low[2])) >= 0 and max(high[0], max(high[1], high[2])) < SIDE
            z = low[2]
            while whole and z <= high[2]:
                y = low[1]
                while whole and y <= high[1]:
                    x = low[0]
                    while whole and x <= high[0]:
                        bx, by, bz = x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS
                        if bx != known_x or by != known_y or bz != known_z:
                            known_x, known_y, known_z = bx, by, bz
                            entry = find_entry(bx, by, bz, nodes, path)
                            place = np.int64(mark_of[entry]) if entry > 0 else np.int64(-2 if entry == keep else -1)
                        if place >= 0:
                            at = np.uint64(place * BRICK_VOXELS + ((z & 7) << 6 | (y & 7) << 3 | (x & 7)))
                            whole = marks[at] != 0
                        else:
                            whole = place == -2
                        x += 1
                    y += 1
                z += 1
            if not whole:
                break
            done += 1
        for k in range(first[t], first[t + 1]):
            skip[order[k]] = done << 2 | major


@njit(cache=True, nogil=True)
def mark_rays(
    begin: int, order: Any, skip: Any, origin: Any, resolution: float, end: Any, kind: Any, keep: Any, refuse: bool,
    nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any, free_bricks: Any, state: Any, touched: Any,
    left: Any, marks: Any, shortcuts: Any, path: Any, refused: Any,
) -> int:  # fmt: skip
    """Mark as FREE the voxels from origin up to, without, the one of end[i], for i of order (M,) from begin on [AW87].

    The walk goes from brick to brick, and from voxel to voxel where a brick has voxels without a mark: with many
    points a scan those are few.  left: (T,) int32, voxels without a mark of each touched brick.
    keep: the entry that more free evidence does not change: such regions are passed, too.  skip: (N,) as
    `marked_layers` has it, what need not be walked; 0 is all from the origin on.
    Returns k when there is no room for ray order[k], M at the end. refuse: pass such a ray over, refused[i] = 1.
    No axis takes more steps than there are borders between the two ends, so rounding cannot make a walk run past.
    """
    reset_path(path)
    half = float(SIDE // 2)
    budget: Any = np.int64(0)
    x0, y0, z0 = origin[0, 0] / resolution + half, origin[0, 1] / resolution + half, origin[0, 2] / resolution + half
    for k in range(begin, order.size):
        i = np.uint64(order[k])
        if kind[i] == 0:
            continue
        if origin.shape[0] > 1:
            x0 = origin[i, 0] / resolution + half
            y0 = origin[i, 1] / resolution + half
            z0 = origin[i, 2] / resolution + half
        x, y, z = np.int64(x0), np.int64(y0), np.int64(z0)
        x1, y1, z1 = np.int64(end[i, 0]), np.int64(end[i, 1]), np.int64(end[i, 2])
        # Border k along an axis is passed at (k - x0) * per_x of the way.
        way_x, way_y, way_z = end[i, 0] - x0, end[i, 1] - y0, end[i, 2] - z0
        per_x = 1.0 / way_x if x1 != x else np.inf
        per_y = 1.0 / way_y if y1 != y else np.inf
        per_z = 1.0 / way_z if z1 != z else np.inf
        sx, sy, sz = np.int64(1 if x1 >= x else -1), np.int64(1 if y1 >= y else -1), np.int64(1 if z1 >= z else -1)
        ax, ay, az = np.int64(1 if x1 >= x else 0), np.int64(1 if y1 >= y else 0), np.int64(1 if z1 >= z else 0)
        if skip[i] >> 2:  # as if it had come so far, in the order of borders that the walk has
            layer, major = np.int64(skip[i] >> 2), skip[i] & 3
            if major == 0:
                x += sx * layer
                t = (x + 1 - ax - x0) * per_x
                y = voxel_at(t, True, y0, way_y, per_y, sy, y, y1)
                z = voxel_at(t, True, z0, way_z, per_z, sz, z, z1)
            elif major == 1:
                y += sy * layer
                t = (y + 1 - ay - y0) * per_y
                x = voxel_at(t, False, x0, way_x, per_x, sx, x, x1)
                z = voxel_at(t, True, z0, way_z, per_z, sz, z, z1)
            else:
                z += sz * layer
                t = (z + 1 - az - z0) * per_z
                x = voxel_at(t, False, x0, way_x, per_x, sx, x, x1)
                y = voxel_at(t, False, y0, way_y, per_y, sy, y, y1)
        bx, by, bz = x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS
        bx1, by1, bz1 = x1 >> BRICK_BITS, y1 >> BRICK_BITS, z1 >> BRICK_BITS
        wanted = abs(bx1 - bx) + abs(by1 - by) + abs(bz1 - bz) + 1
        if wanted > budget:
            budget = np.int64(room_left(nodes, brick_at, touched, state))
            if wanted > budget:
                if not refuse:
                    return k
                refused[i] = 1
                continue
        brick_x = (((bx + ax) << BRICK_BITS) - x0) * per_x if bx != bx1 else np.inf
        brick_y = (((by + ay) << BRICK_BITS) - y0) * per_y if by != by1 else np.inf
        brick_z = (((bz + az) << BRICK_BITS) - z0) * per_z if bz != bz1 else np.inf
        entered, axis = 0.0, -1  # when and across which border
        while True:
            cell = shortcut_of(bx, by, bz)
            name = (bz << LEVELS | by) << LEVELS | bx
            if shortcuts[cell, 0] != name:
                slot = make_brick(
                    bx, by, bz, keep, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks, state, path
                )  # fmt: skip
                shortcuts[cell, 0] = name
                shortcuts[cell, 1] = place_in_marks(slot, mark_of, touched, left, state) if slot > 0 else -1
                budget -= 1
            place = shortcuts[cell, 1]
            if place >= 0 and left[place] > 0:
                if axis >= 0:
                    low_x, low_y, low_z = bx << BRICK_BITS, by << BRICK_BITS, bz << BRICK_BITS
                    x = low_x + (0 if sx > 0 else BRICK - 1)
                    y = low_y + (0 if sy > 0 else BRICK - 1)
                    z = low_z + (0 if sz > 0 else BRICK - 1)
                    last_x = x1 if bx == bx1 else low_x + (BRICK - 1 if sx > 0 else 0)
                    last_y = y1 if by == by1 else low_y + (BRICK - 1 if sy > 0 else 0)
                    last_z = z1 if bz == bz1 else low_z + (BRICK - 1 if sz > 0 else 0)
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
                base = place * BRICK_VOXELS
                fresh = 0
                to_x = (x + ax - x0) * per_x if x != x1 else np.inf
                to_y = (y + ay - y0) * per_y if y != y1 else np.inf
                to_z = (z + az - z0) * per_z if z != z1 else np.inf
                while not (x == x1 and y == y1 and z == z1):
                    at = np.uint64(base + ((z & 7) << 6 | (y & 7) << 3 | (x & 7)))
                    fresh += marks[at] == 0
                    marks[at] = FREE
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
            if brick_x < brick_y and brick_x < brick_z:
                entered, axis = brick_x, 0
                bx += sx
                brick_x = (((bx + ax) << BRICK_BITS) - x0) * per_x if bx != bx1 else np.inf
            elif brick_y < brick_z:
                entered, axis = brick_y, 1
                by += sy
                brick_y = (((by + ay) << BRICK_BITS) - y0) * per_y if by != by1 else np.inf
            elif brick_z < np.inf:
                entered, axis = brick_z, 2
                bz += sz
                brick_z = (((bz + az) << BRICK_BITS) - z0) * per_z if bz != bz1 else np.inf
            else:
                break
    return int(order.size)


@njit(cache=True, nogil=True)
def mark_hits(
    begin: int, end: Any, kind: Any, refuse: bool, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any,
    free_nodes: Any, free_bricks: Any, state: Any, touched: Any, left: Any, marks: Any, shortcuts: Any, path: Any,
    refused: Any,
) -> int:  # fmt: skip
    """Mark as HIT, over what rays said, the voxels of the ends of that kind; otherwise as mark_rays."""
    reset_path(path)
    for i in range(begin, end.shape[0]):
        if kind[i] != HIT:
            continue
        x, y, z = np.int64(end[i, 0]), np.int64(end[i, 1]), np.int64(end[i, 2])
        bx, by, bz = x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS
        cell = shortcut_of(bx, by, bz)
        name = (bz << LEVELS | by) << LEVELS | bx
        if shortcuts[cell, 0] != name or shortcuts[cell, 1] < 0:
            if room_left(nodes, brick_at, touched, state) < 1:
                if not refuse:
                    return i
                refused[i] = 1
                continue
            slot = make_brick(bx, by, bz, 1, nodes, bricks, brick_at, mark_of, free_nodes, free_bricks, state, path)
            shortcuts[cell, 0] = name
            shortcuts[cell, 1] = place_in_marks(slot, mark_of, touched, left, state)
        at = np.uint64(shortcuts[cell, 1] * BRICK_VOXELS + ((z & 7) << 6 | (y & 7) << 3 | (x & 7)))
        marks[at] = HIT
    return int(end.shape[0])


@njit(cache=True, nogil=True)
def settle(
    hit: Any, miss: Any, lowest: Any, highest: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any,
    free_nodes: Any, free_bricks: Any, state: Any, touched: Any, marks: Any, path: Any,
) -> None:  # fmt: skip
    """End of an insertion: each marked voxel gets its evidence, once; bricks that are of one value leave the pool."""
    for k in range(state[TOUCHED]):
        slot = np.int64(touched[k])
        base, from_mark = np.uint64(slot * BRICK_VOXELS), np.uint64(k * BRICK_VOXELS)
        low, high = np.int32(127), np.int32(-128)
        for v in range(np.uint64(BRICK_VOXELS)):
            value = np.int32(bricks[base + v])
            mark = marks[from_mark + v]
            known = np.int32(0) if value == UNKNOWN else value
            known += np.int32(hit) if mark == HIT else np.int32(-miss)
            known = min(max(known, np.int32(lowest)), np.int32(highest))
            value = value if mark == 0 else known
            bricks[base + v] = np.int8(value)
            marks[from_mark + v] = 0
            low, high = min(low, value), max(high, value)
        mark_of[slot] = -1
        if low == high:
            touched[k] = -slot
    for k in range(state[TOUCHED]):
        if touched[k] < 0:
            dissolve_brick(np.int64(-touched[k]), nodes, bricks, brick_at, free_nodes, free_bricks, state, path)
    state[TOUCHED] = 0


@njit(cache=True, nogil=True)
def dissolve_brick(
    slot: Any, nodes: Any, bricks: Any, brick_at: Any, free_nodes: Any, free_bricks: Any, state: Any, path: Any
) -> None:
    """A brick of one value becomes an entry of its node, eight equal entries one of the node above, and so on."""
    x, y, z = np.int64(brick_at[slot, 0]), np.int64(brick_at[slot, 1]), np.int64(brick_at[slot, 2])
    value = np.int64(bricks[slot * BRICK_VOXELS])
    entry = np.int64(0) if value == UNKNOWN else value - UNIFORM
    reset_path(path)
    find_entry(x, y, z, nodes, path)
    free_bricks[state[BRICKS_BACK]] = slot
    state[BRICKS_BACK] += 1
    for level in range(LEVELS):
        octant = ((z >> level) & 1) << 2 | ((y >> level) & 1) << 1 | ((x >> level) & 1)
        node = path[level]
        nodes[node, octant] = entry
        if level == LEVELS - 1:
            break
        for k in range(8):
            if nodes[node, k] != entry:
                return
        free_nodes[state[NODES_BACK]] = node
        state[NODES_BACK] += 1


@njit(cache=True, nogil=True)
def values_at(points: Any, nodes: Any, bricks: Any, path: Any, out: Any) -> None:
    """out: (N,) int8 of (N, 3) places in voxels; UNKNOWN for what is not in the tree's cube or not a number."""
    reset_path(path)
    for i in range(points.shape[0]):
        out[i] = UNKNOWN
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (0.0 <= x < SIDE and 0.0 <= y < SIDE and 0.0 <= z < SIDE):
            continue
        out[i] = value_of(np.int64(x), np.int64(y), np.int64(z), nodes, bricks, path)


@njit(cache=True, nogil=True)
def value_of(x: Any, y: Any, z: Any, nodes: Any, bricks: Any, path: Any) -> Any:
    """The value of one voxel in the cube."""
    entry = find_entry(x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS, nodes, path)
    if entry == 0:
        return np.int64(UNKNOWN)
    if entry < 0:
        return entry + UNIFORM
    return np.int64(bricks[(entry << (3 * BRICK_BITS)) + ((z & 7) << 6 | (y & 7) << 3 | (x & 7))])


@njit(cache=True, nogil=True)
def read_box(low: Any, nodes: Any, bricks: Any, path: Any, out: Any) -> None:
    """out: (NZ, NY, NX) int8, the voxels from low (x, y, z) on, which all lie in the cube."""
    reset_path(path)
    for k in range(out.shape[0]):
        for j in range(out.shape[1]):
            for i in range(out.shape[2]):
                out[k, j, i] = value_of(low[0] + i, low[1] + j, low[2] + k, nodes, bricks, path)


@njit(cache=True, nogil=True)
def count_box(low: Any, high: Any, free_most: Any, occupied_least: Any, nodes: Any, bricks: Any, out: Any) -> None:
    """out: (4,) int64: voxels of the box [low, high) that are unknown, free, partly free, occupied.

    Whole nodes count at once.  low, high: (3,) int64 in the cube.
    """
    stack = np.empty((8 * LEVELS + 8, 5), dtype=np.int64)  # entry, its level, x, y, z in units of that level's cubes
    top = 1
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3], stack[0, 4] = -1, LEVELS, 0, 0, 0  # the root
    out[:] = 0
    while top > 0:
        top -= 1
        entry, level = stack[top, 0], stack[top, 1]
        x, y, z = stack[top, 2], stack[top, 3], stack[top, 4]
        bits = level + BRICK_BITS
        nx = min(high[0], (x + 1) << bits) - max(low[0], x << bits)
        ny = min(high[1], (y + 1) << bits) - max(low[1], y << bits)
        nz = min(high[2], (z + 1) << bits) - max(low[2], z << bits)
        if nx <= 0 or ny <= 0 or nz <= 0:
            continue
        if level < LEVELS and entry <= 0:
            value = np.int64(UNKNOWN) if entry == 0 else entry + UNIFORM
            out[kind_of(value, free_most, occupied_least)] += nx * ny * nz
        elif level == 0:
            for vz in range(max(low[2], z << 3), min(high[2], (z + 1) << 3)):
                for vy in range(max(low[1], y << 3), min(high[1], (y + 1) << 3)):
                    for vx in range(max(low[0], x << 3), min(high[0], (x + 1) << 3)):
                        at = entry * BRICK_VOXELS + ((vz & 7) << 6 | (vy & 7) << 3 | (vx & 7))
                        out[kind_of(np.int64(bricks[at]), free_most, occupied_least)] += 1
        else:
            node = np.int64(0) if level == LEVELS else entry
            for k in range(8):
                stack[top, 0], stack[top, 1] = nodes[node, k], level - 1
                stack[top, 2], stack[top, 3], stack[top, 4] = 2 * x + (k & 1), 2 * y + (k >> 1 & 1), 2 * z + (k >> 2)
                top += 1


@njit(cache=True, nogil=True)
def kind_of(value: Any, free_most: Any, occupied_least: Any) -> Any:
    """0 unknown, 1 free, 2 partly free, 3 occupied."""
    if value == UNKNOWN:
        return 0
    if value <= free_most:
        return 1
    return 3 if value >= occupied_least else 2


@njit(cache=True, nogil=True)
def cast_rays(
    origin: Any, direction: Any, longest: Any, free_most: Any, occupied_least: Any, nodes: Any, bricks: Any, path: Any,
    length: Any, kind: Any,
) -> None:  # fmt: skip
    """How far each ray runs through free voxels, and what stops it.

    origin: (N, 3) in the cube.  direction: (N, 3) unit vectors.  longest: (N,), so that no ray leaves the cube; all in
    voxels.  length: (N,) to the border of the voxel that is not free, or `longest`.  kind: (N,) of that voxel as
    kind_of, 1 if none.
    """
    reset_path(path)
    for i in range(origin.shape[0]):
        x, y, z = np.int64(origin[i, 0]), np.int64(origin[i, 1]), np.int64(origin[i, 2])
        along = np.empty(3)
        step = np.empty(3)
        for axis in range(3):
            d = direction[i, axis]
            inside = origin[i, axis] - math.floor(origin[i, axis])
            step[axis] = 1.0 / abs(d) if d != 0.0 else np.inf
            along[axis] = (1.0 - inside if d > 0.0 else inside) * step[axis] if d != 0.0 else np.inf
        here = 0.0
        length[i], kind[i] = longest[i], 1
        while here <= longest[i]:
            what = kind_of(np.int64(value_of(x, y, z, nodes, bricks, path)), free_most, occupied_least)
            if what != 1:
                length[i], kind[i] = here, what
                break
            if along[0] < along[1] and along[0] < along[2]:
                here = along[0]
                along[0] += step[0]
                x += 1 if direction[i, 0] > 0.0 else -1
            elif along[1] < along[2]:
                here = along[1]
                along[1] += step[1]
                y += 1 if direction[i, 1] > 0.0 else -1
            else:
                here = along[2]
                along[2] += step[2]
                z += 1 if direction[i, 2] > 0.0 else -1
            if not (0 <= x < SIDE and 0 <= y < SIDE and 0 <= z < SIDE):
                break


@njit(cache=True, nogil=True)
def add_value(known: Any, more: Any, lowest: Any, highest: Any) -> Any:
    """Two independent pieces of evidence of one voxel."""
    if more == UNKNOWN:
        return known
    if known == UNKNOWN:
        known = 0
    return min(max(known + more, lowest), highest)


@njit(cache=True, nogil=True)
def add_tree(
    lowest: Any, highest: Any, other_nodes: Any, other_bricks: Any, nodes: Any, bricks: Any, brick_at: Any,
    mark_of: Any, free_nodes: Any, free_bricks: Any, state: Any,
) -> None:  # fmt: skip
    """Add the evidence of another tree of the same voxels; there is room for all its nodes and bricks. Then prune."""
    stack = np.empty((8 * LEVELS + 8, 7), dtype=np.int64)  # entry there, node and octant here, level, x, y, z
    top = 0
    for k in range(8):
        stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = other_nodes[0, k], 0, k, LEVELS - 1
        stack[top, 4], stack[top, 5], stack[top, 6] = k & 1, k >> 1 & 1, k >> 2
        top += 1
    while top > 0:
        top -= 1
        there, node, octant, level = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        x, y, z = stack[top, 4], stack[top, 5], stack[top, 6]
        here = np.int64(nodes[node, octant])
        if there == 0:
            continue
        if there < 0 and here <= 0:
            known = np.int64(UNKNOWN) if here == 0 else here + UNIFORM
            nodes[node, octant] = add_value(known, there + UNIFORM, lowest, highest) - UNIFORM
            continue
        if level == 0:
            if here <= 0:
                here = new_brick(x, y, z, here, bricks, brick_at, mark_of, free_bricks, state)
                nodes[node, octant] = here
            for v in range(BRICK_VOXELS):
                more = there + UNIFORM if there < 0 else np.int64(other_bricks[there * BRICK_VOXELS + v])
                at = here * BRICK_VOXELS + v
                bricks[at] = np.int8(add_value(np.int64(bricks[at]), more, lowest, highest))
            continue
        if here <= 0:
            here = new_node(nodes, free_nodes, state, here)
            nodes[node, octant] = here
        for k in range(8):
            stack[top, 0] = there if there < 0 else np.int64(other_nodes[there, k])
            stack[top, 1], stack[top, 2], stack[top, 3] = here, k, level - 1
            stack[top, 4], stack[top, 5], stack[top, 6] = 2 * x + (k & 1), 2 * y + (k >> 1 & 1), 2 * z + (k >> 2)
            top += 1


@njit(cache=True, nogil=True)
def prune(nodes: Any, bricks: Any, free_nodes: Any, free_bricks: Any, state: Any) -> None:
    """Give back every brick and node whose parts all have one value."""
    at_node = np.zeros(LEVELS, dtype=np.int64)  # by level, from the root down
    at_child = np.zeros(LEVELS, dtype=np.int64)
    level = LEVELS - 1
    while level < LEVELS:
        node, k = at_node[level], at_child[level]
        if k == 8:
            level += 1
            if level == LEVELS:
                return
            entry = np.int64(nodes[node, 0])
            same: Any = entry <= 0
            for j in range(1, 8):
                same = same and nodes[node, j] == entry
            if same:
                nodes[at_node[level], at_child[level] - 1] = entry
                free_nodes[state[NODES_BACK]] = node
                state[NODES_BACK] += 1
            continue
        at_child[level] += 1
        entry = np.int64(nodes[node, k])
        if entry <= 0:
            continue
        if level > 0:
            level -= 1
            at_node[level], at_child[level] = entry, 0
            continue
        base = entry * BRICK_VOXELS
        value = np.int64(bricks[base])
        same = np.bool_(True)
        for v in range(1, BRICK_VOXELS):
            same = same and bricks[base + v] == value
        if same:
            nodes[node, k] = 0 if value == UNKNOWN else value - UNIFORM
            free_bricks[state[BRICKS_BACK]] = entry
            state[BRICKS_BACK] += 1


@njit(cache=True, nogil=True)
def write_tree(nodes: Any, bricks: Any, tree: Any, body: Any) -> Any:
    """Nodes from the root down, depth first: eight kinds (2 bits each: unknown, one value, more), values of the second.

    tree: (10 * nodes,) uint8.  body: (bricks, 512) int8, in the order met.  Returns bytes of `tree` and bricks written.
    """
    stack = np.empty((8 * LEVELS + 8, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = 0, LEVELS - 1
    top, at, count = 1, 0, 0
    while top > 0:
        top -= 1
        node, level = stack[top, 0], stack[top, 1]
        kinds = 0
        values = at + 2
        for k in range(8):
            entry = np.int64(nodes[node, k])
            if entry < 0:
                kinds |= 1 << (2 * k)
                tree[values] = np.uint8(entry + UNIFORM + 128)
                values += 1
            elif entry > 0:
                kinds |= 2 << (2 * k)
        tree[at], tree[at + 1] = kinds & 0xFF, kinds >> 8
        at = values
        for j in range(8):
            entry = np.int64(nodes[node, 7 - j if level > 0 else j])
            if entry <= 0:
                continue
            if level > 0:
                stack[top, 0], stack[top, 1] = entry, level - 1
                top += 1
            else:
                for v in range(BRICK_VOXELS):
                    body[count, v] = bricks[entry * BRICK_VOXELS + v]
                count += 1
    return at, count


@njit(cache=True, nogil=True)
def read_tree(
    tree: Any, body: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any, free_bricks: Any,
    state: Any,
) -> bool:  # fmt: skip
    """Fill an empty tree from what write_tree wrote; False if that is damaged. There is room for all of it.

    Room: a node for each two bytes of `tree`, a brick for each row of `body`.
    """
    stack = np.empty((8 * LEVELS + 8, 5), dtype=np.int64)
    stack[0, :] = 0
    stack[0, 1] = LEVELS - 1
    top, at, count = 1, 0, 0
    while top > 0:
        top -= 1
        node, level = stack[top, 0], stack[top, 1]
        x, y, z = stack[top, 2], stack[top, 3], stack[top, 4]
        if at + 2 > tree.size:
            return False
        kinds = np.int64(tree[at]) | np.int64(tree[at + 1]) << 8
        at += 2
        below = top
        for k in range(8):
            kind = kinds >> (2 * k) & 3
            if kind == 0:
                nodes[node, k] = 0
            elif kind == 1:
                if at >= tree.size or tree[at] == 0:
                    return False
                nodes[node, k] = np.int64(tree[at]) - 128 - UNIFORM
                at += 1
            elif kind == 2:
                cx, cy, cz = 2 * x + (k & 1), 2 * y + (k >> 1 & 1), 2 * z + (k >> 2)
                if level == 0:
                    if count >= body.shape[0]:
                        return False
                    slot = new_brick(cx, cy, cz, 0, bricks, brick_at, mark_of, free_bricks, state)
                    for v in range(BRICK_VOXELS):
                        bricks[slot * BRICK_VOXELS + v] = body[count, v]
                    count += 1
                    nodes[node, k] = slot
                else:
                    child = new_node(nodes, free_nodes, state, 0)
                    nodes[node, k] = child
                    stack[top, 0], stack[top, 1] = child, level - 1
                    stack[top, 2], stack[top, 3], stack[top, 4] = cx, cy, cz
                    top += 1
            else:
                return False
        # The first child comes next.
        for j in range((top - below) // 2):
            for f in range(5):
                swap = stack[below + j, f]
                stack[below + j, f] = stack[top - 1 - j, f]
                stack[top - 1 - j, f] = swap
    return bool(at == tree.size and count == body.shape[0])


@njit(cache=True, nogil=True)
def leaves_of_brick(bricks: Any, slot: Any, uniform: Any) -> Any:
    """How many leaves a brick has if it is divided down to single voxels where it must be. uniform: (64,) int64."""
    base = slot * BRICK_VOXELS
    leaves = 0
    mixed = -129
    side = 4
    for cz in range(4):
        for cy in range(4):
            for cx in range(4):
                value = np.int64(bricks[base + (2 * cz << 6 | 2 * cy << 3 | 2 * cx)])
                known, same = 0, True
                for k in range(8):
                    v = bricks[base + ((2 * cz + (k >> 2)) << 6 | (2 * cy + (k >> 1 & 1)) << 3 | (2 * cx + (k & 1)))]
                    known += v != UNKNOWN
                    same = same and v == value
                uniform[(cz * side + cy) * side + cx] = value if same else mixed
                leaves += known if not same else 1 if value != UNKNOWN else 0
    for cz in range(2):
        for cy in range(2):
            for cx in range(2):
                value = uniform[(2 * cz * side + 2 * cy) * side + 2 * cx]
                same = value != mixed
                for k in range(8):
                    at = ((2 * cz + (k >> 2)) * side + 2 * cy + (k >> 1 & 1)) * side + 2 * cx + (k & 1)
                    same = same and uniform[at] == value
                if same and value != UNKNOWN:
                    leaves -= 7
    return leaves
