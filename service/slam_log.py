"""A recorded log through SLAM: a corrected pose for every scan, and what happened on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.logs import Log, LogScan
from mapping.frames import Pose2, wrap_angles
from mapping.localise.closure_records import WorkResult
from mapping.localise.slam import Slam, run_here
from mapping.localise.slam_records import SlamSettings, without_wheels
from mapping.scan import Scan

F64 = NDArray[np.float64]
Progress = Callable[[int, int], None]

NEAREST_M = 0.05
FINISHING_SHARE = 0.1  # of the bar: what is left to do after the last scan


@dataclass(frozen=True, slots=True)
class SlamRun:
    """What SLAM made of a log. robot_poses: (N, 3) of the scans.

    figures: for the report; their times are those of this thread on its core, not of the wall clock.
    """

    robot_poses: F64
    slam: Slam
    figures: dict[str, object]


def run_slam(
    log: Log, scans: Sequence[LogScan], *, settings: SlamSettings | None = None, progress: Progress | None = None
) -> SlamRun:
    """Robot poses of scans, in the order they were taken; the first stands where the log has it.

    The poses written in the log tell the motion between scans, nothing more; a log whose poses never move has none.
    """
    if settings is None and log.odometry_by_laser:
        settings = without_wheels()
    slam = Slam(settings, start=Pose2(*scans[0].robot_pose))
    has_odometry = _moves(scans)
    mount = Pose2(*log.robot_from_laser)
    total = round(len(scans) * (1.0 + FINISHING_SHARE))
    pending: WorkResult | None = None
    spent_ns = np.zeros(len(scans), dtype=np.int64)
    for index, logged in enumerate(scans):
        began = time.thread_time_ns()
        scan = scan_of(log, logged)
        pending = run_here(slam, scan.stamp_ns, pending)
        slam.add_scan(scan, mount, Pose2(*logged.robot_pose) if has_odometry else None)
        work = slam.take_work()
        if work is not None:
            pending = work.run()
        spent_ns[index] = time.thread_time_ns() - began
        if progress is not None and index % 64 == 0:
            progress(index, total)
    began = time.thread_time_ns()
    slam.finish(
        lambda done, keys: None if progress is None else progress(len(scans) + done * len(scans) // 10 // keys, total)
    )
    finishing_s = (time.thread_time_ns() - began) * 1e-9
    _, poses = slam.trajectory()
    return SlamRun(poses, slam, _figures(slam, scans, spent_ns, finishing_s, has_odometry=has_odometry))


def scan_of(log: Log, logged: LogScan) -> Scan:
    """A log's sweep, taken as swept at once: logs do not tell their beams' times."""
    stamp_ns = round(logged.stamp_s * 1e9)
    return Scan(stamp_ns, 0.0, logged.bearing_rad, logged.range_m, NEAREST_M, log.range_max_m)


def _moves(scans: Sequence[LogScan]) -> bool:
    poses = np.array([scan.robot_pose for scan in scans])
    turned = wrap_angles(poses[:, 2] - poses[0, 2])
    return bool(np.any(np.hypot(*(poses[:, :2] - poses[0, :2]).T) > 1e-6) or np.any(np.abs(turned) > 1e-6))


def _figures(
    slam: Slam, scans: Sequence[LogScan], spent_ns: NDArray[np.int64], finishing_s: float, *, has_odometry: bool
) -> dict[str, object]:
    searched = sum(closure.searched for closure in slam.closures)
    return {
        "odometry": has_odometry,
        "key_scans": slam.keys,
        "closures": len(slam.closures),
        "closures_tracked": len(slam.closures) - searched,
        "closures_searched": searched,
        "corrections": slam.epoch,
        "events": dict(sorted(slam.events.items())),
        "core_seconds": {"scans": round(float(spent_ns.sum()) * 1e-9, 3), "finish": round(finishing_s, 3)},
        "scans_per_second": round(len(scans) / max(1e-9, float(spent_ns.sum()) * 1e-9 + finishing_s), 1),
        "worst_second_scans_per_second": round(worst_second(spent_ns), 1),
        "views_mb": round(slam.memory_bytes / 1e6, 1),
    }


def worst_second(spent_ns: NDArray[np.int64]) -> float:
    """Scans per second of work over the busiest stretch that took at least a second: spent_ns (N,) by scan."""
    ends = np.cumsum(spent_ns)
    starts = ends - spent_ns
    last = np.searchsorted(ends, starts + 1_000_000_000)  # the scan in which that second is over
    whole = last < len(ends)
    if not whole.any():
        return float(len(ends) / max(1e-9, float(ends[-1]) * 1e-9))
    first = np.flatnonzero(whole)
    rates = (last[whole] - first + 1) / ((ends[last[whole]] - starts[first]) * 1e-9)
    return float(rates.min())
