"""A grid that another program made, as a map file that the daemon can load and go on with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from mapping.geo import Anchor
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.tiles import TILE
from service.export import FREE_THRESHOLD, OCCUPIED_THRESHOLD, MapFileTrouble
from service.files import Receipt
from service.live_map import ANCHOR
from service.store import Tile, write_occupancy_map

_OBSERVATIONS = 4
"""Each cell counts as seen this often: sure enough to be occupied or free, and soon overruled by what a robot sees."""


def write_imported_map(
    patch: GridPatch,
    path: Path,
    *,
    source: str,
    model: Literal["counters", "log-odds"],
    anchor: Anchor | None = None,
) -> Receipt:
    """Write patch as a map file. model: that of the grid which shall load it ([grid] model).  anchor: kept with it."""
    grid = OccupancyGrid(resolution_m=patch.resolution_m, model=model, max_tiles=tiles_needed(patch))
    corner = (patch.row0, patch.col0)
    occupied = np.argwhere(patch.cells >= 100 * OCCUPIED_THRESHOLD) + corner
    free = np.argwhere((patch.cells >= 0) & (patch.cells < 100 * FREE_THRESHOLD)) + corner
    if len(occupied) + len(free) == 0:
        raise MapFileTrouble(f"{source}: no cell of it is occupied or free; are its thresholds right?")
    try:
        for _ in range(_OBSERVATIONS):
            grid.insert_cells(occupied, free)
    except ValueError as error:
        raise MapFileTrouble(f"{source}: {error}; move its origin nearer to the map's") from error
    if grid.refused_tiles:
        raise MapFileTrouble(f"{source}: is too large for one map; cut it or use a coarser --resolution")
    return write_grid_map(grid, path, source=source, anchor=anchor)


def write_grid_map(
    grid: OccupancyGrid,
    path: Path,
    *,
    source: str,
    layers: Mapping[str, Iterable[Tile]] | None = None,
    anchor: Anchor | None = None,
) -> Receipt:
    """A grid as a map file: what exports read, and the tiles from which a daemon restores it; replaces path whole.

    layers: of other maps, to go into the same file.  anchor: where the map lies on the earth.
    """
    place = {} if anchor is None else {ANCHOR: anchor_fields(anchor)}
    properties = {"resolution_m": grid.resolution_m, "model": grid.model, "tile_cells": TILE}
    return write_occupancy_map(
        grid.patch(),
        path,
        source=source,
        tile_cells=TILE,
        layers={"grid": grid.tiles(), **(layers or {})},
        meta={"grid": properties, **place},
    )


def anchor_fields(anchor: Anchor) -> dict[str, float]:
    """As a map file keeps it."""
    return {
        "latitude_deg": anchor.latitude_deg,
        "longitude_deg": anchor.longitude_deg,
        "height_m": anchor.height_m,
        "yaw_deg": round(math.degrees(anchor.yaw_rad), 9),
    }


def tiles_needed(patch: GridPatch) -> int:
    """Tiles that a patch touches; at least 1."""
    rows, columns = patch.cells.shape
    height = (patch.row0 + rows - 1) // TILE - patch.row0 // TILE + 1
    width = (patch.col0 + columns - 1) // TILE - patch.col0 // TILE + 1
    return max(1, int(height * width))
