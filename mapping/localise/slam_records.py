"""What SLAM is told and what it tells: settings, where a scan was, and what is kept of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.closure_records import Closure, ClosureSettings
from mapping.localise.views import KeptViews

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SlamSettings:
    """Defaults for every robot and building.

    key_m, key_rad: a key scan so often.  references: how many key scans a sweep is laid on, the newest within near_m.
    farthest_m: longer readings are not matched.  odometry_*: standard deviation of a step by odometry: a constant, a
    share of the way and of the turn, all times a factor that is learned from how well odometry agrees with what is
    matched, odometry_factor at first.  gate: a match so many deviations off the prediction must prove that it fits
    better.  work_keys: new key scans that make a piece of work.  lag_s, lag_s_per_key: see
    mapping.localise.slam.
    """

    key_m: float = 0.3
    key_rad: float = math.radians(12.0)
    references: int = 8
    near_m: float = 6.0
    farthest_m: float = 30.0
    odometry_m: float = 0.004
    odometry_share: float = 0.04
    odometry_m_per_rad: float = 0.05
    odometry_rad: float = math.radians(0.2)
    odometry_turn_share: float = 0.05
    odometry_rad_per_m: float = math.radians(0.5)
    odometry_factor: float = 8.0
    gate: float = 6.0
    floor_m: float = 0.008
    floor_rad: float = math.radians(0.1)
    least_points: int = 12
    work_keys: int = 10
    lag_s: float = 1.0
    lag_s_per_key: float = 0.002
    closures: ClosureSettings = field(default_factory=ClosureSettings)


@dataclass(frozen=True, slots=True)
class SlamUpdate:
    """Where the robot was at one scan.

    covariance: (3, 3) of map_from_base, the start of the map taken as exact.  matched: False where the scan fitted
    nothing and the pose is a prediction.  key: the key scan it is tied to; is_key: this scan is a new one.
    epoch: counts corrections of the map: poses of other epochs do not mix.
    """

    stamp_ns: int
    map_from_base: Pose2
    covariance: F64
    matched: bool
    key: int
    is_key: bool
    epoch: int


@dataclass(frozen=True, slots=True)
class SlamState:
    """What is kept of a map, to go on in it: key scans, what was measured between them, closures.

    poses, base_from_sensor: (N, 3).  travel_m, stamps: (N,).  path, information: (N - 1, 3), (N - 1, 3, 3) as measured
    from one key scan to the next.  weight: (C,) of closures.
    """

    views: KeptViews
    poses: F64
    travel_m: F64
    base_from_sensor: F64
    stamps: I64
    path: F64
    information: F64
    closures: tuple[Closure, ...]
    weight: F64
    epoch: int
    next_number: int


class WorkIsDueError(RuntimeError):
    """A scan was added before the result that is due had been applied."""


def without_wheels() -> SlamSettings:
    """Of a robot whose odometry is its laser's: it goes astray where the match does, so it cannot say that a closure is
    surprising."""
    settings = SlamSettings()
    return replace(settings, closures=replace(settings.closures, surprise=math.inf, doubling=math.inf))
