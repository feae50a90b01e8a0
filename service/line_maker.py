"""The line map in the daemon: sweeps in, the document of `map/lines` out when it has changed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.lines.extract import LineRules
from mapping.lines.gone import Doubts
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines
from mapping.scan import Scan, seen_from
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, Output
from service.sweep_lines import SweepLines, middle_of

F64 = NDArray[np.float64]

KEY = "map/lines"
_NANOS = 1_000_000_000
_LOOK_NS = 80_000_000  # every sweep of a 10 Hz laser, one in four at 40 Hz


def lines_fields(lines: Lines, *, version: int, frame: str = "map") -> dict[str, object]:
    """The document umfeld.lines.v1 but for its schema and stamp. version: rises when the map changes.

    Each line: start and end (free space to the right of the walk), angle and distance of its perpendicular with their
    covariance, supporting points, scans that saw it. Metres and radians, at most 300 bytes a line.
    """
    angle, distance, covariance = lines.parameters()
    entries = [
        {
            "start": [round(float(v), 4) + 0.0 for v in start],
            "end": [round(float(v), 4) + 0.0 for v in end],
            "angle_rad": round(float(a), 6),
            "distance_m": round(float(d), 4),
            "covariance": [float(f"{v:.4g}") for v in (c[0, 0], c[0, 1], c[1, 1])],
            "points": int(points),
            "scans": int(seen),
        }
        for start, end, a, d, c, points, seen in zip(
            lines.start_m, lines.end_m, angle, distance, covariance, lines.count, lines.seen
        )
    ]
    return {"frame": frame, "version": version, "lines": entries}


class LineMaker:
    """A LineMap as a map maker: fed by sweeps of some lasers, published when it has changed. A robot that stands adds
    nothing: the same wall seen a thousand times from one place is no surer. Walls that beams go through are cut out."""

    def __init__(
        self,
        line_map: LineMap,
        sources: Iterable[str],
        *,
        period_ns: int = _NANOS,
        min_seen: int = 2,
        step_m: float = 0.1,
        step_rad: float = math.radians(5.0),
        rules: LineRules | None = None,
    ) -> None:
        """min_seen: scans that must have seen a line before it is published.  step_m, step_rad: how far a sensor must
        have moved or turned for its next sweep to count."""
        self.name = "lines"
        self.line_map = line_map
        self.sources = frozenset(sources)
        self.period_ns = period_ns
        self._min_seen, self._step_m, self._step_rad = min_seen, step_m, step_rad
        self._sweep_lines = SweepLines(rules)
        self._last: dict[str, Pose2] = {}
        self._doubts = Doubts()
        self._looked_ns: dict[str, int] = {}
        self._cut = 0
        self._told_version = 0
        self._kept_version = 0

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Add one sweep's lines. map_from_sensor: (N, 3) the pose of every beam, or (3,) one for all; a sweep of which
        a pose is not known is left out."""
        poses = np.atleast_2d(np.asarray(map_from_sensor, dtype=np.float64))
        if not np.all(np.isfinite(poses)):
            return
        middle = middle_of(poses)
        self._look(source, scan, poses, middle)
        if not self._has_moved(source, middle):
            return
        lines = self._sweep_lines.of(source, scan, poses)
        if len(lines):
            self._last[source] = middle
            self.line_map.insert(lines, middle)

    def make(self, view: MapView) -> list[Output]:
        """The map, if it has changed since it was last told."""
        if self.line_map.version == self._told_version:
            return []
        self._told_version = self.line_map.version
        fields = lines_fields(self.told_lines(), version=self.line_map.version)
        return [DocumentOut(KEY, view.stamp_ns, fields)]

    @property
    def counts(self) -> Mapping[str, int]:
        """How often a line was cut because beams went through."""
        return {"lines.cut": self._cut}

    @property
    def map_version(self) -> int:
        """Rises when the map changes."""
        return self.line_map.version

    def told_lines(self) -> Lines:
        """Those that are published."""
        return self.line_map.lines(min_seen=self._min_seen)

    def changed_tiles(self) -> list[Tile]:
        """The lines that are told, in 20 bytes each."""
        if self.line_map.version == self._kept_version:
            return []
        self._kept_version = self.line_map.version
        return [(0, 0, self.line_map.to_bytes(min_seen=self._min_seen))]

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Go on with stored lines. ValueError if they are damaged."""
        stored = [payload for _, _, payload in tiles]
        self.start_anew(LineMap.from_bytes(stored[0], self.line_map.rules) if stored else None)

    def start_anew(self, line_map: LineMap | None = None) -> None:
        """The map was replaced, or begins again."""
        told = self.line_map.version
        self.line_map = line_map or LineMap(self.line_map.rules)
        self.line_map.version = max(self.line_map.version, told) + 1
        self._last.clear()
        self._doubts = Doubts()
        self._looked_ns.clear()

    def _look(self, source: str, scan: Scan, poses: F64, middle: Pose2) -> None:
        """Whether lines are gone; a robot that stands sees that, too."""
        looked_ns = self._looked_ns.get(source)
        if looked_ns is not None and 0 <= scan.stamp_ns - looked_ns < _LOOK_NS:
            return
        self._looked_ns[source] = scan.stamp_ns
        bearing, distance = (scan.bearing_rad, scan.range_m) if len(poses) == 1 else seen_from(middle, scan, poses)
        self._cut += self._doubts.look(self.line_map, bearing, distance, middle)

    def _has_moved(self, source: str, pose: Pose2) -> bool:
        last = self._last.get(source)
        if last is None:
            return True
        way = math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
        return way >= self._step_m or abs(wrap_angle(pose.yaw_rad - last.yaw_rad)) >= self._step_rad
