"""Rooms in the daemon: the grid in, the document of `map/rooms` out; ways over the Voronoi diagram, names (S44).

What is not known to be free is an obstacle, for rooms and for ways. A room is what the robot can come to through
openings wide enough for it; it gets an id when the robot is in it, or when it was there in three turns running. Ids and
names are kept in the store.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.map_makers import MapView, Rect, Tile
from service.outputs import DocumentOut, Output
from service.room_outlines import RoomOutlines
from service.routes import NEAR_M, NodeId, Passage, Ways
from service.rpc import CallRefused

if TYPE_CHECKING:
    from mapping.hybrid.planner import Plan, Planner, Way
    from mapping.hybrid.room_book import RoomBook
    from mapping.hybrid.rooms import RoomMap
    from mapping.hybrid.rooms_before import RoomsBefore
    from mapping.hybrid.voronoi import VoronoiGrid

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]

KEY = "map/rooms"
PLAN_KEY = "map/plan"
FREE_BELOW = 35  # per cent; what is between free and occupied is not free
_NAME_MAX = 64
_ALTERNATIVES_MAX = 5
_NAMES_ROW = 0  # ids begin at 1
_SETTLE_TURNS = 3
_NS_PER_CELL = 200  # that a turn costs, about
_SHARE = 0.02  # of the time, at most
_AS_GOOD = 0.8  # of the widest place's clearance: then the middle of a room stays where it was


@dataclass(frozen=True, slots=True)
class _End:
    """of a way: x, y.  told: what the caller said.  cells: those of the room, if it is one."""

    at: tuple[float, float]
    told: object
    cells: Bools | None


@dataclass(frozen=True, slots=True)
class FoundRooms:
    """What was found last. patch: the part of the grid it was found in.  labels: (R, C) numbers there, 0 for none.

    numbers, rooms: (N,) numbers and ids of the rooms.  middles_m: (N, 2).  doors: ids of the two rooms of each.
    door_ends_m: (M, 2, 2).
    """

    patch: GridPatch
    labels: NDArray[np.int32]
    numbers: NDArray[np.int64]
    rooms: list[int]
    middles_m: F64
    doors: list[tuple[int, int]]
    door_ends_m: F64


class RoomMaker:
    """A map maker: rooms and doors of the newest grid, with ids and names that stay."""

    def __init__(
        self,
        *,
        period_ns: int = 5_000_000_000,
        clearance_m: float = 0.3,
        width_m: float = 0.4,
        settle_turns: int = _SETTLE_TURNS,
    ) -> None:
        """clearance_m: what plans keep if not told.  width_m: of the robot.  settle_turns: RoomBook's settle."""
        from mapping.hybrid.room_book import RoomBook
        from mapping.hybrid.rooms_before import RoomsBefore

        self.name = "rooms"
        self.sources: frozenset[str] = frozenset()
        self._period_ns = period_ns
        self._clearance_m, self._width_m, self._settle_turns = clearance_m, width_m, settle_turns
        self._book: RoomBook = RoomBook(settle=settle_turns)
        self._before: RoomsBefore = RoomsBefore(settle=settle_turns)
        self._is_restored = False
        self._names_changed = False
        self._grid: GridPatch | None = None
        self._found: RoomMap | None = None
        self._outlines = RoomOutlines()
        self._ids: dict[int, int] = {}
        self._middles: dict[int, tuple[int, int]] = {}
        """By id: the cell [row, col] of the map where the room is widest."""
        self._diagram: VoronoiGrid | None = None
        self._planner: Planner | None = None
        self._asked_m: float | None = None  # the clearance of the last plan
        self._here: Pose2 | None = None
        self._told = b""
        self._planned: dict[str, Any] | None = None
        self._version = 0
        self._turns = 0
        self._stamp_ns = 0

    @property
    def period_ns(self) -> int:
        """As asked for, or longer where the map is so large that it would take more than its share of a core."""
        cells = 0 if self._grid is None else self._grid.cells.size
        return max(self._period_ns, round(cells * _NS_PER_CELL / _SHARE))

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """It is made from the grid."""

    def make(self, view: MapView) -> list[Output]:
        """The rooms, if they are others than were told."""
        self._here, self._stamp_ns = view.map_from_base, view.stamp_ns
        if view.grid is None or not view.changed:
            return []
        from mapping.hybrid.rooms import find_rooms

        patch = self._grid = _free_part(view.grid)
        free, d = _free(patch), patch.resolution_m
        shape, here = free.shape, self._cell_of(None if self._here is None else (self._here.x_m, self._here.y_m))
        inside = self._book.territory_mask(shape, patch.row0, patch.col0)
        if here is not None:
            _mark_disc(inside, here, 0.5 * self._width_m / d)
        if self._is_restored:
            self._before.begin_with(self._book.territories_in(shape, patch.row0, patch.col0), patch.row0, patch.col0)
            self._is_restored = False
        before = self._before.window(shape, patch.row0, patch.col0)
        found = find_rooms(free, d, width_m=self._width_m, inside=inside, before=before)
        self._found, settled = self._before.as_told(found, before, here)
        entered = None if here is None else int(self._found.labels[here])
        self._ids = self._book.update(self._found, row0=patch.row0, col0=patch.col0, entered=entered, settled=settled)
        self._before.keep(self._found, self._ids, patch.row0, patch.col0)
        self._draw_diagram(free)
        self._find_middles()
        self._turns += 1
        return self.news()

    def _draw_diagram(self, free: Bools) -> None:
        """And the planner on it, so that a call need not wait for them."""
        from mapping.hybrid.planner import Planner
        from mapping.hybrid.voronoi import VoronoiGrid

        assert self._grid is not None
        padded = np.pad(free, 1)  # so that the map's own border may be used
        if self._diagram is not None and self._diagram.shape == padded.shape:
            self._diagram.update(padded)
        else:
            self._diagram = VoronoiGrid(padded)
        self._planner = Planner(
            self._diagram, self._grid.resolution_m, row0=self._grid.row0 - 1, col0=self._grid.col0 - 1
        )
        if self._asked_m is not None:
            self._planner.ready_for(self._asked_m)

    def _find_middles(self) -> None:
        """Where each room is widest, furniture and all; as long as it is about as wide there, where it was."""
        from mapping.kernels.rooms import widest_cells

        assert self._found is not None
        assert self._grid is not None
        assert self._diagram is not None
        labels, squared = self._found.labels, np.ascontiguousarray(self._diagram.field.squared[1:-1, 1:-1])
        widest = np.zeros(len(self._found.rooms) + 1, dtype=np.int64)
        widest_cells(labels, squared, widest)
        before, self._middles = self._middles, dict(self._middles)  # of those that sleep, too
        for number, room_id in self._ids.items():
            row, col = divmod(int(widest[number]), labels.shape[1])
            kept = before.get(room_id)
            if kept is not None:
                old_row, old_col = kept[0] - self._grid.row0, kept[1] - self._grid.col0
                is_in = 0 <= old_row < labels.shape[0] and 0 <= old_col < labels.shape[1]
                is_in = is_in and labels[old_row, old_col] == number
                if is_in and squared[old_row, old_col] >= _AS_GOOD**2 * squared[row, col]:
                    row, col = old_row, old_col
            self._middles[room_id] = (row + self._grid.row0, col + self._grid.col0)

    def news(self) -> list[Output]:
        """The document, if it says something new."""
        if self._found is None or self._grid is None:
            return []
        fields = self._fields()
        body = json.dumps(fields, sort_keys=True).encode()
        if body == self._told:
            return []
        self._told = body
        self._version += 1
        return [DocumentOut(KEY, self._stamp_ns, {"frame": "map", "version": self._version, **fields})]

    def _fields(self) -> dict[str, Any]:
        """The document umfeld.rooms.v1 but for its schema, stamp, frame and version. Metres, in the map frame."""
        assert self._found is not None
        assert self._grid is not None
        assert self._diagram is not None
        found, ids, grid = self._found, self._ids, self._grid
        squared = self._diagram.field.squared[1:-1, 1:-1]
        outlines = self._outlines.of(found, grid)
        rooms = []
        for room in sorted((r for r in found.rooms if r.number in ids), key=lambda r: ids[r.number]):
            room_id = ids[room.number]
            row, col = self._middles[room_id]
            row, col = row - grid.row0, col - grid.col0
            rooms.append(
                {
                    "id": room_id,
                    "name": self._book.names.get(room_id),
                    "position": _rounded(_middle((row, col), grid)),
                    "clearance_m": round(math.sqrt(squared[row, col]) * grid.resolution_m, 3),
                    "area_m2": round(room.area_m2, 2),
                    "outline": outlines[room.number],
                }
            )
        doors = [
            {
                "rooms": sorted((ids[door.a], ids[door.b])),
                "position": _rounded(_middle(door.centre, grid)),
                "ends": [_rounded(_middle(end, grid)) for end in door.ends],
                "width_m": round(door.width_m, 3),
            }
            for door in found.doors
            if door.a in ids and door.b in ids
        ]
        return {"rooms": rooms, "doors": doors}

    @property
    def map_version(self) -> int:
        """Rises with every turn."""
        return self._turns

    def found_rooms(self) -> FoundRooms | None:
        """Rooms and doors as they were found last, only those that have an id; None before that."""
        if self._found is None or self._grid is None:
            return None
        found, grid, ids = self._found, self._grid, self._ids
        doors = [door for door in found.doors if door.a in ids and door.b in ids]
        ends = [[_middle(end, grid) for end in door.ends] for door in doors]
        numbers = sorted(ids)
        middles = [self._middles[ids[number]] for number in numbers]
        return FoundRooms(
            grid,
            found.labels,
            np.array(numbers, dtype=np.int64),
            [ids[number] for number in numbers],
            (np.array(middles, dtype=np.float64).reshape(-1, 2)[:, ::-1] + 0.5) * grid.resolution_m,
            [(min(ids[door.a], ids[door.b]), max(ids[door.a], ids[door.b])) for door in doors],
            np.array(ends, dtype=np.float64).reshape(-1, 2, 2),
        )

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
        from mapping.hybrid.rooms_before import RoomsBefore

        stored = {row: payload for row, _, payload in tiles}
        book, head = RoomBook(settle=self._settle_turns), stored.pop(_NAMES_ROW, None)
        if head is not None:
            try:
                told = json.loads(head)
                names = {int(k): str(v) for k, v in told["names"].items()}
                next_id = int(told["next"])
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise ValueError(f"names of rooms are damaged: {error}") from error
            book.restore({k: payload for k, payload in stored.items() if payload}, names, next_id)
        self._book, self._told, self._found, self._planner = book, b"", None, None
        self._before, self._is_restored = RoomsBefore(settle=self._settle_turns), True
        self._ids, self._middles = {}, {}

    # --- calls, between two turns of the makers' thread

    def ways(self) -> Ways:
        """For the call @rpc/route: from door to door, straight on."""
        if self._found is None:
            raise CallRefused("no rooms are known yet: let the robot see some free space first")
        told = self._fields()
        at: dict[NodeId, tuple[float, float]] = {room["id"]: tuple(room["position"]) for room in told["rooms"]}
        doors = [Passage(a, b, tuple(door["position"])) for door in told["doors"] for a, b in [door["rooms"]]]
        names: dict[str, NodeId] = {name: k for k, name in self._book.names.items() if k in at}
        return Ways("rooms", at, doors, through=True, nearest=self._room_at, names=names)

    def _room_at(self, point: tuple[float, float], name: str) -> int:
        """The room in which a position lies, or the nearest within a metre."""
        assert self._grid is not None
        assert self._found is not None
        d, rooms = self._grid.resolution_m, sorted(self._ids)
        rows, cols = np.nonzero(np.isin(self._found.labels, rooms))
        x, y = (cols + self._grid.col0 + 0.5) * d, (rows + self._grid.row0 + 0.5) * d
        away = np.hypot(x - point[0], y - point[1])
        nearest = int(away.argmin()) if away.size else -1
        if nearest < 0 or away[nearest] > NEAR_M:
            raise CallRefused(f'"{name}": no room within {NEAR_M:g} m of {list(point)}')
        return self._ids[int(self._found.labels[rows[nearest], cols[nearest]])]

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
        least_clearance_m, rooms (ids, in the order they are passed) and alternatives. Where the robot stands with less
        clearance than asked, the way begins with a step to where it has it. CallRefused says why not.
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
        if self._planner is None:
            raise CallRefused("no grid is known yet: let the robot see some free space first")
        self._asked_m = float(clearance_m)
        start, goal = self._place(arguments.get("start"), "start"), self._place(arguments.get("goal"), "goal")
        stands_at = start.at
        if start.told is None:
            start = _End(self._out_of_a_tight_place(start.at, float(clearance_m)), None, None)
        try:
            plan = self._plan(start, goal, float(clearance_m), count)
        except NoWayError as error:
            raise CallRefused(str(error)) from error
        ways = [self._way(way, stands_at if start.at != stands_at else None) for way in (plan.way, *plan.alternatives)]
        answer = {**ways[0], "alternatives": ways[1:]}
        self._planned = {"frame": "map", "start": start.told, "goal": goal.told, **answer}
        return answer

    def _out_of_a_tight_place(self, at: tuple[float, float], clearance_m: float) -> tuple[float, float]:
        """Where the robot stands, or, with less clearance than asked, the nearest place that has it, straight on over
        free cells and no farther than a robot's width and the clearance."""
        from mapping.hybrid.planner import HALF_CELLS
        from mapping.kernels.paths import sees

        cell = self._cell_of(at)
        if cell is None:
            return at
        assert self._grid is not None
        assert self._diagram is not None
        squared, d = self._diagram.field.squared, self._grid.resolution_m
        row, col = cell[0] + 1, cell[1] + 1  # the diagram has a cell more around it
        need, reach = (clearance_m / d + HALF_CELLS) ** 2, round((self._width_m + clearance_m) / d)
        if squared[row, col] == 0 or squared[row, col] >= need:
            return at
        top, left = max(row - reach, 0), max(col - reach, 0)
        rows, cols = np.nonzero(squared[top : row + reach + 1, left : col + reach + 1] >= need)
        from_row, from_col = at[1] / d - self._grid.row0 + 0.5, at[0] / d - self._grid.col0 + 0.5
        away = (rows + top - row) ** 2 + (cols + left - col) ** 2
        for k in np.argsort(away, kind="stable").tolist():
            to = int(rows[k]) + top, int(cols[k]) + left
            if away[k] <= reach * reach and sees(squared, 1.0, from_row, from_col, float(to[0]), float(to[1])):
                return _middle((to[0] - 1, to[1] - 1), self._grid)
        return at

    def planned(self) -> Output | None:
        """The newest plan as a document, once."""
        fields, self._planned = self._planned, None
        return None if fields is None else DocumentOut(PLAN_KEY, self._stamp_ns, fields)

    def _plan(self, start: _End, goal: _End, clearance_m: float, alternatives: int) -> Plan:
        """From the middle of a room to that of another; where it cannot be come to, from or to the widest place that
        can. NoWayError."""
        from mapping.hybrid.planner import NoWayError

        assert self._planner is not None
        try:
            return self._planner.plan(start.at, goal.at, clearance_m=clearance_m, alternatives=alternatives)
        except NoWayError:
            at = self._joined(start, goal, clearance_m)
            if at is None:
                raise
            return self._planner.plan(*at, clearance_m=clearance_m, alternatives=alternatives)

    def _joined(
        self, start: _End, goal: _End, clearance_m: float
    ) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """The ends, moved within their rooms to the widest places that are joined; None if nothing can be gained."""
        from mapping.hybrid.planner import HALF_CELLS
        from mapping.kernels.rooms import connected

        assert self._grid is not None
        assert self._diagram is not None
        if start.cells is None and goal.cells is None:
            return None
        squared = np.ascontiguousarray(self._diagram.field.squared[1:-1, 1:-1])
        wide = squared >= (clearance_m / self._grid.resolution_m + HALF_CELLS) ** 2
        label = np.empty(wide.shape, dtype=np.int32)
        connected(wide, True, label)
        labels = [self._labels_in(end, label) for end in (start, goal)]
        common = labels[0][np.isin(labels[0], labels[1])]
        if not common.size:
            return None
        rated = np.where(label == common[0], squared, 0)
        moved = []
        for end in (start, goal):
            if end.cells is None:
                moved.append(end.at)
            else:
                row, col = divmod(int(np.where(end.cells, rated, 0).argmax()), wide.shape[1])
                moved.append(_middle((row, col), self._grid))
        return moved[0], moved[1]

    def _labels_in(self, end: _End, label: NDArray[np.int32]) -> NDArray[np.int32]:
        """Connected pieces of space that an end has a part in, the one it shares most with first."""
        if end.cells is not None:
            counts = np.bincount(label[end.cells & (label >= 0)])
            order = np.argsort(-counts, kind="stable")
            return order[counts[order] > 0].astype(np.int32)
        cell = self._cell_of(end.at)
        return np.array([] if cell is None or label[cell] < 0 else [label[cell]], dtype=np.int32)

    def _cell_of(self, place: tuple[float, float] | None) -> tuple[int, int] | None:
        """Row and column in the part of the grid that is looked at; None beyond it."""
        if place is None or self._grid is None:
            return None
        row = math.floor(place[1] / self._grid.resolution_m) - self._grid.row0
        col = math.floor(place[0] / self._grid.resolution_m) - self._grid.col0
        rows, cols = self._grid.cells.shape
        return (row, col) if 0 <= row < rows and 0 <= col < cols else None

    def _place(self, given: object, what: str) -> _End:
        if given is None and what == "start":
            if self._here is None:
                raise CallRefused('"start": where the robot is is not known; give a position [x, y] or a room')
            return _End((self._here.x_m, self._here.y_m), None, None)
        match given:
            case [x, y] if _is_number(x) and _is_number(y):
                return _End((float(x), float(y)), [float(x), float(y)], None)
            case int() | str() if not isinstance(given, bool):
                return self._room(given, what)
        raise CallRefused(f'"{what}" is a position [x, y], the id of a room or its name, got {json.dumps(given)}')

    def _room(self, given: int | str, what: str) -> _End:
        """A room by id or name; one that another has swallowed for now is where it was."""
        assert self._grid is not None
        name = given.strip() if isinstance(given, str) else None
        room_id = given if isinstance(given, int) else next((k for k, v in self._book.names.items() if v == name), None)
        if room_id not in self._book.known_ids:
            raise CallRefused(f'"{what}": no room {json.dumps(given)} is known; map/rooms tells which there are')
        number = next((n for n, k in self._ids.items() if k == room_id), None)
        if self._found is not None and number is not None:
            cells = self._found.labels == number
        else:
            cells = self._book.territory_mask(self._grid.cells.shape, self._grid.row0, self._grid.col0, only=room_id)
            cells &= _free(self._grid)
        if room_id not in self._middles:
            if not cells.any():
                raise CallRefused(f'"{what}": nothing of room {json.dumps(given)} is free now')
            row, col = np.argwhere(cells)[0].tolist()
            return _End(_middle((row, col), self._grid), given, cells)
        row, col = self._middles[room_id]
        return _End(_middle((row - self._grid.row0, col - self._grid.col0), self._grid), given, cells)

    def _way(self, way: Way, stands_at: tuple[float, float] | None) -> dict[str, Any]:
        """stands_at: whence the robot comes first, with less clearance than the way has."""
        fields: dict[str, Any] = {
            "poses": [_rounded(pose) for pose in way.poses],
            "length_m": round(way.length_m, 3),
            "clearance_m": _rounded(way.clearance_m),
            "least_clearance_m": round(way.least_clearance_m, 3),
            "rooms": self._rooms_along(way),
        }
        if stands_at is not None:
            step = way.poses[0, :2] - stands_at
            least_m = self._clearance_between(stands_at, (float(way.poses[0, 0]), float(way.poses[0, 1])))
            fields["poses"].insert(0, _rounded((*stands_at, math.atan2(step[1], step[0]))))
            fields["clearance_m"].insert(0, round(least_m, 3))
            fields["length_m"] = round(way.length_m + math.hypot(*step), 3)
            fields["least_clearance_m"] = round(min(least_m, way.least_clearance_m), 3)
        return fields

    def _clearance_between(self, a: tuple[float, float], b: tuple[float, float]) -> float:
        """The least on a straight line."""
        from mapping.hybrid.planner import HALF_CELLS
        from mapping.kernels.paths import least_along

        assert self._grid is not None
        assert self._diagram is not None
        d = self._grid.resolution_m
        corners = np.array((a, b))[:, ::-1] / d - (self._grid.row0 - 1, self._grid.col0 - 1) - 0.5
        least = math.sqrt(least_along(self._diagram.field.squared, np.ascontiguousarray(corners), 2))
        return max(least - HALF_CELLS, 0.0) * d

    def _rooms_along(self, way: Way) -> list[int]:
        assert self._grid is not None
        if self._found is None:
            return []
        cells = np.floor(way.poses[:, 1::-1] / self._grid.resolution_m).astype(np.int64)
        cells = np.clip(cells - (self._grid.row0, self._grid.col0), 0, np.array(self._found.labels.shape) - 1)
        passed: list[int] = []
        for number in self._found.labels[cells[:, 0], cells[:, 1]].tolist():
            if number in self._ids and passed[-1:] != [self._ids[number]]:
                passed.append(self._ids[number])
        return passed


