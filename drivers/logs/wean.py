"""Wean Hall logs ("robotdata"): centimetres and radians, `L` lines for the laser, `O` lines for odometry.

    O x y theta t
    L x y theta laser_x laser_y laser_theta r1..r180 t

180 beams, one degree apart, from right to left; both poses by odometry.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.logs.carmen import field_of_beams
from drivers.logs.log import (
    Log,
    LogError,
    LogScan,
    PlanarPose,
    PoseKind,
    mounting_of,
    no_echo_threshold,
    odometry_from,
    path_of,
    read_lines,
    timed,
    without_echo_from,
    without_fillers,
)


def looks_like_wean(head: str) -> bool:
    """Whether the beginning of a text is such a log's."""
    rows = [line.split() for line in head.splitlines() if line.strip()]
    return bool(rows) and all(r[0] in ("L", "O") for r in rows[:3]) and (len(rows[0]) in (5, 188) or rows[0][0] == "L")


def read_wean(path: Path, *, no_echo_m: float | None = None) -> Log:
    """A Wean Hall log in metres. Raises LogError if the file cannot be read or holds no scan."""
    lines, provenance = read_lines(path)
    scans: list[LogScan] = []
    odometry: list[tuple[float, ...]] = []
    skipped: Counter[str] = Counter()
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if not fields:
            continue
        try:
            if fields[0] == "L":
                scans.append(_scan(fields, number))
            elif fields[0] == "O" and len(fields) >= 5:
                odometry.append((_finite(fields[4]), *_pose_from_cm(fields[1:4])))
            else:
                skipped["other"] += 1
        except (ValueError, IndexError):
            skipped["bad_line"] += 1
    if not scans:
        raise LogError(f"{path}: no laser line (L x y theta ...) in it")
    measured = without_fillers(scans)
    threshold = no_echo_m if no_echo_m is not None else no_echo_threshold([s.range_m for s in measured])
    ordered, repaired, made_up = timed(without_echo_from(measured, threshold))
    table = np.array(odometry).reshape(-1, 4)
    return Log(
        scans=tuple(ordered),
        odometry=path_of(ordered, odometry_from(table[:, 0], table[:, 1:])),
        poses=PoseKind.ODOMETRY,
        robot_from_laser=mounting_of([s.robot_pose for s in scans], [s.laser_pose for s in scans]),
        range_max_m=threshold if math.isfinite(threshold) else max(float(np.nanmax(s.range_m)) for s in scans),
        no_echo_from_m=threshold,
        stamps_repaired=repaired,
        stamps_made_up=made_up,
        provenance=replace(provenance, dialect="wean"),
        skipped=dict(skipped),
    )


def _scan(fields: list[str], number: int) -> LogScan:
    ranges = np.array([float(v) for v in fields[7:-1]]) / 100.0
    if len(ranges) < 2:
        raise ValueError("the line ends early")
    robot, laser = _pose_from_cm(fields[1:4]), _pose_from_cm(fields[4:7])
    return LogScan(_finite(fields[-1]), fields[-1], field_of_beams(len(ranges)), ranges, laser, robot, number)


def _pose_from_cm(texts: list[str]) -> PlanarPose:
    x, y, yaw = (_finite(v) for v in texts)
    return (x / 100.0, y / 100.0, yaw)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError("not finite")
    return value
