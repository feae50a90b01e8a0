"""The light localiser: odometry corrected by straight walls, in one Kalman filter (mapping/localise/ekf.py, S46).

For small computers: a scan costs a millisecond or two, nothing runs beside, nothing is drawn again. It follows walls
and closes no loops wider than its own uncertainty; `[slam] method = "scans"` does. What it says depends on what it is
handed alone, so a replay makes the same map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from mapping.deskew import beam_stamps, deskew
from mapping.frames import IDENTITY, Pose2, compose_covariance
from mapping.lines.extract import LineExtractor, are_in_order, extract_from_points
from mapping.lines.lines import Lines
from mapping.localise.ekf import EkfRules, LineEkf, step_covariance
from mapping.odometry import DriveGeometry, OdometryState
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan
from service.fusion import Located, OdometryOnly, StoredTile

F64 = NDArray[np.float64]

MATCH_M = 0.05
MATCH_RAD = math.radians(2.0)
MATCH_NS = 500_000_000
DOUBT_SCANS = 20  # in a row without a known line: then it is said
_LEAST_NOISE: F64 = np.diag([1e-8, 1e-8, 1e-8])


class LineLocaliser(OdometryOnly):
    """See the module's docstring. Without walls in sight it is odometry with its uncertainty."""

    def __init__(
        self,
        sources: Iterable[str],
        geometry: DriveGeometry,
        *,
        start: Pose2 = IDENTITY,
        rules: EkfRules | None = None,
    ) -> None:
        """sources: lasers whose lines count.  geometry: tells how unsure a step of the wheels is."""
        super().__init__(start)
        self._sources = frozenset(sources)
        self._geometry = geometry
        self._rules = rules
        self._ekf: LineEkf | None = None
        self._odom = IDENTITY  # where odometry was when the filter was last corrected
        self._matched_ns: int | None = None
        self._is_broken = False
        self._unmatched = 0
        self._counts = {"slam.scans": 0, "slam.scans_passed": 0, "slam.scans_unordered": 0}

    def take_odometry(self, state: OdometryState) -> None:
        self._is_broken |= state.broken

    def take_scan(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        if sensor not in self._sources:
            return True
        stamps = beam_stamps(scan)
        odom = odom_from_base.at(int(stamps[len(stamps) // 2]))
        if self._matched_ns is not None and scan.stamp_ns <= self._matched_ns:
            self._counts["slam.scans_unordered"] += 1
            return True
        if self._ekf is None:
            self._ekf = LineEkf(self._map_from_odom @ odom, rules=self._rules)
        elif not self._is_due(scan.stamp_ns, odom):
            self._counts["slam.scans_passed"] += 1
            return True
        else:
            self._ekf.predict(*self._step(odom))
        self._odom, self._matched_ns, self._is_broken = odom, scan.stamp_ns, False
        seen = self._ekf.update(_lines_of(deskew(scan, odom_from_base, base_from_sensor).scan), base_from_sensor)
        self._unmatched = 0 if seen.matched else self._unmatched + 1
        self._map_from_odom = self._ekf.pose @ odom.inverse()
        self._counts["slam.scans"] += 1
        return True

    def locate(self, state: OdometryState) -> Located:
        if self._ekf is None:
            return super().locate(state)
        step, noise = self._step(state.odom_from_base)
        covariance = compose_covariance(self._ekf.pose, self._ekf.pose_covariance, step, noise)
        return Located(state.stamp_ns, self._map_from_odom @ state.odom_from_base, self._map_from_odom, covariance)

    def map_was_replaced(self, tiles: Iterable[StoredTile], slam: Iterable[StoredTile]) -> None:
        """Lines belong to the map that is gone."""
        self._ekf, self._matched_ns = None, None

    def begin_map(self, map_from_odom: Pose2) -> None:
        super().begin_map(map_from_odom)
        self._ekf, self._matched_ns = None, None

    def troubles(self) -> list[str]:
        if self._unmatched < DOUBT_SCANS:
            return []
        return [
            f"{self._unmatched} scans in a row show no known wall: the pose is odometry's meanwhile; "
            'where walls are rare or curved take [slam] method = "scans"'
        ]

    def counters(self) -> Mapping[str, int]:
        return {**self._counts, "slam.lines": 0 if self._ekf is None else len(self._ekf)}

    def _is_due(self, stamp_ns: int, odom: Pose2) -> bool:
        if self._is_broken:
            return True
        step = self._odom.inverse() @ odom
        if math.hypot(step.x_m, step.y_m) >= MATCH_M or abs(step.yaw_rad) >= MATCH_RAD:
            return True
        return stamp_ns - (self._matched_ns or 0) >= MATCH_NS

    def _step(self, odom: Pose2) -> tuple[Pose2, F64]:
        """The motion since the last correction and how unsure it is."""
        step = self._odom.inverse() @ odom
        noise = step_covariance(
            step,
            track_width_m=self._geometry.track_width_m,
            travel_noise_m_per_sqrt_m=self._geometry.travel_noise_m_per_sqrt_m,
        )
        if self._is_broken:  # how far it went unseen nobody knows
            noise = noise + np.diag([0.25, 0.25, 0.25])
        return step, noise + _LEAST_NOISE


def _lines_of(scan: Scan) -> Lines:
    """The lines of a de-skewed scan, whose bearings may lie in any order."""
    seen = np.isfinite(scan.range_m) & (scan.range_m >= scan.range_min_m) & (scan.range_m <= scan.range_max_m)
    bearing, reach = scan.bearing_rad[seen], scan.range_m[seen]
    if len(bearing) > 2 and are_in_order(bearing):
        return LineExtractor(bearing).extract(reach)
    order = np.argsort(bearing, kind="stable")
    points = np.stack((reach * np.cos(bearing), reach * np.sin(bearing)), axis=-1)[order]
    spacing = float(np.median(np.abs(np.diff(bearing)))) if len(bearing) > 1 else 0.0
    return extract_from_points(points, spacing_rad=spacing, full_turn=False)
