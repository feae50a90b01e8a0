"""Regions of free space in the daemon: the grid in, the document of `map/topo` out, routes over it (S41).

Only cells known to be free make regions, and regions keep `smooth_m` off everything else: smoothing the ragged outline
of a grid may never add what is not free. Where a plan has too many corners it is smoothed more, up to four times.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, Output
from service.routes import NEAR_M, NodeId, Passage, Ways
from service.rpc import CallRefused

if TYPE_CHECKING:
    from shapely.geometry import MultiPolygon

    from mapping.topology.regions import RegionMap

F64 = NDArray[np.float64]

KEY = "map/topo"
FREE_BELOW = 35  # per cent; what is between free and occupied is not free
_COARSE_M = 0.1
_LEAST_M2 = 0.5
_MOST_CORNERS = 400
_SMOOTHER = (1.0, 2.0, 4.0)


class TopoMaker:
    """A map maker: regions, passages and rooms of the newest grid. Not kept in the store: the grid is."""

    def __init__(self, *, period_ns: int = 5_000_000_000, smooth_m: float = 0.15, door_m: float = 1.3) -> None:
        self.name = "topo"
        self.sources: frozenset[str] = frozenset()
        self.period_ns = period_ns
        self._smooth_m, self._door_m = smooth_m, door_m
        self._told: bytes = b""
        self._version = 0
        self._regions: RegionMap | None = None

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """It is made from the grid."""

    def make(self, view: MapView) -> list[Output]:
        """The graph, if it is another than was told."""
        if view.grid is None or not view.changed:
            return []
        self._regions = regions_of_grid(view.grid, smooth_m=self._smooth_m)
        fields = topo_fields(self._regions, door_m=self._door_m)
        body = json.dumps(fields, sort_keys=True).encode()
        if body == self._told:
            return []
        self._told = body
        self._version += 1
        return [DocumentOut(KEY, view.stamp_ns, {"frame": "map", "version": self._version, **fields})]

    @property
    def map_version(self) -> int:
        """Rises when the map changes."""
        return self._version

    @property
    def regions(self) -> RegionMap | None:
        """As they were found last."""
        return self._regions

    def changed_tiles(self) -> list[Tile]:
        return []

    def restore(self, tiles: Iterable[Tile]) -> None:
        """The grid comes back, and with it the regions."""
        self._regions, self._told = None, b""

    def ways(self) -> Ways:
        """For the call @rpc/route."""
        if self._regions is None or not self._regions.regions:
            raise CallRefused("no regions are known yet: let the robot see some free space first")
        return ways_of(self._regions)


def regions_of_grid(grid: GridPatch, *, smooth_m: float) -> RegionMap:
    """The convex free regions of a grid; none if there is no free space, or no smoothing makes it simple enough."""
    from mapping.topology.regions import RegionMap, decompose

    free = free_polygons(grid)
    for times in _SMOOTHER:
        inner = free.buffer(-smooth_m * times, join_style="mitre").simplify(smooth_m * times)
        parts = [part for part in getattr(inner, "geoms", [inner]) if part.area >= _LEAST_M2]
        if not parts:
            break
        if sum(len(ring.coords) for part in parts for ring in (part.exterior, *part.interiors)) <= _MOST_CORNERS:
            from shapely.geometry import MultiPolygon

            return decompose(MultiPolygon(parts))
    return RegionMap((), ())


def free_polygons(grid: GridPatch) -> MultiPolygon:
    """What is free in a grid, in blocks of about 0.1 m of which every cell is."""
    import shapely
    from shapely.geometry import MultiPolygon

    factor = max(1, round(_COARSE_M / grid.resolution_m))
    first_row, first_col = -(-grid.row0 // factor), -(-grid.col0 // factor)
    cells = grid.cells[first_row * factor - grid.row0 :, first_col * factor - grid.col0 :]
    rows, cols = cells.shape[0] // factor, cells.shape[1] // factor
    is_free = (cells >= 0) & (cells < FREE_BELOW)
    block = is_free[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor).all(axis=(1, 3))
    edge = np.diff(np.pad(block, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, begin = np.nonzero(edge == 1)
    _, end = np.nonzero(edge == -1)
    side = grid.resolution_m * factor
    runs = shapely.box(
        (begin + first_col) * side, (row + first_row) * side, (end + first_col) * side, (row + first_row + 1) * side
    )
    union = shapely.union_all(runs)
    return MultiPolygon([part for part in shapely.get_parts(union) if part.geom_type == "Polygon"])


def topo_fields(regions: RegionMap, *, door_m: float) -> dict[str, Any]:
    """The document umfeld.topo.v1 but for its schema, stamp, frame and version."""
    from mapping.topology.regions import room_graph

    rooms = room_graph(regions, door_m=door_m)
    room_of = {number: room for room, facts in rooms.nodes(data=True) for number in facts["regions"]}
    return {
        "kind": "regions",
        "nodes": [
            {
                "id": region.number,
                "position": _rounded(region.centre_m),
                "room": room_of[region.number],
                "area_m2": round(region.area_m2, 3),
                "polygon": [_rounded(corner) for corner in region.corners_m],
            }
            for region in regions.regions
        ],
        "edges": [
            {
                "from": passage.a,
                "to": passage.b,
                "ends": [_rounded(end) for end in passage.ends_m],
                "width_m": round(passage.width_m, 3),
                "is_door": room_of[passage.a] != room_of[passage.b],
            }
            for passage in regions.passages
        ],
    }


def ways_of(regions: RegionMap) -> Ways:
    """Regions for routes: from centre to centre through the passages."""
    at: dict[NodeId, tuple[float, float]] = {
        each.number: (float(each.centre_m[0]), float(each.centre_m[1])) for each in regions.regions
    }
    passages = []
    for each in regions.passages:
        x, y = each.ends_m.mean(axis=0).tolist()
        passages.append(Passage(each.a, each.b, (x, y)))
    return Ways("regions", at, passages, nearest=partial(_region_at, regions))


def _region_at(regions: RegionMap, point: tuple[float, float], name: str) -> int:
    """The region in which a point lies; of a point outside all of them the nearest within 1 m."""
    from shapely.geometry import Point, Polygon

    away = [(Polygon(region.corners_m).distance(Point(point)), region.number) for region in regions.regions]
    distance, number = min(away)
    if distance > NEAR_M:
        raise CallRefused(
            f'"{name}": no region within {NEAR_M:g} m of {list(point)}; the nearest is {distance:.1f} m away'
        )
    return number


def _rounded(point: Any) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in point]
