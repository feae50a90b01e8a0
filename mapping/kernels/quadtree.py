"""Compiled loops of the quadtree (S31, algorithm 5.4).

An entry says what a square of cells is: below 0 a leaf, all UNKNOWN, all FREE or all OCCUPIED; else the node that
divides it in four, row by row: lower left, lower right, upper left, upper right (rows grow with y).

    nodes  (M, 4) int32   the entries of each node's parts
    spare  (M,) int32     a stack of nodes given back
    state  (3,) int64     nodes ever used, nodes on the stack, whether room was wanted and not there

The functions call themselves, at most once a level: the depth is that of the tree.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

UNKNOWN, FREE, OCCUPIED = -1, -2, -3

TOP, BACK, FULL = 0, 1, 2
STATE_LENGTH = 3


@njit(cache=True, nogil=True)
def new_node(nodes: Any, spare: Any, state: Any, entry: Any) -> Any:
    """A node whose parts all are `entry`; -1 if there is no room, which state tells."""
    if state[BACK] > 0:
        state[BACK] -= 1
        node = np.int64(spare[state[BACK]])
    elif state[TOP] < nodes.shape[0]:
        node = np.int64(state[TOP])
        state[TOP] += 1
    else:
        state[FULL] = 1
        return np.int64(-1)
    for k in range(4):
        nodes[node, k] = entry
    return node


@njit(cache=True, nogil=True)
def joined(node: Any, nodes: Any, spare: Any, state: Any) -> Any:
    """The node, or the leaf that it is, the node given back, if all its parts are the same leaf."""
    entry = np.int64(nodes[node, 0])
    if entry >= 0 or nodes[node, 1] != entry or nodes[node, 2] != entry or nodes[node, 3] != entry:
        return np.int64(node)
    spare[state[BACK]] = node
    state[BACK] += 1
    return entry


@njit(cache=True, nogil=True)
def leaf_of_percent(percent: Any, free_most: Any, occupied_least: Any) -> Any:
    """What a cell is: between the two it is neither free nor occupied for sure, so unknown."""
    if percent >= occupied_least:
        return np.int64(OCCUPIED)
    return np.int64(FREE) if 0 <= percent <= free_most else np.int64(UNKNOWN)


@njit(cache=True, nogil=True)
def write_cells(
    entry: Any, size: Any, row: Any, col: Any, cells: Any, row0: Any, col0: Any, free_most: Any, occupied_least: Any,
    nodes: Any, spare: Any, state: Any,
) -> Any:  # fmt: skip
    """The entry of the square at (row, col) after `cells`, at (row0, col0), took the place of what was there.

    Where room fails the old entry stays; doing it again with more room completes it.
    """
    if row >= row0 + cells.shape[0] or row + size <= row0 or col >= col0 + cells.shape[1] or col + size <= col0:
        return np.int64(entry)
    if size == 1:
        return leaf_of_percent(cells[row - row0, col - col0], free_most, occupied_least)
    node = np.int64(entry)
    if entry < 0:
        node = new_node(nodes, spare, state, entry)
        if node < 0:
            return np.int64(entry)
    half = size >> 1
    for k in range(4):
        nodes[node, k] = write_cells(
            np.int64(nodes[node, k]), half, row + half * (k >> 1), col + half * (k & 1), cells, row0, col0, free_most,
            occupied_least, nodes, spare, state,
        )  # fmt: skip
    return joined(node, nodes, spare, state)


@njit(cache=True, nogil=True)
def join_trees(
    entry: Any, other: Any, other_nodes: Any, nodes: Any, spare: Any, state: Any
) -> Any:  # fmt: skip
    """The entry of a square after another tree's entry of it was joined: occupied before free before unknown."""
    if other == UNKNOWN or entry == OCCUPIED:
        return np.int64(entry)
    if other < 0 and entry < 0:
        return np.int64(min(entry, other))
    node = np.int64(entry)
    if entry < 0:
        node = new_node(nodes, spare, state, entry)
        if node < 0:
            return np.int64(entry)
    for k in range(4):
        part = np.int64(other_nodes[other, k]) if other >= 0 else np.int64(other)
        nodes[node, k] = join_trees(np.int64(nodes[node, k]), part, other_nodes, nodes, spare, state)
    return joined(node, nodes, spare, state)


