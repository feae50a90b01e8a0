"""One sweep of a range sensor, as maps take it."""

from __future__ import annotations

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
    from mapping.kernels import motion as kernels  # here, for programs that only hand scans on

    if poses.shape != (len(scan.bearing_rad), 3):
        raise ValueError(f"{len(scan.bearing_rad)} beams need as many poses, got {poses.shape}")
    bearing, distance = np.empty(len(poses)), np.empty(len(poses))
    kernels.seen_from(
        np.ascontiguousarray(poses), at.x_m, at.y_m, at.yaw_rad, np.ascontiguousarray(scan.bearing_rad),
        np.ascontiguousarray(scan.range_m), bearing, distance,
    )  # fmt: skip
    return bearing, distance
