"""Compiled loops of the search through a whole known grid: bounds of its blocks, and what is best in the likely ones.

Rasters hold likelihoods in uint8, indexed [row, col] from their lower left corner, with so wide a margin that no point
of a scan seen from any block lies outside; so nothing here asks whether a cell exists. A block is BLOCK x BLOCK cells.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

BLOCK = 8
_SHIFT, _MASK = 3, 7
MOST_POINTS = 257  # of 255 each fit into 16 bits
INNER = 2  # among equals in a block, the first of the first square of so many cells wins


@njit(cache=True, nogil=True)
def turned_cells(px: Any, py: Any, resolution_m: float, step_rad: float, cx: Any, cy: Any) -> None:
    """cx, cy: (T, N) int32 cells of points (N,) seen from the centre of a cell, for T headings."""
    for t in range(cx.shape[0]):
        c, s = math.cos(t * step_rad), math.sin(t * step_rad)
        for i in range(len(px)):
            cx[t, i] = math.floor(0.5 + (c * px[i] - s * py[i]) / resolution_m)
            cy[t, i] = math.floor(0.5 + (s * px[i] + c * py[i]) / resolution_m)


@njit(cache=True, nogil=True)
def in_phases(pooled: Any) -> Any:
    """(BLOCK, BLOCK, H / BLOCK, W / BLOCK): cells [v::BLOCK, u::BLOCK] of a raster lie together, so that what a point
    meets from each block of a row lies in a row."""
    rows, cols = pooled.shape[0] // BLOCK, pooled.shape[1] // BLOCK
    out = np.empty((BLOCK, BLOCK, rows, cols), dtype=np.uint8)
    for v in range(BLOCK):
        for u in range(BLOCK):
            for r in range(rows):
                for c in range(cols):
                    out[v, u, r, c] = pooled[r * BLOCK + v, c * BLOCK + u]
    return out


@njit(cache=True, nogil=True)
def block_bounds(phases: Any, blocks: Any, cx: Any, cy: Any, bounds: Any) -> None:
    """bounds: (T, B) uint16, what no pose in block b (rows of (row, col) of blocks, by row) at heading t can exceed."""
    line = np.empty(phases.shape[3], dtype=np.int32)
    for t in range(cx.shape[0]):
        b = 0
        while b < len(blocks):
            row, first, after = blocks[b, 0], blocks[b, 1], b + 1
            while after < len(blocks) and blocks[after, 0] == row:
                after += 1
            wide = blocks[after - 1, 1] - first + 1
            line[:wide] = 0
            for i in range(cx.shape[1]):
                under = phases[cy[t, i] & _MASK, cx[t, i] & _MASK, row + (cy[t, i] >> _SHIFT)]
                under = under[first + (cx[t, i] >> _SHIFT) :]
                for k in range(wide):
                    line[k] += under[k]
            for n in range(b, after):
                bounds[t, n] = line[blocks[n, 1] - first]
            b = after


@njit(cache=True, nogil=True)
def in_words(fine: Any) -> Any:
    """(BLOCK, H, W / BLOCK) uint64: eight cells of a row side by side, [phase, row, column] from the cell
    column * BLOCK + phase on, the first in the lowest byte; so eight poses are scored at once."""
    rows, cols = fine.shape[0], fine.shape[1] // BLOCK
    out = np.zeros((BLOCK, rows, cols), dtype=np.uint64)
    for phase in range(BLOCK):
        for r in range(rows):
            for c in range(cols):
                for k in range(min(BLOCK, fine.shape[1] - c * BLOCK - phase)):
                    out[phase, r, c] |= np.uint64(fine[r, c * BLOCK + phase + k]) << np.uint64(8 * k)
    return out


@njit(cache=True, nogil=True)
def block_scores(flat: Any, stride: int, first: int, offset: Any, scores: Any) -> None:
    """scores: (BLOCK, BLOCK) of the poses of a block, [row, col].

    flat: `in_words`, flat, stride words a row.  first: where the block's first word of phase 0 lies.  offset: (N,) from
    there to what each point meets; sums are kept in 16 bits, so N is MOST_POINTS at most.
    """
    bytes_apart, eight = np.uint64(0x00FF00FF00FF00FF), np.uint64(8)
    for v in range(BLOCK):
        even, odd = np.uint64(0), np.uint64(0)
        row = first + v * stride
        for i in range(len(offset)):
            word = flat[np.uint64(row + offset[i])]  # unsigned: no cell is counted from the end
            even += word & bytes_apart
            odd += (word >> eight) & bytes_apart
        for k in range(BLOCK // 2):
            scores[v, 2 * k] = (even >> np.uint64(16 * k)) & np.uint64(0xFFFF)
            scores[v, 2 * k + 1] = (odd >> np.uint64(16 * k)) & np.uint64(0xFFFF)


@njit(cache=True, nogil=True)
def best_in_blocks(
    words: Any, allowed: Any, blocks: Any, cx: Any, cy: Any, bounds: Any, order: Any, share: float, sector: int,
    most: int, best: Any, where: Any,
) -> tuple[int, int]:  # fmt: skip
    """Look into blocks in the given order, as long as their bounds reach `share` of the best score found.

    best: (T / sector, B) int32, gets the best score of each block and sector of headings; where: (T / sector, B, 3)
    its heading, row, col.

    allowed: (H, W) cells where a robot may stand.  most: so many blocks are looked into.
    Returns the best score, and the number of blocks looked into.
    """
    count = len(blocks)
    rows, stride = words.shape[1], words.shape[2]
    offset = np.empty(cx.shape, dtype=np.int64)
    for t in range(cx.shape[0]):
        for i in range(cx.shape[1]):
            offset[t, i] = ((cx[t, i] & _MASK) * rows + cy[t, i]) * stride + (cx[t, i] >> _SHIFT)
    scores, flat = np.empty((BLOCK, BLOCK), dtype=np.int32), words.ravel()
    top, looked = 0, 0
    for n in range(len(order)):
        t, b = order[n] // count, order[n] % count
        if bounds[t, b] < share * top or looked >= most:
            break
        looked += 1
        v0, u0 = blocks[b, 0] * BLOCK, blocks[b, 1] * BLOCK
        k = t // sector
        block_scores(flat, stride, v0 * stride + blocks[b, 1], offset[t], scores)
        if scores.max() <= max(np.int64(best[k, b]), np.int64(share * top)):
            continue
        for v in range(0, BLOCK, INNER):
            for u in range(0, BLOCK, INNER):
                for vv in range(v, v + INNER):
                    for uu in range(u, u + INNER):
                        if scores[vv, uu] > best[k, b] and allowed[v0 + vv, u0 + uu]:
                            best[k, b] = scores[vv, uu]
                            where[k, b, 0], where[k, b, 1], where[k, b, 2] = t, v0 + vv, u0 + uu
                            top = max(top, int(scores[vv, uu]))
    return top, looked
