"""Straight lines of posed sweeps, for the makers of maps that are drawn from lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, LineRules, are_in_order, extract_from_points
from mapping.lines.lines import Lines, no_lines
from mapping.scan import Scan

F64 = NDArray[np.float64]

_STILL_M = 1e-3
_STILL_RAD = 2e-4


def middle_of(poses: F64) -> Pose2:
    """(N, 3) the poses of a sweep's beams: the one in the middle."""
    return Pose2(*(float(v) for v in poses[len(poses) // 2]))


class SweepLines:
    """Extracts lines; tables are kept while a device's bearings stay the same."""

    def __init__(self, rules: LineRules | None = None) -> None:
        self._rules = rules or LineRules()
        self._extractors: dict[str, tuple[F64, LineExtractor]] = {}

    def of(self, source: str, scan: Scan, poses: F64) -> Lines:
        """Of a standing sensor by its beams, of a moving one by its points; as seen from where it was midway.

        poses: (N, 3) of every beam, or (1, 3), finite.  Counter-clockwise around the sensor.
        """
        middle, in_order = middle_of(poses), are_in_order(scan.bearing_rad)
        place, yaw = np.abs(poses[:, :2] - poses[0, :2]).max(), np.abs(poses[:, 2] - poses[0, 2]).max()
        if in_order and place < _STILL_M and yaw < _STILL_RAD:
            return self._extractor(source, scan).extract(scan.range_m)
        seen = np.isfinite(scan.range_m) & (scan.range_m > 0.0) & (scan.range_m <= scan.range_max_m)
        if np.count_nonzero(seen) < 2:
            return no_lines()
        at, r = np.broadcast_to(poses, (len(seen), 3))[seen], scan.range_m[seen]
        angle = scan.bearing_rad[seen] + at[:, 2]
        points = middle.inverse().apply(at[:, :2] + r[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1))
        if not in_order:
            points = points[np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable")]
        elif scan.bearing_rad[0] > scan.bearing_rad[-1]:
            points = points[::-1]
        spacing = float(np.median(np.abs(np.diff(scan.bearing_rad))))
        return extract_from_points(points, self._rules, spacing_rad=spacing)

    def _extractor(self, source: str, scan: Scan) -> LineExtractor:
        known = self._extractors.get(source)
        if known is not None and (known[0] is scan.bearing_rad or np.array_equal(known[0], scan.bearing_rad)):
            return known[1]
        made = LineExtractor(scan.bearing_rad, self._rules, range_min_m=scan.range_min_m, range_max_m=scan.range_max_m)
        self._extractors[source] = (scan.bearing_rad, made)
        return made
