"""Room around obstacles: the cell size that a safety distance asks for, distances, inflated maps (S30)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.grids.geometry import check_resolution
from mapping.grids.patch import GridPatch
from mapping.kernels import clearance as kernels

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
Bools = NDArray[np.bool_]

MAX_SIDE_CELLS = 20_000


def cell_size_for_clearance(clearance_m: float) -> float:
    """The cell size d = n / sqrt(2) whose diagonal is the safety clearance n (0.07 m -> 0.0495 m).

    With it, a point in a cell next to an occupied one is at most n from the cell's far corner: marking the neighbours
    of occupied cells keeps n of free space. ValueError unless positive and finite.
    """
    return check_resolution(clearance_m) / math.sqrt(2.0)


def clearance_of_cell_size(resolution_m: float) -> float:
    """The safety clearance n = d sqrt(2) that cells of this size stand for."""
    return check_resolution(resolution_m) * math.sqrt(2.0)


def squared_cell_distances(obstacle: Bools) -> I32:
    """(R, C) exact squared distance, in cells, from each cell's centre to the nearest obstacle cell's centre.

    obstacle: (R, C).  kernels.FAR where there is no obstacle at all.  Time grows as R * C.
    Raises ValueError if it is not (R, C) or has a side above 20,000.
    """
    if obstacle.ndim != 2 or max(obstacle.shape) > MAX_SIDE_CELLS:
        raise ValueError(f"obstacles are (R, C) with sides up to {MAX_SIDE_CELLS}, got {obstacle.shape}")
    rows, cols = obstacle.shape
    squared: I32 = np.empty((rows, cols), dtype=np.int32)
    if squared.size == 0:
        return squared
    down = np.empty((rows, cols), dtype=np.int32)
    work = [np.empty(cols + 1, dtype=np.int32) for _ in range(3)]
    kernels.column_distances(np.ascontiguousarray(obstacle, dtype=np.bool_), down)
    kernels.row_envelopes(down, squared, *work)
    return squared


def clearance_layer(patch: GridPatch, *, occupied_percent: int = 65, unknown_is_obstacle: bool = False) -> F32:
    """(R, C) distance in metres from each cell to the nearest occupied cell, exact Euclid between centres.

    inf where no cell of the patch is occupied. An obstacle can stand at the near side of its cell and the robot at
    the near side of its own: subtract clearance_of_cell_size for what is surely free.
    unknown_is_obstacle: for planners that must not come near what was never seen.
    """
    obstacle = patch.cells >= occupied_percent
    if unknown_is_obstacle:
        obstacle = obstacle | (patch.cells < 0)
    squared = squared_cell_distances(obstacle)
    metres = np.sqrt(squared, dtype=np.float32) * np.float32(patch.resolution_m)
    metres[squared == kernels.FAR] = np.inf
    return metres


def inflated(patch: GridPatch, radius_m: float, *, occupied_percent: int = 65) -> GridPatch:
    """The patch with every cell that comes within radius_m of an occupied cell occupied too (100).

    Distances are between the nearest points of the two cells, so that a disc of that radius, wherever it stands in a
    cell left free, touches no occupied cell. Unknown cells within the radius become occupied as well, others stay.
    Raises ValueError for a radius that is negative or not finite.
    """
    if not (math.isfinite(radius_m) and radius_m >= 0.0):
        raise ValueError(f"radius_m is a length, got {radius_m}")
    obstacle = patch.cells >= occupied_percent
    if radius_m == 0.0 or not obstacle.any():
        return patch
    squared = squared_cell_distances(obstacle)
    # Two cells whose centres are D apart come as near as D - sqrt(2) cells.
    reach = radius_m / patch.resolution_m + math.sqrt(2.0)
    cells = np.where(squared < reach * reach, np.int8(100), patch.cells)
    return GridPatch(patch.resolution_m, patch.row0, patch.col0, cells.astype(np.int8))