def _free(grid: GridPatch) -> Bools:
    return np.asarray((grid.cells >= 0) & (grid.cells < FREE_BELOW))


def _free_part(grid: GridPatch) -> GridPatch:
    """A copy of the part that holds all that is free, cut at multiples of 64 cells of the map or at the grid's end."""
    free, (height, width) = _free(grid), grid.cells.shape
    rows, cols = np.flatnonzero(free.any(axis=1)), np.flatnonzero(free.any(axis=0))
    if not len(rows):
        return GridPatch(grid.resolution_m, grid.row0, grid.col0, grid.cells[:1, :1].copy())
    spans = []
    for cells, first, size in ((rows, grid.row0, height), (cols, grid.col0, width)):
        begin, end = int(cells[0]) + first - 1, int(cells[-1]) + first + 2
        spans.append((max(begin // 64 * 64 - first, 0), min(-(-end // 64) * 64 - first, size)))
    (top, bottom), (left, right) = spans
    part = grid.cells[top:bottom, left:right].copy()
    return GridPatch(grid.resolution_m, grid.row0 + top, grid.col0 + left, part)


def _mark_disc(mask: Bools, at: tuple[int, int], radius: float) -> None:
    rows, cols = np.ogrid[: mask.shape[0], : mask.shape[1]]
    mask |= (rows - at[0]) ** 2 + (cols - at[1]) ** 2 <= radius * radius


def _middle(cell: tuple[int, int], grid: GridPatch) -> tuple[float, float]:
    return (cell[1] + grid.col0 + 0.5) * grid.resolution_m, (cell[0] + grid.row0 + 0.5) * grid.resolution_m


def _is_number(value: object) -> TypeGuard[float]:
    """Of a size that may be reckoned with; not NaN, nor an int that no float holds."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -1e9 <= value <= 1e9


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in values]


def warm_up() -> None:
    """Load or compile every kernel that rooms and plans use: a turn, a change, and plans in a small house."""
    cells = np.full((60, 130), 100, dtype=np.int8)
    cells[2:58, 2:64] = cells[2:58, 66:128] = cells[25:35, 60:70] = 0
    maker, here = RoomMaker(settle_turns=1), Pose2(0.4, 0.4, 0.0)
    for stamp_ns in range(2):
        cells[30, 20 + stamp_ns] = 100
        maker.make(MapView(stamp_ns, GridPatch(0.1, 0, 0, cells), (Rect(0, 0, *cells.shape),), here))
    maker.plan({"goal": [12.0, 5.0]})  # out of a corner, to a place
    with contextlib.suppress(CallRefused):
        maker.plan({"start": 1, "goal": 2, "clearance_m": 0.6})  # too wide: looks for places that are joined
