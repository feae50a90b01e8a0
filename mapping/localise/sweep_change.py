"""Whether a sweep looks as the last one did that was laid on the map, once odometry is believed.

Between two matches a sweep is put where odometry says. If wheels slip, encoders answer late or somebody carries the
robot, what it sees moves although odometry does not: then it has to be matched before it is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels import motion
from mapping.kernels.localise_table import count_changed, fill_depths
from mapping.localise.views import BearingTable
from mapping.scan import Scan

F64 = NDArray[np.float64]

SLACK_M = 0.10
SLACK_SHARE = 0.02  # of the distance
CHANGED_SHARE = 0.2  # 0.2 % of Intel's sweeps change so much while odometry is right, 60 % if it is 3 degrees off
LEAST_JUDGED = 20  # beams


@dataclass(frozen=True, slots=True)
class Depths:
    """A sweep as nearest and farthest surface in the bins of a table (B,); inf and -inf where it has none."""

    table: BearingTable
    nearest_m: F64
    farthest_m: F64


def depths_of(scan: Scan, table: BearingTable) -> Depths:
    """Of a de-skewed sweep, in its sensor's frame [m]; beams without a finite range count for nothing."""
    nearest, farthest = np.empty(table.bins), np.empty(table.bins)
    fill_depths(_row(scan.bearing_rad), _row(scan.range_m), table.frame(), nearest, farthest)
    return Depths(table, nearest, farthest)


def is_changed(scan: Scan, depths: Depths, seen_from_base: F64, base_from_sensor: Pose2) -> bool:
    """Whether the surfaces of a sweep (N beams) lie elsewhere than those seen before.

    seen_from_base: (N, 3) x, y [m], yaw [rad] of the base at each beam, in the frame in which the sensor saw `depths`.
    base_from_sensor: its mount. A beam counts if there was a surface about its bearing; it is changed if it ends
    clearly before or behind that, or meets nothing. False where fewer than LEAST_JUDGED beams count.
    """
    sensor = motion.carried(
        np.ascontiguousarray(seen_from_base), base_from_sensor.x_m, base_from_sensor.y_m, base_from_sensor.yaw_rad
    )
    judged, changed = count_changed(
        _row(scan.bearing_rad), _row(scan.range_m), sensor, max(scan.range_min_m, 0.0),
        depths.table.frame(), depths.nearest_m, depths.farthest_m, SLACK_M, SLACK_SHARE,
    )  # fmt: skip
    return judged >= LEAST_JUDGED and changed > CHANGED_SHARE * judged


def _row(values: F64) -> F64:
    return np.ascontiguousarray(values, dtype=np.float64)
