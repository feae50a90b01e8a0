"""Compiled loops of an insertion into the octree (S32): marks on voxels, and at its end the evidence they stand for.

The tree's arrays are those of mapping.kernels.octree. What an insertion under way adds:

    marks      (T * WORDS,) uint64  of each touched brick: which voxels have a mark, then which of those a hit; a word
               for each z, a bit for y, x
    touched    (T,) int64    bricks by their place in `marks`;  left: (T,) int32, voxels without a mark of each
    shortcuts  (SHORTCUTS, 2) int64  name of a brick, its place or KEPT; -1, KEPT where there is none yet
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.octree import (
    BRICK,
    BRICK_TOP,
    BRICK_VOXELS,
    BRICKS_BACK,
    LEVELS,
    NODE_TOP,
    NODES_BACK,
    TOUCHED,
    UNKNOWN,
    dissolve_brick,
    find_entry,
    make_brick,
)

KEPT = -1  # a region that is as free as it can be
NO_ROOM = -2
WORDS = 2 * BRICK  # of 64 voxels: which have a mark, and which of those a hit
SHORTCUTS = 1 << 13


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
def place_if_any(x: Any, y: Any, z: Any, keep: Any, nodes: Any, mark_of: Any, path: Any) -> Any:
    """The place in `marks` of a brick, NO_ROOM if it has none, KEPT if no mark is needed there."""
    entry = find_entry(x, y, z, nodes, path)
    if entry > 0:
        return np.int64(mark_of[entry] if mark_of[entry] >= 0 else NO_ROOM)
    return np.int64(KEPT if entry == keep else NO_ROOM)


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
