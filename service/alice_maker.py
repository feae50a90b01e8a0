"""ALICE's map in the daemon: looks in, the document of `map/topo` out, kept in the store (S43)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, LookOut, Output
from service.routes import NodeId, Passage, Ways, nearest_of
from service.store import StoreTrouble, pack_array, unpack_array

if TYPE_CHECKING:
    from mapping.topology.alice import AliceRules

F64 = NDArray[np.float64]

KEY = "map/topo"


class AliceMaker:
    """A map maker of places and the ways driven between them."""

    def __init__(self, rules: AliceRules | None = None, *, period_ns: int = 1_000_000_000) -> None:
        from mapping.topology.alice import AliceMap

        self.name = "alice"
        self.sources: frozenset[str] = frozenset()
        self.period_ns = period_ns
        self.topo = AliceMap(rules)
        self._before: LookOut | None = None
        self._stamp_ns = 0
        self._version = 0
        self._is_kept = True

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """It has no laser."""

    def take_look(self, look: LookOut) -> None:
        """Take one look in; after a gap the way since the one before is not known, and taken as none."""
        before, self._before = self._before, look
        way_m = (0.0, 0.0)
        if before is not None and look.continuous:
            way_m = (look.way_m[0] - before.way_m[0], look.way_m[1] - before.way_m[1])
        self.topo.look(look.light, look.touch, way_m)
        self._stamp_ns = look.stamp_ns
        self._is_kept = False

    def make(self, view: MapView) -> list[Output]:
        """The graph and where the robot is, whenever there was a look."""
        graph = self.topo.graph()
        self._version += 1
        pose = self.topo.pose
        fields = {
            "frame": "map",
            "version": self._version,
            "kind": "places",
            "robot": [round(pose.x_m, 3) + 0.0, round(pose.y_m, 3) + 0.0, round(pose.yaw_rad, 4) + 0.0],
            "nodes": [
                {
                    "id": node.number,
                    "position": [round(value, 3) + 0.0 for value in node.position_m],
                    "looks": node.looks,
                    "light": [round(float(value), 3) for value in node.vector[:24]],
                    "touch": [round(float(value), 3) for value in node.vector[24:]],
                }
                for node in graph.nodes
            ],
            "edges": [
                {"from": a, "to": b, "strength": round(strength, 2), "driven": driven}
                for a, b, strength, driven in graph.edges
            ],
        }
        return [DocumentOut(KEY, self._stamp_ns, fields)]

    def ways(self) -> Ways:
        """For the call @rpc/route: straight from place to place, as the robot drove."""
        graph = self.topo.graph()
        at: dict[NodeId, tuple[float, float] | None] = {}
        for node in graph.nodes:
            x, y = node.position_m
            at[node.number] = (float(x), float(y))
        passages = []
        for a, b, _, _ in graph.edges:
            (ax, ay), (bx, by) = at[a] or (0.0, 0.0), at[b] or (0.0, 0.0)
            passages.append(Passage(a, b, (0.5 * (ax + bx), 0.5 * (ay + by))))
        return Ways("places", at, passages, nearest=lambda point, name: nearest_of(at, point, name, "place"))

    def changed_tiles(self) -> list[Tile]:
        """The whole map, an array a tile, named by (its rank, how many dimensions it has)."""
        if self._is_kept:
            return []
        self._is_kept = True
        return [(rank, array.ndim, pack_array(np.atleast_2d(array))) for rank, array in enumerate(self.topo.arrays())]

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Go on with a stored map, from where the robot was last. ValueError if it is damaged."""
        from mapping.topology.alice import AliceMap

        stored = {}
        for rank, dimensions, payload in tiles:
            try:
                array = unpack_array(payload)
            except StoreTrouble as trouble:
                raise ValueError(str(trouble)) from trouble
            stored[rank] = array[0] if dimensions == 1 and len(array) else array
        self._before = None
        if stored:
            self.topo = AliceMap.from_arrays([stored[rank] for rank in sorted(stored)], self.topo.rules)
        else:
            self.topo = AliceMap(self.topo.rules)
