"""Places and hallways in the daemon (S45): sweeps in, the document of `map/topo` out, kept in the store.

The map has no frame of its own for the whole: each area has one, and what is told of the map frame is where an area lay
when the robot was in it last, for drawings. Motion comes from the poses of the sweeps; where the map was corrected in
between, the step is doubted and the walls decide. After a start the robot is looked for in the map that was kept.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2, wrap_angle
from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, Output
from service.routes import NodeId, Passage, Ways
from service.rpc import CallRefused
from service.sweep_lines import SweepLines, middle_of

if TYPE_CHECKING:
    from mapping.hybrid.hierarchical import HierarchicalMap, Where
    from mapping.hybrid.places import Area

F64 = NDArray[np.float64]

KEY = "map/topo"
_EVERY_NS = 200_000_000
_AGAIN_NS = 2_000_000_000  # a robot that is lost looks for itself so often
_STEP_M = 0.04
_STEP_RAD = math.radians(3.0)
_NOISE_PER_M, _NOISE_PER_RAD, _NOISE_M, _NOISE_RAD = 0.03, 0.03, 0.005, 0.003
_DOUBT_M, _DOUBT_RAD = 0.3, 0.1
_JUMP_M, _JUMP_RAD = 1.0, 0.8  # in one step: no motion at all
_STORED_MOST = 64 * 1024 * 1024


class PlaceMaker:
    """A map maker. source: the laser.  base_from_sensor: how it sits."""

    def __init__(self, source: str, base_from_sensor: Pose2, *, period_ns: int = 1_000_000_000) -> None:
        from mapping.hybrid.hierarchical import HierarchicalMap

        self.name = "places"
        self.sources = frozenset((source,))
        self.period_ns = period_ns
        self._sensor_from_base = base_from_sensor.inverse()
        self._base_from_sensor = base_from_sensor
        self._lines = SweepLines()
        self.hybrid: HierarchicalMap = HierarchicalMap()
        self.frames: dict[int, Pose2] = {}
        """map_from_area, as each area lay when the robot was in it last."""
        self._last: tuple[int, Pose2] | None = None
        self._looked_ns: int | None = None
        self._doubted = False
        self._version = 0
        self._told: dict[str, Any] | None = None
        self._is_kept = True
        self.counts = {"places.switched": 0, "places.lost": 0}

    def map_moved(self) -> None:
        """The map was corrected: the poses before and after do not tell how the robot moved."""
        self._doubted = True

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Go on by one sweep, unless the robot stood since the last; one whose poses are not known is left out."""
        poses = np.atleast_2d(np.asarray(map_from_sensor, dtype=np.float64))
        if not np.all(np.isfinite(poses)):
            return
        here = middle_of(poses) @ self._sensor_from_base
        step = IDENTITY if self._last is None else self._last[1].inverse() @ here
        if self._last is not None:
            way, turn = math.hypot(step.x_m, step.y_m), abs(wrap_angle(step.yaw_rad))
            if scan.stamp_ns - self._last[0] < _EVERY_NS or (way < _STEP_M and turn < _STEP_RAD):
                return
            if way > _JUMP_M or turn > _JUMP_RAD:
                self._look_anew()
                step = IDENTITY
        if self._is_lost and self._looked_ns is not None and scan.stamp_ns - self._looked_ns < _AGAIN_NS:
            return
        self._looked_ns = scan.stamp_ns
        lines = self._lines.of(source, scan, poses).transformed(self._base_from_sensor)
        before = self.hybrid.where()
        where = self.hybrid.take(lines, step, self._noise(step))
        self._last, self._doubted, self._is_kept = (scan.stamp_ns, here), False, False
        if where.area is not None and where.pose is not None and not where.leaving:
            self.frames[where.area] = here @ where.pose.inverse()
        if before.area is not None and where.area is not None and where.area != before.area:
            self.counts["places.switched"] += 1

    def make(self, view: MapView) -> list[Output]:
        """The map and where the robot is in it, if that is something else than was told."""
        fields = self._fields()
        if fields == self._told:
            return []
        self._told = fields
        self._version += 1
        return [DocumentOut(KEY, view.stamp_ns, {"frame": "map", "version": self._version, **fields})]

    def ways(self) -> Ways:
        """For the call @rpc/route: nodes are "place 3" and, on hallways, openings "node 2.0"."""
        graph = self.hybrid.graph()
        if not len(graph):
            raise CallRefused("no places are known yet: let the robot see some walls first")
        at: dict[NodeId, tuple[float, float] | None] = dict.fromkeys(graph.nodes)
        passages = [Passage(a, b, None, float(facts["length_m"])) for a, b, facts in graph.edges(data=True)]
        return Ways("areas", at, passages)

    def changed_tiles(self) -> list[Tile]:
        """The whole map as one tile."""
        if self._is_kept:
            return []
        self._is_kept = True
        frames = {str(k): [pose.x_m, pose.y_m, pose.yaw_rad] for k, pose in sorted(self.frames.items())}
        state = {"map": self.hybrid.state(), "frames": frames}
        return [(0, 0, zlib.compress(json.dumps(state).encode(), 1))]

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Go on with a stored map; where the robot is in it shows the next sweep. ValueError if it is damaged."""
        from mapping.hybrid.hierarchical import HierarchicalMap

        stored = [payload for _, _, payload in tiles]
        hybrid, frames = HierarchicalMap(), dict[int, Pose2]()
        if stored:
            try:
                unpacked = zlib.decompressobj().decompress(stored[0], _STORED_MOST)
                state = json.loads(unpacked)
                frames = {int(k): Pose2(*map(float, pose)) for k, pose in state["frames"].items()}
                hybrid = HierarchicalMap.from_state(state["map"])
            except (zlib.error, KeyError, TypeError, AttributeError) as error:
                raise ValueError(f"places are damaged: {error}") from error
        self._begin(hybrid, frames)

    # --- inside

    @property
    def _is_lost(self) -> bool:
        return bool(self.hybrid.areas) and self.hybrid.where().area is None

    def _look_anew(self) -> None:
        """The robot was put elsewhere, or its pose was: it has to recognise where it is."""
        from mapping.hybrid.hierarchical import HierarchicalMap

        self.counts["places.lost"] += 1
        self._begin(HierarchicalMap.from_state(self.hybrid.state()), self.frames)

    def _begin(self, hybrid: HierarchicalMap, frames: Mapping[int, Pose2]) -> None:
        self.hybrid, self.frames = hybrid, dict(frames)
        self._last = self._looked_ns = self._told = None
        self._doubted, self._is_kept = False, True

    def _noise(self, step: Pose2) -> F64:
        """(3, 3) of a step, frame of the base before."""
        way, turn = math.hypot(step.x_m, step.y_m), abs(step.yaw_rad)
        place = _NOISE_M + _NOISE_PER_M * way
        yaw = _NOISE_RAD + _NOISE_PER_RAD * turn
        if self._doubted:
            place, yaw = place + _DOUBT_M, yaw + _DOUBT_RAD
        return np.diag([place**2, place**2, yaw**2])

    def _fields(self) -> dict[str, Any]:
        """The document umfeld.topo.v1 but for its schema, stamp, frame and version."""
        where = self.hybrid.where()
        edges = []
        for area in self.hybrid.areas:
            for k, opening in enumerate(area.openings):
                if opening.leads_to is not None and opening.leads_to > (area.number, k):
                    ends = self._in_map(area, [opening.left_m, opening.right_m])
                    edge: dict[str, Any] = {"from": area.number, "to": opening.leads_to[0]}
                    edges.append(edge if ends is None else {**edge, "ends": ends, "width_m": round(opening.width_m, 3)})
        return {
            "kind": "areas",
            "nodes": [self._node(area) for area in self.hybrid.areas],
            "edges": edges,
            "where": _where_fields(where),
        }

    def _node(self, area: Area) -> dict[str, Any]:
        walls = area.walls.lines(min_seen=2)
        middle = np.zeros(2)
        if len(walls):  # by length, so that what was seen through an opening moves it little
            middle = np.average(0.5 * (walls.start_m + walls.end_m), axis=0, weights=walls.length_m)
        frame = self.frames.get(area.number, IDENTITY)
        x, y = frame.apply(middle[None, :])[0].tolist()
        is_place = area.kind.value == "place"
        return {
            "id": area.number,
            "position": _rounded((x, y)),
            "what": area.kind.value,
            "name": f"place {area.number}" if is_place else f"hallway {area.number}",
            "visits": area.visits,
            "area_frame": [*_rounded((frame.x_m, frame.y_m)), round(frame.yaw_rad, 4) + 0.0],
            "walls": [[_rounded(a), _rounded(b)] for a, b in zip(walls.start_m, walls.end_m)],
            "corners": [{"at": _rounded(c.point_m), "convex": bool(c.convex)} for c in area.corner_list()],
            "openings": [
                {
                    "name": f"place {area.number}" if is_place else f"node {area.number}.{k}",
                    "ends": [_rounded(opening.left_m), _rounded(opening.right_m)],
                    "leads_to": None if opening.leads_to is None else opening.leads_to[0],
                }
                for k, opening in enumerate(area.openings)
                if opening.leads_to is not None or (opening.seen > 2 and not opening.dismissed)
            ],
        }

    def _in_map(self, area: Area, points: list[tuple[float, float]]) -> list[list[float]] | None:
        frame = self.frames.get(area.number)
        return None if frame is None else [_rounded(point) for point in frame.apply(np.array(points))]


def _where_fields(where: Where) -> dict[str, Any] | None:
    """On which level the robot is localised: metric in a place, along the way on a hallway; None while it is lost."""
    if where.area is None or where.pose is None or where.kind is None:
        return None
    fields: dict[str, Any] = {
        "area": where.area,
        "level": "metric" if where.kind.value == "place" else "along",
        "pose": [*_rounded((where.pose.x_m, where.pose.y_m)), round(where.pose.yaw_rad, 3) + 0.0],
        "in_opening": where.leaving,
    }
    if where.way_m is not None:
        fields |= {"way_m": round(where.way_m, 2) + 0.0, "between": list(where.link or (None, None))}
    return fields


def _rounded(point: Any) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in point]


def warm_up() -> None:
    """Load or compile every kernel of places: two sweeps in a room, and recognising it."""
    bearing = np.linspace(-math.pi, math.pi, 361)
    maker = PlaceMaker("any", IDENTITY)
    for stamp_ns, x_m in ((0, 0.0), (_EVERY_NS, 0.1), (2 * _EVERY_NS, 2.5)):
        reach = np.minimum(2.0 / np.abs(np.cos(bearing)), 3.0 / np.maximum(np.abs(np.sin(bearing)), 1e-9))
        maker.take_sweep("any", Scan(stamp_ns, 0.0, bearing, reach, 0.05, 10.0), np.array([[x_m, 0.0, 0.0]]))
