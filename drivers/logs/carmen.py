"""CARMEN logs: one message a line, fields separated by blanks, metres and radians, `#` starts a comment.

    ODOM x y theta tv rv accel  STAMPS
    FLASER n r1..rn x y theta odom_x odom_y odom_theta  STAMPS          (RLASER: the rear laser, alike)
    ROBOTLASER1 type start fov resolution max_range accuracy remission_mode n r1..rn m e1..em
                laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side turn_axis  STAMPS
    RAWLASER1 type start fov resolution max_range accuracy remission_mode n r1..rn m e1..em  STAMPS   (no poses)
    STAMPS: stamp host logger_stamp

Beams run from right to left. FLASER does not say its field of view: 180 degrees unless the number of beams tells of
another (`field_of_beams`). Old programs wrote even counts for SICKs (180, 360) that leave out +90 degrees.
Of several lasers in one log the one with the most scans is read; one that is told without poses (RAWLASER beside
ROBOTLASER) only if it has twice as many. Where scans have no poses of their own, or poses that never move, the robot is
where ODOM lines have it at their stamps. Odd lines are counted by reason and skipped.
Source: the format comments at the head of CARMEN's own logs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
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
    mounting_of,
    no_echo_threshold,
    odometry_from,
    path_of,
    posed_by,
    read_lines,
    timed,
    without_echo_from,
    without_fillers,
)

MOST_BEAMS = 20000
FIRST_WORDS = frozenset({"ODOM", "FLASER", "RLASER", "PARAM", "SYNC", "NEFF", "TRUEPOS", "RAWLASER1", "ROBOTLASER1"})


@dataclass(slots=True)
class _Gathered:
    """What the lines of a file said."""

    scans: dict[str, list[LogScan]] = field(default_factory=dict)
    odometry: list[tuple[float, float, float, float]] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    declared_max_m: float | None = None
    particle_filter_lines: int = 0


def looks_like_carmen(head: str) -> bool:
    """Whether the beginning of a text is a CARMEN log's."""
    return any(line.split(None, 1)[0].rstrip("0123456789") in _STEMS for line in head.splitlines() if line.strip())


_STEMS = {word.rstrip("0123456789") for word in FIRST_WORDS}


def read_carmen(path: Path, *, no_echo_m: float | None = None, poses: PoseKind | None = None) -> Log:
    """A CARMEN log, plain or gzip.

    no_echo_m: readings from here on mean "no echo"; None finds it (`no_echo_threshold`).  poses: what the log's poses
    are; None takes them as corrected if a particle filter's NEFF lines stand in the log or its name says "corrected".
    Raises LogError if the file cannot be read or holds no scan.
    """
    lines, provenance = read_lines(path)
    found = _gather(lines)
    if not found.scans:
        raise LogError(f"{path}: no laser scan in it (skipped: {dict(found.skipped) or 'nothing'})")
    measured = without_fillers(_principal_laser(found))
    found.scans.clear()  # each step copies all ranges: no more than two of these are kept at a time
    threshold = no_echo_m
    if threshold is None:
        threshold = no_echo_threshold([s.range_m for s in measured], found.declared_max_m)
    kind = poses or _pose_kind(path, found)
    scans, repaired, made_up = timed(without_echo_from(measured, threshold))
    del measured
    odometry = _own_odometry(found, kind, made_up)
    if not _moves(scans):
        scans = posed_by(scans, odometry)
    return Log(
        scans=tuple(scans),
        odometry=path_of(scans, odometry),
        poses=kind,
        robot_from_laser=mounting_of([s.robot_pose for s in scans], [s.laser_pose for s in scans]),
        range_max_m=_range_max(scans, threshold, found.declared_max_m),
        no_echo_from_m=threshold,
        stamps_repaired=repaired,
        stamps_made_up=made_up,
        provenance=replace(provenance, dialect="carmen", comments=tuple(found.comments[:40])),
        skipped=dict(found.skipped),
    )


def _gather(lines: Iterable[str]) -> _Gathered:
    found = _Gathered()
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if not fields:
            continue
        if line[0] == "#":
            found.comments.append(line[1:].strip())
            continue
        try:
            _take_line(fields, number, found)
        except (ValueError, IndexError, OverflowError):
            found.skipped[f"bad_{_label(fields[0])}"] += 1
    return found


def _label(word: str) -> str:
    return word.lower() if word in FIRST_WORDS or word.startswith(("ROBOTLASER", "RAWLASER")) else "line"


def _take_line(fields: list[str], number: int, found: _Gathered) -> None:
    word = fields[0]
    if word == "ODOM":
        x, y, yaw = _pose(fields[1:4])
        found.odometry.append((_stamp(fields[7]), x, y, yaw))
    elif word in ("FLASER", "RLASER"):
        found.scans.setdefault(word, []).append(_flaser(fields, number))
    elif word.startswith("ROBOTLASER"):
        scan, declared = _robotlaser(fields, number, posed=True)
        _declare(found, declared)
        found.scans.setdefault(word, []).append(scan)
    elif word.startswith("RAWLASER"):
        scan, declared = _robotlaser(fields, number, posed=False)
        _declare(found, declared)
        found.scans.setdefault(word, []).append(scan)
    else:
        found.particle_filter_lines += word == "NEFF"
        found.skipped[word.lower() if word in FIRST_WORDS else "other"] += 1


