"""The electric car's log: a pair of CSV files, `NAME.encoders.csv` and `NAME.scans.csv`, plain or gzip.

    encoders: time_s,odo_x_m,odo_y_m,odo_phi_rad,left_ticks_increment,right_ticks_increment,speed_m_s,turn_rate_rad_s
    scans:    time_s,range_0_m..range_360_m        (0 = flagged invalid)

361 beams over 180 degrees from right to left (SICK). Right ticks fall when driving forward; 0.00012910 m a tick and
1.266 m between the wheels reproduce the car's own odometry. Where the laser sits on the car is not told: the origin.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.logs.carmen import field_of_beams
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
    read_lines,
)

M_PER_TICK = 0.00012910
WHEELS = WheelGeometry(M_PER_TICK, -M_PER_TICK, 1.266)


def looks_like_ual_car(head: str) -> bool:
    """Whether the beginning of a text is one of the pair."""
    first = head.split("\n", 1)[0]
    return first.startswith("time_s,") and ("left_ticks_increment" in first or "range_0_m" in first)


def read_ual_car(path: Path) -> Log:
    """The log that either file of the pair belongs to. Raises LogError if one is missing or empty."""
    encoder_path, scan_path = _pair(path)
    encoder_text, _ = read_lines(encoder_path)
    scan_text, provenance = read_lines(scan_path)
    skipped: Counter[str] = Counter()
    encoders = _numbers(encoder_text, 8, skipped, "bad_encoder_row")[1]
    scan_lines, scan_rows = _numbers(scan_text, None, skipped, "bad_scan_row")
    if not len(encoders) or not len(scan_rows):
        raise LogError(f"{path}: no usable rows in {encoder_path.name} or {scan_path.name}")
    order = np.argsort(encoders[:, 0], kind="stable")
    odometry = Odometry(encoders[order, 0], encoders[order, 1:4])
    ticks = np.cumsum(encoders[order, 4:6], axis=0).astype(np.int64)
    poses = interpolated(odometry, scan_rows[:, 0])
    scans = [
        _scan(row, (float(p[0]), float(p[1]), float(p[2])), line) for row, p, line in zip(scan_rows, poses, scan_lines)
    ]
    scans.sort(key=lambda s: s.stamp_s)
    return Log(
        scans=tuple(scans),
        odometry=odometry,
        poses=PoseKind.ODOMETRY,
        robot_from_laser=(0.0, 0.0, 0.0),
        range_max_m=max(float(np.nanmax(s.range_m, initial=0.0)) for s in scans),
        no_echo_from_m=math.inf,
        stamps_repaired=0,
        stamps_made_up=False,
        provenance=replace(provenance, dialect="ual-car"),
        ticks=Ticks(odometry.stamp_s, ticks[:, 0], ticks[:, 1]),
        wheels=WHEELS,
        skipped=dict(skipped),
    )


def interpolated(odometry: Odometry, stamp_s: F64) -> F64:
    """Poses (N, 3) at the given times, on the straight line between neighbours; the end poses beyond the ends."""
    yaw = np.unwrap(odometry.pose[:, 2])
    columns = (odometry.pose[:, 0], odometry.pose[:, 1], yaw)
    pose = np.stack([np.interp(stamp_s, odometry.stamp_s, c) for c in columns], axis=-1)
    pose[:, 2] = (pose[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return pose


def _pair(path: Path) -> tuple[Path, Path]:
    for own, other in ((".encoders.csv", ".scans.csv"), (".scans.csv", ".encoders.csv")):
        if own in path.name:
            partners = [path.with_name(path.name.replace(own, other).removesuffix(".gz") + end) for end in ("", ".gz")]
            for partner in partners:
                if partner.exists():
                    return (path, partner) if own == ".encoders.csv" else (partner, path)
            raise LogError(f"{path}: its partner {partners[0].name} is not beside it")
    raise LogError(f"{path}: expected NAME.encoders.csv or NAME.scans.csv")


def _numbers(text: Iterable[str], columns: int | None, skipped: Counter[str], reason: str) -> tuple[list[int], F64]:
    """Rows of numbers below the header, with their line numbers; rows of another width are skipped and counted."""
    lines: list[int] = []
    rows: list[list[float]] = []
    width = columns
    for number, line in enumerate(text, 1):
        if number == 1 or not line.strip():
            continue
        try:
            row = [float(v) for v in line.split(",")]
        except ValueError:
            skipped[reason] += 1
            continue
        width = len(row) if width is None else width
        if len(row) != width or width < 2 or not np.all(np.isfinite(row)):
            skipped[reason] += 1
            continue
        rows.append(row)
        lines.append(number)
    return lines, np.array(rows).reshape(len(rows), -1)


def _scan(row: F64, pose: PlanarPose, line: int) -> LogScan:
    ranges = np.where(row[1:] > 0.0, row[1:], np.nan)
    return LogScan(float(row[0]), f"{row[0]:.6f}", field_of_beams(len(ranges)), ranges, pose, pose, line)
