"""The views of the world held against each other: key map/agreement (mapping/agreement.py says what is compared).

It asks the other makers for their maps on their own thread, right after they were made. Maps of one daemon are not of
one moment: rooms lag some seconds behind the grid, so that a door that is shut is told here until they catch up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapping import agreement
from mapping.agreement import AGREES, DISAGREES, UNKNOWN
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, Output

if TYPE_CHECKING:
    from service.line_maker import LineMaker
    from service.room_maker import RoomMaker
    from service.topo_maker import TopoMaker

F64 = NDArray[np.float64]

KEY = "map/agreement"
_TOLD_MOST = 50
_SAME_M = 0.5
_NS_PER_SAMPLE = 1500
_PER_PAIR = 0.7  # of a door or way and a wall, in samples
_SHARE = 0.01

KINDS = {
    "wall_is_free": "a wall of map/lines is free in the grid",
    "door_is_blocked": "a door of map/rooms is occupied in the grid",
    "door_is_walled": "a wall of map/lines stands across a door of map/rooms",
    "room_is_occupied": "a room of map/rooms is occupied in the grid where it was free",
    "place_is_occupied": "a region of map/topo has its middle in an occupied cell",
    "way_is_blocked": "the way between two regions of map/topo that are joined is occupied in the grid",
    "way_is_walled": "a wall of map/lines stands between two regions of map/topo that are joined",
}
Mark = tuple[str, int, int, str]


@dataclass(frozen=True, slots=True)
class _Judged:
    """Things of one kind: verdicts (N,), where each is (N, 2), what it is called."""

    kind: str
    verdict: NDArray[np.int8]
    at: F64
    called: Callable[[int], str]


class AgreementMaker:
    """A map maker of disagreements. sources: lasers, only so that it is asked as long as they see."""

    def __init__(
        self,
        *,
        lines: LineMaker | None = None,
        rooms: RoomMaker | None = None,
        topo: TopoMaker | None = None,
        sources: Iterable[str] = (),
        period_ns: int = 2_000_000_000,
    ) -> None:
        self.name = "agreement"
        self.sources = frozenset(sources)
        self.counts = {f"agreement.{kind}": 0 for kind in KINDS}
        self._lines, self._rooms, self._topo = lines, rooms, topo
        self._period_ns = period_ns
        self._samples = 0
        self._seen: tuple[int, ...] = ()
        self._open: dict[Mark, int] = {}
        self._healed = dict.fromkeys(KINDS, 0)
        self._version = 0
        self._told: dict[str, Any] | None = None

    @property
    def period_ns(self) -> int:
        """As asked for, or longer where there is so much to compare that it would take more than its share."""
        return max(self._period_ns, round(self._samples * _NS_PER_SAMPLE / _SHARE))

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """It compares maps."""

    def make(self, view: MapView) -> list[Output]:
        """What disagrees now, if that is something else than was told."""
        versions = tuple(-1 if maker is None else maker.map_version for maker in (self._lines, self._rooms, self._topo))
        if view.grid is None or (not view.changed and versions == self._seen):
            return []
        self._seen = versions
        judged = list(self._judge(view.grid))
        self._count(judged, view.stamp_ns)
        fields = self._fields(judged)
        if fields == self._told:
            return []
        self._told = fields
        self._version += 1
        return [DocumentOut(KEY, view.stamp_ns, {"frame": "map", "version": self._version, **fields})]

    def changed_tiles(self) -> list[Tile]:
        return []

    def restore(self, tiles: Iterable[Tile]) -> None:
        """The maps come back, and with them what disagrees."""
        self._seen, self._told = (), None
        self._open.clear()

    def _judge(self, grid: GridPatch) -> Iterator[_Judged]:
        self._samples = 0
        walls = None if self._lines is None else self._lines.told_lines()
        if walls is not None:
            self._samples += round(float(walls.length_m.sum()) / grid.resolution_m)
            verdict = agreement.walls_in(grid, walls.start_m, walls.end_m)
            yield _Judged("wall_is_free", verdict, 0.5 * (walls.start_m + walls.end_m), lambda _: "wall")
        found = None if self._rooms is None else self._rooms.found_rooms()
        if found is not None:
            between = [f"door {a} - {b}" for a, b in found.doors]
            middles = found.door_ends_m.mean(axis=1)
            verdict = agreement.passages_in(grid, found.door_ends_m)
            yield _Judged("door_is_blocked", verdict, middles, between.__getitem__)
            if walls is not None:
                self._samples += round(_PER_PAIR * len(found.door_ends_m) * len(walls))
                verdict = agreement.walled_passages(found.door_ends_m, walls.start_m, walls.end_m)
                yield _Judged("door_is_walled", verdict, middles, between.__getitem__)
            patch, labels, numbers = found.patch, found.labels, found.numbers
            was_free = (patch.cells >= 0) & (patch.cells < agreement.AgreementRules().free_below)
            verdict = agreement.rooms_in(grid, labels, was_free, patch.row0, patch.col0, int(labels.max(initial=0)))
            names = [f"room {room}" for room in found.rooms]
            yield _Judged("room_is_occupied", verdict[numbers - 1], found.middles_m, names.__getitem__)
        regions = None if self._topo is None else self._topo.regions
        if regions is not None and regions.regions:
            centres = np.array([each.centre_m for each in regions.regions])
            verdict = agreement.points_in(grid, centres)
            yield _Judged("place_is_occupied", verdict, centres, lambda k: f"region {regions.regions[k].number}")
            centre_of = {each.number: each.centre_m for each in regions.regions}
            middles = np.array([each.ends_m for each in regions.passages]).reshape(-1, 2, 2).mean(axis=1)
            joined = [(centre_of[each.a], centre_of[each.b]) for each in regions.passages]
            ways = np.array([(a, middle, b) for (a, b), middle in zip(joined, middles)]).reshape(-1, 3, 2)
            names = [f"passage {each.a} - {each.b}" for each in regions.passages]
            self._samples += round(float(np.hypot(*np.diff(ways, axis=1).T).sum()) / grid.resolution_m)
            yield _Judged("way_is_blocked", agreement.ways_in(grid, ways), middles, names.__getitem__)
            if walls is not None:
                self._samples += round(_PER_PAIR * len(ways) * len(walls))
                verdict = agreement.crossed_ways(ways, walls.start_m, walls.end_m)
                yield _Judged("way_is_walled", verdict, middles, names.__getitem__)

    def _count(self, judged: list[_Judged], stamp_ns: int) -> None:
        """Each disagreement counts once, when it begins; it is the same while it is about the same place."""
        now: dict[Mark, int] = {}
        for each in judged:
            for k in np.flatnonzero(each.verdict == DISAGREES).tolist():
                x, y = np.floor(each.at[k] / _SAME_M).astype(int).tolist()
                mark = (each.kind, x, y, each.called(k))
                now[mark] = self._open.get(mark, stamp_ns)
        for mark in now.keys() - self._open.keys():
            self.counts[f"agreement.{mark[0]}"] += 1
        for mark in self._open.keys() - now.keys():
            self._healed[mark[0]] += 1
        self._open = now

    def _fields(self, judged: list[_Judged]) -> dict[str, Any]:
        """The document umfeld.agreement.v1 but for its schema, stamp, frame and version."""
        kinds = [
            {
                "kind": each.kind,
                "means": KINDS[each.kind],
                "agree": int(np.count_nonzero(each.verdict == AGREES)),
                "unknown": int(np.count_nonzero(each.verdict == UNKNOWN)),
                "disagree": int(np.count_nonzero(each.verdict == DISAGREES)),
                "began": self.counts[f"agreement.{each.kind}"],
                "ended": self._healed[each.kind],
            }
            for each in judged
        ]
        where = [
            {"kind": each.kind, "what": each.called(k), "position": [round(float(v), 3) + 0.0 for v in each.at[k]]}
            for each in judged
            for k in np.flatnonzero(each.verdict == DISAGREES).tolist()
        ]
        return {"disagreements": len(where), "kinds": kinds, "where": where[:_TOLD_MOST]}
