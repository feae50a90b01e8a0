"""Planes in the daemon: clouds of tilting lasers in, the document of `map/planes` out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose3
from mapping.planes.extract import PlaneRules, Planes, extract_planes
from mapping.scan import Scan
from service.map_makers import MapView, Tile
from service.outputs import CloudOut, DocumentOut, Output

F64 = NDArray[np.float64]

KEY = "map/planes"
_UNMOVED = Pose3()


class PlaneMaker:
    """A map maker that keeps the planes of the newest cloud of each mount. They are not kept in the store: a cloud
    later they are there again."""

    def __init__(self, rules: PlaneRules | None = None, *, period_ns: int = 1_000_000_000) -> None:
        self.name = "planes"
        self.sources: frozenset[str] = frozenset()
        self.period_ns = period_ns
        self._rules = rules or PlaneRules()
        self._newest: dict[str, list[dict[str, object]]] = {}
        self._stamp_ns = 0
        self._version = self._told_version = 0

    def take_cloud(self, cloud: CloudOut) -> None:
        """Find its planes and say them in the map; of a cloud whose place in the map is not known nothing is told."""
        if cloud.map_from_base is None:
            return
        planes = extract_planes(cloud.points_m, self._rules, sensor_m=cloud.sensor_m)
        map_from_base = Pose3.from_plane(cloud.map_from_base)
        entries = plane_entries(planes, map_from_base)
        self._newest[cloud.mount] = [{"mount": cloud.mount, **entry} for entry in entries]
        self._stamp_ns = max(self._stamp_ns, cloud.stamp_ns)
        self._version += 1

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Level sweeps say nothing about planes in space."""

    def make(self, view: MapView) -> list[Output]:
        """The planes, if a cloud came since they were last told."""
        if self._version == self._told_version:
            return []
        self._told_version = self._version
        planes = [entry for mount in sorted(self._newest) for entry in self._newest[mount]]
        fields = {"frame": "map", "version": self._version, "planes": planes}
        return [DocumentOut(KEY, self._stamp_ns, fields)]

    def changed_tiles(self) -> list[Tile]:
        return []

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Begins empty."""
        self._newest.clear()


def plane_entries(planes: Planes, frame_from_points: Pose3 = _UNMOVED) -> list[dict[str, object]]:
    """Each plane as umfeld.planes.v1 has it, those of most points first; SI units, moved into another frame."""
    turn = frame_from_points.rotation()
    normal, centre = planes.normal @ turn.T, frame_from_points.apply(planes.centre_m)
    covariance = turn @ planes.covariance @ turn.T
    distance = np.einsum("pi,pi->p", normal, centre)
    normal[distance < 0.0] *= -1.0
    return [
        {
            "normal": _rounded(normal[k], 7),
            "distance_m": abs(round(float(distance[k]), 5)),
            "centre_m": _rounded(centre[k], 4),
            "covariance_m2": [_rounded(row, 8) for row in covariance[k]],
            "rms_m": round(float(planes.rms_m[k]), 5),
            "points": int(planes.count[k]),
            "cells": int(planes.cells[k]),
            "polygon_m": [_rounded(corner, 4) for corner in frame_from_points.apply(planes.polygon[k])],
        }
        for k in range(len(planes))
    ]


def _rounded(values: Sequence[float] | F64, digits: int) -> list[float]:
    return [round(float(v), digits) + 0.0 for v in values]
