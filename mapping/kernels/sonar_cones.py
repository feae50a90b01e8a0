"""Compiled loops of the sonar layer of a grid (S29). Same tiles and slots as in mapping.kernels.grids.

A cell is uint8: 0 never observed, else SONAR_ZERO + evidence in steps of SONAR_STEP log-odds.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.grids import TILE_BITS, TILE_MASK, new_slot

SONAR_ZERO = 128
SONAR_STEP = 0.025


@njit(cache=True, nogil=True)
def insert_cone(
    ox: float, oy: float, axis_x: float, axis_y: float, cos_half: float, arc_len: float, arc_half: float,
    free_from: float, free_len: float, weights: Any, guards: Any, window: Any, tile_row0: int, tile_col0: int,
    cells: Any, sonar_seen: Any, index: Any, tile_at: Any, free_slots: Any, flags: Any, state: Any,
) -> None:  # fmt: skip
    """Evidence of one echo, or of its absence, in a cone; lengths and places in cells, cells by their centres.

    ox, oy, axis_x, axis_y, cos_half: the transducer, its axis (unit vector) and the cosine of half the opening angle.
    arc_len, arc_half: the echo lies this far away, plus or minus; arc_len negative: no echo.
    free_from, free_len: between them the cone is free, if free_len is larger.
    weights: (occupied on the axis, its share at the edge 0 to 1, free on the axis, lowest, highest) in steps.
    guards: (K, 7) arcs of other transducers (ox, oy, axis_x, axis_y, cos_half, arc_len, arc_half) not to be cleared.

    The angle enters as a = 1 - (1 - cos t) / (1 - cos t_max), nearly 1 - (t / t_max)^2: 1 on the axis, 0 at the edge.
    Occupied evidence falls with it to the share at the edge, and with the distance from the arc to about 0. Free
    evidence falls with a to 0 and with the distance from the transducer to half. Evidence below half a step is none.
    """
    far = free_len
    if arc_len >= 0.0:
        far = max(far, arc_len + arc_half)
    row_lo, row_hi = max(window[0], math.floor(oy - far) - 1), min(window[1], math.floor(oy + far) + 2)
    col_lo, col_hi = max(window[2], math.floor(ox - far) - 1), min(window[3], math.floor(ox + far) + 2)
    per_cos = 1.0 / max(1.0 - cos_half, 1e-12)
    occupied, edge_share, free, lowest, highest = weights[0], weights[1], weights[2], weights[3], weights[4]
    for row in range(row_lo, row_hi):
        y = row + 0.5 - oy
        for col in range(col_lo, col_hi):
            x = col + 0.5 - ox
            distance = math.sqrt(x * x + y * y)
            along = x * axis_x + y * axis_y
            if distance > far or along < cos_half * distance or distance == 0.0:
                continue
            centred = max(0.0, 1.0 - (1.0 - along / distance) * per_cos)
            step = 0
            if arc_len >= 0.0 and abs(distance - arc_len) <= arc_half:
                off = (distance - arc_len) / (arc_half + 0.5)
                step = int(occupied * (edge_share + (1.0 - edge_share) * centred) * (1.0 - off * off) + 0.5)
            elif free_from <= distance <= free_len:
                step = -int(free * centred * (1.0 - 0.5 * distance / free_len) + 0.5)
                if step < 0:
                    for g in range(guards.shape[0]):
                        gx = col + 0.5 - guards[g, 0]
                        gy = row + 0.5 - guards[g, 1]
                        away = math.sqrt(gx * gx + gy * gy)
                        if (
                            abs(away - guards[g, 5]) <= guards[g, 6]
                            and gx * guards[g, 2] + gy * guards[g, 3] >= guards[g, 4] * away
                        ):
                            step = 0
                            break
            if step == 0:
                continue
            table_row = (row >> TILE_BITS) - tile_row0
            table_col = (col >> TILE_BITS) - tile_col0
            slot: Any = np.int64(index[table_row, table_col])
            if slot == 0:
                slot = new_slot(table_row, table_col, tile_row0, tile_col0, index, tile_at, free_slots, state)
            at = (slot << (2 * TILE_BITS)) + ((row & TILE_MASK) << TILE_BITS) + (col & TILE_MASK)
            value: Any = np.int64(cells[at])
            value = step if value == 0 else value - SONAR_ZERO + step
            cells[at] = SONAR_ZERO + int(min(max(value, lowest), highest))
            sonar_seen[slot] = 1
            flags[slot] = 0xFF


@njit(cache=True, nogil=True)
def echo_explained(
    ox: float, oy: float, axis_x: float, axis_y: float, cos_half: float, arc_len: float, tolerance: float, window: Any,
    tile_row0: int, tile_col0: int, laser_cells: Any, laser_percent: Any, occupied: int, index: Any,
) -> bool:  # fmt: skip
    """Whether the laser knows an obstacle in the cone whose nearest point is where the echo came from.

    Lengths and places in cells. tolerance: how far off the arc a cell's centre may lie.  occupied: per cent from which
    laser_percent[cell] is an obstacle.
    """
    far, near = arc_len + tolerance, max(arc_len - tolerance, 0.0)
    row_lo, row_hi = max(window[0], math.floor(oy - far) - 1), min(window[1], math.floor(oy + far) + 2)
    col_lo, col_hi = max(window[2], math.floor(ox - far) - 1), min(window[3], math.floor(ox + far) + 2)
    for row in range(row_lo, row_hi):
        y = row + 0.5 - oy
        for col in range(col_lo, col_hi):
            x = col + 0.5 - ox
            distance = math.sqrt(x * x + y * y)
            if distance < near or distance > far or x * axis_x + y * axis_y < cos_half * distance:
                continue
            slot: Any = np.int64(index[(row >> TILE_BITS) - tile_row0, (col >> TILE_BITS) - tile_col0])
            if slot != 0:
                at = (slot << (2 * TILE_BITS)) + ((row & TILE_MASK) << TILE_BITS) + (col & TILE_MASK)
                if laser_percent[laser_cells[at]] >= occupied:
                    return True
    return False


@njit(cache=True, nogil=True)
def insert_reading(
    ox: float, oy: float, axis_x: float, axis_y: float, cos_half: float, arc_len: float, arc_half: float,
    explain: float, free_from: float, free_len: float, weights: Any, guards: Any, window: Any, tile_row0: int,
    tile_col0: int, laser_cells: Any, laser_percent: Any, laser_occupied: int, cells: Any, sonar_seen: Any, index: Any,
    tile_at: Any, free_slots: Any, flags: Any, state: Any,
) -> None:  # fmt: skip
    """As insert_cone, where an echo that the laser explains (echo_explained, with the tolerance `explain`) puts up no
    obstacle: the arc's other cells have no claim to be where it came from.

    laser_cells, laser_percent, laser_occupied: as in echo_explained. The other arguments are those of insert_cone.
    """
    if arc_len >= 0.0 and echo_explained(
        ox, oy, axis_x, axis_y, cos_half, arc_len, explain, window, tile_row0, tile_col0, laser_cells, laser_percent,
        laser_occupied, index,
    ):  # fmt: skip
        weights = weights.copy()
        weights[0] = 0.0
    insert_cone(
        ox, oy, axis_x, axis_y, cos_half, arc_len, arc_half, free_from, free_len, weights, guards, window, tile_row0,
        tile_col0, cells, sonar_seen, index, tile_at, free_slots, flags, state,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def halve_sonar(cells: Any, start: int, stop: int) -> None:
    """Forget half of the evidence; a cell with nothing left becomes unknown."""
    for at in range(np.uint64(start), np.uint64(stop)):
        value = np.int32(cells[at])
        if value != 0:
            odds = value - np.int32(SONAR_ZERO)
            half = (abs(odds) >> 1) * (1 if odds > 0 else -1)
            cells[at] = np.uint8(0 if half == 0 else half + SONAR_ZERO)
