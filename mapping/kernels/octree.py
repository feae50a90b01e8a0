"""Compiled loops of the octree (S32): look-ups, sums of two trees, pruning, bytes; rays: octree_ends, octree_rays.

The tree ends in bricks of 8 x 8 x 8 voxels, so that a ray walks arrays and goes through the tree only from brick to
brick, and there from the deepest node that the two have in common. LEVELS levels of nodes stand above the bricks:
level l chooses a child by bit l of the brick's coordinates.

    nodes     (M, 8) int32   a child each: 0 unknown; above 0 a node, or at level 0 a brick; below 0 one value for all
                             of it, value - UNIFORM.  nodes[0] is the root
    bricks    (B * 512,) int8  log-odds in steps, UNKNOWN never observed; [z, y, x] within a brick.  Brick 0 is not used
    brick_at  (B, 3) int32   x, y, z of each brick
    mark_of   (B,) int32     its place in `marks` during an insertion, else -1
    state     (5,) int64     see below; free_nodes, free_bricks: stacks of what was given back

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

NODE_TOP = 0  # nodes ever used; those given back lie on a stack
NODES_BACK = 1
BRICK_TOP = 2
BRICKS_BACK = 3
TOUCHED = 4
STATE_LENGTH = 5

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
    x: Any, y: Any, z: Any, nodes: Any, bricks: Any, brick_at: Any, mark_of: Any, free_nodes: Any, free_bricks: Any,
    state: Any, path: Any,
) -> Any:  # fmt: skip
    """Make the brick (x, y, z), which has none yet; there must be room for it and all its nodes."""
    entry = find_entry(x, y, z, nodes, path)
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
