"""Calibration in the daemon: what the wheels and the mounts of the lasers really are, from driving about; it advises.

Sweeps some way apart are laid on one another as soon as they come; every twenty such motions the fit is made anew over
the last minutes. Once there are many, only now and then another one is measured: what changes (a tyre that loses air)
takes minutes. Nothing is kept across a restart.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.localise.calibrate import Calibration, RobotModel, calibrate, rolled_back, turns_as_believed
from mapping.localise.relative_motions import (
    TURN_RAD,
    LaserMotion,
    MotionMeter,
    joined_motions,
    way_between,
)
from mapping.odometry import DriveGeometry
from mapping.scan import Scan, seen_from
from service.calibration_report import advice_of, contradiction_of, report_of
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, OdomOut, Output

log = logging.getLogger(__name__)

F64 = NDArray[np.float64]

KEY = "calibration"

_RECOUNT: Final = 20  # new motions before the fit is made anew
_MOTIONS_MAX: Final = 600  # of each laser
_CALM_AFTER: Final = 400
_CALM_NS: Final = 4_000_000_000  # then so long between two motions
_SAMPLES: Final = 20  # sweeps that tell how far the walls are
_POSE_STEP_NS: Final = 40_000_000
_POSES_MAX: Final = 45_000  # half an hour of driving


@dataclass(slots=True)
class _Laser:
    """What one laser's sweeps have told."""

    base_from_laser: Pose2
    meter: MotionMeter = field(default_factory=MotionMeter)
    motions: deque[LaserMotion] = field(default_factory=lambda: deque(maxlen=_MOTIONS_MAX))
    samples: list[Scan] = field(default_factory=list)
    way_m: float | None = None
    last: Pose2 | None = None  # of the sweep that the next is compared with
    rest_until_ns: int = 0
    new: int = 0
    found: Calibration | None = None
    turns_as_believed: tuple[bool, bool] | None = None


