"""A recorded log's drive as a calibration: what the wheels and the laser's mount are, beside what was believed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.logs import LogError, PoseKind, WheelGeometry
from mapping.localise.calibrate import Calibration, RobotModel, calibrate, rising, rolled_back
from mapping.localise.pose_graph import composed_poses
from mapping.localise.relative_motions import RelativeMotions, relative_motions, spread_out, way_between
from service.calibration_report import report_of
from service.errors import WrongUsage
from service.recording_log import read_any_log
from service.slam_log import run_slam, scan_of

Progress = Callable[[int, int], None]

VIRTUAL_M_PER_TICK = 1e-5  # of wheels that are worked back from odometry
SAMPLES = 100  # sweeps that tell how far the walls are


@dataclass(frozen=True, slots=True)
class LogCalibration:
    """What a log says.

    believed: what the log's reader takes for granted.  has_ticks: False where the wheels were worked back from the
    log's own odometry; gains and track are then factors on whatever made it.
    """

    found: Calibration
    believed: RobotModel
    motions: RelativeMotions
    has_ticks: bool

    def report(self, ticks_per_turn: tuple[float, float] | None = None) -> dict[str, object]:
        """As a document; ticks_per_turn: of the left and right wheel, to tell radii."""
        return report_of(
            self.found,
            self.believed,
            rejected=self.motions.rejected,
            has_ticks=self.has_ticks,
            ticks_per_turn=ticks_per_turn,
        )


def calibrate_log(
    path: Path, *, way_m: float | None = None, track_width_m: float | None = None, progress: Progress | None = None
) -> LogCalibration:
    """Run SLAM over a log to know which sweeps to compare, compare them without it, and fit.

    track_width_m: believed, for logs without ticks. WrongUsage if the log has corrected poses or none that move.
    """
    try:
        log = read_any_log(path)
    except LogError as error:
        raise WrongUsage(str(error)) from error
    if log.poses is not PoseKind.ODOMETRY or len(log.odometry) < 2:
        raise WrongUsage(f"{path}: holds no odometry, so it says nothing about wheels")
    wheels = log.wheels
    if log.ticks is not None and wheels is not None:
        start = RobotModel(*_row_of(wheels), *log.robot_from_laser)
        ticks = rising(log.ticks.stamp_s, log.ticks.left.astype(np.float64), log.ticks.right.astype(np.float64))
    else:
        if wheels is not None:
            believed = _row_of(wheels)
        elif track_width_m is not None:
            believed = (VIRTUAL_M_PER_TICK, VIRTUAL_M_PER_TICK, track_width_m)
        else:
            raise WrongUsage(f"{path}: has poses but no wheel ticks: add --track-width METRES, as its odometry took it")
        start = RobotModel(*believed, *log.robot_from_laser)
        ticks = rolled_back(log.odometry.stamp_s, log.odometry.pose, start)
    run = run_slam(log, log.scans, progress=progress)
    mount = np.tile(np.array(log.robot_from_laser), (len(log.scans), 1))
    lasers = composed_poses(run.robot_poses, mount)
    if way_m is None:
        way_m = way_between([scan_of(log, scan) for scan in log.scans[:: max(1, len(log.scans) // SAMPLES)]])
    chosen = spread_out(lasers, way_m=way_m)
    motions = relative_motions([scan_of(log, log.scans[k]) for k in chosen], lasers[chosen])
    return LogCalibration(calibrate(ticks, motions, start), start, motions, wheels is not None)


def _row_of(wheels: WheelGeometry) -> tuple[float, float, float]:
    return wheels.left_m_per_tick, wheels.right_m_per_tick, wheels.track_width_m
