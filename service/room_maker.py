"""Rooms in the daemon: the grid in, the document of `map/rooms` out; ways over the Voronoi diagram, names (S44).

What is not known to be free is an obstacle, for rooms and for ways. Ids and names are kept in the store.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, Output
from service.rpc import CallRefused

if TYPE_CHECKING:
    from mapping.hybrid.planner import Planner, Way
    from mapping.hybrid.room_book import RoomBook
    from mapping.hybrid.rooms import Room, RoomMap
    from mapping.hybrid.voronoi import VoronoiGrid

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]

KEY = "map/rooms"
FREE_BELOW = 35  # per cent; what is between free and occupied is not free
_OUTLINE_M = 0.1
_NAME_MAX = 64
_ALTERNATIVES_MAX = 5
_NAMES_ROW = 0  # ids begin at 1


class RoomMaker:
    """A map maker: rooms and doors of the newest grid, with ids and names that stay."""

    def __init__(self, *, period_ns: int = 5_000_000_000, clearance_m: float = 0.3) -> None:
        """clearance_m: what a plan keeps if it is not told."""
        from mapping.hybrid.room_book import RoomBook

        self.name = "rooms"
        self.sources: frozenset[str] = frozenset()
        self.period_ns = period_ns
        self._clearance_m = clearance_m
        self._book: RoomBook = RoomBook()
        self._names_changed = False
        self._grid: GridPatch | None = None
        self._found: RoomMap | None = None
        self._ids: dict[int, int] = {}
        self._diagram: VoronoiGrid | None = None
        self._planner: Planner | None = None
        self._here: Pose2 | None = None
        self._told = b""
        self._version = 0
        self._stamp_ns = 0

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """It is made from the grid."""

    def make(self, view: MapView) -> list[Output]:
        """The rooms, if they are others than were told."""
        self._here, self._stamp_ns = view.map_from_base, view.stamp_ns
        if view.grid is None or not view.changed:
            return []
        from mapping.hybrid.rooms import find_rooms

        patch = view.grid
        free = _free(patch)
        self._grid = GridPatch(patch.resolution_m, patch.row0, patch.col0, patch.cells.copy())
        self._planner = None
        self._found = find_rooms(free, patch.resolution_m)
        self._ids = self._book.update(self._found, row0=patch.row0, col0=patch.col0)
        return self.news()

    def news(self) -> list[Output]:
        """The document, if it says something new."""
        if self._found is None or self._grid is None:
            return []
        fields = rooms_fields(self._found, self._ids, self._book.names, self._grid)
        body = json.dumps(fields, sort_keys=True).encode()
        if body == self._told:
            return []
        self._told = body
        self._version += 1
        return [DocumentOut(KEY, self._stamp_ns, {"frame": "map", "version": self._version, **fields})]

    def changed_tiles(self) -> list[Tile]:
        """Territories of rooms, by id, and the names."""
        alive = set(self._book.known_ids)
        tiles = [(k, 0, self._book.territory_bytes(k) if k in alive else b"") for k in sorted(self._book.changed)]
        if tiles or self._names_changed:
            names = {"next": self._book.next_id, "names": {str(k): v for k, v in sorted(self._book.names.items())}}
            tiles.append((_NAMES_ROW, 0, json.dumps(names).encode()))
        self._book.changed, self._names_changed = set(), False
        return tiles

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Ids and names of a stored map. ValueError if they are damaged."""
        from mapping.hybrid.room_book import RoomBook

        stored = {row: payload for row, _, payload in tiles}
        book, head = RoomBook(), stored.pop(_NAMES_ROW, None)
        if head is not None:
            try:
                told = json.loads(head)
                names = {int(k): str(v) for k, v in told["names"].items()}
                next_id = int(told["next"])
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise ValueError(f"names of rooms are damaged: {error}") from error
            book.restore({k: payload for k, payload in stored.items() if payload}, names, next_id)
        self._book, self._told, self._found, self._planner = book, b"", None, None

    # --- calls, between two turns of the makers' thread

    def name_room(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The call @rpc/name_room: {"id": 3, "name": "kitchen"}; an empty name takes it away.

        CallRefused if there is no such room, the name is too long, or another room has it.
        """
        room_id, name = arguments.get("id"), arguments.get("name")
        if not isinstance(room_id, int) or isinstance(room_id, bool) or room_id not in self._book.known_ids:
            raise CallRefused(f'"id": no room has the id {json.dumps(room_id)}; map/rooms tells which there are')
        if not isinstance(name, str) or len(name) > _NAME_MAX or not name.isprintable():
            raise CallRefused(f'"name" is a text of at most {_NAME_MAX} characters, such as "kitchen"')
        name = name.strip()
        holder = next((k for k, known in self._book.names.items() if known == name and k != room_id), None)
        if name and holder is not None:
            raise CallRefused(f"room {holder} is called {name!r} already; give it another name first")
        self._book.names.pop(room_id, None)
        if name:
            self._book.names[room_id] = name
        self._names_changed = True
        return {"id": room_id, "name": name or None}

    def plan(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The call @rpc/plan: "goal", and if wanted "start" (default: where the robot is), "clearance_m",
        "alternatives".

        An end is a position [x, y], a room's id or its name. Answers poses, length_m, clearance_m along them,
        least_clearance_m, rooms (ids, in the order they are passed) and alternatives. CallRefused says why not.
        """
        from mapping.hybrid.planner import NoWayError

        unknown = set(arguments) - {"start", "goal", "clearance_m", "alternatives"}
        if unknown:
            raise CallRefused(
                f"unknown argument {sorted(unknown)[0]!r}; there are start, goal, clearance_m, alternatives"
            )
        clearance_m = arguments.get("clearance_m", self._clearance_m)
        if not _is_number(clearance_m) or not 0.0 <= clearance_m <= 100.0:
            raise CallRefused(f'"clearance_m" is a length up to 100, got {json.dumps(clearance_m)}')
        count = arguments.get("alternatives", 2)
        if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count <= _ALTERNATIVES_MAX:
            raise CallRefused(f'"alternatives" is a whole number up to {_ALTERNATIVES_MAX}, got {json.dumps(count)}')
        if self._grid is None:
            raise CallRefused("no grid is known yet: let the robot see some free space first")
        start, goal = self._place(arguments.get("start"), "start"), self._place(arguments.get("goal"), "goal")
        try:
            plan = self._warm_planner().plan(start, goal, clearance_m=float(clearance_m), alternatives=count)
        except NoWayError as error:
            raise CallRefused(str(error)) from error
        return {**self._way(plan.way), "alternatives": [self._way(other) for other in plan.alternatives]}

    def _warm_planner(self) -> Planner:
        """On the newest grid; made when it is first asked for after a change."""
        from mapping.hybrid.planner import Planner
        from mapping.hybrid.voronoi import VoronoiGrid

        assert self._grid is not None
        if self._planner is None:
            free = _free(self._grid)
            padded = np.pad(free, 1)  # so that the map's own border may be used
            if self._diagram is not None and self._diagram.shape == padded.shape:
                self._diagram.update(padded)
            else:
                self._diagram = VoronoiGrid(padded)
            self._planner = Planner(
                self._diagram, self._grid.resolution_m, row0=self._grid.row0 - 1, col0=self._grid.col0 - 1
            )
        return self._planner

    def _place(self, given: object, what: str) -> tuple[float, float]:
        if given is None and what == "start":
            if self._here is None:
                raise CallRefused('"start": where the robot is is not known; give a position [x, y] or a room')
            return self._here.x_m, self._here.y_m
        match given:
            case [x, y] if _is_number(x) and _is_number(y):
                return float(x), float(y)
            case int() | str() if not isinstance(given, bool):
                return self._anchor(given, what)
        raise CallRefused(f'"{what}" is a position [x, y], the id of a room or its name, got {json.dumps(given)}')

    def _anchor(self, given: int | str, what: str) -> tuple[float, float]:
        """The middle of a room: where it is widest."""
        if self._found is not None and self._grid is not None:
            for room in self._found.rooms:
                if given in (self._ids[room.number], self._book.names.get(self._ids[room.number])):
                    return _middle(room.anchor, self._grid)
        raise CallRefused(f'"{what}": no room {json.dumps(given)} is there now; map/rooms tells which there are')

    def _way(self, way: Way) -> dict[str, Any]:
        return {
            "poses": [_rounded(pose) for pose in way.poses],
            "length_m": round(way.length_m, 3),
            "clearance_m": _rounded(way.clearance_m),
            "least_clearance_m": round(way.least_clearance_m, 3),
            "rooms": self._rooms_along(way),
        }

    def _rooms_along(self, way: Way) -> list[int]:
        assert self._grid is not None
        if self._found is None:
            return []
        cells = np.floor(way.poses[:, 1::-1] / self._grid.resolution_m).astype(np.int64)
        cells = np.clip(cells - (self._grid.row0, self._grid.col0), 0, np.array(self._found.labels.shape) - 1)
        passed: list[int] = []
        for number in self._found.labels[cells[:, 0], cells[:, 1]].tolist():
            if number > 0 and passed[-1:] != [self._ids[number]]:
                passed.append(self._ids[number])
        return passed


def rooms_fields(found: RoomMap, ids: Mapping[int, int], names: Mapping[int, str], grid: GridPatch) -> dict[str, Any]:
    """The document umfeld.rooms.v1 but for its schema, stamp, frame and version. Metres, in the map frame."""
    rooms = sorted(found.rooms, key=lambda room: ids[room.number])
    return {
        "rooms": [
            {
                "id": ids[room.number],
                "name": names.get(ids[room.number]),
                "position": _rounded(_middle(room.anchor, grid)),
                "clearance_m": round(room.clearance_m, 3),
                "area_m2": round(room.area_m2, 2),
                "outline": outline_of(found, room, grid),
            }
            for room in rooms
        ],
        "doors": [
            {
                "rooms": sorted((ids[door.a], ids[door.b])),
                "position": _rounded(_middle(door.centre, grid)),
                "ends": [_rounded(_middle(end, grid)) for end in door.ends],
                "width_m": round(door.width_m, 3),
            }
            for door in found.doors
        ],
    }


def outline_of(found: RoomMap, room: Room, grid: GridPatch) -> list[list[float]]:
    """The outer ring of a room's largest piece, simplified to about a decimetre; holes are left out."""
    import shapely

    rows, cols = np.nonzero(found.labels == room.number)
    row0, col0 = int(rows.min()), int(cols.min())
    mask = np.zeros((int(rows.max()) - row0 + 1, int(cols.max()) - col0 + 1), dtype=np.bool_)
    mask[rows - row0, cols - col0] = True
    edge = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, begin = np.nonzero(edge == 1)
    _, end = np.nonzero(edge == -1)
    d, x0, y0 = grid.resolution_m, col0 + grid.col0, row0 + grid.row0
    runs = shapely.box((begin + x0) * d, (row + y0) * d, (end + x0) * d, (row + y0 + 1) * d)
    whole = shapely.union_all(runs)
    ring = max(shapely.get_parts(whole), key=lambda part: float(part.area)).exterior.simplify(_OUTLINE_M)
    return [_rounded(point) for point in ring.coords[:-1]]


def _free(grid: GridPatch) -> Bools:
    return np.asarray((grid.cells >= 0) & (grid.cells < FREE_BELOW))


def _middle(cell: tuple[int, int], grid: GridPatch) -> tuple[float, float]:
    return (cell[1] + grid.col0 + 0.5) * grid.resolution_m, (cell[0] + grid.row0 + 0.5) * grid.resolution_m


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in values]
