"""From a polar sector map to the cells of a grid, around the robot or in the world (S39, figures 5.27 to 5.29)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.kernels import sectors as kernels
from mapping.sectors.snapshot import PolarSnapshot, SectorState

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
_CELLS_MAX = 100_000_000


def obstacle_tiles(
    *, position_m: tuple[float, float], heading_rad: float, distance_m: float, bearing_rad: float, width_rad: float,
    resolution_m: float,
) -> I64:  # fmt: skip
    """The up to three tiles of a sector's obstacle: at its centre and at both borders.

    position_m, heading_rad: of the kinematic centre in the grid, (x, y) and psi.  bearing_rad: phi, the sector's
    centre.  Returns (3, 2) tiles [row, col] = [n, m], counted from the tile of the kinematic centre.
    Source: eqs. 5.47 to 5.52 with the robot's position counted once: m d - e <= r cos(phi + psi) < (m + 1) d - e,
    where e is the offset of the centre from its tile's origin; the printed M + m adds the position a second time.
    """
    eps_x = position_m[0] - math.floor(position_m[0] / resolution_m) * resolution_m
    eps_y = position_m[1] - math.floor(position_m[1] / resolution_m) * resolution_m
    tiles = np.empty((3, 2), dtype=np.int64)
    for k, off in enumerate((0.0, 0.5 * width_rad, -0.5 * width_rad)):
        angle = bearing_rad + heading_rad + off
        tiles[k, 0] = math.floor((distance_m * math.sin(angle) + eps_y) / resolution_m)
        tiles[k, 1] = math.floor((distance_m * math.cos(angle) + eps_x) / resolution_m)
    return tiles


def robot_cells(snapshot: PolarSnapshot, *, resolution_m: float) -> tuple[I64, I64]:
    """world_cells for a grid that turns with the robot, its origin at the corner of cell (0, 0)."""
    return world_cells(snapshot, IDENTITY, resolution_m=resolution_m)


def world_cells(
    snapshot: PolarSnapshot, world_from_base: Pose2, *, resolution_m: float, reach_m: float = math.inf
) -> tuple[I64, I64]:
    """What a sector map says about the cells of a grid.

    reach_m: nothing farther from the virtual sensor is transferred.
    Returns hits (H, 2) and frees (F, 2), [row, col] in ascending order without repetition, no cell in both. Hits are
    all cells that a sector's arc at its obstacle's distance passes: the three tiles of eqs. 5.47 to 5.52 and, where
    the arc is longer than those, the ones between. Frees are the cells whose centre lies in a sector, nearer than its
    obstacle or than free was seen. Unknown and stale sectors give nothing.
    Raises ValueError if resolution_m is not positive, or the free area would be too large to list: set reach_m.
    """
    if not resolution_m > 0.0:
        raise ValueError("resolution_m must be positive")
    sensor = world_from_base @ snapshot.base_from_sensor
    is_obstacle = snapshot.state == SectorState.OBSTACLE
    knows = is_obstacle | (snapshot.state == SectorState.FREE)
    reach = np.minimum(np.where(knows, np.nan_to_num(snapshot.distance_m, nan=0.0), 0.0), reach_m)
    hits = _arcs(snapshot, sensor, resolution_m, is_obstacle & (snapshot.distance_m <= reach_m))
    free, row0, col0 = _cones(snapshot, sensor, resolution_m, reach)
    inside = (
        (hits[:, 0] >= row0)
        & (hits[:, 0] < row0 + free.shape[0])
        & (hits[:, 1] >= col0)
        & (hits[:, 1] < col0 + free.shape[1])
    )
    free[hits[inside, 0] - row0, hits[inside, 1] - col0] = False
    return hits, np.argwhere(free).astype(np.int64) + np.array([row0, col0])


def _arcs(snapshot: PolarSnapshot, sensor: Pose2, resolution_m: float, wanted: NDArray[np.bool_]) -> I64:
    cells = [np.empty((0, 2), dtype=np.int64)]
    for sector in np.flatnonzero(wanted):
        distance = float(snapshot.distance_m[sector])
        room = np.empty((int(8.0 * distance / resolution_m) + 20, 2), dtype=np.int64)
        count = kernels.arc_cells(
            sensor.x_m,
            sensor.y_m,
            max(distance, 1e-9),
            float(snapshot.edges_rad[sector]) + sensor.yaw_rad,
            float(snapshot.edges_rad[sector + 1]) + sensor.yaw_rad,
            resolution_m,
            room,
        )
        cells.append(room[:count])
    return np.unique(np.concatenate(cells), axis=0)


def _cones(
    snapshot: PolarSnapshot, sensor: Pose2, resolution_m: float, reach: F64
) -> tuple[NDArray[np.bool_], int, int]:
    farthest = float(reach.max()) if len(reach) else 0.0
    row0 = math.floor((sensor.y_m - farthest) / resolution_m)
    col0 = math.floor((sensor.x_m - farthest) / resolution_m)
    rows = math.floor((sensor.y_m + farthest) / resolution_m) + 1 - row0
    cols = math.floor((sensor.x_m + farthest) / resolution_m) + 1 - col0
    if rows * cols > _CELLS_MAX:
        raise ValueError(f"{rows} x {cols} cells are too many: set reach_m")
    free = np.zeros((rows, cols), dtype=bool)
    edges = snapshot.edges_rad
    kernels.cone_cells(
        sensor.x_m,
        sensor.y_m,
        sensor.yaw_rad,
        float(edges[0]),
        float(edges[1] - edges[0]),
        float(edges[-1] - edges[0]),
        reach,
        resolution_m,
        row0,
        col0,
        free,
    )
    return free, row0, col0
