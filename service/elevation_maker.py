"""Heights around the vehicle in the daemon: clouds of tilting lasers in, the document of `map/elevation` out (S33).

The map is made anew from the newest clouds of each mount and ends around the vehicle: what has gone is forgotten with
its cloud, and memory stays bounded however far the vehicle drives. What sectors are told of it (S37) is told in
`service/sector_ground.py`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, Pose3
from mapping.grids.height import Elevation, ElevationMap, Ground, GroundRules
from mapping.scan import Scan
from mapping.sectors.footprint import in_polygon
from service.map_makers import MapView, Tile
from service.outputs import CloudOut, DocumentOut, Output

F64 = NDArray[np.float64]

KEY = "map/elevation"
_LAYERS = (("height_m", "mean_m"), ("slope_rad", "slope_rad"), ("step_m", "step_m"), ("roughness_m", "roughness_m"))


@dataclass(frozen=True, slots=True)
class KnownGround:
    """An elevation map and when it is from. stamp_ns, map_from_base: of its newest cloud; since_ns: of its oldest."""

    stamp_ns: int
    since_ns: int
    map_from_base: Pose2
    elevation: Elevation


@dataclass(frozen=True, slots=True)
class _Cloud:
    stamp_ns: int
    map_from_base: Pose2
    points_m: F64


class ElevationMaker:
    """A map maker that keeps the heights of the newest clouds. They are not kept in the store: nods later they are
    there again.

    size_m: edge of the square around the vehicle.  height_max_m: above the base's level; what lies higher is left out.
    clouds: how many of each mount count.  footprint: (N, 2) outline in the base frame; what was measured inside of it
    is the vehicle itself, and left out.
    """

    def __init__(
        self,
        *,
        resolution_m: float = 0.1,
        size_m: float = 10.0,
        height_max_m: float = 2.0,
        clouds: int = 10,
        rules: GroundRules | None = None,
        footprint: ArrayLike | None = None,
        period_ns: int = 1_000_000_000,
    ) -> None:
        self.name = "elevation"
        self.sources: frozenset[str] = frozenset()
        self.period_ns = period_ns
        self.newest: KnownGround | None = None
        """The map as last made; replaced, never changed, so other threads may read it."""
        self._resolution_m, self._half_m, self._height_max_m = resolution_m, size_m / 2.0, height_max_m
        self._rules = rules or GroundRules()
        self._clouds_max = clouds
        self._footprint = None if footprint is None else np.asarray(footprint, dtype=np.float64)
        self._clouds: dict[str, deque[_Cloud]] = {}
        self._not_before_ns = 0
        self._version = self._told_version = 0

    def take_cloud(self, cloud: CloudOut) -> None:
        """Keep it; one whose place in the map is not known, or from before the map was moved, says nothing."""
        if cloud.map_from_base is None or cloud.stamp_ns < self._not_before_ns:
            return
        points = cloud.points_m.astype(np.float64)
        wanted = np.all(np.isfinite(points), axis=1) & (points[:, 2] <= self._height_max_m)
        if self._footprint is not None:
            wanted &= ~in_polygon(points[:, :2], self._footprint)
        placed = Pose3.from_plane(cloud.map_from_base).apply(points[wanted])
        kept = self._clouds.setdefault(cloud.mount, deque(maxlen=self._clouds_max))
        kept.append(_Cloud(cloud.stamp_ns, cloud.map_from_base, placed))
        self._version += 1

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Level sweeps say nothing about heights."""

    def forget_before(self, stamp_ns: int) -> None:
        """The map was moved under the vehicle: older clouds lie in the wrong place. From any thread."""
        self._not_before_ns = stamp_ns

    def make(self, view: MapView) -> list[Output]:
        """The map, if a cloud came since it was last told."""
        if self._version == self._told_version:
            return []
        self._told_version = self._version
        since_ns = self._not_before_ns
        clouds = [each for mount in sorted(self._clouds) for each in self._clouds[mount] if each.stamp_ns >= since_ns]
        if not clouds:
            self.newest = None
            return []
        newest = max(clouds, key=lambda each: each.stamp_ns)
        elevation = self._elevation(clouds, newest.map_from_base)
        self.newest = KnownGround(
            newest.stamp_ns, min(each.stamp_ns for each in clouds), newest.map_from_base, elevation
        )
        return [DocumentOut(KEY, newest.stamp_ns, elevation_fields(elevation, version=self._version))]

    def _elevation(self, clouds: Iterable[_Cloud], map_from_base: Pose2) -> Elevation:
        heights = ElevationMap(resolution_m=self._resolution_m, rules=self._rules)
        centre = np.array((map_from_base.x_m, map_from_base.y_m))
        for cloud in clouds:
            near = np.all(np.abs(cloud.points_m[:, :2] - centre) <= self._half_m, axis=1)
            heights.insert(cloud.points_m[near])
        return heights.elevation()

    def changed_tiles(self) -> list[Tile]:
        return []

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Begins empty."""
        self._clouds.clear()


def elevation_fields(elevation: Elevation, *, version: int, frame: str = "map") -> dict[str, object]:
    """The document umfeld.elevation.v1 but for its schema and stamp, cut to the cells that say something.

    Layers are rows of cells, the lowest row first; null: not known. ground: the number of Ground.
    """
    part = known_part(elevation)
    ground, r = elevation.ground[part], elevation.resolution_m
    rows, columns = ground.shape
    return {
        "frame": frame,
        "version": version,
        "resolution_m": r,
        "rows": rows,
        "columns": columns,
        "origin": {
            "x_m": round((elevation.col0 + part[1].start) * r, 6) + 0.0,
            "y_m": round((elevation.row0 + part[0].start) * r, 6) + 0.0,
            "yaw_rad": 0.0,
        },
        "cells": {kind.name.lower(): int(np.count_nonzero(ground == kind)) for kind in Ground},
        **{name: rows_of(getattr(elevation, layer)[part]) for name, layer in _LAYERS},
        "ground": ground.tolist(),
    }


def known_part(elevation: Elevation) -> tuple[slice, slice]:
    """The rows and columns around the cells that say something."""
    return _bounds(~np.isnan(elevation.mean_m) | (elevation.ground != Ground.UNKNOWN))


def rows_of(layer: F64) -> list[list[float | None]]:
    """A layer (R, C) as lists, to a thousandth; None where nothing is known."""
    return [[round(v, 3) + 0.0 if math.isfinite(v) else None for v in row] for row in layer.tolist()]


def _bounds(says: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The rows and columns around what is true."""
    rows, cols = np.flatnonzero(says.any(axis=1)), np.flatnonzero(says.any(axis=0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)
