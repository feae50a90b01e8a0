"""Readers of recorded logs: `read_log(path)` knows the dialect by looking and returns one `Log`, whatever wrote it.

Dialects: CARMEN (`.clf`, `.log`), Wean Hall's robotdata, tinySLAM's `.dat`, the electric car's pair of CSV files; each
plain or gzip. A log is read as a whole: Intel's 45 minutes (13,631 scans) take about half a second.

    log = read_log("intel.clf.gz")
    for scan in log.scans:                 # in order of time
        scan.stamp_s, scan.bearing_rad, scan.range_m      # +inf no echo, NaN nothing known
        scan.laser_pose, scan.robot_pose                  # as logged: odometry, or corrected (log.poses)
    log.odometry.stamp_s, log.odometry.pose               # the robot's path by its wheels: (M,), (M, 3)
    log.robot_from_laser, log.range_max_m, log.ticks, log.wheels, log.skipped, log.provenance
"""

from __future__ import annotations

from pathlib import Path

from drivers.logs.carmen import looks_like_carmen, read_carmen
from drivers.logs.log import (
    Log,
    LogError,
    LogScan,
    Odometry,
    PlanarPose,
    PoseKind,
    Provenance,
    Ticks,
    WheelGeometry,
    read_head,
)
from drivers.logs.tinyslam import looks_like_tinyslam, read_tinyslam
from drivers.logs.ual_car import looks_like_ual_car, read_ual_car
from drivers.logs.wean import looks_like_wean, read_wean

__all__ = [
    "Log",
    "LogError",
    "LogScan",
    "Odometry",
    "PlanarPose",
    "PoseKind",
    "Provenance",
    "Ticks",
    "WheelGeometry",
    "read_log",
]

HEAD_CHARACTERS = 65536


def read_log(path: str | Path, *, no_echo_m: float | None = None, poses: PoseKind | None = None) -> Log:
    """The log in a file, its dialect recognised from its first lines.

    no_echo_m: readings from here on mean "no echo"; None finds it in the log.  poses: overrides what the log's poses
    are taken for (CARMEN only).  Raises LogError naming the file and what was expected.
    """
    path = Path(path)
    head = read_head(path, HEAD_CHARACTERS)
    if looks_like_ual_car(head):
        return read_ual_car(path)
    if looks_like_tinyslam(head):
        return read_tinyslam(path)
    if looks_like_wean(head):
        return read_wean(path, no_echo_m=no_echo_m)
    if looks_like_carmen(head):
        return read_carmen(path, no_echo_m=no_echo_m, poses=poses)
    raise LogError(f"{path}: not a log that is known here (CARMEN, robotdata, tinySLAM .dat, encoders/scans .csv)")
