"""Take the vehicle's motion during a sweep out of a scan.

A sweep lasts 25 to 200 ms; at 1 m/s and 1 rad/s its last beam is measured centimetres and degrees away from its first.
Every beam has its time, so every beam has its own sensor pose; all are expressed in one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels import motion as kernels
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Deskewed:
    """A scan as if all of it had been measured at once, at scan.stamp_ns, from odom_from_sensor.

    scan: bearings and ranges in the sensor frame of that instant; the order of beams is kept, +inf, -inf and NaN stay
    what they are (a beam without echo is turned, not moved).  origin_m: (N, 2) where each beam really started, in that
    frame.
    """

    scan: Scan
    odom_from_sensor: Pose2
    origin_m: F64


def beam_stamps(scan: Scan) -> NDArray[np.int64]:
    """(N,) when each beam was measured."""
    return np.asarray(scan.stamp_ns + _late_ns(len(scan.bearing_rad), scan.beam_period_ns))


@lru_cache(32)
def _late_ns(beams: int, beam_period_ns: float) -> NDArray[np.int64]:
    """(N,) after the first beam: the same for every sweep of a sensor that keeps its speed."""
    late: NDArray[np.int64] = np.rint(np.arange(beams) * beam_period_ns).astype(np.int64)
    late.setflags(write=False)
    return late


def deskew(scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> Deskewed:
    """Express a scan in the sensor's frame at the time of its middle beam.

    The middle halves the largest displacement of a beam's origin against first or last.
    Raises NotYetError while odometry has not reached the last beam, GoneError when it does not reach back to the first.
    Source: S28 with each beam's own pose; interpolation on SE(2), nothing extrapolated.
    """
    stamps = beam_stamps(scan)
    reference_ns = int(stamps[len(stamps) // 2]) if len(stamps) else scan.stamp_ns
    reference = odom_from_base.at(reference_ns) @ base_from_sensor
    if not len(stamps) or scan.beam_period_ns == 0.0:
        at_once = Scan(reference_ns, 0.0, scan.bearing_rad, scan.range_m, scan.range_min_m, scan.range_max_m)
        return Deskewed(at_once, reference, np.zeros((len(stamps), 2)))
    sensor = kernels.carried(
        odom_from_base.at_many(stamps), base_from_sensor.x_m, base_from_sensor.y_m, base_from_sensor.yaw_rad
    )
    bearing, distance, origin = kernels.seen_at_once(
        sensor, reference.x_m, reference.y_m, reference.yaw_rad, scan.bearing_rad, scan.range_m
    )
    moved = Scan(reference_ns, 0.0, bearing, distance, scan.range_min_m, scan.range_max_m)
    return Deskewed(moved, reference, origin)
