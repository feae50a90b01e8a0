"""Logs of the small robot of the tinySLAM program (`.dat`): one row per scan, 706 or more numbers, Hokuyo URG-04LX.

    column 0 time in microseconds (32 bits, wraps); 2, 3 left and right ticks, cumulative; 24..705 ranges in millimetres

The 682 ranges are the URG's steps 44 to 725, from right to left; values below 20 are the sensor's codes, not
distances: nothing known. By the recorder's programs 2,000 ticks make a turn of a wheel of 77 mm radius, half the axle
is 165 mm, the laser sits 145 mm ahead of it. Poses are dead reckoned from the ticks.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.logs.log import (
    F64,
    Log,
    LogError,
    LogScan,
    Odometry,
    PlanarPose,
    PoseKind,
    Ticks,
    WheelGeometry,
    compose,
    dead_reckoning,
    read_lines,
)

FIRST_RANGE, LAST_RANGE = 24, 706
SMALLEST_DISTANCE_MM = 20.0
RANGE_MAX_M = 5.6
ROBOT_FROM_LASER: PlanarPose = (0.145, 0.0, 0.0)
M_PER_TICK = 2.0 * math.pi * 0.077 / 2000.0
WHEELS = WheelGeometry(M_PER_TICK, M_PER_TICK, 0.330)


def looks_like_tinyslam(head: str) -> bool:
    """Whether the beginning of a text is such a log's: a first line of nothing but 706 or more numbers."""
    fields = head.split("\n", 1)[0].split()
    return len(fields) >= LAST_RANGE and all(f.lstrip("-").replace(".", "", 1).isdigit() for f in fields)


def read_tinyslam(path: Path) -> Log:
    """A tinySLAM log. Raises LogError if the file cannot be read or holds no whole row."""
    text, provenance = read_lines(path)
    skipped: Counter[str] = Counter()
    rows: list[F64] = []
    lines: list[int] = []
    for number, line in enumerate(text, 1):
        fields = line.split()
        if len(fields) < LAST_RANGE:
            skipped["short_row"] += bool(fields)
            continue
        try:
            rows.append(np.array(list(map(float, fields[:LAST_RANGE]))))
            lines.append(number)
        except ValueError:
            skipped["bad_row"] += 1
    if not rows:
        raise LogError(f"{path}: no row of {LAST_RANGE} numbers in it")
    table = np.stack(rows)
    stamps = _unwrapped(table[:, 0]) * 1e-6
    left, right = table[:, 2].astype(np.int64), table[:, 3].astype(np.int64)
    poses = dead_reckoning((left - left[0]) * M_PER_TICK, (right - right[0]) * M_PER_TICK, WHEELS.track_width_m)
    scans = tuple(
        _scan(row, float(stamp), (float(pose[0]), float(pose[1]), float(pose[2])), line)
        for row, stamp, pose, line in zip(table, stamps, poses, lines)
    )
    return Log(
        scans=scans,
        odometry=Odometry(stamps, poses),
        poses=PoseKind.ODOMETRY,
        robot_from_laser=ROBOT_FROM_LASER,
        range_max_m=RANGE_MAX_M,
        no_echo_from_m=math.inf,
        stamps_repaired=0,
        stamps_made_up=False,
        provenance=replace(provenance, dialect="tinyslam"),
        ticks=Ticks(stamps, left, right),
        wheels=WHEELS,
        skipped={k: v for k, v in skipped.items() if v},
    )


def _bearings() -> F64:
    bearings: F64 = np.radians((np.arange(44, 726) - 384) * 360.0 / 1024.0)
    bearings.flags.writeable = False
    return bearings


BEARINGS_RAD = _bearings()


def _scan(row: F64, stamp_s: float, robot: PlanarPose, line: int) -> LogScan:
    millimetres = row[FIRST_RANGE:LAST_RANGE]
    ranges = np.where(millimetres >= SMALLEST_DISTANCE_MM, millimetres / 1000.0, np.nan)
    text = f"{stamp_s:.6f}"
    return LogScan(stamp_s, text, BEARINGS_RAD, ranges, compose(robot, ROBOT_FROM_LASER), robot, line)


def _unwrapped(microseconds: F64) -> F64:
    """The 32-bit counter as a rising one."""
    wraps = np.concatenate(([0], np.cumsum(np.diff(microseconds) < -(2.0**31))))
    return np.asarray(microseconds + wraps * 2.0**32)
