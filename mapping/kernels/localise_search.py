"""Compiled loops of the correlative search: where in a raster of likelihoods do most end points of a scan fall?

The raster holds uint8 likelihoods of a surface (255 on it, falling off with distance). A pooled copy whose cell holds
the maximum over the block of cells from it on bounds what any shift within that block can score, so that blocks are
looked into from the best bound down and most never are. Source: correlative scan matching (Olson, ICRA 2009) with two
resolutions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def draw_points(
    x: Any, y: Any, quality: Any, rows: Any, poses: Any, x0: float, y0: float, resolution_m: float, out: Any
) -> None:
    """Draw the points of views `rows` at poses (R, 3) into a raster (H, W) uint8, blurred over two cells."""
    height, width = out.shape
    for k in range(len(rows)):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for i in range(x.shape[1]):
            if quality[rows[k], i] < 0.0:
                continue
            px = (poses[k, 0] + c * x[rows[k], i] - s * y[rows[k], i] - x0) / resolution_m
            py = (poses[k, 1] + s * x[rows[k], i] + c * y[rows[k], i] - y0) / resolution_m
            if not (px >= 2.0 and py >= 2.0 and px < width - 2.0 and py < height - 2.0):
                continue
            column, row = int(px), int(py)
            for v in range(row - 2, row + 3):
                for u in range(column - 2, column + 3):
                    square = (u + 0.5 - px) ** 2 + (v + 0.5 - py) ** 2
                    value = int(255.0 * math.exp(-0.5 * square))
                    if value > out[v, u]:
                        out[v, u] = value


@njit(cache=True, nogil=True)
def pool(raster: Any, times: int, step: int) -> Any:
    """Raster whose cell (v, u) is the maximum of raster[v + i step, u + j step], i and j below times, a power of two.

    Of a copy pooled over `step` cells that is one pooled over times * step.
    """
    height, width = raster.shape
    out = raster.copy()
    shift = step
    while shift < times * step:
        for v in range(height):
            for u in range(width - shift):
                out[v, u] = max(out[v, u], out[v, u + shift])
        for v in range(height - shift):
            for u in range(width):
                out[v, u] = max(out[v, u], out[v + shift, u])
        shift *= 2
    return out


@njit(cache=True, nogil=True)
def score_at(raster: Any, cx: Any, cy: Any, dx: int, dy: int) -> int:
    """Sum of likelihoods under points (M,) of cells cx, cy shifted by whole cells."""
    height, width = raster.shape
    total = 0
    for i in range(len(cx)):
        u, v = cx[i] + dx, cy[i] + dy
        if u >= 0 and v >= 0 and u < width and v < height:
            total += raster[v, u]
    return total


@njit(cache=True, nogil=True)
def search(
    fine: Any, pooled: Any, block: int, top: Any, top_block: int, x0: float, y0: float, resolution_m: float, px: Any,
    py: Any, guess: Any, window_m: float, turn_rad: float, turn_step_rad: float, apart_m: float, apart_rad: float,
    floor_share: float, any_rival: bool, least: float, result: Any,
) -> None:  # fmt: skip
    """Best pose of points (M,) around a guess (3,), and the best of those that lie apart from it.

    pooled, top: maxima over block and top_block cells, a multiple (the same raster if it is 1).  any_rival: the first
    that reaches floor_share will do.  least: a best that scores less need not be found.
    result: (5,) x, y, yaw of the best, its score, and the score of the best that is apart_m or apart_rad away (0 if
    none reaches floor_share of the best's); scores are mean likelihoods in [0, 1].
    """
    turns = int(turn_rad / turn_step_rad)
    blocks = math.ceil(window_m / (resolution_m * top_block))
    side = 2 * blocks + 1
    total = (2 * turns + 1) * side * side
    bounds = np.empty(total, dtype=np.int64)
    count = len(px)
    cells_x, cells_y = (
        np.empty((2 * turns + 1, count), dtype=np.int64),
        np.empty((2 * turns + 1, count), dtype=np.int64),
    )
    at = 0
    for t in range(2 * turns + 1):
        yaw = guess[2] + (t - turns) * turn_step_rad
        c, s = math.cos(yaw), math.sin(yaw)
        for i in range(count):
            cells_x[t, i] = math.floor((guess[0] + c * px[i] - s * py[i] - x0) / resolution_m)
            cells_y[t, i] = math.floor((guess[1] + s * px[i] + c * py[i] - y0) / resolution_m)
        for by in range(-blocks, blocks + 1):
            for bx in range(-blocks, blocks + 1):
                bounds[at] = score_at(top, cells_x[t], cells_y[t], bx * top_block, by * top_block)
                at += 1
    enough = int(least * 255.0 * count)
    hopeful = np.flatnonzero(bounds >= min(floor_share, 1.0) * enough)
    order = hopeful[np.argsort(-bounds[hopeful], kind="mergesort")]
    ratio = top_block // block
    # Wide blocks reach beyond the window by up to 3 m: what drift cannot explain must not be found there.
    most = math.ceil(window_m / resolution_m) if ratio > 1 else 2 * (blocks + 1) * top_block
    best, best_t, best_x, best_y = enough - 1, turns, 0, 0
    for n in range(len(order)):
        k = order[n]
        if bounds[k] <= best:
            break
        t = k // (side * side)
        by, bx = ((k % (side * side)) // side - blocks) * top_block, (k % side - blocks) * top_block
        for part in range(ratio * ratio):
            my, mx = by + (part // ratio) * block, bx + (part % ratio) * block
            if ratio > 1 and score_at(pooled, cells_x[t], cells_y[t], mx, my) <= best:
                continue
            for dy in range(my, my + block):
                for dx in range(mx, mx + block):
                    if dx * dx + dy * dy > most * most:
                        continue
                    score = score_at(fine, cells_x[t], cells_y[t], dx, dy)
                    if score > best:
                        best, best_t, best_x, best_y = score, t, dx, dy
    if best < enough:
        result[:] = 0.0
        return
    second = int(floor_share * best)
    found = False
    apart_cells = apart_m / resolution_m
    for n in range(len(order)):
        k = order[n]
        if bounds[k] <= second or (found and any_rival):
            break
        t = k // (side * side)
        by, bx = ((k % (side * side)) // side - blocks) * top_block, (k % side - blocks) * top_block
        turned = abs(t - best_t) * turn_step_rad > apart_rad
        for part in range(ratio * ratio):
            my, mx = by + (part // ratio) * block, bx + (part % ratio) * block
            if ratio > 1 and score_at(pooled, cells_x[t], cells_y[t], mx, my) <= second:
                continue
            for dy in range(my, my + block):
                for dx in range(mx, mx + block):
                    if not turned and (dx - best_x) ** 2 + (dy - best_y) ** 2 < apart_cells * apart_cells:
                        continue
                    if dx * dx + dy * dy > most * most:
                        continue
                    score = score_at(fine, cells_x[t], cells_y[t], dx, dy)
                    if score > second:
                        second = score
                        found = True
    scale = 1.0 / (255.0 * max(1, count))
    result[0] = guess[0] + best_x * resolution_m
    result[1] = guess[1] + best_y * resolution_m
    result[2] = guess[2] + (best_t - turns) * turn_step_rad
    result[3] = best * scale
    result[4] = second * scale if found else 0.0
