"""Virtual sensors in a grid map: the sector map a sensor would see at any pose, also ahead on a planned path (S38).

A virtual sensor fed by real ones is PolarSectors or RectSectors with a pose of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.grids.patch import GridPatch
from mapping.kernels import sectors as kernels
from mapping.sectors.footprint import Outline
from mapping.sectors.polar import sector_edges
from mapping.sectors.snapshot import PolarSnapshot, SectorState

F64 = NDArray[np.float64]


def polar_from_grid(
    patch: GridPatch,
    map_from_virtual: Pose2,
    *,
    range_max_m: float,
    stamp_ns: int,
    start_rad: float = math.radians(-120.0),
    stop_rad: float = math.radians(120.0),
    sector_rad: float = math.radians(5.0),
    footprint: ArrayLike | None = None,
    occupied_from: int = 65,
    free_to: int = 35,
) -> PolarSnapshot:
    """What a sensor at a pose in the map would know from the map alone.

    footprint: the vehicle's outline about that pose; unknown cells under it do not count, occupied ones do.  Cells at
    occupied_from per cent or more are obstacles, up to free_to free; those between, -1 and what lies outside the
    patch are unknown.
    A sector is an obstacle if the nearest of its cells that are not free is occupied (at the nearest part of that
    cell within the sector), free up to range_max_m if all its cells are free, else unknown: an unknown cell hides what
    is behind it.  base_from_sensor of the result is the pose in the map; its source is `grid`, of age 0.
    Raises ValueError for a range that is not positive and finite, and for thresholds out of order.
    """
    if not (range_max_m > 0.0 and math.isfinite(range_max_m)):
        raise ValueError("range_max_m must be positive and finite")
    if not 0 <= free_to < occupied_from <= 100:
        raise ValueError("thresholds must be 0 <= free_to < occupied_from <= 100")
    edges = sector_edges(start_rad=start_rad, stop_rad=stop_rad, sector_rad=sector_rad)
    outline = Outline(footprint, IDENTITY)
    body = outline.polygon
    kinds = np.full(patch.cells.shape, 2, dtype=np.int8)
    kinds[(patch.cells >= 0) & (patch.cells <= free_to)] = 0
    kinds[patch.cells >= occupied_from] = 1
    occupied, bearing, unknown = kernels.nearest_cells_in_sectors(
        kinds,
        patch.row0,
        patch.col0,
        patch.resolution_m,
        map_from_virtual.x_m,
        map_from_virtual.y_m,
        map_from_virtual.yaw_rad,
        edges,
        sector_rad,
        range_max_m,
        body,
        float(np.hypot(body[:, 0], body[:, 1]).max()) if len(body) else 0.0,
    )
    return _snapshot(map_from_virtual, edges, outline, stamp_ns, range_max_m, (occupied, bearing, unknown))


def probe_path(
    patch: GridPatch,
    map_from_virtual: Iterable[Pose2],
    *,
    range_max_m: float,
    stamp_ns: int,
    start_rad: float = math.radians(-120.0),
    stop_rad: float = math.radians(120.0),
    sector_rad: float = math.radians(5.0),
    footprint: ArrayLike | None = None,
    occupied_from: int = 65,
    free_to: int = 35,
) -> list[PolarSnapshot]:
    """polar_from_grid at every pose of a planned path, in its order."""
    return [
        polar_from_grid(
            patch,
            pose,
            range_max_m=range_max_m,
            stamp_ns=stamp_ns,
            start_rad=start_rad,
            stop_rad=stop_rad,
            sector_rad=sector_rad,
            footprint=footprint,
            occupied_from=occupied_from,
            free_to=free_to,
        )
        for pose in map_from_virtual
    ]


def _snapshot(
    pose: Pose2, edges: F64, outline: Outline, stamp_ns: int, range_max_m: float, found: tuple[F64, F64, F64]
) -> PolarSnapshot:
    occupied, bearing, unknown = found
    state = np.full(len(occupied), SectorState.UNKNOWN, dtype=np.int8)
    is_free = (unknown >= range_max_m) & ~(occupied < range_max_m)
    # An unknown cell beside an occupied one begins where that one begins: a tie goes to what is known.
    is_obstacle = (occupied < range_max_m) & (occupied <= unknown + 1e-9)
    state[is_free], state[is_obstacle] = SectorState.FREE, SectorState.OBSTACLE
    distance = np.where(is_obstacle, occupied, np.where(is_free, range_max_m, np.nan))
    at = np.where(is_obstacle, bearing, np.nan)
    border = np.where(is_free, outline.farthest_border_m(edges), outline.border_m(at))
    known = state != SectorState.UNKNOWN
    return PolarSnapshot(
        stamp_ns=stamp_ns,
        base_from_sensor=pose,
        edges_rad=edges,
        state=state,
        distance_m=distance,
        bearing_rad=at,
        clearance_m=distance - border,
        age_ns=np.where(known, 0, -1).astype(np.int64),
        source=np.where(known, 0, -1).astype(np.int16),
        sources=("grid",),
    )
