"""Compiled loops of the quadtree (S31, algorithm 5.4).

An entry says what a square of cells is: UNKNOWN, FREE or OCCUPIED all over, a leaf; from 0 on the node that divides it
in four, row by row: lower left, lower right, upper left, upper right (rows grow with y). Squares of 4 x 4 cells are
not divided: where they are not of one kind, the entry is MIXED less a number with two bits for each cell, row by row:
0 unknown, 1 free, 2 occupied. So a tree has no nodes for its two lowest levels, which are most of a real map's.

    nodes  (M, 4) int64   the entries of each node's parts
    spare  (M,) int32     a stack of nodes given back
    state  (3,) int64     nodes ever used, nodes on the stack, whether room was wanted and not there

The functions call themselves, at most once a level: the depth is that of the tree.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

UNKNOWN, FREE, OCCUPIED, MIXED = -1, -2, -3, -4
BLOCK = 4  # cells along an edge of the smallest squares with entries of their own
ALL_FREE, ALL_OCCUPIED = 0x5555_5555, 0xAAAA_AAAA
DAMAGED = -(1 << 40)  # no entry

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
def bits_of(entry: Any) -> Any:
    """Two bits for each cell of a square of 4 x 4."""
    return MIXED - entry if entry <= MIXED else (-1 - entry) * np.int64(ALL_FREE)


@njit(cache=True, nogil=True)
def entry_of(bits: Any) -> Any:
    """The entry of a square of 4 x 4 cells."""
    if bits in (0, ALL_FREE, ALL_OCCUPIED):
        return np.int64(-1 - (bits & 3))
    return np.int64(MIXED - bits)


@njit(cache=True, nogil=True)
def kind_of_quarter(bits: Any, k: Any) -> Any:
    """What four cells of a square of 4 x 4 are, one of its quarters: 0 to 2, or 3 if they differ."""
    four = bits >> (16 * (k >> 1) + 4 * (k & 1))
    four = four & 15 | (four >> 8 & 15) << 4
    kind = four & 3
    return kind if four == kind * 0x55 else np.int64(3)


@njit(cache=True, nogil=True)
def kind_of_cell(bits: Any, row: Any, col: Any) -> Any:
    """What a cell of a square of 4 x 4 is: 0 to 2."""
    return bits >> (8 * row + 2 * col) & 3


@njit(cache=True, nogil=True)
def joined(node: Any, nodes: Any, spare: Any, state: Any) -> Any:
    """The node, or the leaf that it is, the node given back, if all its parts are the same leaf."""
    entry = np.int64(nodes[node, 0])
    if not MIXED < entry < 0 or nodes[node, 1] != entry or nodes[node, 2] != entry or nodes[node, 3] != entry:
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
def write_block(entry: Any, row: Any, col: Any, cells: Any, free_most: Any, occupied_least: Any) -> Any:
    """The entry of a square of 4 x 4 after `cells`, in which it begins at (row, col), took the place of its own."""
    bits = np.int64(bits_of(entry))
    for r in range(max(row, 0), min(row + BLOCK, cells.shape[0])):
        for c in range(max(col, 0), min(col + BLOCK, cells.shape[1])):
            shift = 8 * (r - row) + 2 * (c - col)
            kind = -1 - leaf_of_percent(cells[r, c], free_most, occupied_least)
            bits = bits & ~(np.int64(3) << shift) | kind << shift
    return entry_of(bits)


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
    if size == BLOCK:
        return write_block(entry, row - row0, col - col0, cells, free_most, occupied_least)
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
    if other <= MIXED or entry <= MIXED:
        both = bits_of(entry) | bits_of(other)
        occupied = both & ALL_OCCUPIED
        return entry_of(occupied | both & ALL_FREE & ~(occupied >> 1))
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
    """out: (R, C) int8, the entries of the cells from (row0, col0) on: UNKNOWN, FREE, OCCUPIED."""
    low_row, high_row = max(row, row0), min(row + size, row0 + out.shape[0])
    low_col, high_col = max(col, col0), min(col + size, col0 + out.shape[1])
    if low_row >= high_row or low_col >= high_col:
        return
    if entry <= MIXED:
        for r in range(low_row, high_row):
            for c in range(low_col, high_col):
                out[r - row0, c - col0] = np.int8(-1 - kind_of_cell(MIXED - entry, r - row, c - col))
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
    if entry <= MIXED:
        for r in range(max(row, row0), min(row + size, row1)):
            for c in range(max(col, col0), min(col + size, col1)):
                counts[kind_of_cell(MIXED - entry, r - row, c - col)] += 1
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
        if entry <= MIXED:
            bits = MIXED - entry
            size = np.int64(2)
            kind = kind_of_quarter(bits, (2 if row & 2 else 0) + (1 if col & 2 else 0))
            if kind == 3:
                size = np.int64(1)
                kind = kind_of_cell(bits, row & 3, col & 3)
            entry = np.int64(-1 - kind)
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = row & -size, col & -size, size, entry


@njit(cache=True, nogil=True)
def leaves_below(entry: Any, nodes: Any) -> Any:
    """How many leaves a square has."""
    if entry <= MIXED:
        count = np.int64(0)
        for k in range(4):
            count += 4 if kind_of_quarter(MIXED - entry, k) == 3 else 1
        return count
    if entry < 0:
        return np.int64(1)
    count = np.int64(0)
    for k in range(4):
        count += np.int64(leaves_below(np.int64(nodes[entry, k]), nodes))
    return count


@njit(cache=True, nogil=True)
def list_leaves(entry: Any, size: Any, row: Any, col: Any, nodes: Any, count: Any, out: Any) -> Any:
    """out: (N, 4) int64 row, column, size, entry of every leaf from `count` on, part by part; the new count."""
    if entry <= MIXED:
        return list_block(MIXED - entry, row, col, np.int64(count), out)
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
def list_block(bits: Any, row: Any, col: Any, count: Any, out: Any) -> Any:
    """`list_leaves` of a square of 4 x 4 cells."""
    for k in range(4):
        low, left = 2 * (k >> 1), 2 * (k & 1)
        kind = kind_of_quarter(bits, k)
        for j in range(4 if kind == 3 else 1):
            r, c = low + (j >> 1), left + (j & 1)
            out[count, 0], out[count, 1], out[count, 2] = row + r, col + c, 1 if kind == 3 else 2
            out[count, 3] = -1 - kind_of_cell(bits, r, c)
            count += 1
    return np.int64(count)


@njit(cache=True, nogil=True)
def write_tree(entry: Any, nodes: Any, count: Any, out: Any) -> Any:
    """out: (divided squares,) uint8: each before its parts, two bits a part: 0, 1, 2 the leaves, 3 divided. New count.

    Squares of 4 and 2 cells count as divided where they are mixed, as algorithm 5.4 has them.
    """
    if entry <= MIXED:
        return write_block_bytes(MIXED - entry, np.int64(count), out)
    if entry < 0:
        return np.int64(count)
    at = np.int64(count)
    kinds: Any = 0
    count = np.int64(at + 1)
    for k in range(4):
        part = np.int64(nodes[entry, k])
        kinds |= (3 if part >= 0 or part <= MIXED else -1 - part) << (2 * k)
        count = write_tree(part, nodes, np.int64(count), out)
    out[at] = kinds
    return np.int64(count)


@njit(cache=True, nogil=True)
def write_block_bytes(bits: Any, count: Any, out: Any) -> Any:
    """`write_tree` of a square of 4 x 4 cells."""
    at = np.int64(count)
    kinds: Any = 0
    count += 1
    for k in range(4):
        kind = kind_of_quarter(bits, k)
        kinds |= kind << (2 * k)
        if kind == 3:
            four = bits >> (16 * (k >> 1) + 4 * (k & 1))
            out[count] = four & 15 | (four >> 8 & 15) << 4
            count += 1
    out[at] = kinds
    return np.int64(count)


@njit(cache=True, nogil=True)
def read_tree(size: Any, data: Any, place: Any, nodes: Any, state: Any) -> Any:
    """The entry of a divided square that is written at data[place[0]], with all below it; DAMAGED if that is damaged.

    place: (1,) int64, moves on.  size: BLOCK at least. There is room for data.size nodes.
    """
    if place[0] >= data.size:
        return np.int64(DAMAGED)
    if size == BLOCK:
        return read_block(data, place)
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
        if part == DAMAGED:
            return np.int64(DAMAGED)
        nodes[node, k] = part
    return node


@njit(cache=True, nogil=True)
def read_block(data: Any, place: Any) -> Any:
    """`read_tree` of a square of 4 x 4 cells. A cell that is divided is damage."""
    kinds = np.int64(data[place[0]])
    place[0] += 1
    bits = np.int64(0)
    for k in range(4):
        kind = kinds >> (2 * k) & 3
        four = kind * 0x55
        if kind == 3:
            if place[0] >= data.size:
                return np.int64(DAMAGED)
            four = np.int64(data[place[0]])
            place[0] += 1
            if four & (four >> 1) & 0x55:
                return np.int64(DAMAGED)
        bits |= (four & 15 | (four >> 4) << 8) << (16 * (k >> 1) + 4 * (k & 1))
    return entry_of(bits)