@njit(cache=True, nogil=True)
def read_cells(entry: Any, size: Any, row: Any, col: Any, nodes: Any, row0: Any, col0: Any, out: Any) -> None:
    """out: (R, C) int8, the leaves' entries of the cells from (row0, col0) on."""
    low_row, high_row = max(row, row0), min(row + size, row0 + out.shape[0])
    low_col, high_col = max(col, col0), min(col + size, col0 + out.shape[1])
    if low_row >= high_row or low_col >= high_col:
        return
    if entry < 0:
        for r in range(low_row - row0, high_row - row0):
            for c in range(low_col - col0, high_col - col0):
                out[r, c] = np.int8(entry)
        return
    half = size >> 1
    for k in range(4):
        read_cells(
            np.int64(nodes[entry, k]), half, row + half * (k >> 1), col + half * (k & 1), nodes, row0, col0, out
        )  # fmt: skip


@njit(cache=True, nogil=True)
def count_cells(
    entry: Any, size: Any, row: Any, col: Any, nodes: Any, row0: Any, row1: Any, col0: Any, col1: Any, counts: Any
) -> None:
    """Add the cells of [row0, row1) x [col0, col1) to counts: (3,) int64 of unknown, free, occupied."""
    high = min(row + size, row1) - max(row, row0)
    wide = min(col + size, col1) - max(col, col0)
    if high <= 0 or wide <= 0:
        return
    if entry < 0:
        counts[-1 - entry] += high * wide
        return
    half = size >> 1
    for k in range(4):
        count_cells(
            np.int64(nodes[entry, k]), half, row + half * (k >> 1), col + half * (k & 1), nodes, row0, row1, col0, col1,
            counts,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def find_leaves(root: Any, side: Any, cells: Any, nodes: Any, found: Any) -> None:
    """found: (N, 4) int64 row, column, size, entry of the leaf with each cell (N, 2); outside the root: size 0.

    Cells and leaves are counted from the root's corner.
    """
    for i in range(cells.shape[0]):
        row, col = np.int64(cells[i, 0]), np.int64(cells[i, 1])
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = row, col, 0, UNKNOWN
        if not (0 <= row < side and 0 <= col < side):
            continue
        entry, size = np.int64(root), np.int64(side)
        while entry >= 0:
            size >>= 1
            entry = np.int64(nodes[entry, (2 if row & size else 0) + (1 if col & size else 0)])
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = row & -size, col & -size, size, entry


@njit(cache=True, nogil=True)
def list_leaves(entry: Any, size: Any, row: Any, col: Any, nodes: Any, count: Any, out: Any) -> Any:
    """out: (N, 4) int64 row, column, size, entry of every leaf from `count` on, part by part; the new count."""
    if entry < 0:
        out[count, 0], out[count, 1], out[count, 2], out[count, 3] = row, col, size, entry
        return np.int64(count + 1)
    half = size >> 1
    for k in range(4):
        count = list_leaves(
            np.int64(nodes[entry, k]), half, row + half * (k >> 1), col + half * (k & 1), nodes, np.int64(count), out
        )  # fmt: skip
    return np.int64(count)


@njit(cache=True, nogil=True)
def write_tree(entry: Any, nodes: Any, count: Any, out: Any) -> Any:
    """out: (nodes,) uint8: each node before its parts, two bits a part: 0, 1, 2 the leaves, 3 a node. New count."""
    if entry < 0:
        return np.int64(count)
    at = np.int64(count)
    kinds: Any = 0
    count = np.int64(at + 1)
    for k in range(4):
        part = np.int64(nodes[entry, k])
        kinds |= (3 if part >= 0 else -1 - part) << (2 * k)
        count = write_tree(part, nodes, np.int64(count), out)
    out[at] = kinds
    return np.int64(count)


@njit(cache=True, nogil=True)
def read_tree(size: Any, data: Any, place: Any, nodes: Any, state: Any) -> Any:
    """The node of a square that is written at data[place[0]], with all below it; -1 if that is damaged.

    place: (1,) int64, moves on.  A node that divides a single cell is damage, too. There is room for data.size nodes.
    """
    if place[0] >= data.size or size < 2:
        return np.int64(-1)
    kinds = np.int64(data[place[0]])
    place[0] += 1
    node = np.int64(state[TOP])
    state[TOP] += 1
    for k in range(4):
        kind = kinds >> (2 * k) & 3
        if kind < 3:
            nodes[node, k] = -1 - kind
            continue
        part = np.int64(read_tree(size >> 1, data, place, nodes, state))
        if part < 0:
            return np.int64(-1)
        nodes[node, k] = part
    return node
