"""Other contents of sectors: slope of the ground and how far it can be driven on, from an elevation map (S37)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.height import Elevation, Ground

F64 = NDArray[np.float64]
I8 = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class SectorGround:
    """The ground in the wedges of a polar sector map; (N,) each, in the order of the sectors.

    traversable_m: from the origin, as far as every cell of the wedge is TRAVERSABLE; 0 if not even the first is.
    stopped_by: Ground of the nearest cell that is not, TRAVERSABLE if there is none within reach.
    slope_rad: the steepest of the cells from blind_m up to there, NaN without one.
    """

    traversable_m: F64
    stopped_by: I8
    slope_rad: F64


def ground_in_sectors(
    elevation: Elevation, map_from_sensor: Pose2, edges_rad: F64, *, reach_m: float, blind_m: float = 0.0
) -> SectorGround:
    """What the elevation map says about each wedge of bearings.

    edges_rad: (N + 1,) ascending, in the virtual sensor's frame, as in PolarSnapshot.  reach_m: how far to look.
    blind_m: unknown cells whose centre is nearer are passed over: the vehicle hides them. What is known to be in the
    way there stops all the same.
    A cell counts in every wedge that its circle around touches, at the distance of its nearest point. Cells outside
    of the map are unknown, and stop.  Raises ValueError for edges that do not rise, or a reach that is no length.
    """
    if edges_rad.ndim != 1 or len(edges_rad) < 2 or not np.all(np.diff(edges_rad) > 0.0):
        raise ValueError("edges_rad rises, and has at least two entries")
    if not (0.0 < reach_m < math.inf and 0.0 <= blind_m < reach_m):
        raise ValueError(f"0 <= blind_m < reach_m, got {blind_m} and {reach_m}")
    d = elevation.resolution_m
    half = d * math.sqrt(0.5)
    around = math.ceil((reach_m + d) / d) + 1
    row, col = math.floor(map_from_sensor.y_m / d), math.floor(map_from_sensor.x_m / d)
    rows, cols = np.mgrid[row - around : row + around + 1, col - around : col + around + 1].reshape(2, -1)
    x, y = (cols + 0.5) * d - map_from_sensor.x_m, (rows + 0.5) * d - map_from_sensor.y_m
    distance = np.hypot(x, y)
    ground, slope = _look_up(elevation, rows, cols)
    wanted = (distance - half < reach_m) & ((distance >= blind_m) | (ground != Ground.UNKNOWN))
    x, y, distance, ground, slope = x[wanted], y[wanted], distance[wanted], ground[wanted], slope[wanted]
    middle = (edges_rad[0] + edges_rad[-1]) / 2.0
    bearing = np.arctan2(y, x) - map_from_sensor.yaw_rad
    bearing = middle + np.mod(bearing - middle + math.pi, 2.0 * math.pi) - math.pi
    spread = np.where(distance > half, np.arcsin(np.minimum(half / np.maximum(distance, 1e-9), 1.0)), math.pi)
    nearest = np.maximum(distance - half, 0.0)
    n = len(edges_rad) - 1
    reached, stopped, steepest = np.full(n, reach_m), np.full(n, Ground.TRAVERSABLE, dtype=np.int8), np.full(n, np.nan)
    for k in range(n):
        inside = _touches(bearing, spread, float(edges_rad[k]), float(edges_rad[k + 1]))
        stops = inside & (ground != Ground.TRAVERSABLE)
        if stops.any():
            first = np.flatnonzero(stops)[np.argmin(nearest[stops])]
            reached[k], stopped[k] = min(float(nearest[first]), reach_m), ground[first]
        driven = inside & (nearest < reached[k]) & (distance >= blind_m) & ~np.isnan(slope)
        if driven.any():
            steepest[k] = slope[driven].max()
    return SectorGround(reached, stopped, steepest)


def _touches(bearing: F64, spread: F64, start: float, stop: float) -> NDArray[np.bool_]:
    """Whether [bearing - spread, bearing + spread] meets the wedge, a turn up or down included."""
    half = (stop - start) / 2.0
    off = np.abs(np.mod(bearing - (start + half) + math.pi, 2.0 * math.pi) - math.pi)
    return np.asarray(off <= half + spread)


def _look_up(elevation: Elevation, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> tuple[I8, F64]:
    """Ground and slope of cells, unknown outside."""
    r, c = rows - elevation.row0, cols - elevation.col0
    inside = (r >= 0) & (r < elevation.ground.shape[0]) & (c >= 0) & (c < elevation.ground.shape[1])
    ground = np.full(len(r), Ground.UNKNOWN, dtype=np.int8)
    slope = np.full(len(r), np.nan)
    ground[inside], slope[inside] = elevation.ground[r[inside], c[inside]], elevation.slope_rad[r[inside], c[inside]]
    return ground, slope
