"""The line map in the daemon: sweeps in, the document of `map/lines` out when it has changed."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.lines.extract import LineExtractor, LineRules, extract_from_points
from mapping.lines.line_map import LineMap
from mapping.lines.lines import Lines, no_lines
from mapping.scan import Scan

F64 = NDArray[np.float64]

SCHEMA = "umfeld.lines.v1"
_STILL_M = 1e-3
_STILL_RAD = 2e-4
_NANOS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LinesOut:
    """Key map/lines: every line that is sure enough. version: rises when the map changes."""

    stamp_ns: int
    version: int
    lines: Lines
    frame: str = "map"


def lines_json(out: LinesOut, wall_offset_ns: int) -> bytes:
    """The document umfeld.lines.v1. wall_offset_ns: wall clock minus the clock of the stamps.

    Each line: start and end (free space to the right of the walk), angle and distance of its perpendicular with their
    covariance, supporting points, scans that saw it. Metres and radians, at most 300 bytes a line.
    """
    angle, distance, covariance = out.lines.parameters()
    wall_ns = out.stamp_ns + wall_offset_ns
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
            out.lines.start_m, out.lines.end_m, angle, distance, covariance, out.lines.count, out.lines.seen
        )
    ]
    document = {
        "schema": SCHEMA,
        "stamp": {"sec": wall_ns // _NANOS, "nanosec": wall_ns % _NANOS},
        "frame": out.frame,
        "version": out.version,
        "lines": entries,
    }
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode()


class LineLayer:
    """A LineMap as fusion sees a map: fed by sweeps of some lasers, published when it has changed, at most once a
    period. A robot that stands adds nothing: the same wall seen a thousand times from one place is no surer."""

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
        self.line_map = line_map
        self.sources = frozenset(sources)
        self._period_ns, self._min_seen, self._step_m, self._step_rad = period_ns, min_seen, step_m, step_rad
        self._rules = rules or LineRules()
        self._extractors: dict[str, tuple[F64, LineExtractor]] = {}
        self._last: dict[str, Pose2] = {}
        self._told_version = 0
        self._told_ns: int | None = None

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Add one sweep's lines. map_from_sensor: (N, 3) the pose of every beam, or (3,) one for all; a sweep of which
        a pose is not known is left out."""
        poses = np.atleast_2d(np.asarray(map_from_sensor, dtype=np.float64))
        middle = Pose2(*(float(v) for v in poses[len(poses) // 2]))
        if not np.all(np.isfinite(poses)) or not self._has_moved(source, middle):
            return
        lines = self._lines(source, scan, poses, middle)
        if len(lines):
            self._last[source] = middle
            self.line_map.insert(lines, middle)

    def take_round(self, source: str, heard: object, map_from_base: Pose2) -> None:
        """Cones have no lines."""

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[LinesOut]:
        """The map, if it has changed since it was last told and a period has passed."""
        if self.line_map.version == self._told_version:
            return []
        if self._told_ns is not None and now_ns - self._told_ns < self._period_ns:
            return []
        self._told_version, self._told_ns = self.line_map.version, now_ns
        return [LinesOut(stamp_ns, self.line_map.version, self.line_map.lines(min_seen=self._min_seen))]

    def start_anew(self, line_map: LineMap | None = None) -> None:
        """The map was replaced, or begins again."""
        told = self.line_map.version
        self.line_map = line_map or LineMap(self.line_map.rules)
        self.line_map.version = max(self.line_map.version, told) + 1
        self._last.clear()

    def _has_moved(self, source: str, pose: Pose2) -> bool:
        last = self._last.get(source)
        if last is None:
            return True
        way = math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
        return way >= self._step_m or abs(wrap_angle(pose.yaw_rad - last.yaw_rad)) >= self._step_rad

    def _lines(self, source: str, scan: Scan, poses: F64, middle: Pose2) -> Lines:
        """Of a standing sensor by its beams, of a moving one by its points, seen from where it was midway."""
        place, yaw = np.abs(poses[:, :2] - poses[0, :2]).max(), np.abs(poses[:, 2] - poses[0, 2]).max()
        if place < _STILL_M and yaw < _STILL_RAD:
            return self._extractor(source, scan).extract(scan.range_m)
        seen = np.isfinite(scan.range_m) & (scan.range_m > 0.0) & (scan.range_m <= scan.range_max_m)
        if np.count_nonzero(seen) < 2:
            return no_lines()
        at, r = poses[seen], scan.range_m[seen]
        angle = scan.bearing_rad[seen] + at[:, 2]
        points = middle.inverse().apply(at[:, :2] + r[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1))
        if scan.bearing_rad[0] > scan.bearing_rad[-1]:
            points = points[::-1]
        spacing = float(np.median(np.abs(np.diff(scan.bearing_rad))))
        return extract_from_points(points, self._rules, spacing_rad=spacing)

    def _extractor(self, source: str, scan: Scan) -> LineExtractor:
        """Kept while the device's bearings stay the same."""
        known = self._extractors.get(source)
        if known is not None and (known[0] is scan.bearing_rad or np.array_equal(known[0], scan.bearing_rad)):
            return known[1]
        made = LineExtractor(scan.bearing_rad, self._rules, range_min_m=scan.range_min_m, range_max_m=scan.range_max_m)
        self._extractors[source] = (scan.bearing_rad, made)
        return made
