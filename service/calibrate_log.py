"""A recorded log's drive as a calibration: what the wheels and the laser's mount are, beside what was believed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.logs import Log, LogError, PoseKind
from mapping.localise.calibrate import NAMES, Calibration, RobotModel, WheelTicks, calibrate
from mapping.localise.pose_graph import composed_poses
from mapping.localise.relative_motions import RelativeMotions, relative_motions, spread_out, way_between
from mapping.localise.umbmark import SIDE_M, square_end
from service.errors import WrongUsage
from service.recording_log import read_any_log
from service.slam_log import run_slam, scan_of

F64 = NDArray[np.float64]
Progress = Callable[[int, int], None]

VIRTUAL_M_PER_TICK = 1e-5  # of wheels that are worked back from odometry
SAMPLES = 100  # sweeps that tell how far the walls are
NOT_OBSERVABLE = "not observable yet"


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
        ticks = _rising(log.ticks.stamp_s, log.ticks.left.astype(np.float64), log.ticks.right.astype(np.float64))
        believed = (wheels.left_m_per_tick, wheels.right_m_per_tick, wheels.track_width_m)
    else:
        if track_width_m is None:
            raise WrongUsage(f"{path}: has poses but no wheel ticks: add --track-width METRES, as its odometry took it")
        ticks = _ticks_of(log, track_width_m)
        believed = (VIRTUAL_M_PER_TICK, VIRTUAL_M_PER_TICK, track_width_m)
    start = RobotModel(*believed, *log.robot_from_laser)
    run = run_slam(log, log.scans, progress=progress)
    mount = np.tile(np.array(log.robot_from_laser), (len(log.scans), 1))
    lasers = composed_poses(run.robot_poses, mount)
    if way_m is None:
        way_m = way_between([scan_of(log, scan) for scan in log.scans[:: max(1, len(log.scans) // SAMPLES)]])
    chosen = spread_out(lasers, way_m=way_m)
    motions = relative_motions([scan_of(log, log.scans[k]) for k in chosen], lasers[chosen])
    return LogCalibration(calibrate(ticks, motions, start), start, motions, log.ticks is not None)


def _rising(stamp_s: F64, left: F64, right: F64) -> WheelTicks:
    first = np.concatenate(([True], np.diff(stamp_s) > 0.0))
    return WheelTicks(stamp_s[first], left[first], right[first])


def _ticks_of(log: Log, track_width_m: float) -> WheelTicks:
    """Wheels that would have made the log's odometry: each step's arc and turn, forwards where it points forwards."""
    pose = log.odometry.pose
    turn = (np.diff(pose[:, 2]) + np.pi) % (2.0 * np.pi) - np.pi
    dx, dy = np.diff(pose[:, 0]), np.diff(pose[:, 1])
    heading = pose[:-1, 2] + 0.5 * turn
    arc = (dx * np.cos(heading) + dy * np.sin(heading)) / np.sinc(turn / (2.0 * np.pi))
    half = 0.5 * turn * track_width_m
    left, right = (np.concatenate(([0.0], np.cumsum(w))) / VIRTUAL_M_PER_TICK for w in (arc - half, arc + half))
    return _rising(log.odometry.stamp_s, left, right)


def report_of(run: LogCalibration, ticks_per_turn: tuple[float, float] | None = None) -> dict[str, object]:
    """The calibration as a document; numbers that the drive does not tell are null and named.

    ticks_per_turn: of the left and right wheel, to tell radii.
    """
    found, believed = run.found, run.believed.row()
    values: dict[str, object] = {}
    for k, name in enumerate(NAMES):
        row = {"value": found.value(name), "deviation": float(found.deviation[k]), "believed": float(believed[k])}
        values[name] = row
        if ticks_per_turn is not None and k < 2:
            radius = abs(ticks_per_turn[k]) / (2.0 * math.pi)
            values[("wheel_radius_left_m", "wheel_radius_right_m")[k]] = {
                key: None if value is None else abs(value) * radius for key, value in row.items()
            }
    return {
        "values": values,
        "not_observable": [name for name in NAMES if found.value(name) is None],
        "wheels": "ticks" if run.has_ticks else "worked back from odometry: gains and track are factors on it",
        "motions": {
            "used": found.motions,
            "outliers": found.trimmed,
            "sweeps_that_did_not_fit": run.motions.rejected,
            "way_m": round(found.way_m, 2),
            "turn_deg": round(math.degrees(found.turn_rad), 1),
            "median_off_m": round(found.residual_m, 5),
            "median_off_deg": round(math.degrees(found.residual_rad), 4),
        },
        "umbmark": _umbmark(run),
    }


def _umbmark(run: LogCalibration) -> dict[str, object] | None:
    """How far off a square of 4 m would end that is driven by what was believed; None unless the wheels are known."""
    wheels = [run.found.value(name) for name in NAMES[:3]]
    left, right, track = wheels
    if left is None or right is None or track is None:
        return None
    b = run.believed
    ends = {
        name: square_end((left, right, track), (b.left_m_per_tick, b.right_m_per_tick, b.track_width_m), way=way)
        for name, way in (("clockwise_m", -1), ("counter_clockwise_m", 1))
    }
    worst = max(float(np.hypot(*end)) for end in ends.values())
    return {"side_m": SIDE_M, "worst_m": round(worst, 4)} | {
        name: [round(float(v), 4) for v in end] for name, end in ends.items()
    }