class CalibrationMaker:
    """See the module's docstring. Wants sweeps with the poses of their beams, and every odometry."""

    def __init__(
        self,
        drive: DriveGeometry,
        base_from_laser: Mapping[str, Pose2],
        sections: Mapping[str, str],
        *,
        period_ns: int = 10_000_000_000,
    ) -> None:
        """drive: as odometry takes the wheels.  base_from_laser: where each laser is believed to sit, by source.
        sections: of the configuration that says so, by source."""
        self.name = "calibration"
        self.sources = frozenset(base_from_laser)
        self.period_ns = period_ns
        self._drive = drive
        self._sections = dict(sections)
        self._lasers = {source: _Laser(pose) for source, pose in base_from_laser.items()}
        self._way = _Way()
        self._told: dict[str, tuple[object, ...]] = {}

    def take_odometry(self, odom: OdomOut) -> None:
        """Where the wheels have the base."""
        self._way.add(odom.stamp_ns, odom.odom_from_base)

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Compare a sweep with the one before it, if it was taken far enough from there.

        map_from_sensor: (N, 3) the pose of every beam, or (3,) one for all; a sweep of which a pose is not known is
        left out.
        """
        poses = np.atleast_2d(np.asarray(map_from_sensor, dtype=np.float64))
        if not np.all(np.isfinite(poses)) or len(scan.bearing_rad) < 3:
            return
        laser = self._lasers[source]
        if laser.way_m is None:
            laser.samples.append(scan)
            if len(laser.samples) < _SAMPLES:
                return
            laser.way_m = way_between(laser.samples)
            laser.samples.clear()
        middle = len(poses) // 2
        at = Pose2(*poses[middle].tolist())
        if scan.stamp_ns < laser.rest_until_ns or not _is_apart(laser.last, at, laser.way_m):
            return
        laser.last = at
        stamp_ns = scan.stamp_ns + (round(middle * scan.beam_period_ns) if len(poses) > 1 else 0)
        bearing, distance = (scan.bearing_rad, scan.range_m) if len(poses) == 1 else seen_from(at, scan, poses)
        still = Scan(stamp_ns, 0.0, bearing, distance, scan.range_min_m, scan.range_max_m)
        motion = laser.meter.take(still, at)
        if motion is None:
            return
        laser.motions.append(motion)
        laser.new += 1
        if len(laser.motions) >= _CALM_AFTER:
            laser.rest_until_ns = scan.stamp_ns + _CALM_NS
            self._part(laser)

    def map_moved(self) -> None:
        """The pose jumped: no sweep is compared across it."""
        for laser in self._lasers.values():
            self._part(laser)

    def make(self, view: MapView) -> list[Output]:
        """Fit anew where enough has come; the document if it did."""
        due = [source for source, laser in self._lasers.items() if laser.new >= _RECOUNT]
        for source in due:
            laser = self._lasers[source]
            laser.new = 0
            believed = self._believed(laser)
            ticks = rolled_back(*self._way.rows(), believed)
            motions = joined_motions(tuple(laser.motions), laser.meter.rejected)
            laser.found = calibrate(ticks, motions, believed)
            laser.turns_as_believed = turns_as_believed(ticks, motions, believed)
        return [DocumentOut(KEY, view.stamp_ns, self._fields())] if due else []

    def changed_tiles(self) -> list[Tile]:
        return []

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Nothing is kept."""

    def _part(self, laser: _Laser) -> None:
        laser.last = None
        laser.meter.begin_anew()

    def _believed(self, laser: _Laser) -> RobotModel:
        drive, mount = self._drive, laser.base_from_laser
        wheels = (drive.left_m_per_tick, drive.right_m_per_tick, drive.track_width_m)
        return RobotModel(*wheels, mount.x_m, mount.y_m, mount.yaw_rad)

    def _fields(self) -> dict[str, object]:
        ticks_per_turn = (self._drive.ticks_per_turn_left, self._drive.ticks_per_turn_right)
        lasers: dict[str, object] = {}
        for source, laser in self._lasers.items():
            if laser.found is None:
                continue
            believed = self._believed(laser)
            section = self._sections[source]
            wrong = contradiction_of(laser.turns_as_believed, laser=section, ticks_per_turn=ticks_per_turn)
            advice = []  # with a sign that is wrong the numbers mean nothing
            if wrong is None:
                advice = advice_of(laser.found, believed, laser=section, ticks_per_turn=ticks_per_turn)
            lasers[source] = report_of(
                laser.found, believed, rejected=laser.meter.rejected, has_ticks=True, ticks_per_turn=ticks_per_turn
            ) | {"contradiction": wrong, "advice": advice}
            self._say(source, wrong, advice)
        return {"lasers": lasers}

    def _say(self, source: str, wrong: str | None, advice: list[dict[str, object]]) -> None:
        """One line in the log when the settings change that should be looked at."""
        settings = (wrong,) if wrong is not None else tuple(each["setting"] for each in advice)
        if wrong is not None and settings != self._told.get(source):
            log.warning("calibration by %s: %s", source, wrong)
        elif settings and settings != self._told.get(source):
            lines = ", ".join(
                f"{each['setting']} = {each['value']} ± {each['deviation']} instead of {each['instead_of']}"
                for each in advice
            )
            log.info("calibration by %s: the drive so far says %s", source, lines)
        self._told[source] = settings


class _Way:
    """The newest odometry poses, some 40 ms apart; of a stand its first and last."""

    def __init__(self) -> None:
        self._row = np.zeros((1024, 4))  # seconds, x, y, yaw
        self._count = 0

    def add(self, stamp_ns: int, pose: Pose2) -> None:
        row, n = self._row, self._count
        seconds = stamp_ns * 1e-9
        new = (seconds, pose.x_m, pose.y_m, pose.yaw_rad)
        if n and seconds <= row[n - 1, 0]:
            return
        if n > 1:
            stands = bool(np.array_equal(row[n - 1, 1:], row[n - 2, 1:]) and np.array_equal(row[n - 1, 1:], new[1:]))
            # the newest row gives way to this one while it is nearer to the one before it than a step
            if stands or row[n - 1, 0] - row[n - 2, 0] < _POSE_STEP_NS * 1e-9:
                row[n - 1] = new
                return
        if n == len(row):
            kept = row[n // 4 :] if n >= _POSES_MAX else row
            self._row = np.zeros((min(2 * n, max(_POSES_MAX, n)), 4))
            self._row[: len(kept)] = kept
            n = len(kept)
        self._row[n] = new
        self._count = n + 1

    def rows(self) -> tuple[F64, F64]:
        """Stamps (M,) in seconds and poses (M, 3)."""
        rows = self._row[: self._count]
        return rows[:, 0].copy(), rows[:, 1:].copy()


def _is_apart(last: Pose2 | None, at: Pose2, way_m: float) -> bool:
    if last is None:
        return True
    way = math.hypot(at.x_m - last.x_m, at.y_m - last.y_m)
    return way >= way_m or abs(wrap_angle(at.yaw_rad - last.yaw_rad)) >= TURN_RAD
