"""One sweep of a range sensor, as maps take it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scan:
    """A sweep in the frame of its sensor, beams in the order they were measured.

    stamp_ns: the first beam.  beam_period_ns: from one beam to the next (0: all at once).
    bearing_rad: (N,) counter-clockwise from the sensor's x axis; a sweep that passes the back runs on beyond pi.
    range_m: (N,) +inf nothing seen up to range_max_m, -inf too close to measure, NaN invalid (nothing known).
    """

    stamp_ns: int
    beam_period_ns: float
    bearing_rad: F64
    range_m: F64
    range_min_m: float
    range_max_m: float

    def points(self) -> F64:
        """(M, 2) end points of the beams that hit something, sensor frame, in beam order."""
        hit = np.isfinite(self.range_m)
        r, a = self.range_m[hit], self.bearing_rad[hit]
        return np.stack((r * np.cos(a), r * np.sin(a)), axis=-1)


def seen_from(at: Pose2, scan: Scan, poses: F64) -> tuple[F64, F64]:
    """Bearings and ranges (N,) of a sweep taken while moving, as they would be from the pose `at`, in the same order.

    poses: (N, 3) of the sensor at each beam, in the frame of `at`. Beams may have changed places there. Those without a
    range keep their status, and turn as the sensor did.
    """
    hit = np.isfinite(scan.range_m)
    bearing = scan.bearing_rad + (poses[:, 2] - at.yaw_rad)
    distance = scan.range_m.copy()
    angle = scan.bearing_rad[hit] + poses[hit, 2]
    reach = scan.range_m[hit][:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    points = at.inverse().apply(poses[hit, :2] + reach)
    seen = np.arctan2(points[:, 1], points[:, 0])
    bearing[hit] += (seen - bearing[hit] + math.pi) % (2.0 * math.pi) - math.pi
    distance[hit] = np.hypot(points[:, 0], points[:, 1])
    return bearing, distance