def _declare(found: _Gathered, declared_max_m: float) -> None:
    if math.isfinite(declared_max_m) and declared_max_m > 0.0:
        found.declared_max_m = max(declared_max_m, found.declared_max_m or 0.0)


def _flaser(fields: list[str], number: int) -> LogScan:
    n = _count(fields[1])
    ranges = _ranges(fields[2 : 2 + n], n)
    tail = fields[2 + n :]
    if len(tail) < 7:
        raise ValueError("the line ends early")
    return LogScan(_stamp(tail[6]), tail[6], field_of_beams(n), ranges, _pose(tail[0:3]), _pose(tail[3:6]), number)


def _robotlaser(fields: list[str], number: int, *, posed: bool) -> tuple[LogScan, float]:
    start, _fov, step, declared = (float(v) for v in fields[2:6])
    n = _count(fields[8])
    ranges = _ranges(fields[9 : 9 + n], n)
    remissions = int(fields[9 + n])
    if not 0 <= remissions <= MOST_BEAMS:
        raise ValueError("impossible number of remissions")
    tail = fields[10 + n + remissions :]
    laser = _pose(tail[0:3]) if posed else (0.0, 0.0, 0.0)
    robot = _pose(tail[3:6]) if posed else (0.0, 0.0, 0.0)
    stamp = tail[11] if posed else tail[0]
    return LogScan(_stamp(stamp), stamp, _bearings(start, step, n), ranges, laser, robot, number), declared


def _count(text: str) -> int:
    n = int(text)
    if not 0 < n <= MOST_BEAMS:
        raise ValueError("impossible number of beams")
    return n


def _ranges(texts: list[str], n: int) -> F64:
    if len(texts) != n:
        raise ValueError("fewer readings than announced")
    return np.array(list(map(float, texts)))


def _pose(texts: Sequence[str]) -> PlanarPose:
    x, y, yaw = (float(v) for v in texts)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(yaw)):
        raise ValueError("a pose that is not finite")
    return (x, y, yaw)


def _stamp(text: str) -> float:
    stamp = float(text)
    if not math.isfinite(stamp):
        raise ValueError("a stamp that is not finite")
    return stamp


@lru_cache(maxsize=256)
def _bearings(start_rad: float, step_rad: float, n: int) -> F64:
    if not (math.isfinite(start_rad) and math.isfinite(step_rad) and step_rad != 0.0):
        raise ValueError("impossible beam angles")
    bearings = _snapped(start_rad) + _snapped(step_rad) * np.arange(n, dtype=np.float64)
    bearings.flags.writeable = False
    return bearings


def _snapped(angle_rad: float) -> float:
    """An angle written with 6 digits, put back on the twelfth of a degree that it stands for, if it is near one."""
    parts = math.degrees(angle_rad) * 12.0
    nearest = round(parts)
    return math.radians(nearest / 12.0) if abs(parts - nearest) < 5e-4 else angle_rad


def field_of_beams(n: int) -> F64:
    """Bearings (n,) of a FLASER's beams, which the line does not give: right to left, read-only.

    101, 201, 401 beams cover 100 degrees (LMS in its narrow mode), 541 and 1081 cover 270 (30 m scanners), 682
    cover the 239.8 degrees of a small Hokuyo; all others 180 degrees: odd counts with both ends, even ones
    without +90.
    """
    if n in (101, 201, 401):
        return _bearings(math.radians(-50.0), math.radians(100.0 / (n - 1)), n)
    if n in (541, 1081):
        return _bearings(math.radians(-135.0), math.radians(270.0 / (n - 1)), n)
    if n == 682:
        return _bearings(math.radians(-119.53125), math.radians(360.0 / 1024.0), n)
    return _bearings(math.radians(-90.0), math.radians(180.0 / (n - n % 2 or 1)), n)


def _principal_laser(found: _Gathered) -> list[LogScan]:
    name = max(found.scans, key=lambda k: len(found.scans[k]) * (1 if k.startswith("RAWLASER") else 2))
    for other, scans in found.scans.items():
        if other != name:
            found.skipped[f"other_laser_{other.lower()}"] += len(scans)
    return found.scans[name]


def _pose_kind(path: Path, found: _Gathered) -> PoseKind:
    corrected = found.particle_filter_lines > 0 or "corrected" in path.name.lower()
    return PoseKind.CORRECTED if corrected else PoseKind.ODOMETRY


def _moves(scans: Sequence[LogScan]) -> bool:
    first = scans[0].robot_pose
    return any(scan.robot_pose != first for scan in scans)


def _own_odometry(found: _Gathered, kind: PoseKind, made_up: bool) -> Odometry:
    """The ODOM lines; of a corrected log none, since there they mix raw and corrected poses."""
    usable = kind is PoseKind.ODOMETRY and not made_up
    table = np.array(found.odometry if usable else []).reshape(-1, 4)
    return odometry_from(table[:, 0], table[:, 1:])


def _range_max(scans: list[LogScan], threshold_m: float, declared_max_m: float | None) -> float:
    if math.isfinite(threshold_m):
        return threshold_m
    seen = max((float(np.max(s.range_m, initial=0.0, where=np.isfinite(s.range_m))) for s in scans), default=0.0)
    return max(seen, declared_max_m or 0.0)
